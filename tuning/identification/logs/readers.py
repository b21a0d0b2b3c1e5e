"""Readers of log files in different formats; only the requested columns are read.

Text and Parquet files need no further library. The module `third_party` reads MAT, HDF5, ROS 2 bags, MDF4 and
TDMS with the optional libraries of `jaxhil[logs]`.
"""

from __future__ import annotations

import csv
import importlib
import io
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv
from pyarrow import parquet

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.mechanism.conversion import suggest_names
from tuning.identification.logs.mapping import TextFormat

# Values of each column: float64, text objects, or time stamps [s] relative to the first one.
ColumnsByName = dict[str, np.ndarray]

# Function that returns the time stamps [s] of given columns; None for a column without separate stamps.
StampsOfColumns = Callable[[Sequence[str]], Mapping[str, np.ndarray | None]]

DEFAULT_TEXT_FORMAT = TextFormat()
DELIMITERS = "\t;,"  # candidates; the first one that occurs in the line of column names is the delimiter
PARSE_BLOCK_BYTES = 1 << 22  # number of bytes that are parsed at once
GROWTH_ROWS = 1 << 19  # number of rows by which a full array is enlarged
MAX_LINE_BYTES = 1 << 20  # maximum number of bytes in the line of column names
MAX_NAMES_IN_MESSAGE = 12  # maximum number of column names in a message

_TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".log")
_PARQUET_SUFFIXES = (".parquet", ".pq")
_THIRD_PARTY_FORMATS = {
    ".mat": ("mat", ("pymatreader", "h5py")),
    ".h5": ("hdf5", ("h5py",)),
    ".hdf5": ("hdf5", ("h5py",)),
    ".mcap": ("bag", ("rosbags",)),
    ".db3": ("bag", ("rosbags",)),
    ".mf4": ("mdf", ("asammdf",)),
    ".mdf": ("mdf", ("asammdf",)),
    ".tdms": ("tdms", ("nptdms",)),
}


class OpenLog(NamedTuple):
    """Opened log file: its column names, and functions that read columns and their time stamps."""

    label: str  # name of the log in messages
    names: list[str]
    read: Callable[[Sequence[str]], ColumnsByName]
    # Time stamps [s] of columns that were read, with a common origin; None for a column without separate
    # stamps.
    clocks: StampsOfColumns = dict.fromkeys
    stamps: Collection[str] = ()  # names of the columns that contain such time stamps


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
            return _open_text_log(path, label, text)
        if suffix in _PARQUET_SUFFIXES:
            return _open_parquet_log(path, label)
        format, packages = _THIRD_PARTY_FORMATS[suffix]
        for package in packages:
            try:
                importlib.import_module(package)
            except ImportError:
                needs = f"{package}, which is not installed: python3 -m pip install 'jaxhil[logs]'"
                raise InputError(f"{label}: reading {suffix} files needs {needs}") from None
        opened = getattr(importlib.import_module("tuning.identification.logs.third_party"), format)(path)
        read = _wrap_reader(label, opened.names, opened.read)
        return OpenLog(label, opened.names, read, _wrap_stamp_reader(label, opened.clocks), opened.stamps)


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


def _wrap_stamp_reader(label: str, clocks: StampsOfColumns | None) -> StampsOfColumns:
    if clocks is None:
        return dict.fromkeys

    def checked(wanted: Sequence[str]) -> Mapping[str, np.ndarray | None]:
        with convert_reader_errors(label):
            return clocks(wanted)

    return checked


def _wrap_reader(label: str, names: Sequence[str], read: Callable[[Sequence[str]], ColumnsByName]):
    """Return a function that reads columns and raises `InputError` if a column is missing or ambiguous."""

    def checked(wanted: Sequence[str]) -> ColumnsByName:
        for name in wanted:
            if name not in names:
                examples = ", ".join(
                    to_one_line(column, 40) for column in names[:MAX_NAMES_IN_MESSAGE]
                ) + ", ..." * (len(names) > MAX_NAMES_IN_MESSAGE)
                hint = to_one_line(suggest_names(name, names))
                raise InputError(
                    f"{label}: column {format_value(name)}: found no column with this name, expected "
                    f"{examples}{hint}"
                )
            if names.count(name) > 1:
                raise InputError(
                    f"{label}: column {format_value(name)}: found {names.count(name)} columns, expected one"
                )
        with convert_reader_errors(label):
            columns = read(wanted)
        return columns

    return checked


def _open_text_log(path: Path, label: str, text: TextFormat) -> OpenLog:
    with path.open("rb") as file:
        for _ in range(text.skip_rows):
            file.readline(MAX_LINE_BYTES)
        raw = file.readline(MAX_LINE_BYTES)
        second = file.readline(MAX_LINE_BYTES)
    if not raw.strip():
        raise InputError(f"{label}: found no line of column names, expected it in line {text.skip_rows + 1}")
    line, following = (
        _decode_line(raw_line, text.skip_rows == 0).strip("\r\n") for raw_line in (raw, second)
    )
    delimiter = text.delimiter or next((character for character in DELIMITERS if character in line), ",")
    names = [name.strip() for name in next(csv.reader(io.StringIO(line), delimiter=delimiter))]
    headless = all(_is_number(name, text.decimal) for name in names)
    if headless:
        names = [str(index + 1) for index in range(len(names))]
    skipped = text.skip_rows + (not headless)

    def read(wanted: Sequence[str]) -> ColumnsByName:
        texts = [
            n
            for n in wanted
            if not _is_numeric_column(following if not headless else line, names, n, delimiter, text)
        ]
        return _read_text(path, names, wanted, texts, skipped, delimiter, text.decimal)

    return OpenLog(label, names, _wrap_reader(label, names, read))


def _is_numeric_column(line: str, names: Sequence[str], name: str, delimiter: str, text: TextFormat) -> bool:
    """Return whether the column is empty or contains a number in this line."""
    cells = next(csv.reader(io.StringIO(line), delimiter=delimiter), [])
    index = list(names).index(name)
    return index >= len(cells) or not cells[index].strip() or _is_number(cells[index], text.decimal)


def _read_text(
    path: Path, names: list[str], wanted: Sequence[str], texts: Sequence[str], skipped: int, delimiter: str,
    decimal: str,
) -> ColumnsByName:  # fmt: skip
    unique = [f"{index} {name}" for index, name in enumerate(names)]
    chosen = {name: unique[names.index(name)] for name in wanted}
    kinds = {chosen[name]: pa.string() if name in texts else pa.float64() for name in wanted}

    batches = arrow_csv.open_csv(
        path,
        arrow_csv.ReadOptions(
            column_names=unique, skip_rows=skipped, block_size=PARSE_BLOCK_BYTES, use_threads=False
        ),
        arrow_csv.ParseOptions(delimiter=delimiter),
        arrow_csv.ConvertOptions(
            column_types=kinds,
            include_columns=list(kinds),
            decimal_point=decimal,
            strings_can_be_null=False,
        ),
    )
    # Arrays that grow with each batch save memory: a whole table needs three times the memory of its numbers.
    # A single thread parses the file, so that error messages name the invalid row.
    columns: ColumnsByName = {name: np.empty(0, object if name in texts else float) for name in chosen}
    rows = 0
    for batch in batches:
        until = rows + batch.num_rows
        for name, unique_name in chosen.items():
            column = columns[name]
            if len(column) < until:
                column.resize(until + GROWTH_ROWS, refcheck=False)
            column[rows:until] = _column_to_array(pa.chunked_array([batch.column(unique_name)]), name)
        rows = until
    return {name: column[:rows] for name, column in columns.items()}


def _open_parquet_log(path: Path, label: str) -> OpenLog:
    names = list(parquet.read_schema(path).names)

    def read(wanted: Sequence[str]) -> ColumnsByName:
        # Read one column at a time: a whole table together with its arrays needs twice the memory.
        columns = (parquet.read_table(path, columns=[name]).column(0) for name in wanted)
        return {name: _column_to_array(column, name) for name, column in zip(wanted, columns, strict=True)}

    return OpenLog(label, names, _wrap_reader(label, names, read))


def _column_to_array(column: pa.ChunkedArray, name: str) -> np.ndarray:
    kind = column.type
    if pa.types.is_dictionary(kind):
        column, kind = column.cast(kind.value_type), kind.value_type
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return np.array(column.to_pylist(), dtype=object)
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time(kind):
        if column.null_count:
            raise ValueError(
                f"column {format_value(name)}: found {column.null_count} empty cells, expected none"
            )
        unit = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        integers = column.cast(pa.int64() if kind.bit_width == 64 else pa.int32()).to_numpy().astype(np.int64)
        return unit * (integers - integers[:1]).astype(float)
    if pa.types.is_boolean(kind):
        column = column.cast(pa.int8())
    return np.asarray(column.cast(pa.float64(), safe=False).to_numpy())


def _decode_line(line: bytes, first: bool) -> str:
    try:
        return line.decode("utf-8-sig" if first else "utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _is_number(cell: str, decimal: str) -> bool:
    try:
        float(cell.strip().replace(decimal, "."))
    except ValueError:
        return False
    return True
