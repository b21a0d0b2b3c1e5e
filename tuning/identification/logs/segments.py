"""Where in a run the hardware is touched, told by the force where no channel says so."""

from __future__ import annotations

import numpy as np

SIGMAS = 5.0  # of the force's noise, beyond which there is contact
TICKS = 3  # for so many in a row
APART = 0.1  # s, between two contacts; what is nearer is one
FIRST = 200  # rows at most, from which the force at rest is taken


def contacts(
    force: np.ndarray, period: float, rest: float | None = None, apart: float = APART
) -> list[tuple[int, int]]:
    """First row of each contact and the row after its last one.

    `force` [N] begins without contact, unless what it is at `rest` is given; NaN where a row was lost.
    Contacts nearer than `apart` [s] are one.
    """
    touched = np.abs(force - (resting(force) if rest is None else rest)) > threshold(force)
    long = touched.copy()
    for ticks in range(1, TICKS):
        long[: len(force) - ticks] &= touched[ticks:]
        long[len(force) - ticks :] = False
    starts = np.flatnonzero(long)
    if not len(starts):
        return []
    # Single rows beyond the threshold belong to a contact only beside one.
    inside = np.flatnonzero(touched)
    inside = inside[inside >= starts[0]]
    breaks = np.flatnonzero(np.diff(inside) > round(apart / period))
    begins, ends = inside[[0, *(breaks + 1)]], inside[[*breaks, len(inside) - 1]] + 1
    has = np.searchsorted(starts, begins) < np.searchsorted(starts, ends)
    return [(int(a), int(b)) for a, b, good in zip(begins, ends, has, strict=True) if good]


def resting(force: np.ndarray) -> float:
    """What the sensor reads at first, without contact [N]."""
    return float(np.nanmedian(_first(force)))


def threshold(force: np.ndarray) -> float:
    """Beyond what the sensor's noise reaches [N]: by the scatter from row to row, and of the first rows."""
    steps = np.diff(force[np.isfinite(force)])
    sigma = max(1.4826 * float(np.median(np.abs(steps))) / np.sqrt(2), float(np.nanstd(_first(force))))
    return max(SIGMAS * sigma, 1e-6 * float(np.nanmax(np.abs(force))))


def _first(force: np.ndarray) -> np.ndarray:
    return force[: max(10, min(FIRST, len(force) // 20))]
