"""Rate of a separate force clock relative to the drives' clock, from contacts at different times.

A constant offset between the clocks cannot be separated from the force sensor's delay. A rate can: the time
between motion and force then grows from contact to contact. Over hours the clocks diverge by more than the
longest delay of a search. So the rate is estimated in two steps: first from the mean time of each contact's
force after its deepest point, then from the residuals of a law fitted to all contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.contact_laws import Law
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.force_readings import ForceReadings
from tuning.identification.law_choice import choose_contact_law, flag_rows_near_edges, search_coarsely
from tuning.identification.motion import MotionResponse
from tuning.identification.rational import MotionModel
from tuning.identification.records import CampaignTiming, LoggedRun

MIN_CONTACTS_FOR_DRIFT = 3  # contacts
FORCE_DETECTION_SIGMAS = 5.0  # standard deviations of the noise, above which a force is detected
CENTRAL_DELAY = (
    0.5 * MAX_FORCE_DELAY
)  # s, delay that the data are shifted to, since the offset of the clocks is arbitrary
DELAY_DIFFERENCE_STEP = 2.5e-4  # s, step of finite differences by the delay
DRIFT_ITERATIONS = 6  # iterations of law and rate
DRIFT_TOLERANCE = 1e-6  # s, over all contacts; a smaller step ends the iteration
SEPARATE_CLOCK_MESSAGE = (
    'timing.clock: found "separate", expected "stamps" or "index" where a mechanism is told'
)


@dataclass(frozen=True)
class ClockDrift:
    """Drift of the forces' clock relative to the drives' clock."""

    rate: float  # s/s, time that the forces' clock gains
    std: float  # standard deviation of the rate
    late: np.ndarray  # s, delay that it adds in each run, up to a constant


def reject_separate_clocks(timing: CampaignTiming) -> None:
    """Raise `InputError` for logs with two clocks, because their constant offset is unknown."""
    if timing.two_clocks:
        raise InputError(SEPARATE_CLOCK_MESSAGE)


def estimate_clock_drift(
    runs: Sequence[LoggedRun],
    model: MotionModel,
    timing: CampaignTiming,
    readings: ForceReadings,
    law: Law | str | None,
    plane: float | None,
) -> ClockDrift:
    """Return the drift of the forces' clock from the trend of the contacts' times.

    Raises:
        InputError: If there are too few contacts, or all at one time.
    """
    period, longest = timing.control_period, MAX_FORCE_DELAY + timing.control_period
    time = np.array([run.begin + period * run.tick[len(run.tick) // 2] for run in runs])
    touches = np.array([run.kind in ("contact", "tap") for run in runs])
    if touches.sum() < MIN_CONTACTS_FOR_DRIFT or not np.ptp(time[touches]):
        finding = f"{touches.sum()} touches within {np.ptp(time[touches]) if touches.any() else 0:g} s"
        allowed = f"{MIN_CONTACTS_FOR_DRIFT} apart by their stamps"
        raise InputError(f'timing.clock: found "separate" and {finding}, expected {allowed}')
    time = time - time.mean()
    late = _estimate_run_delays(MotionResponse(model, runs, timing, longest), readings, time, touches)
    rate = std = 0.0
    for _ in range(DRIFT_ITERATIONS):
        motion = MotionResponse(model, runs, timing, longest, late)
        if not isinstance(law, Law):
            law = choose_contact_law(motion, readings, plane, None if law is None else (law,))[0].law
        problem = ContactProblem(motion, readings, law, plane)
        delay, surface, _ = search_coarsely(problem)
        off, variance = estimate_residual_delays(
            problem, delay, surface, problem.at(delay, surface).coefficients
        )
        step, std = fit_weighted_slope(off, 1.0 / variance, time)
        late = late + step * time
        if abs(step) * np.ptp(time) < DRIFT_TOLERANCE:
            break
    if not std * np.ptp(time) < MAX_FORCE_DELAY:
        allowed = "touches whose forces are within their runs"
        raise InputError(
            f'timing.clock: found "separate" and forces that follow no touch, expected {allowed}'
        )
    rate = float(np.ptp(late) / np.ptp(time) * np.sign(np.dot(late - late.mean(), time)))
    return ClockDrift(rate, std, late)


def _estimate_run_delays(
    motion: MotionResponse, readings: ForceReadings, time: np.ndarray, touches: np.ndarray
) -> np.ndarray:
    """Return the delay that the clock adds to each run [s], from the mean time of its force."""
    level = np.median(readings.force[readings.counts])
    above = np.where(readings.counts, np.abs(readings.force - level), 0.0)
    weight = np.where(above > FORCE_DETECTION_SIGMAS * readings.std, above, 0.0) ** 2
    row = np.arange(len(weight))[:, None]
    middle = np.sum(row * weight, axis=0) / np.maximum(weight.sum(axis=0), 1e-300)
    position, _ = motion.at(0.0)
    off = motion.period * (middle - np.argmax(np.where(readings.counts, position, -np.inf), axis=0))
    pairs = combinations(np.flatnonzero(touches & (weight.sum(axis=0) > 0.0)), 2)
    rates = [(off[j] - off[i]) / (time[j] - time[i]) for i, j in pairs if time[j] != time[i]]
    rate = float(np.median(rates)) if rates else 0.0
    return rate * time + float(np.median((off - rate * time)[touches])) - CENTRAL_DELAY


def estimate_residual_delays(
    problem: ContactProblem, delay: float, plane: float, coefficients: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the delay of each run's readings beyond these parameters [s], and its variance.

    Rows near an onset are not used, because the force of damped contact jumps there.
    """
    readings, sooner = problem.readings, max(delay - DELAY_DIFFERENCE_STEP, problem.min_delay)
    counts = readings.counts & ~flag_rows_near_edges(problem.motion, readings, (delay, plane, 0.0))
    after, before = (
        problem.force(shifted, plane, coefficients) for shifted in (delay + DELAY_DIFFERENCE_STEP, sooner)
    )
    grows = problem.whiten(after - before) / (delay + DELAY_DIFFERENCE_STEP - sooner)
    left = problem.whiten(readings.force - problem.force(delay, plane, coefficients))
    grows, left = (np.where(counts, values, 0.0) / readings.std for values in (grows, left))
    power = np.maximum(np.sum(grows**2, axis=0), 1e-300)
    return np.sum(grows * left, axis=0) / power, 1.0 / power


def fit_weighted_slope(values: np.ndarray, weight: np.ndarray, place: np.ndarray) -> tuple[float, float]:
    """Return the weighted slope and its standard error, inflated if the reduced chi-square exceeds 1."""
    from_centre = place - np.average(place, weights=weight)
    spread = float(np.sum(weight * from_centre**2))
    result = float(np.sum(weight * from_centre * values)) / spread
    scatter = values - np.average(values, weights=weight) - result * from_centre
    inflation = max(1.0, float(np.sum(weight * scatter**2)) / max(len(values) - 2, 1))
    return result, float(np.sqrt(inflation / spread))
