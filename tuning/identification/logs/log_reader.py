"""Record that the reader of every log format returns: columns, their time stamps and units."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

# Values of each column: float64, text objects, or time stamps [s] relative to the first one.
ColumnsByName = dict[str, np.ndarray]

# Function of column names and the name of the log's column of time stamps. It returns the separate time
# stamps [s] of each column, or None for a column without separate stamps.
StampsOfColumns = Callable[[Sequence[str], str | None], Mapping[str, np.ndarray | None]]


def find_no_stamps(columns: Sequence[str], time: str | None = None) -> dict[str, None]:
    """Return None for each column, because the log's format has no separate time stamps."""
    return dict.fromkeys(columns)


class LogReader(NamedTuple):
    """Opened log: its column names, and functions that read columns and their time stamps."""

    names: list[str]  # names of the columns
    read: Callable[[Sequence[str]], ColumnsByName]
    # Time stamps [s] of columns that were read, with a common origin.
    clocks: StampsOfColumns = find_no_stamps
    stamps: Collection[str] = ()  # names of the columns that contain separate time stamps of other columns
    units: Mapping[str, str] = {}  # unit of each column for which the file states one, as the file spells it


def make_reader(columns: ColumnsByName, units: Mapping[str, str] | None = None) -> LogReader:
    """Return a reader of columns in memory, which have common time stamps."""
    return LogReader(
        list(columns), lambda wanted: {name: columns[name] for name in wanted}, units=units or {}
    )
