"""Check of the readings near the onset and the release of contact, which separate damping from force delay.

A filter of higher order, a dead zone or a resampled force changes the readings for some milliseconds after a
jump, which the noise of one contact hides. The mean over all contacts, aligned at the edge of contact and
weighted by their speeds, shows it. The estimates are taken to err by as many of their standard deviations as
the mean residuals exceed the noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special, stats

from tuning.identification.contact import ContactFit
from tuning.identification.records import Run
from tuning.identification.uncertain_effect import SURE, Effect
from tuning.identification.validation import RARE, Line, certain_rows

BEFORE, AFTER = 3, 15  # rows outside and inside the contact that are evaluated
FEWEST = 3  # contacts that a mean needs


def edges(contact: ContactFit, runs: Sequence[Run], effect: Effect) -> list[Line]:
    """Check the mean of all contacts at both edges of contact.

    Args:
        contact: The model, compared with the runs.
        runs: The contacts, one per lane.
        effect: Effect of the parameters' uncertainty on e and on e - e*.

    Returns:
        One line; none if no parameter is uncertain or fewer than `FEWEST` contacts have both edges.
    """
    means = mean_residuals(contact, runs)
    if not effect.parts or not len(means):
        return []
    power, count = float(np.sum(means**2)), len(means)
    times = float(np.sqrt(max(power - count, 0.0)) / special.ndtri(0.5 + 0.5 * SURE))
    is_present = bool(stats.chi2.sf(power, count) < RARE)
    finding = f"the mean of all touches leaves {power / count:.3g} times the noise's power next to them"
    if is_present:
        finding += ", as behind a filter or a dead zone of another kind, or of a force that was resampled"
    return [
        Line(
            "edges of contact", finding, is_present, times * effect.restitution, on_error=times * effect.error
        )
    ]


def mean_residuals(contact: ContactFit, runs: Sequence[Run]) -> np.ndarray:
    """Return the weighted mean residual at each row next to either edge, in its standard deviations."""
    delay, plane, inner = contact.posterior.best
    problem, readings = contact.problem, contact.readings
    predicted = problem.force(delay, plane, inner.coefficients)
    left = problem.whiten(readings.force - predicted) / readings.std
    counts = readings.counts & certain_rows(contact)
    inside = problem.motion.at(delay)[0] > plane
    speed = np.array([(run.speed or 0.0) if run.kind == "contact" else 0.0 for run in runs])
    begins = np.argmax(inside, axis=0)
    # A contact that begins or ends with its run lacks the rows outside.
    ends = len(inside) - np.argmax(inside[::-1], axis=0) - 1
    whole = (begins > BEFORE) & (ends < len(inside) - BEFORE - 1) & inside.any(axis=0) & (speed > 0.0)
    means: list[float] = []
    if whole.sum() < FEWEST:
        return np.array(means)
    for edge, outward in ((begins, -1), (ends, 1)):
        for row_offset in range(-AFTER, BEFORE + 1):
            row = np.clip(edge + outward * row_offset, 0, len(inside) - 1)
            lanes = np.flatnonzero(whole & counts[row, np.arange(len(row))] & (row > 0))
            if len(lanes):
                weight = speed[lanes]
                means.append(float(weight @ left[row[lanes], lanes] / np.linalg.norm(weight)))
    return np.array(means)
