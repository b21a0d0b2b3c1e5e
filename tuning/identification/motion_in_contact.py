"""Comparison of the measured motion in contact with the motion that the model of the simulator predicts.

The model comes from free motion or, without such a run, from the prior. It is wrong in contact if the prior
is, or if the simulator moves differently under load. In contact, the residual of the measured position is
fitted, in each run, by an offset and by a later motion: r = a - delta v, with the predicted speed v.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tuning.identification.contact_fit import ContactFit
from tuning.identification.records import LoggedRun
from tuning.identification.validation import CheckResult

MIN_ROWS = 10  # smallest number of position readings in contact for a comparison
MIN_SIGMAS = 4.0  # smallest ratio of a significant delay to its standard deviation


def check_motion_in_contact(
    contact: ContactFit, runs: Sequence[LoggedRun], frequency: float
) -> list[CheckResult]:
    """Check that the simulator moves in contact when its model predicts it.

    Args:
        contact: Contact model, with the predicted motion.
        runs: Runs in contact.
        frequency: Contact frequency [Hz].

    Returns:
        A list with one check; empty if the logs have too few position readings in contact.
    """
    positions, speeds = contact.problem.motion.at_row_times().at(0.0)
    plane = contact.posterior.best[1]
    delays, weights, variances = [], [], []
    for lane, run in enumerate(runs):
        position, speed = (values[: len(run.tick), lane] for values in (positions, speeds))
        residual = run.position_measured - position
        usable = run.valid & np.isfinite(residual) & (position > plane)
        if usable.sum() < MIN_ROWS:
            continue
        residual, speed = (values[usable] - np.mean(values[usable]) for values in (residual, speed))
        weight = float(np.sum(speed**2))
        if weight > 0.0:
            delays.append(-float(np.sum(residual * speed)) / weight)
            weights.append(weight)
            variances.append(float(np.var(residual + delays[-1] * speed)) / weight)
    if not delays:
        return []
    delay, std = _average(np.array(delays), np.array(weights), np.array(variances))
    finding = f"{1e3 * abs(delay):.3g} +- {1e3 * std:.2g} ms {'later' if delay > 0.0 else 'earlier'}"
    return [
        CheckResult(
            "motion in contact",
            f"{finding} than the model of the motion simulator predicts",
            abs(delay) > MIN_SIGMAS * std,
            float(np.pi**2 * frequency * abs(delay)),
        )
    ]


def _average(values: np.ndarray, weights: np.ndarray, variances: np.ndarray) -> tuple[float, float]:
    """Return the weighted mean and its standard deviation, from the noise or, if larger, the scatter."""
    shares = weights / weights.sum()
    mean = float(shares @ values)
    scatter = float(np.sum(shares**2 * (values - mean) ** 2)) * len(values) / max(len(values) - 1, 1)
    return mean, float(np.sqrt(max(scatter, float(np.sum(shares**2 * variances)))))
