"""The store of a sweep: a folder with a manifest and one Parquet file per chunk.

    DIR/manifest.json
    DIR/parts/part-000000.parquet, part-000001.parquet, ...
    DIR/errors.png, failures.png, convergence.png
    DIR/verdict.json
    DIR/studies/drivers-1024.json, ... (`tuning.sweeps.stored_studies`)

`DIR/parts` is a Parquet dataset, for pandas, DuckDB or Arrow; units are in the fields' metadata. A part is
there as a whole or not at all: it is written under another name, forced to disk, then renamed. It carries the
manifest's digest and checksums of its pages. Whatever interrupts a sweep, what is missing can be computed
later, and the store is the same, row for row.
"""

import fcntl
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, one_line
from tuning.files import TEMPORARY, write_whole, writing
from tuning.sweeps.columns import Column, texts_of
from tuning.sweeps.manifest import NAME, Manifest, differences, encode, read_manifest

PARTS = "parts"
PICTURES = ("errors.png", "failures.png", "convergence.png")  # made of the rows, not part of them
STUDIES = "studies"
VERDICT = "verdict.json"
LOCK = ".lock"
DIGEST = b"jaxhil.sweep.sha256"


class Store(NamedTuple):
    """An open store."""

    folder: Path
    manifest: Manifest

    def part_path(self, part: int) -> Path:
        return self.folder / PARTS / f"part-{part:06d}.parquet"


def open_store(folder: Path, manifest: Manifest, resume: bool) -> Store:
    """A store for the sweep of `manifest`: a new one or, to `resume`, the one that is there, if any.

    What an interruption left unfinished is removed. Raises `InputError` when the folder holds something
    and is not to be resumed, when its store was made with other inputs, or when it cannot be written.
    """
    shown = one_line(str(folder))
    with writing(folder):
        (folder / PARTS).mkdir(parents=True, exist_ok=True)
        for place in (folder, folder / PARTS, folder / STUDIES):
            for stale in place.glob(f".*{TEMPORARY}"):
                stale.unlink(missing_ok=True)
        held = {entry.name for entry in folder.iterdir()} - {LOCK, PARTS, *PICTURES}
        parts = any((folder / PARTS).iterdir())
    if NAME in held and resume:
        old = read_manifest(folder)
        if differing := differences(old, manifest):
            raise InputError(f"{shown}: was made with other inputs: {'; '.join(differing[:3])}")
        return Store(folder, old)
    if held or parts:
        allowed = "an empty folder, or a store and --resume" if not resume else "a store with its manifest"
        raise InputError(f"{shown}: found a folder with something in it, allowed {allowed}")
    with writing(folder / NAME):
        write_whole(folder / NAME, encode(manifest))
    return Store(folder, manifest)


def read_store(folder: Path) -> Store:
    """The store that is there. Raises `InputError` if there is none."""
    return Store(folder, read_manifest(folder))


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Nobody else writes to the store meanwhile. Raises `InputError` if somebody does."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("wb")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"{one_line(str(folder))}: another sweep is writing to this store") from None
        yield


def write_part(store: Store, part: int, rows: Mapping[str, np.ndarray]) -> None:
    """Write a part, whole or not at all. Raises `InputError` when it cannot be written."""
    import pyarrow as pa
    from pyarrow import parquet

    buffer = pa.BufferOutputStream()
    texts = [column.name for column in store.manifest.columns if column.kind == "text"]
    parquet.write_table(
        to_table(store.manifest, rows),
        buffer,
        compression="zstd",
        compression_level=1,
        # Numbers hardly repeat.
        use_dictionary=texts,  # pyright: ignore[reportArgumentType]
        write_page_checksum=True,
    )
    path = store.part_path(part)
    with writing(path):
        write_whole(path, buffer.getvalue())


def read_part(store: Store, part: int) -> dict[str, np.ndarray] | None:
    """A part's rows, as `write_part` got them; None if it is missing, damaged, or not of this sweep."""
    import pyarrow as pa
    from pyarrow import parquet

    path = store.part_path(part)
    try:
        with path.open("rb") as file:
            table = parquet.ParquetFile(file, page_checksum_verification=True).read()
    except FileNotFoundError:
        return None
    except (pa.ArrowException, OSError, ValueError):
        # A file cut short or overwritten can fail in several ways; it is then made anew.
        return None
    manifest = store.manifest
    first, number = manifest.part_rows(part)
    metadata = table.schema.metadata or {}
    if metadata.get(DIGEST) != manifest.sha256.encode() or table.num_rows != number:
        return None
    if not table.schema.equals(schema(manifest)):
        return None
    rows = from_table(manifest, table)
    return rows if np.array_equal(rows["index"], np.arange(first, first + number)) else None


def write_verdict(store: Store, text: str) -> None:
    """Write the verdict, whole or not at all. Raises `InputError` when it cannot be written."""
    path = store.folder / VERDICT
    with writing(path):
        write_whole(path, text.encode("ascii"))


def remove_parts(store: Store, first: int) -> None:
    """Remove the parts from number `first` on. Raises `InputError` when they cannot be."""
    with writing(store.folder / PARTS):
        for path in (store.folder / PARTS).glob("part-*.parquet"):
            number = path.stem.removeprefix("part-")
            if number.isdigit() and int(number) >= first:
                path.unlink(missing_ok=True)


def read_row(store: Store, index: int) -> dict[str, Any]:
    """One row, arrays of length 1. Raises `InputError` for an index that the store does not hold."""
    manifest = store.manifest
    shown = one_line(str(store.folder))
    if not 0 <= index < manifest.scenarios:
        raise InputError(f"{shown}: index: found {index}, allowed 0 to {manifest.scenarios - 1}")
    part, place = divmod(index, manifest.chunk)
    rows = read_part(store, part)
    if rows is None:
        name = store.part_path(part).name
        if manifest.until_width is not None and not store.part_path(part).exists():
            raise InputError(f"{shown}: index: found {index}, allowed those before the sweep stopped")
        raise InputError(f"{shown}: {PARTS}/{name}: missing or damaged (`jaxhil sweep --resume` makes it)")
    return {name: values[place : place + 1] for name, values in rows.items()}


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

    return pa.schema([field(column) for column in manifest.columns], metadata={DIGEST: manifest.sha256})


def to_table(manifest: Manifest, rows: Mapping[str, np.ndarray]) -> Any:
    """Rows as an Arrow table: NaN is null, texts are spelled out."""
    import pyarrow as pa

    arrays = []
    for column, field in zip(manifest.columns, target := schema(manifest), strict=True):
        values = rows[column.name]
        if column.kind == "text":
            arrays.append(pa.DictionaryArray.from_arrays(pa.array(values), list(texts_of(column.name))))
        else:
            arrays.append(pa.array(values, field.type, from_pandas=True))
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
