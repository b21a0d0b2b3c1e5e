"""Detection of contacts in a run, from the force, if no channel marks them."""

from __future__ import annotations

import numpy as np

CONTACT_THRESHOLD_SIGMAS = 5.0  # standard deviations of the force noise that indicate contact
MIN_CONTACT_TICKS = 3  # successive ticks above the threshold that begin a contact
MIN_CONTACT_GAP = 0.1  # s, least time between two contacts
MAX_REST_ROWS = 200  # largest number of rows for the force at rest


def detect_contacts(
    force: np.ndarray, period: float, rest: float | None = None, apart: float = MIN_CONTACT_GAP
) -> list[tuple[int, int]]:
    """Return the first row of each contact and the row after its last one.

    Args:
        force: Force [N], without contact at first unless `rest` is specified; NaN in lost rows.
        period: Control period [s].
        rest: Force at rest [N].
        apart: Time [s] below which successive contacts are merged.
    """
    touched = np.abs(
        force - (estimate_resting_force(force) if rest is None else rest)
    ) > estimate_contact_threshold(force)
    long = touched.copy()
    for ticks in range(1, MIN_CONTACT_TICKS):
        long[: len(force) - ticks] &= touched[ticks:]
        long[len(force) - ticks :] = False
    starts = np.flatnonzero(long)
    if not len(starts):
        return []
    # Short excursions above the threshold belong to a contact only if they are close to one.
    inside = np.flatnonzero(touched)
    inside = inside[inside >= starts[0]]
    breaks = np.flatnonzero(np.diff(inside) > round(apart / period))
    begins, ends = inside[[0, *(breaks + 1)]], inside[[*breaks, len(inside) - 1]] + 1
    has = np.searchsorted(starts, begins) < np.searchsorted(starts, ends)
    return [(int(a), int(b)) for a, b, good in zip(begins, ends, has, strict=True) if good]


def estimate_resting_force(force: np.ndarray) -> float:
    """Return the reading of the sensor without contact [N], from the first rows."""
    return float(np.nanmedian(_select_first_readings(force)))


def estimate_contact_threshold(force: np.ndarray) -> float:
    """Return the contact threshold [N], from the scatter between rows and that of the first rows."""
    steps = np.diff(force[np.isfinite(force)])
    sigma = max(
        1.4826 * float(np.median(np.abs(steps))) / np.sqrt(2), float(np.nanstd(_select_first_readings(force)))
    )
    return max(CONTACT_THRESHOLD_SIGMAS * sigma, 1e-6 * float(np.nanmax(np.abs(force))))


def _select_first_readings(force: np.ndarray) -> np.ndarray:
    return force[: max(10, min(MAX_REST_ROWS, len(force) // 20))]
