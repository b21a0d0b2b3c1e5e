"""Readers of log files in different formats; only the requested columns are read.

Text and Parquet files need no further library. The modules `matlab`, `ros_bag` and `third_party` read MAT,
ROS 2 bags, HDF5, MDF4 and TDMS with the optional libraries of `jaxhil[logs]`.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.mechanism.conversion import suggest_names
from tuning.identification.logs.arrow_columns import open_parquet_log
from tuning.identification.logs.log_reader import ColumnsByName, LogReader
from tuning.identification.logs.mapping import TextFormat
from tuning.identification.logs.text_log import open_text_log

DEFAULT_TEXT_FORMAT = TextFormat()
MAX_NAMES_IN_MESSAGE = 12  # maximum number of column names in a message

_TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".log", ".out", ".lvm", ".asc")
_PARQUET_SUFFIXES = (".parquet", ".pq")
# For each suffix: module and function that open the file, and the libraries that they need.
_THIRD_PARTY_FORMATS = {
    ".mat": ("matlab", "mat", ("pymatreader", "h5py")),
    ".h5": ("third_party", "hdf5", ("h5py",)),
    ".hdf5": ("third_party", "hdf5", ("h5py",)),
    ".mcap": ("ros_bag", "bag", ("rosbags",)),
    ".db3": ("ros_bag", "bag", ("rosbags",)),
    ".mf4": ("third_party", "mdf", ("asammdf",)),
    ".mdf": ("third_party", "mdf", ("asammdf",)),
    ".tdms": ("third_party", "tdms", ("nptdms",)),
}


class OpenLog(NamedTuple):
    """Opened log file: the reader of its columns, and its label."""

    label: str  # name of the log in messages
    reader: LogReader

    @property
    def names(self) -> list[str]:
        """Return the names of the columns."""
        return self.reader.names

    def read(self, wanted: Sequence[str]) -> ColumnsByName:
        """Return the values of columns.

        Raises:
            InputError: If a column is missing or ambiguous, or cannot be read.
        """
        names = self.names
        for name in wanted:
            where = f"{self.label}: column {format_value(name)}"
            if name not in names:
                examples = ", ".join(
                    to_one_line(column, 40) for column in names[:MAX_NAMES_IN_MESSAGE]
                ) + ", ..." * (len(names) > MAX_NAMES_IN_MESSAGE)
                hint = to_one_line(suggest_names(name, names))
                raise InputError(f"{where}: found no column with this name, expected {examples}{hint}")
            if names.count(name) > 1:
                raise InputError(f"{where}: found {names.count(name)} columns, expected one")
        with convert_reader_errors(self.label):
            return self.reader.read(wanted)

    def clocks(self, wanted: Sequence[str], time: str | None = None) -> Mapping[str, np.ndarray | None]:
        """Return the time stamps [s] of columns that were read; None for a column without separate stamps.

        Args:
            wanted: Names of the columns.
            time: Column of time stamps that the mapping names.
        """
        with convert_reader_errors(self.label):
            return self.reader.clocks(wanted, time)


def open_log(path: Path, text: TextFormat = DEFAULT_TEXT_FORMAT) -> OpenLog:
    """Open a log file, or a folder that contains a ROS 2 bag.

    Args:
        path: Path of the log.
        text: Format of text files.

    Raises:
        InputError: If the log does not exist, has an unknown format or cannot be read.
    """
    label = to_one_line(os.fspath(path)) or "''"
    if not path.exists():
        raise InputError(f"{label}: found no such file, expected a log")
    suffix = ".db3" if (path / "metadata.yaml").is_file() else path.suffix.lower()
    suffixes = (*_TEXT_SUFFIXES, *_PARQUET_SUFFIXES, *_THIRD_PARTY_FORMATS)
    if suffix not in suffixes:
        raise InputError(
            f"{label}: found a name that ends in {format_value(suffix)}, expected {', '.join(suffixes)}"
        )
    if path.is_dir() and suffix != ".db3":
        raise InputError(f"{label}: found a directory, expected a log")
    if not (path.is_file() or path.is_dir()):
        raise InputError(f"{label}: found a pipe or a device, expected a log")
    with convert_reader_errors(label):
        if suffix in _TEXT_SUFFIXES:
            reader = open_text_log(path, text)
            if not any(reader.names):
                line = (text.skip_rows or 0) + 1
                raise InputError(f"{label}: found no line of column names, expected it in line {line}")
            return OpenLog(label, reader)
        if suffix in _PARQUET_SUFFIXES:
            return OpenLog(label, open_parquet_log(path))
        module, format, packages = _THIRD_PARTY_FORMATS[suffix]
        for package in packages:
            try:
                importlib.import_module(package)
            except ImportError:
                needs = f"{package}, which is not installed: python3 -m pip install 'jaxhil[logs]'"
                raise InputError(f"{label}: reading {suffix} files needs {needs}") from None
        reader = getattr(importlib.import_module(f"tuning.identification.logs.{module}"), format)(path)
        return OpenLog(label, reader)


@contextmanager
def convert_reader_errors(label: str) -> Iterator[None]:
    """Convert every exception in the `with` block to an `InputError` whose message has one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise InputError(f"{label}: cannot be read: {to_one_line(reason.splitlines()[0], 200)}") from None
