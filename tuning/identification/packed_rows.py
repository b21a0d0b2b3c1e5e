"""Sequence of the rows near contact of all lanes (runs), so that a single call filters all lanes.

For each lane, the sequence contains the rows from the first to the last contact, and further rows in which
the filters decay. The filtered values of a lane therefore do not depend on other lanes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class PackedRows(NamedTuple):
    """Rows of several lanes in a single sequence, one lane after the other."""

    rows: np.ndarray  # flat index into an array (rows, lanes) for each element; -1 after the end of a lane
    starts: np.ndarray  # (lanes,), index in the sequence that row 0 of each lane has, or would have

    def places(self, rows: np.ndarray) -> np.ndarray:
        """Convert flat indices into an array (rows, lanes) to indices in the sequence."""
        row, lane = np.divmod(rows, len(self.starts))
        return self.starts[lane] + row


def pack_rows(near: Sequence[np.ndarray], shape: tuple[int, int], memory: int) -> PackedRows:
    """Build the sequence of rows near contact.

    Args:
        near: Arrays of rows near contact; each contains sorted flat indices into an array (rows, lanes).
        shape: Numbers of rows and lanes.
        memory: Number of rows until the response of the filters has decayed.
    """
    length, lanes = shape
    first, last = np.full(lanes, length), np.full(lanes, -1)
    for rows in near:
        row, lane = np.divmod(rows, lanes)
        # If an index occurs several times, NumPy keeps the value that was assigned last.
        lasting, beginning = last.copy(), first.copy()
        lasting[lane], beginning[lane[::-1]] = row, row[::-1]
        first, last = np.minimum(first, beginning), np.maximum(last, lasting)
    counts = np.where(last >= 0, last - first + 1 + memory, 0)
    begins = np.cumsum(counts) - counts
    starts = begins - first
    lane = np.repeat(np.arange(lanes), counts)
    row = np.arange(len(lane)) - starts[lane]
    return PackedRows(np.where(row < length, row * lanes + lane, -1), starts)
