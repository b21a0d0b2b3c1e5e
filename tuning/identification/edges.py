"""Readings next to the begin and the end of contact: all that tells damping from the age of the force.

What a filter of higher order, a dead zone or a resampled force does to a reading lasts some milliseconds
after a jump, and is lost in the noise of one touch. The mean over all touches, aligned at the edge of contact
and weighed by their speeds, shows it. The model is off there by so many standard deviations; what it took up
of that is about as much, and the estimate is then off by as many of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special, stats

from tuning.identification.contact import ContactFit
from tuning.identification.records import Run
from tuning.identification.uncertain_effect import SURE, Effect
from tuning.identification.validation import RARE, Line, certain_rows

BEFORE, AFTER = 3, 15  # rows out of contact and in it that are looked at
FEWEST = 3  # touches, of which a mean tells more than each of them


def edges(contact: ContactFit, runs: Sequence[Run], effect: Effect) -> list[Line]:
    """Check the mean of all touches at both edges of contact.

    Args:
        contact: The model, set against the runs.
        runs: The touches, one a lane.
        effect: What the numbers' uncertainty can change e and e - e* by.

    Returns:
        One line; none where no number is uncertain or fewer than `FEWEST` touches have both edges.
    """
    means = mean_residuals(contact, runs)
    if not effect.parts or not len(means):
        return []
    power, count = float(np.sum(means**2)), len(means)
    times = float(np.sqrt(max(power - count, 0.0)) / special.ndtri(0.5 + 0.5 * SURE))
    there = bool(stats.chi2.sf(power, count) < RARE)
    finding = f"the mean of all touches leaves {power / count:.3g} times the noise's power next to them"
    if there:
        finding += ", as behind a filter or a dead zone of another kind, or of a force that was resampled"
    return [
        Line("edges of contact", finding, there, times * effect.restitution, on_error=times * effect.error)
    ]


def mean_residuals(contact: ContactFit, runs: Sequence[Run]) -> np.ndarray:
    """Return the weighted mean residual of each row next to either edge, in its standard deviations."""
    delay, plane, inner = contact.posterior.best
    problem, readings = contact.problem, contact.readings
    predicted = problem.force(delay, plane, inner.coefficients)
    left = problem.whiten(readings.force - predicted) / readings.std
    counts = readings.counts & certain_rows(contact)
    inside = problem.motion.at(delay)[0] > plane
    speed = np.array([(run.speed or 0.0) if run.kind == "contact" else 0.0 for run in runs])
    begins = np.argmax(inside, axis=0)
    # Rows before a contact that went on at the begin of its run, or ends with it, are not there.
    ends = len(inside) - np.argmax(inside[::-1], axis=0) - 1
    whole = (begins > BEFORE) & (ends < len(inside) - BEFORE - 1) & inside.any(axis=0) & (speed > 0.0)
    means: list[float] = []
    if whole.sum() < FEWEST:
        return np.array(means)
    for edge, outward in ((begins, -1), (ends, 1)):
        for place in range(-AFTER, BEFORE + 1):
            row = np.clip(edge + outward * place, 0, len(inside) - 1)
            lanes = np.flatnonzero(whole & counts[row, np.arange(len(row))] & (row > 0))
            if len(lanes):
                weight = speed[lanes]
                means.append(float(weight @ left[row[lanes], lanes] / np.linalg.norm(weight)))
    return np.array(means)
