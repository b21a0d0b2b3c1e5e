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

from tuning.identification.contact_fit import ContactFit
from tuning.identification.records import LoggedRun
from tuning.identification.uncertainty_effect import EFFECT_PROBABILITY, UncertaintyEffect
from tuning.identification.validation import DEFECT_P_VALUE, CheckResult, flag_certain_rows

ROWS_OUTSIDE_CONTACT, ROWS_INSIDE_CONTACT = 3, 15  # rows outside and inside the contact that are evaluated
MIN_CONTACTS_FOR_MEAN = 3  # contacts that a mean needs


def check_contact_edges(
    contact: ContactFit, runs: Sequence[LoggedRun], effect: UncertaintyEffect
) -> list[CheckResult]:
    """Check the mean of all contacts at both edges of contact.

    Args:
        contact: The model, compared with the runs.
        runs: The contacts, one per lane.
        effect: Effect of the parameters' uncertainty on e and on e - e*.

    Returns:
        One line; none if no parameter is uncertain or fewer than `MIN_CONTACTS_FOR_MEAN` contacts have both
        edges.
    """
    means = average_edge_residuals(contact, runs)
    if not effect.parts or not len(means):
        return []
    power, count = float(np.sum(means**2)), len(means)
    times = float(np.sqrt(max(power - count, 0.0)) / special.ndtri(0.5 + 0.5 * EFFECT_PROBABILITY))
    is_present = bool(stats.chi2.sf(power, count) < DEFECT_P_VALUE)
    finding = f"the mean of all touches leaves {power / count:.3g} times the noise's power next to them"
    if is_present:
        finding += ", as behind a filter or a dead zone of another kind, or of a force that was resampled"
    return [
        CheckResult(
            "edges of contact", finding, is_present, times * effect.restitution, on_error=times * effect.error
        )
    ]


def average_edge_residuals(contact: ContactFit, runs: Sequence[LoggedRun]) -> np.ndarray:
    """Return the weighted mean residual at each row next to either edge, in its standard deviations."""
    delay, plane, inner = contact.posterior.best
    problem, readings = contact.problem, contact.readings
    predicted = problem.force(delay, plane, inner.coefficients)
    left = problem.whiten(readings.force - predicted) / readings.std
    counts = readings.counts & flag_certain_rows(contact)
    inside = problem.motion.at(delay)[0] > plane
    speed = np.array([(run.speed or 0.0) if run.kind == "contact" else 0.0 for run in runs])
    begins = np.argmax(inside, axis=0)
    # A contact that begins or ends with its run lacks the rows outside.
    ends = len(inside) - np.argmax(inside[::-1], axis=0) - 1
    whole = (
        (begins > ROWS_OUTSIDE_CONTACT)
        & (ends < len(inside) - ROWS_OUTSIDE_CONTACT - 1)
        & inside.any(axis=0)
        & (speed > 0.0)
    )
    means: list[float] = []
    if whole.sum() < MIN_CONTACTS_FOR_MEAN:
        return np.array(means)
    for edge, outward in ((begins, -1), (ends, 1)):
        for row_offset in range(-ROWS_INSIDE_CONTACT, ROWS_OUTSIDE_CONTACT + 1):
            row = np.clip(edge + outward * row_offset, 0, len(inside) - 1)
            lanes = np.flatnonzero(whole & counts[row, np.arange(len(row))] & (row > 0))
            if len(lanes):
                weight = speed[lanes]
                means.append(float(weight @ left[row[lanes], lanes] / np.linalg.norm(weight)))
    return np.array(means)
