"""First rows of a log, and records of the columns that are guessed from these rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tuning.identification.logs import checks
from tuning.identification.logs.column_names import find_unit
from tuning.identification.logs.log_reader import ColumnsByName
from tuning.identification.logs.readers import OpenLog

MAX_SAMPLED_ROWS = 200_000  # maximum number of rows that are read


class ChannelGuess(NamedTuple):
    """Guess of a channel's column, unit and sign, with the reason for the guess."""

    column: str | None  # None if the user must decide
    unit: str | None = None  # None for the SI unit
    sign: int = 1
    why: str = ""
    nanoseconds: str | None = None  # column of nanoseconds that belong to a column of seconds
    time_format: str | None = None
    candidates: Sequence[str] = ()  # columns among which the user must decide


class LogSample(NamedTuple):
    """First rows of a log's columns, and what the file states about these columns."""

    values: ColumnsByName  # of equal lengths; a missing number has the value of the row above
    present: Mapping[str, np.ndarray]  # whether each row of a column of numbers has a number
    units: Mapping[str, str]  # unit of each column that states one, as the log spells it
    stamps: Sequence[str]  # columns with time stamps of separate clocks

    def numbers(self, column: str) -> np.ndarray:
        """Return the column, or an empty array if it contains no numbers."""
        values = self.values.get(column)
        return np.empty(0) if values is None or values.dtype == object else values


def sample_log(log: OpenLog, columns: Sequence[str]) -> LogSample:
    """Read the first rows of columns; replace a missing or too large number by the number above it."""
    names = [name for name in dict.fromkeys(columns) if log.names.count(name) == 1]
    read = log.read(names) if names else {}
    # Columns with other time stamps may have other lengths.
    rows = min([MAX_SAMPLED_ROWS, *(len(values) for values in read.values())])
    stated = {name: unit for name in log.names if (unit := log.reader.units.get(name) or find_unit(name))}
    read = {name: values[:rows] for name, values in read.items()}
    present = {
        name: np.abs(values) <= checks.MAX_ABSOLUTE_VALUE
        for name, values in read.items()
        if values.dtype != object
    }
    values = {name: _continue_missing(column, present.get(name)) for name, column in read.items()}
    return LogSample(values, present, stated, list(log.reader.stamps))


def _continue_missing(values: np.ndarray, present: np.ndarray | None) -> np.ndarray:
    if present is None or present.all():
        return values
    if not present.any():
        return np.empty(0)
    return values[np.maximum.accumulate(np.where(present, np.arange(len(values)), np.argmax(present)))]
