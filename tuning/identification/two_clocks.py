"""Forces that were logged by a clock of their own: how fast it is, from touches that lie apart in time.

A constant between two clocks cannot be told from the force sensor's delay. A rate can: the time by which
forces come after the motion then grows from touch to touch. It is followed in two steps, since over hours
clocks part by more than the longest delay that is looked for: first by the middle of each touch's forces
after its deepest place, then by what a law fitted to all touches leaves of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.contact_laws import Law
from tuning.identification.contact_problem import LONGEST, Problem, Readings
from tuning.identification.law_choice import at_onset, judge, quick
from tuning.identification.motion import Motion
from tuning.identification.rational import Model
from tuning.identification.records import Run, Timing

FEWEST = 3  # touches
LOUD = 5.0  # standard deviations of the noise, beyond which a force is one
MIDDLE = 0.5 * LONGEST  # s, where the delay is brought that clocks make meaningless
STEP = 2.5e-4  # s, of differences by the delay
ROUNDS = 6
CLOSE = 1e-6  # s, of all touches: a step below it is the last one
UNTOLD = 'timing.clock: found "separate", allowed "stamps" or "index" where a mechanism is told'


@dataclass(frozen=True)
class Drift:
    """Of the forces' clock against the drives'."""

    rate: float  # seconds that it gains a second
    std: float  # of the rate
    late: np.ndarray  # s, what it adds to the delay of each run, up to a constant


def refuse(timing: Timing) -> None:
    """Raises `InputError` for logs of two clocks: what their constant is nobody knows."""
    if timing.two_clocks:
        raise InputError(UNTOLD)


def drift(
    runs: Sequence[Run],
    model: Model,
    timing: Timing,
    readings: Readings,
    law: Law | str | None,
    plane: float | None,
) -> Drift:
    """By the trend of the touches' times. Raises `InputError` for too few touches, or all at one time."""
    period, longest = timing.control_period, LONGEST + timing.control_period
    time = np.array([run.begin + period * run.tick[len(run.tick) // 2] for run in runs])
    touches = np.array([run.kind in ("contact", "tap") for run in runs])
    if touches.sum() < FEWEST or not np.ptp(time[touches]):
        found = f"{touches.sum()} touches within {np.ptp(time[touches]) if touches.any() else 0:g} s"
        allowed = f"{FEWEST} apart by their stamps"
        raise InputError(f'timing.clock: found "separate" and {found}, allowed {allowed}')
    time = time - time.mean()
    late = _roughly(Motion(model, runs, timing, longest), readings, time, touches)
    rate = std = 0.0
    for _ in range(ROUNDS):
        motion = Motion(model, runs, timing, longest, late)
        if not isinstance(law, Law):
            law = judge(motion, readings, plane, None if law is None else (law,))[0].law
        problem = Problem(motion, readings, law, plane)
        delay, place, _ = quick(problem)
        off, variance = differences(problem, delay, place, problem.at(delay, place).coefficients)
        step, std = slope(off, 1.0 / variance, time)
        late = late + step * time
        if abs(step) * np.ptp(time) < CLOSE:
            break
    if not std * np.ptp(time) < LONGEST:
        allowed = "touches whose forces are within their runs"
        raise InputError(f'timing.clock: found "separate" and forces that follow no touch, allowed {allowed}')
    rate = float(np.ptp(late) / np.ptp(time) * np.sign(np.dot(late - late.mean(), time)))
    return Drift(rate, std, late)


def _roughly(motion: Motion, readings: Readings, time: np.ndarray, touches: np.ndarray) -> np.ndarray:
    """What the clock adds to the delay of each run, by the middle of its force after its deepest place."""
    level = np.median(readings.force[readings.counts])
    above = np.where(readings.counts, np.abs(readings.force - level), 0.0)
    weight = np.where(above > LOUD * readings.std, above, 0.0) ** 2
    row = np.arange(len(weight))[:, None]
    middle = np.sum(row * weight, axis=0) / np.maximum(weight.sum(axis=0), 1e-300)
    position, _ = motion.at(0.0)
    off = motion.period * (middle - np.argmax(np.where(readings.counts, position, -np.inf), axis=0))
    pairs = combinations(np.flatnonzero(touches & (weight.sum(axis=0) > 0.0)), 2)
    rates = [(off[j] - off[i]) / (time[j] - time[i]) for i, j in pairs if time[j] != time[i]]
    rate = float(np.median(rates)) if rates else 0.0
    return rate * time + float(np.median((off - rate * time)[touches])) - MIDDLE


def differences(
    problem: Problem, delay: float, plane: float, coefficients: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """By how much the readings of each run come later than by these numbers [s], and the variance of that.

    Rows at an onset do not count: damped contact begins with a jump, whose place in a row is chance."""
    readings, sooner = problem.readings, max(delay - STEP, problem.shortest)
    counts = readings.counts & ~at_onset(problem.motion, readings, (delay, plane, 0.0))
    after, before = (problem.force(one, plane, coefficients) for one in (delay + STEP, sooner))
    grows = problem.whiten(after - before) / (delay + STEP - sooner)
    left = problem.whiten(readings.force - problem.force(delay, plane, coefficients))
    grows, left = (np.where(counts, one, 0.0) / readings.std for one in (grows, left))
    power = np.maximum(np.sum(grows**2, axis=0), 1e-300)
    return np.sum(grows * left, axis=0) / power, 1.0 / power


def slope(values: np.ndarray, weight: np.ndarray, place: np.ndarray) -> tuple[float, float]:
    """Of a line through values, and its standard deviation; weights are over the values' variance, and where
    the values scatter by more, so does the slope."""
    from_centre = place - np.average(place, weights=weight)
    spread = float(np.sum(weight * from_centre**2))
    found = float(np.sum(weight * from_centre * values)) / spread
    scatter = values - np.average(values, weights=weight) - found * from_centre
    inflation = max(1.0, float(np.sum(weight * scatter**2)) / max(len(values) - 2, 1))
    return found, float(np.sqrt(inflation / spread))
