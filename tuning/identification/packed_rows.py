"""Rows near contact of all lanes, one after the other in a single sequence, for filters along the rows.

Each lane has the rows from its first to its last contact, and as many more as the filters remember. What a
filter returns there depends on no other lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class PackedRows(NamedTuple):
    """Sequence of rows of several lanes."""

    rows: np.ndarray  # row of the readings, counted along (rows, lanes); -1 behind the end of a lane
    starts: np.ndarray  # (lanes,), place in the sequence where row 0 of each lane is or would be

    def places(self, rows: np.ndarray) -> np.ndarray:
        """Return the places of rows of the readings in the sequence."""
        row, lane = np.divmod(rows, len(self.starts))
        return self.starts[lane] + row


def pack_rows(near: Sequence[np.ndarray], shape: tuple[int, int], memory: int) -> PackedRows:
    """Return the sequence that holds rows near contact.

    Args:
        near: Sorted rows near contact, counted along (rows, lanes), several times.
        shape: Numbers of rows and lanes.
        memory: Rows that the filters remember.
    """
    length, lanes = shape
    first, last = np.full(lanes, length), np.full(lanes, -1)
    for rows in near:
        row, lane = np.divmod(rows, lanes)
        # Of several values for one lane the last assignment counts.
        lasting, beginning = last.copy(), first.copy()
        lasting[lane], beginning[lane[::-1]] = row, row[::-1]
        first, last = np.minimum(first, beginning), np.maximum(last, lasting)
    counts = np.where(last >= 0, last - first + 1 + memory, 0)
    begins = np.cumsum(counts) - counts
    starts = begins - first
    lane = np.repeat(np.arange(lanes), counts)
    row = np.arange(len(lane)) - starts[lane]
    return PackedRows(np.where(row < length, row * lanes + lane, -1), starts)
