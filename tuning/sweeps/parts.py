"""Parts of a store: rows of a sweep as Parquet files with a checksum.

The metadata of a part hold the manifest's digest and a SHA-256 of the file, computed with zeros in place of
its own digits. pandas, DuckDB and Arrow read a part like any Parquet file. The checksum is checked before the
file is parsed; the rows' outcomes must then follow from their errors and statuses.
"""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxhil.errors import InputError
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning.sweeps.columns import Column, judge, slots, texts_of
from tuning.sweeps.manifest import Manifest, loaded_gains

SWEEP = b"jaxhil.sweep.sha256"
SEAL = b"jaxhil.part.sha256"
BLANK = b"0" * 64  # replaces the checksum's digits while it is computed
FORCE_RANGE = "rig.force_sensor.range"
PERIOD = "rig.control_period"


def encode_part(manifest: Manifest, rows: Mapping[str, np.ndarray]) -> bytearray:
    """Return the content of a part's file."""
    import pyarrow as pa
    from pyarrow import parquet

    buffer = pa.BufferOutputStream()
    table = to_table(manifest, rows)
    texts = [column.name for column in manifest.columns if column.kind == "text"]
    # Numbers hardly repeat: stronger compression would save a tenth of the size in twice the time. Rows are
    # searched by index only, so that no other column needs statistics.
    options: dict[str, Any] = {"compression": "lz4", "use_dictionary": texts, "write_statistics": ["index"]}
    with parquet.ParquetWriter(buffer, table.schema, **options) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({SEAL: BLANK})
    content = bytearray(buffer.getvalue())
    digits = _seal_digits(content)
    assert content[digits] == BLANK
    content[digits] = _digest(content)
    return content


def decode_part(manifest: Manifest, part: int, content: bytes) -> dict[str, np.ndarray] | None:
    """Return the rows that `encode_part` encoded; None if the content is damaged or of another part."""
    import pyarrow as pa
    from pyarrow import parquet

    digits = _seal_digits(content)
    if content[digits] != _digest(content[: digits.start] + BLANK + content[digits.stop :]):
        return None
    try:
        table = parquet.ParquetFile(pa.BufferReader(content)).read()
        return _checked(manifest, part, table)
    except (pa.ArrowException, InputError, LookupError, OSError, TypeError, ValueError):
        # The checksum is valid, but another program wrote the content.
        return None


def _checked(manifest: Manifest, part: int, table: Any) -> dict[str, np.ndarray] | None:
    """Return the rows of a table; None if they are not those of this part or contradict themselves."""
    first, number = manifest.part_rows(part)
    if (table.schema.metadata or {}).get(SWEEP) != manifest.sha256.encode() or table.num_rows != number:
        return None
    if not table.schema.equals(schema(manifest)):
        return None
    rows = from_table(manifest, table)
    if not np.array_equal(rows["index"], np.arange(first, first + number)):
        return None
    mechanism = loaded_gains(manifest).mechanism
    if isinstance(mechanism, SixAxisMechanism):
        # The range is the least of the three force channels, drawn or nominal.
        forces = [f"{FORCE_RANGE}_{axis}" for axis in (1, 2, 3)]
        ranges = zip(forces, mechanism.rig.force_sensor.range[:3], strict=True)
        values = (rows.get(name, nominal) for name, nominal in ranges)
        force_range = np.min(np.broadcast_arrays(*values), axis=0)
    else:
        force_range = rows.get(FORCE_RANGE, np.array(mechanism.rig.force_sensor.range))
    period = rows.get(PERIOD, np.array(mechanism.rig.control_period))
    evaluated = judge(rows, slots(mechanism), force_range, period, manifest.largest_error)
    return None if same_rows(evaluated, rows) else rows


def same_rows(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> list[str]:
    """Return the names of the columns that differ in type or in any bit, where all NaN are equal."""
    return [
        name
        for name in a
        if a[name].dtype != b[name].dtype
        or not np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f")
    ]


def schema(manifest: Manifest) -> Any:
    """Return the Arrow schema of every part; units and meanings are metadata of the fields."""
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

    return pa.schema([field(column) for column in manifest.columns], metadata={SWEEP: manifest.sha256})


def to_table(manifest: Manifest, rows: Mapping[str, np.ndarray]) -> Any:
    """Convert rows to an Arrow table with null for NaN and texts for their indices."""
    import pyarrow as pa

    arrays = []
    for column, field in zip(manifest.columns, target := schema(manifest), strict=True):
        values = rows[column.name]
        if column.kind == "text":
            arrays.append(pa.DictionaryArray.from_arrays(pa.array(values), list(texts_of(column.name))))
        else:
            # Without NaN, Arrow need not copy the values.
            gaps = values.dtype.kind == "f" and bool(np.any(np.isnan(values)))
            arrays.append(pa.array(values, field.type, from_pandas=gaps))
    return pa.Table.from_arrays(arrays, schema=target)


def from_table(manifest: Manifest, table: Any) -> dict[str, np.ndarray]:
    """Convert a table of `to_table` back to rows."""
    rows = {}
    for column in manifest.columns:
        array = table.column(column.name).combine_chunks()
        if column.kind == "text":
            # Arrow may return the dictionary's texts in another order.
            indices = {text: index for index, text in enumerate(texts_of(column.name))}
            translated = np.array([indices[text.as_py()] for text in array.dictionary], np.int8)
            rows[column.name] = translated[array.indices.to_numpy(zero_copy_only=False)]
        else:
            rows[column.name] = array.to_numpy(zero_copy_only=False)
    return rows


def _seal_digits(content: bytes | bytearray) -> slice:
    """Return the position of the checksum's digits, behind its name, a header byte and a length byte."""
    start = content.rfind(SEAL) + len(SEAL) + 2
    return slice(start, start + len(BLANK))


def _digest(content: bytes | bytearray) -> bytes:
    return hashlib.sha256(content).hexdigest().encode("ascii")
