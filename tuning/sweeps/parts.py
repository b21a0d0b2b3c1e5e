"""Parts of a store: some rows of a sweep as a Parquet file that shows whether it is as it was written.

A part carries the manifest's digest, and a SHA-256 of the whole file but for the digits of this digest, which
stand in the file's own metadata: pandas, DuckDB and Arrow read it like any other. It is checked before the
file is parsed. What the rows say of outcomes has to follow from their errors and statuses.
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
BLANK = b"0" * 64  # in the place of the seal while it is worked out
FORCE_RANGE = "rig.force_sensor.range"
PERIOD = "rig.control_period"


def encode_part(manifest: Manifest, rows: Mapping[str, np.ndarray]) -> bytearray:
    """The content of a part's file."""
    import pyarrow as pa
    from pyarrow import parquet

    buffer = pa.BufferOutputStream()
    table = to_table(manifest, rows)
    texts = [column.name for column in manifest.columns if column.kind == "text"]
    # Numbers hardly repeat: to spare the disk another tenth would take twice the time. Only by its index is a
    # row looked for, so that nothing else needs its extremes stated.
    options: dict[str, Any] = {"compression": "lz4", "use_dictionary": texts, "write_statistics": ["index"]}
    with parquet.ParquetWriter(buffer, table.schema, **options) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({SEAL: BLANK})
    content = bytearray(buffer.getvalue())
    place = _seal_place(content)
    assert content[place] == BLANK
    content[place] = _digest(content)
    return content


def decode_part(manifest: Manifest, part: int, content: bytes) -> dict[str, np.ndarray] | None:
    """The rows that `encode_part` got; None for any other content than it made for this part."""
    import pyarrow as pa
    from pyarrow import parquet

    place = _seal_place(content)
    if content[place] != _digest(content[: place.start] + BLANK + content[place.stop :]):
        return None
    try:
        table = parquet.ParquetFile(pa.BufferReader(content)).read()
        return _checked(manifest, part, table)
    except (pa.ArrowException, InputError, LookupError, OSError, TypeError, ValueError):
        # Sealed, but by something else.
        return None


def _checked(manifest: Manifest, part: int, table: Any) -> dict[str, np.ndarray] | None:
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
        # Whether it was drawn or not, the least of three.
        forces = [f"{FORCE_RANGE}_{axis}" for axis in (1, 2, 3)]
        ranges = zip(forces, mechanism.rig.force_sensor.range[:3], strict=True)
        force_range = np.min(np.broadcast_arrays(*(rows.get(name, own) for name, own in ranges)), axis=0)
    else:
        force_range = rows.get(FORCE_RANGE, np.array(mechanism.rig.force_sensor.range))
    period = rows.get(PERIOD, np.array(mechanism.rig.control_period))
    judged = judge(rows, slots(mechanism), force_range, period, manifest.largest_error)
    return None if same_rows(judged, rows) else rows


def same_rows(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> list[str]:
    """Names of the columns that differ, to the bit but for which NaN it is."""
    return [
        name
        for name in one
        if one[name].dtype != other[name].dtype
        or not np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f")
    ]


def schema(manifest: Manifest) -> Any:
    """The Arrow schema of every part; units and meanings are metadata of the fields."""
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
    """Rows as an Arrow table: NaN is null, texts are spelled out."""
    import pyarrow as pa

    arrays = []
    for column, field in zip(manifest.columns, target := schema(manifest), strict=True):
        values = rows[column.name]
        if column.kind == "text":
            arrays.append(pa.DictionaryArray.from_arrays(pa.array(values), list(texts_of(column.name))))
        else:
            # Where there is no NaN to be looked for again, values need not be copied.
            gaps = values.dtype.kind == "f" and bool(np.any(np.isnan(values)))
            arrays.append(pa.array(values, field.type, from_pandas=gaps))
    return pa.Table.from_arrays(arrays, schema=target)


def from_table(manifest: Manifest, table: Any) -> dict[str, np.ndarray]:
    """The rows that `to_table` made a table of."""
    rows = {}
    for column in manifest.columns:
        array = table.column(column.name).combine_chunks()
        if column.kind == "text":
            # A dictionary that was read holds the texts in another order.
            places = {text: place for place, text in enumerate(texts_of(column.name))}
            translated = np.array([places[text.as_py()] for text in array.dictionary], np.int8)
            rows[column.name] = translated[array.indices.to_numpy(zero_copy_only=False)]
        else:
            rows[column.name] = array.to_numpy(zero_copy_only=False)
    return rows


def _seal_place(content: bytes | bytearray) -> slice:
    """Of the seal's digits: behind its name, the field's header and the length, of a byte each."""
    start = content.rfind(SEAL) + len(SEAL) + 2
    return slice(start, start + len(BLANK))


def _digest(content: bytes | bytearray) -> bytes:
    return hashlib.sha256(content).hexdigest().encode("ascii")
