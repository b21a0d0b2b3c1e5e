"""Response of a force sensor with a lag, T_s y' = F - y, or a filter, during segments of smooth motion.

Within a segment, a cubic Hermite polynomial through the exact positions and velocities at both ends
interpolates the motion. The contact starts and ends at roots of this polynomial. In between, parabolas
interpolate the force, and the response of the lag to each parabola is exact.
"""

import cmath
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from jaxhil.contact.float_law import FloatLaw

Number = TypeVar("Number", float, complex)
FORCE_PARABOLAS = 2  # number of parabolas that interpolate the force in one segment
MAX_ROOT_STEPS = 50  # largest number of iterations of the root finder
ROOT_TOLERANCE = 1e-13  # largest error of a root [fraction of the segment]
# Shortest duration of a parabola [time constants] at which the closed form is accurate (cancellation).
MIN_CLOSED_FORM_DURATION = 1e-2


class MotionState(NamedTuple):
    """Position and velocity of the docking mechanism relative to the contact surface."""

    position: float  # [m]
    velocity: float  # [m/s]


def apply_sensor_lag(
    reading: float,
    law: FloatLaw,
    clearance: float,
    start: MotionState,
    end: MotionState,
    duration: float,
    time_constant: float,
    deepest: float = 0.0,
) -> float:
    """Return the output of the sensor's first-order lag [N] at the end of a segment of motion.

    Args:
        reading: output of the lag at the start of the segment [N].
        law: contact law.
        clearance: distance between the two surfaces [m], at 0 and -clearance; infinite for one surface.
        start: motion at the start of the segment.
        end: motion at the end of the segment.
        duration: duration of the segment [s].
        time_constant: time constant T_s of the lag [s].
        deepest: deepest penetration before the segment [m], for contact laws with memory.
    """
    forces = _find_forces(law, clearance, start, end, duration, deepest)
    return _respond(reading, forces, duration, time_constant)


def apply_sensor_filter(
    modes: list[complex],
    law: FloatLaw,
    clearance: float,
    start: MotionState,
    end: MotionState,
    duration: float,
    rates: list[complex],
    deepest: float = 0.0,
) -> list[complex]:
    """Return the outputs of a filter's modes [N] at the end of a segment of motion.

    Every mode is a first-order lag with a complex rate (`jaxhil.mechanism.sensor_filter`).

    Args:
        modes: outputs of the modes at the start of the segment [N].
        law: contact law.
        clearance: distance between the two surfaces [m]; infinite for one surface.
        start: motion at the start of the segment.
        end: motion at the end of the segment.
        duration: duration of the segment [s].
        rates: rate of each mode [1/s].
        deepest: deepest penetration before the segment [m], for contact laws with memory.
    """
    forces = _find_forces(law, clearance, start, end, duration, deepest)
    return [_respond(mode, forces, duration, 1.0 / rate) for mode, rate in zip(modes, rates, strict=True)]


def _find_forces(
    law: FloatLaw,
    clearance: float,
    start: MotionState,
    end: MotionState,
    duration: float,
    deepest: float,
) -> tuple[float, float, list[float]]:
    """Return the fractions of a segment at which the force starts and ends, and its values [N] in between.

    The values are equidistant. Without a contact force, their list is empty.
    """
    side, surface = _reached_surface(start.position, end.position, clearance)
    if duration <= 0.0 or side == 0.0:
        return 1.0, 0.0, []
    return _ContactInterval(_CubicPath(start, end, duration), side, surface, law, deepest).forces()


def _respond(
    reading: Number, interval: tuple[float, float, list[float]], duration: float, time_constant: Number
) -> Number:
    """Return the output [N] of a first-order lag at the end of a segment of motion.

    `reading` is the lag's output at the start, and `interval` the result of `_find_forces`.
    """
    if duration <= 0.0:
        return reading
    first, last, forces = interval
    if not first < last:
        return reading * _exp(-duration / time_constant)
    reading *= _exp(-first * duration / time_constant)
    span = (last - first) * duration / FORCE_PARABOLAS / time_constant
    decay, mean_decay, parabola_response = _parabola_weights(span)
    for i in range(0, 2 * FORCE_PARABOLAS, 2):
        begin, middle, finish = forces[i : i + 3]
        bend = middle - (begin + finish) / 2
        reading = reading * decay + finish - begin * decay - (finish - begin) * mean_decay
        reading += bend * parabola_response
    return reading * _exp(-(1.0 - last) * duration / time_constant)


def deepest_penetration(start: MotionState, end: MotionState, duration: float, clearance: float) -> float:
    """Return the deepest penetration [m] during a segment of smooth motion; 0 without contact."""
    side, surface = _reached_surface(start.position, end.position, clearance)
    if side == 0.0:
        return 0.0
    path = _CubicPath(start, end, duration)

    def depth(s: float) -> float:
        return side * (path.position(s) - surface)

    return max(depth(0.0), depth(1.0), _turning_point(path, depth, side)[1], 0.0)


class _ContactInterval:
    """Contact force during one segment of motion, as a function of the elapsed fraction s of the segment.

    A contact law with memory receives the deepest penetration up to s.
    """

    def __init__(
        self, path: "_CubicPath", side: float, surface: float, law: FloatLaw, deepest: float
    ) -> None:
        self._path, self._side, self._surface, self._law = path, side, surface, law
        self._turn, bottom = _turning_point(path, self._depth, side) if law.loaded_law else (1.0, 0.0)
        self._before = max(deepest, self._depth(0.0))
        self._bottom = max(self._before, bottom)

    def forces(self) -> tuple[float, float, list[float]]:
        """Return start and end of the force, and its values [N] at equidistant nodes in between.

        Start and end are fractions s of the segment's duration. Parabola i = 0, 1, ... of the
        interpolation passes through the nodes 2 i, 2 i + 1 and 2 i + 2.
        """
        enters, leaves = _positive_interval(self._depth)
        force_starts, force_ends = _positive_interval(self._hold)
        first, last = max(enters, force_starts), min(leaves, force_ends)
        if not first < last:
            return first, last, []
        is_at_surface = {
            0: enters > 0.0 and enters >= force_starts,
            2 * FORCE_PARABOLAS: leaves < 1.0 and leaves <= force_ends,
        }
        forces = []
        for i in range(2 * FORCE_PARABOLAS + 1):
            s = first + (last - first) * (i / (2 * FORCE_PARABOLAS))
            forces.append(self._side * self._force(s, is_at_surface.get(i, False)))
        return first, last, forces

    def _depth(self, s: float) -> float:
        return self._side * (self._path.position(s) - self._surface)

    def _law_at(self, s: float) -> FloatLaw:
        if self._law.loaded_law is None:
            return self._law
        return self._law.loaded_law(self._bottom if s > self._turn else max(self._before, self._depth(s)))

    def _hold(self, s: float) -> float:
        return self._law_at(s).separation_function(self._depth(s), self._side * self._path.velocity(s))

    def _force(self, s: float, at_surface: bool) -> float:
        rate = self._side * self._path.velocity(s)
        if at_surface:
            # At the surface, use the limit of the force from inside the contact.
            return self._law.onset_force(rate)
        penetration = self._depth(s)
        return self._law_at(s).force(penetration, rate) if penetration > 0.0 else 0.0


def _reached_surface(start: float, end: float, clearance: float) -> tuple[float, float]:
    """Return direction (1, -1; 0 for none) and position [m] of the surface that a segment penetrates.

    The surfaces are at 0 and -`clearance`; `start` and `end` are positions at the segment's ends [m].
    """
    for position in (start, end):
        if position > 0.0:
            return 1.0, 0.0
        if position < -clearance:
            return -1.0, -clearance
    return 0.0, 0.0


def _turning_point(path: "_CubicPath", depth: Callable[[float], float], side: float) -> tuple[float, float]:
    """Return the fraction s of a segment at which the penetration stops growing, and the penetration there.

    If this does not happen in the segment, s is 1, its end. `side` is the direction into the surface (1, -1).
    """

    def inward(s: float) -> float:
        return side * path.velocity(s)

    at_0, at_1 = inward(0.0), inward(1.0)
    turn = _find_root(inward, at_0, at_1) if at_0 > 0.0 > at_1 else 1.0
    return turn, depth(turn)


class _CubicPath:
    """Motion during a segment, as a cubic Hermite polynomial of the elapsed fraction s of the segment."""

    __slots__ = ("_bend", "_duration", "_rate", "_start", "_twist")

    def __init__(self, start: MotionState, end: MotionState, duration: float) -> None:
        rate, last = start.velocity * duration, end.velocity * duration
        moved = end.position - start.position
        self._start, self._rate, self._duration = start.position, rate, duration
        self._bend, self._twist = 3 * moved - 2 * rate - last, rate + last - 2 * moved

    def position(self, s: float) -> float:
        return self._start + s * (self._rate + s * (self._bend + s * self._twist))

    def velocity(self, s: float) -> float:
        return (self._rate + s * (2 * self._bend + s * 3 * self._twist)) / self._duration


def _positive_interval(function: Callable[[float], float]) -> tuple[float, float]:
    """Return the interval in [0, 1] where `function` is positive; the function has at most one root."""
    at_0, at_1 = function(0.0), function(1.0)
    if at_0 <= 0.0 and at_1 <= 0.0:
        return 1.0, 0.0
    if at_0 > 0.0 and at_1 > 0.0:
        return 0.0, 1.0
    root = _find_root(function, at_0, at_1)
    return (0.0, root) if at_0 > 0.0 else (root, 1.0)


def _find_root(function: Callable[[float], float], at_0: float, at_1: float) -> float:
    """Return the root of `function` in [0, 1] by the Illinois variant of the false-position method.

    `at_0` and `at_1` are the values of the function at 0 and 1, with opposite signs.
    """
    low, high, last_side = 0.0, 1.0, 0
    s = 1.0
    for _ in range(MAX_ROOT_STEPS):
        before, s = s, low + (high - low) * at_0 / (at_0 - at_1)
        value = function(s)
        if value == 0.0 or abs(s - before) < ROOT_TOLERANCE:
            break
        if (value > 0.0) == (at_1 > 0.0):
            high, at_1 = s, value
            at_0 = at_0 / 2 if last_side == 1 else at_0
            last_side = 1
        else:
            low, at_0 = s, value
            at_1 = at_1 / 2 if last_side == -1 else at_1
            last_side = -1
    return s


def _parabola_weights(span: Number) -> tuple[Number, Number, Number]:
    """Return three coefficients of the lag's exact response to a parabola that lasts `span` time constants.

    The first is the decay exp(-span) of the initial value. The second is the mean of exp(-t) for t from 0 to
    span. The third is the response at t = span to the input 4 (t/span) (1 - t/span).
    """
    decay = _exp(-span)
    if abs(span) < MIN_CLOSED_FORM_DURATION:
        parabola_response = 4 * span * (1 / 6 - span * (1 / 12 - span * (1 / 40 - span / 180)))
        return decay, _mean_decay(span), parabola_response
    mean = _mean_decay(span)
    return decay, mean, 4 * (mean - 2 * (mean - decay) / span)


def _mean_decay(span: Number) -> Number:
    """Return the mean of exp(-t) for t from 0 to span."""
    if isinstance(span, complex):
        if abs(span) < MIN_CLOSED_FORM_DURATION:
            return 1 - span * (1 / 2 - span * (1 / 6 - span * (1 / 24 - span * (1 / 120 - span / 720))))
        return (1 - cmath.exp(-span)) / span
    return -math.expm1(-span) / span if span > 0.0 else 1.0


def _exp(exponent: Any) -> Any:
    return cmath.exp(exponent) if isinstance(exponent, complex) else math.exp(exponent)
