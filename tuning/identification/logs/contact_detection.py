"""Detection of contacts from the measured force, for logs in which no channel marks the contacts."""

from __future__ import annotations

import numpy as np

CONTACT_THRESHOLD_SIGMAS = 5.0  # minimum force in contact, in standard deviations of the force noise
MIN_CONTACT_TICKS = 3  # minimum number of successive ticks above the threshold at the beginning of a contact
WEAK_CONTACT_RATIO = 3.0  # largest force, divided by the threshold, below which readings are averaged
AVERAGED_ROWS = 9  # odd number of successive readings whose mean replaces a reading of a weak contact
MIN_CONTACT_GAP = 0.1  # minimum time between two contacts [s]
MAX_REST_ROWS = 200  # maximum number of first rows that determine the force without contact


def detect_contacts(
    force: np.ndarray, period: float, rest: float | None = None, apart: float = MIN_CONTACT_GAP
) -> list[tuple[int, int]]:
    """Detect contacts: intervals in which the force exceeds its noise.

    If `rest` is None and noise nearly hides the contacts, means of successive readings replace the readings.

    Args:
        force: Measured force [N]; NaN in lost rows. Without `rest`, the first rows must be without contact.
        period: Control period [s].
        rest: Force reading without contact [N], or None to estimate it.
        apart: Minimum time between two contacts [s]; closer contacts are merged.

    Returns:
        For each contact, its first row and the row after its last row.
    """
    level = estimate_resting_force(force) if rest is None else rest
    size, threshold = np.abs(force - level), estimate_contact_threshold(force)
    is_weak = len(force) > AVERAGED_ROWS and float(np.nanmax(size)) < WEAK_CONTACT_RATIO * threshold
    if rest is None and is_weak:
        mean = _average_readings(force)
        # Means of disjoint groups of readings determine the threshold; overlapping means are correlated.
        size, threshold = np.abs(mean - level), estimate_contact_threshold(mean, AVERAGED_ROWS)
    is_above = size > threshold
    is_sustained = is_above.copy()
    for ticks in range(1, MIN_CONTACT_TICKS):
        is_sustained[: len(force) - ticks] &= is_above[ticks:]
        is_sustained[len(force) - ticks :] = False
    starts = np.flatnonzero(is_sustained)
    if not len(starts):
        return []
    # Fewer ticks above the threshold belong to a contact only if they are close to it.
    inside = np.flatnonzero(is_above)
    inside = inside[inside >= starts[0]]
    breaks = np.flatnonzero(np.diff(inside) > round(apart / period))
    begins, ends = inside[[0, *(breaks + 1)]], inside[[*breaks, len(inside) - 1]] + 1
    has_start = np.searchsorted(starts, begins) < np.searchsorted(starts, ends)
    return [(int(a), int(b)) for a, b, is_contact in zip(begins, ends, has_start, strict=True) if is_contact]


def estimate_resting_force(force: np.ndarray) -> float:
    """Return the force reading without contact [N]: the median of the first rows."""
    return float(np.nanmedian(_select_first_readings(force)))


def estimate_contact_threshold(force: np.ndarray, step: int = 1) -> float:
    """Return the force [N] above which contact is assumed, from the noise of every `step`-th reading."""
    first, readings = _select_first_readings(force)[::step], force[::step]
    steps = np.diff(readings[np.isfinite(readings)])
    sigma = max(1.4826 * float(np.median(np.abs(steps))) / np.sqrt(2), float(np.nanstd(first)))
    return max(CONTACT_THRESHOLD_SIGMAS * sigma, 1e-6 * float(np.nanmax(np.abs(force))))


def _average_readings(force: np.ndarray) -> np.ndarray:
    """Return the mean of the `AVERAGED_ROWS` readings around each row, ignoring NaN; NaN if all are NaN."""
    exists, window = np.isfinite(force), np.ones(AVERAGED_ROWS)
    number = np.convolve(exists, window, "same")
    total = np.convolve(np.where(exists, force, 0.0), window, "same")
    return np.where(number > 0.5, total / np.maximum(number, 1.0), np.nan)


def _select_first_readings(force: np.ndarray) -> np.ndarray:
    return force[: max(10, min(MAX_REST_ROWS, len(force) // 20))]
