"""Parquet file of one chunk of a sweep: rows with a checksum.

pandas, DuckDB and Arrow can read the file. Its metadata hold the manifest's digest and a SHA-256 checksum of
the file, computed while zeros replace the checksum's digits. A reader verifies the checksum before it parses
the file, and then checks that the outcome of each row follows from its errors and statuses.
"""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxhil.errors import InputError
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning.sweeps.columns import Column, classify_outcomes, list_allowed_texts, list_verdict_columns
from tuning.sweeps.manifest import Manifest, load_gains

SWEEP_DIGEST_KEY = b"jaxhil.sweep.sha256"
CHECKSUM_KEY = b"jaxhil.part.sha256"
BLANK_CHECKSUM = b"0" * 64  # replaces the checksum's digits while the checksum is computed
FORCE_RANGE_KEY = "rig.force_sensor.range"
CONTROL_PERIOD_KEY = "rig.control_period"


def encode_chunk(manifest: Manifest, rows: Mapping[str, np.ndarray]) -> bytearray:
    """Encode the rows of a chunk as a Parquet file with a checksum."""
    import pyarrow as pa
    from pyarrow import parquet

    buffer = pa.BufferOutputStream()
    table = to_table(manifest, rows)
    texts = [column.name for column in manifest.columns if column.kind == "text"]
    # A stronger compression would save only a tenth of the size and take twice the time. Only the index
    # column needs statistics, because readers search for rows by index.
    options: dict[str, Any] = {"compression": "lz4", "use_dictionary": texts, "write_statistics": ["index"]}
    with parquet.ParquetWriter(buffer, table.schema, **options) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({CHECKSUM_KEY: BLANK_CHECKSUM})
    content = bytearray(buffer.getvalue())
    digits = _locate_checksum(content)
    assert content[digits] == BLANK_CHECKSUM
    content[digits] = _compute_checksum(content)
    return content


def decode_chunk(manifest: Manifest, part: int, content: bytes) -> dict[str, np.ndarray] | None:
    """Decode the rows of chunk number `part`; return None if the file is damaged or from another chunk."""
    import pyarrow as pa
    from pyarrow import parquet

    digits = _locate_checksum(content)
    if content[digits] != _compute_checksum(
        content[: digits.start] + BLANK_CHECKSUM + content[digits.stop :]
    ):
        return None
    try:
        table = parquet.ParquetFile(pa.BufferReader(content)).read()
        return _check_rows(manifest, part, table)
    except (pa.ArrowException, InputError, LookupError, OSError, TypeError, ValueError):
        # The checksum is valid, but another program wrote the file.
        return None


def _check_rows(manifest: Manifest, part: int, table: Any) -> dict[str, np.ndarray] | None:
    """Convert a table to rows; return None if the rows are not those of the chunk or are inconsistent."""
    first, number = manifest.chunk_range(part)
    if (table.schema.metadata or {}).get(
        SWEEP_DIGEST_KEY
    ) != manifest.sha256.encode() or table.num_rows != number:
        return None
    if not table.schema.equals(build_arrow_schema(manifest)):
        return None
    rows = from_table(manifest, table)
    if not np.array_equal(rows["index"], np.arange(first, first + number)):
        return None
    mechanism = load_gains(manifest).mechanism
    if isinstance(mechanism, SixAxisMechanism):
        # The sensor's range is the smallest range of its force channels, each of them drawn or nominal.
        forces = [f"{FORCE_RANGE_KEY}_{axis}" for axis in (1, 2, 3)]
        ranges = zip(forces, mechanism.rig.force_sensor.range[:3], strict=True)
        values = (rows.get(name, nominal) for name, nominal in ranges)
        force_range = np.min(np.broadcast_arrays(*values), axis=0)
    else:
        force_range = rows.get(FORCE_RANGE_KEY, np.array(mechanism.rig.force_sensor.range))
    period = rows.get(CONTROL_PERIOD_KEY, np.array(mechanism.rig.control_period))
    evaluated = classify_outcomes(
        rows, list_verdict_columns(mechanism), force_range, period, manifest.error_limit
    )
    return None if list_different_columns(evaluated, rows) else rows


def list_different_columns(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> list[str]:
    """Return the names of columns that differ in type or in any bit; all NaN count as equal."""
    return [
        name
        for name in a
        if a[name].dtype != b[name].dtype
        or not np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f")
    ]


def build_arrow_schema(manifest: Manifest) -> Any:
    """Return the Arrow schema of a chunk's table, with units and descriptions as metadata of the fields."""
    import pyarrow as pa

    kinds = {
        "integer": pa.int64(),
        "input": pa.float64(),
        "number": pa.float64() if manifest.precision == "float64" else pa.float32(),
        "flag": pa.bool_(),
        "text": pa.dictionary(pa.int8(), pa.string()),
    }

    def field(column: Column):
        metadata = {"unit": column.unit, "meaning": column.meaning}
        return pa.field(column.name, kinds[column.kind], metadata=metadata)

    return pa.schema(
        [field(column) for column in manifest.columns], metadata={SWEEP_DIGEST_KEY: manifest.sha256}
    )


def to_table(manifest: Manifest, rows: Mapping[str, np.ndarray]) -> Any:
    """Convert rows to an Arrow table; NaN becomes null, and indices of texts become the texts."""
    import pyarrow as pa

    arrays = []
    for column, field in zip(manifest.columns, target := build_arrow_schema(manifest), strict=True):
        values = rows[column.name]
        if column.kind == "text":
            arrays.append(
                pa.DictionaryArray.from_arrays(pa.array(values), list(list_allowed_texts(column.name)))
            )
        else:
            # If there is no NaN, Arrow need not copy the values.
            gaps = values.dtype.kind == "f" and bool(np.any(np.isnan(values)))
            arrays.append(pa.array(values, field.type, from_pandas=gaps))
    return pa.Table.from_arrays(arrays, schema=target)


def from_table(manifest: Manifest, table: Any) -> dict[str, np.ndarray]:
    """Convert an Arrow table to rows; reverses `to_table`."""
    rows = {}
    for column in manifest.columns:
        array = table.column(column.name).combine_chunks()
        if column.kind == "text":
            # Arrow may return the dictionary's texts in a different order.
            indices = {text: index for index, text in enumerate(list_allowed_texts(column.name))}
            translated = np.array([indices[text.as_py()] for text in array.dictionary], np.int8)
            rows[column.name] = translated[array.indices.to_numpy(zero_copy_only=False)]
        else:
            rows[column.name] = array.to_numpy(zero_copy_only=False)
    return rows


def _locate_checksum(content: bytes | bytearray) -> slice:
    """Return the slice of a chunk file's bytes that holds the digits of the checksum."""
    # In the file, one header byte and one length byte lie between the checksum's key and its digits.
    start = content.rfind(CHECKSUM_KEY) + len(CHECKSUM_KEY) + 2
    return slice(start, start + len(BLANK_CHECKSUM))


def _compute_checksum(content: bytes | bytearray) -> bytes:
    return hashlib.sha256(content).hexdigest().encode("ascii")
