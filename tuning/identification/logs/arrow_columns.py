"""Conversion of Arrow's columns to arrays, and reader of Parquet files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from jaxhil.errors import format_value
from tuning.identification.logs.log_reader import ColumnsByName, LogReader


def open_parquet_log(path: Path) -> LogReader:
    """Open a Parquet file; the metadata entry `unit` of a field states the unit of its values."""
    schema = parquet.read_schema(path)
    stated = {field.name: (field.metadata or {}).get(b"unit", b"") for field in schema}
    units = {name: unit.decode("utf-8", "replace") for name, unit in stated.items() if unit}

    def read(wanted: Sequence[str]) -> ColumnsByName:
        # Read one column at a time: a whole table together with its arrays needs twice the memory.
        columns = (parquet.read_table(path, columns=[name]).column(0) for name in wanted)
        return {name: to_array(column, name) for name, column in zip(wanted, columns, strict=True)}

    return LogReader(list(schema.names), read, units=units)


def to_array(column: pa.ChunkedArray, name: str) -> np.ndarray:
    """Return a column as numbers, texts, or time stamps [s] relative to the first one."""
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
