"""Sequence of the rows near contact of all lanes (runs), so that a single call filters all lanes.

For each lane, the sequence contains the rows from the first to the last contact, and further rows in which
the filters decay. The filtered values of a lane therefore do not depend on other lanes.
"""

from __future__ import annotations

import numpy as np


def pack_rows(inside: np.ndarray, memory: int) -> np.ndarray:
    """Return the sequence of the rows near contact, one lane (run) after the other.

    Args:
        inside: Flags of the rows in contact, shape (rows, lanes).
        memory: Number of rows after contact in which the filters of the readings decay.

    Returns:
        For each row in the sequence, its flat index into an array (rows, lanes); -1 after the end of a lane.
    """
    length, lanes = inside.shape
    by_lane = np.ascontiguousarray(inside.T)
    first, last = np.argmax(by_lane, axis=1), length - 1 - np.argmax(by_lane[:, ::-1], axis=1)
    counts = np.where(by_lane.any(axis=1), last - first + 1 + memory, 0)
    lane = np.repeat(np.arange(lanes), counts)
    row = np.arange(len(lane)) - (np.cumsum(counts) - counts - first)[lane]
    return np.where(row < length, row * lanes + lane, -1)
