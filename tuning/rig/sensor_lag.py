"""Reading of a force sensor with a first-order lag, T_s y' = F - y, over stretches of smooth motion.

Within a stretch the motion is the cubic Hermite polynomial through its exact ends. The contact begins and
ends at roots of that cubic, and the force in between is interpolated by parabolas, whose lag is exact.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from jaxhil.contact.float_law import FloatLaw

FORCE_PARABOLAS = 2  # number of parabolas that interpolate the force of one stretch
MAX_ROOT_STEPS = 50  # largest number of steps of false position
ROOT_TOLERANCE = 1e-13  # tolerance of a root as a fraction of a stretch
MIN_CLOSED_FORM_DURATION = (
    1e-2  # duration of an arc [time constants] below which the closed form suffers from cancellation
)


class MotionState(NamedTuple):
    """Position [m] and velocity [m/s]."""

    position: float
    velocity: float


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
    """Return the lag's output [N] at the end of a stretch of `duration` [s], from `reading` [N] at its start.

    The surfaces are at 0 and, with the opposite direction, at -clearance [m], which may be infinite.
    `deepest` [m] is the deepest penetration up to the start of the stretch, for laws with memory.
    """
    if duration <= 0.0:
        return reading
    side, surface = _reached_surface(start.position, end.position, clearance)
    if side == 0.0:
        return reading * math.exp(-duration / time_constant)
    stretch = _ContactInterval(_CubicPath(start, end, duration), side, surface, law, deepest)
    first, last, forces = stretch.pressed()
    if not first < last:
        return reading * math.exp(-duration / time_constant)
    reading *= math.exp(-first * duration / time_constant)
    span = (last - first) * duration / FORCE_PARABOLAS / time_constant
    decay, straight, bow = _parabola_weights(span)
    for i in range(0, 2 * FORCE_PARABOLAS, 2):
        begin, middle, finish = forces[i : i + 3]
        bend = middle - (begin + finish) / 2
        reading = reading * decay + finish - begin * decay - (finish - begin) * straight + bend * bow
    return reading * math.exp(-(1.0 - last) * duration / time_constant)


def deepest_penetration(start: MotionState, end: MotionState, duration: float, clearance: float) -> float:
    """Return the deepest penetration [m] of either surface along a smooth stretch of motion; 0 if none."""
    side, surface = _reached_surface(start.position, end.position, clearance)
    if side == 0.0:
        return 0.0
    path = _CubicPath(start, end, duration)

    def depth(s: float) -> float:
        return side * (path.position(s) - surface)

    return max(depth(0.0), depth(1.0), _turning_point(path, depth, side)[1], 0.0)


class _ContactInterval:
    """Contact force along one stretch of motion at one surface, as a function of its fraction s.

    A law with memory uses the deepest penetration up to s.
    """

    def __init__(
        self, path: "_CubicPath", side: float, surface: float, law: FloatLaw, deepest: float
    ) -> None:
        self._path, self._side, self._surface, self._law = path, side, surface, law
        self._turn, bottom = _turning_point(path, self._depth, side) if law.loaded else (1.0, 0.0)
        self._before = max(deepest, self._depth(0.0))
        self._bottom = max(self._before, bottom)

    def pressed(self) -> tuple[float, float, list[float]]:
        """Return the interval of s with a force, and its values [N] at the ends and middles of the arcs."""
        enters, leaves = _positive_interval(self._depth)
        catches, lets_go = _positive_interval(self._hold)
        first, last = max(enters, catches), min(leaves, lets_go)
        if not first < last:
            return first, last, []
        edges = {
            0: enters > 0.0 and enters >= catches,
            2 * FORCE_PARABOLAS: leaves < 1.0 and leaves <= lets_go,
        }
        forces = []
        for i in range(2 * FORCE_PARABOLAS + 1):
            s = first + (last - first) * (i / (2 * FORCE_PARABOLAS))
            forces.append(self._side * self._force(s, edges.get(i, False)))
        return first, last, forces

    def _depth(self, s: float) -> float:
        return self._side * (self._path.position(s) - self._surface)

    def _law_at(self, s: float) -> FloatLaw:
        if self._law.loaded is None:
            return self._law
        return self._law.loaded(self._bottom if s > self._turn else max(self._before, self._depth(s)))

    def _hold(self, s: float) -> float:
        return self._law_at(s).hold(self._depth(s), self._side * self._path.velocity(s))

    def _force(self, s: float, at_surface: bool) -> float:
        rate = self._side * self._path.velocity(s)
        if at_surface:
            # At the surface the force is the limit from inside.
            return self._law.edge(rate)
        penetration = self._depth(s)
        return self._law_at(s).force(penetration, rate) if penetration > 0.0 else 0.0


def _reached_surface(start: float, end: float, clearance: float) -> tuple[float, float]:
    """Return side (1, -1, or 0 for none) and position [m] of the surface that a stretch reaches."""
    for position in (start, end):
        if position > 0.0:
            return 1.0, 0.0
        if position < -clearance:
            return -1.0, -clearance
    return 0.0, 0.0


def _turning_point(path: "_CubicPath", depth: Callable[[float], float], side: float) -> tuple[float, float]:
    """Return fraction and depth [m] of the turning point of a stretch; those of its end if there is none."""

    def inward(s: float) -> float:
        return side * path.velocity(s)

    at_0, at_1 = inward(0.0), inward(1.0)
    turn = _find_root(inward, at_0, at_1) if at_0 > 0.0 > at_1 else 1.0
    return turn, depth(turn)


class _CubicPath:
    """Cubic Hermite polynomial through both ends of a stretch, over its fraction s."""

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
    """Return the interval of s in [0, 1] in which a function with at most one sign change is positive."""
    at_0, at_1 = function(0.0), function(1.0)
    if at_0 <= 0.0 and at_1 <= 0.0:
        return 1.0, 0.0
    if at_0 > 0.0 and at_1 > 0.0:
        return 0.0, 1.0
    root = _find_root(function, at_0, at_1)
    return (0.0, root) if at_0 > 0.0 else (root, 1.0)


def _find_root(function: Callable[[float], float], at_0: float, at_1: float) -> float:
    """Return the root of a function in [0, 1] by false position with the Illinois modification."""
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


def _parabola_weights(span: float) -> tuple[float, float, float]:
    """Return three weights of an arc of `span` time constants for the exact lag of a parabola.

    They are the decay of y, the mean of that decay, and the response to 4 s/span (1 - s/span).
    """
    decay = math.exp(-span)
    if span < MIN_CLOSED_FORM_DURATION:
        mean = -math.expm1(-span) / span if span > 0.0 else 1.0
        bow = 4 * span * (1 / 6 - span * (1 / 12 - span * (1 / 40 - span / 180)))
        return decay, mean, bow
    mean = -math.expm1(-span) / span
    return decay, mean, 4 * (mean - 2 * (mean - decay) / span)
