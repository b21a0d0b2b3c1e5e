"""Check of the force readings near the edges of contact (onset and release).

These readings distinguish damping from force delay. An unmodelled sensor filter, an unmodelled dead zone or a
resampled force changes the readings for some milliseconds after a jump of the force. In one contact, the
noise hides this change. The mean over all contacts of the residuals at the same distance from the edge,
weighted with the approach speeds, reveals it. If the mean is n standard deviations from 0, the estimates are
assumed to be wrong by n standard deviations, too.

In these residuals, a short smoothing of the readings, such as an interpolation between two samples, hardly
differs from the lag of a sensor. If a lag is fitted instead, damping and delay are wrong. The smoothing also
correlates the noise of successive readings at rest; this correlation reveals it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special, stats

from tuning.identification.contact_fit import ContactFit
from tuning.identification.noise import NoiseEstimate, autocorrelate
from tuning.identification.records import LoggedRun
from tuning.identification.uncertainty_effect import EFFECT_PROBABILITY, UncertaintyEffect
from tuning.identification.validation import DEFECT_P_VALUE, CheckResult, flag_certain_rows

# numbers of evaluated rows outside and inside the contact at each edge
ROWS_OUTSIDE_CONTACT, ROWS_INSIDE_CONTACT = 3, 15
MIN_CONTACTS_FOR_MEAN = 3  # minimum number of contacts for a mean
MIN_CORRELATION_ERRORS = 4.0  # minimum correlation of successive readings, in standard errors
MAX_CORRELATION_RATIO = 1 / 3  # maximum correlation of every other reading divided by that of successive ones
# Error of the estimated delay, divided by the standard deviation of the smoothing: measured with interpolated
# readings of contacts whose fits have a lag.
SMOOTHING_DELAY_SHARE = 0.3
CLOCK_STD = 2e-5  # s, standard deviation of a delay because of clock errors, which logs do not show
MAX_SMOOTHING_ERROR_RATIO = 2.0  # maximum effect of a smoothing, divided by that of the uncertain parameters


def check_contact_edges(
    contact: ContactFit, runs: Sequence[LoggedRun], effect: UncertaintyEffect
) -> list[CheckResult]:
    """Check that the mean residual of all contacts near onset and release is not larger than the noise.

    Args:
        contact: Contact model.
        runs: Runs in contact, in the order of the columns (lanes) of the model's readings.
        effect: Effect of the parameters' uncertainty on e and on e - e*.

    Returns:
        A list with one check. It is empty if no parameter is uncertain, or if fewer than
        `MIN_CONTACTS_FOR_MEAN` runs contain both onset and release.
    """
    means = average_edge_residuals(contact, runs)
    if not effect.parts or not len(means):
        return []
    power, count = float(np.sum(means**2)), len(means)
    times = float(np.sqrt(max(power - count, 0.0)) / special.ndtri(0.5 + 0.5 * EFFECT_PROBABILITY))
    is_present = bool(stats.chi2.sf(power, count) < DEFECT_P_VALUE)
    finding = f"the mean residual of all contacts has {power / count:.3g} times the noise's power there"
    if is_present:
        finding += ", as if the filter or dead zone differed from the model's or the force were resampled"
    return [
        CheckResult(
            "edges of contact", finding, is_present, times * effect.restitution, on_error=times * effect.error
        )
    ]


def check_force_smoothing(
    noise: NoiseEstimate | None, effect: UncertaintyEffect, frequency: float, period: float
) -> list[CheckResult]:
    """Check that the noise of the force at rest is not correlated as if readings were interpolated.

    Linear interpolation with the shares a and 1 - a correlates only successive readings. Its impulse response
    has the standard deviation sqrt(a (1 - a)) periods. Noise with a longer correlation passes the check.

    Args:
        noise: Noise of the force at rest, or None if it is unknown.
        effect: Effect of the parameters' uncertainty on e and on e - e*.
        frequency: Contact frequency [Hz].
        period: Control period [s].

    Returns:
        A list with one failed check, or an empty list if the noise shows no smoothing.
    """
    if noise is None or noise.silent or noise.walk or len(noise.filter) == 1 or not effect.parts:
        return []
    first, second = autocorrelate(noise.filter)[:2]
    if first < MIN_CORRELATION_ERRORS / np.sqrt(noise.number) or second > MAX_CORRELATION_RATIO * first:
        return []
    smoothing = period * float(np.sqrt(min(first / (1.0 + 2.0 * first), 0.25)))
    error = np.pi**2 * frequency * SMOOTHING_DELAY_SHARE * smoothing
    finding = f"successive readings at rest have a correlation of {first:.2g}, as if they were interpolated"
    on_error = min(error, MAX_SMOOTHING_ERROR_RATIO * effect.error)
    return [CheckResult("noise of the force", finding, True, 0.0, on_error=on_error)]


def average_edge_residuals(contact: ContactFit, runs: Sequence[LoggedRun]) -> np.ndarray:
    """Return the mean residual at each distance [rows] from onset and release, in standard deviations.

    The mean is weighted with the approach speeds. The standard deviation includes the noise, and a clock
    error (`CLOCK_STD`) that shifts all readings by the same time.
    """
    delay, plane, coefficient_fit = contact.posterior.best
    problem, readings = contact.problem, contact.readings
    predicted = problem.force(delay, plane, coefficient_fit.coefficients)
    residual = problem.whiten(readings.force - predicted) / readings.std
    late = problem.whiten(np.gradient(predicted, axis=0)) * CLOCK_STD / problem.motion.period / readings.std
    counts = readings.counts & flag_certain_rows(contact)
    inside = problem.motion.at(delay)[0] > plane
    speed = np.array([(run.speed or 0.0) if run.kind == "contact" else 0.0 for run in runs])
    begins = np.argmax(inside, axis=0)
    # If a run begins or ends in contact, it lacks an edge.
    ends = len(inside) - np.argmax(inside[::-1], axis=0) - 1
    has_both_edges = (
        (begins > ROWS_OUTSIDE_CONTACT)
        & (ends < len(inside) - ROWS_OUTSIDE_CONTACT - 1)
        & inside.any(axis=0)
        & (speed > 0.0)
    )
    means: list[float] = []
    if has_both_edges.sum() < MIN_CONTACTS_FOR_MEAN:
        return np.array(means)
    for edge, outward in ((begins, -1), (ends, 1)):
        for row_offset in range(-ROWS_INSIDE_CONTACT, ROWS_OUTSIDE_CONTACT + 1):
            row = np.clip(edge + outward * row_offset, 0, len(inside) - 1)
            lanes = np.flatnonzero(has_both_edges & counts[row, np.arange(len(row))] & (row > 0))
            if len(lanes):
                weight = speed[lanes] / np.linalg.norm(speed[lanes])
                mean, error = (float(weight @ values[row[lanes], lanes]) for values in (residual, late))
                means.append(mean / float(np.hypot(1.0, error)))
    return np.array(means)
