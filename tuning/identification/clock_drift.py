"""Drift between a separate force clock and the drives' clock, estimated from contacts at different times.

A constant offset between the two clocks looks like a delay of the force sensor. A drift is different: it
changes the time from the motion to the force from contact to contact. After some hours, the clocks differ by
more than `MAX_FORCE_DELAY`, the longest delay in the search range of a fit. The drift is therefore estimated
in two steps. The first step uses the time from the deepest point of each contact to the mean time of its
force. The second step uses the residuals of a contact law that is fitted to all contacts.
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
FORCE_DETECTION_SIGMAS = 5.0  # minimum force in contact, in standard deviations of the noise
# delay to which the data are shifted [s]: the middle of the search range, because the clock offset is
# arbitrary.
CENTRAL_DELAY = 0.5 * MAX_FORCE_DELAY
DELAY_DIFFERENCE_STEP = 2.5e-4  # step of the finite differences with respect to the delay [s]
DRIFT_ITERATIONS = 6  # maximum number of alternating estimates of the contact law and of the drift
DRIFT_TOLERANCE = 1e-6  # change of all contacts' delays below which the iteration ends [s]
SEPARATE_CLOCK_MESSAGE = (
    'timing.clock: found "separate", expected "stamps" or "index" to compare logs with a mechanism'
)


@dataclass(frozen=True)
class ClockDrift:
    """Drift of the force clock relative to the drives' clock."""

    rate: float  # s/s, time that the force clock gains per second
    std: float  # s/s, standard error of the rate
    delays: np.ndarray  # (runs,), force delay of each run due to the drift, plus an unknown constant [s]


def reject_separate_clocks(timing: CampaignTiming) -> None:
    """Raise `InputError` if the forces were logged with a separate clock, because its offset is unknown."""
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
    """Estimate the drift of the force clock from the change of the force delay between the contacts.

    Args:
        runs: Runs in contact.
        model: Model of the motion simulator.
        timing: Timing of commands and readings.
        readings: Force readings of the runs.
        law: Contact law, the name of a law, or None to choose the law.
        plane: Position of the surface [m], or None to estimate it.

    Raises:
        InputError: If there are too few contacts, if all contacts have the same time stamp, or if the forces
            do not follow the motion.
    """
    period, longest = timing.control_period, MAX_FORCE_DELAY + timing.control_period
    time = np.array([run.begin + period * run.tick[len(run.tick) // 2] for run in runs])
    is_contact = np.array([run.kind in ("contact", "tap") for run in runs])
    if is_contact.sum() < MIN_CONTACTS_FOR_DRIFT or not np.ptp(time[is_contact]):
        finding = (
            f"{is_contact.sum()} contacts within {np.ptp(time[is_contact]) if is_contact.any() else 0:g} s"
        )
        expected = f"at least {MIN_CONTACTS_FOR_DRIFT} contacts with different time stamps"
        raise InputError(f'timing.clock: found "separate" and {finding}, expected {expected}')
    time = time - time.mean()
    delays = _estimate_run_delays(MotionResponse(model, runs, timing, longest), readings, time, is_contact)
    rate = std = 0.0
    variance = np.full(len(runs), np.inf)
    for _ in range(DRIFT_ITERATIONS):
        motion = MotionResponse(model, runs, timing, longest, delays)
        if not isinstance(law, Law):
            law = choose_contact_law(motion, readings, plane, None if law is None else (law,))[0].law
        problem = ContactProblem(motion, readings, law, plane)
        delay, surface, _ = search_coarsely(problem)
        delay_changes, variance = estimate_residual_delays(
            problem, delay, surface, problem.at(delay, surface).coefficients
        )
        step, std = fit_weighted_slope(delay_changes, 1.0 / variance, time)
        delays = delays + step * time
        if abs(step) * np.ptp(time) < DRIFT_TOLERANCE:
            break
    informative = np.count_nonzero(variance[is_contact] < MAX_FORCE_DELAY**2)
    if informative < MIN_CONTACTS_FOR_DRIFT or not std * np.ptp(time) < MAX_FORCE_DELAY:
        expected = "runs that contain the force of their contact"
        raise InputError(
            f'timing.clock: found "separate" and forces that do not follow the motion, expected {expected}'
        )
    rate = float(np.ptp(delays) / np.ptp(time) * np.sign(np.dot(delays - delays.mean(), time)))
    return ClockDrift(rate, std, delays)


def _estimate_run_delays(
    motion: MotionResponse, readings: ForceReadings, time: np.ndarray, is_contact: np.ndarray
) -> np.ndarray:
    """Estimate how late the force clock is in each run [s], from the mean time of the forces."""
    level = np.median(readings.force[readings.counts])
    above = np.where(readings.counts, np.abs(readings.force - level), 0.0)
    weight = np.where(above > FORCE_DETECTION_SIGMAS * readings.std, above, 0.0) ** 2
    row = np.arange(len(weight))[:, None]
    middle = np.sum(row * weight, axis=0) / np.maximum(weight.sum(axis=0), 1e-300)
    position, _ = motion.at(0.0)
    delay_changes = motion.period * (middle - np.argmax(np.where(readings.counts, position, -np.inf), axis=0))
    pairs = combinations(np.flatnonzero(is_contact & (weight.sum(axis=0) > 0.0)), 2)
    rates = [
        (delay_changes[j] - delay_changes[i]) / (time[j] - time[i]) for i, j in pairs if time[j] != time[i]
    ]
    rate = float(np.median(rates)) if rates else 0.0
    return rate * time + float(np.median((delay_changes - rate * time)[is_contact])) - CENTRAL_DELAY


def estimate_residual_delays(
    problem: ContactProblem, delay: float, plane: float, coefficients: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the force delay of each run minus `delay` [s], and the variance of this estimate [s^2].

    Readings near the onset of contact are not used, because the force of a damped contact jumps there.

    Args:
        problem: Readings, motion and contact law of the runs.
        delay: Force delay that all runs share [s].
        plane: Position of the surface [m].
        coefficients: Coefficients of the contact law.
    """
    readings, sooner = problem.readings, max(delay - DELAY_DIFFERENCE_STEP, problem.min_delay)
    counts = readings.counts & ~flag_rows_near_edges(problem.motion, readings, (delay, plane, 0.0))
    after, before = (
        problem.force(shifted, plane, coefficients) for shifted in (delay + DELAY_DIFFERENCE_STEP, sooner)
    )
    sensitivity = problem.whiten(after - before) / (delay + DELAY_DIFFERENCE_STEP - sooner)
    residual = problem.whiten(readings.force - problem.force(delay, plane, coefficients))
    sensitivity, residual = (
        np.where(counts, values, 0.0) / readings.std for values in (sensitivity, residual)
    )
    power = np.maximum(np.sum(sensitivity**2, axis=0), 1e-300)
    return np.sum(sensitivity * residual, axis=0) / power, 1.0 / power


def fit_weighted_slope(values: np.ndarray, weight: np.ndarray, position: np.ndarray) -> tuple[float, float]:
    """Return the weighted least-squares slope of `values` against `position`, and its standard error.

    The standard error is inflated if the reduced chi-square exceeds 1.
    """
    from_centre = position - np.average(position, weights=weight)
    spread = float(np.sum(weight * from_centre**2))
    slope = float(np.sum(weight * from_centre * values)) / spread
    residual = values - np.average(values, weights=weight) - slope * from_centre
    inflation = max(1.0, float(np.sum(weight * residual**2)) / max(len(values) - 2, 1))
    return slope, float(np.sqrt(inflation / spread))
