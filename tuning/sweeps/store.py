"""Store of a sweep: a folder with a manifest and one Parquet file per chunk.

    DIR/manifest.json
    DIR/parts/part-000000.parquet, part-000001.parquet, ...
    DIR/errors.png, failures.png, convergence.png
    DIR/verdict.json
    DIR/studies/drivers-1024.json, ... (`tuning.sweeps.stored_studies`)

`DIR/parts` is a Parquet dataset for pandas, DuckDB or Arrow; units are in the fields' metadata. Parts are
written atomically (under another name, flushed to disk, then renamed) and have a checksum
(`tuning.sweeps.parts`). After any interruption the same code can compute the missing parts, and the rows are
those of an uninterrupted sweep.

A folder that holds other files than a store is never changed.
"""

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import is_temporary, lock, make_folder, open_plain, remove_stale, write_whole, writing
from jaxhil.simulation.environment import on_half_the_cores
from tuning import terminal
from tuning.sweeps.manifest import NAME, Manifest, differences, encode, other_code, read_manifest
from tuning.sweeps.parts import decode_part, encode_part

PARTS = "parts"
PLOTS = ("errors.png", "failures.png", "convergence.png")  # plots made from the rows
STUDIES = "studies"
VERDICT = "verdict.json"
LOCK = ".lock"
PART = re.compile(r"part-(\d{6,})\.parquet")


class Store(NamedTuple):
    """Open store."""

    folder: Path
    manifest: Manifest

    def part_path(self, part: int) -> Path:
        """Return the path of a part's file."""
        return self.folder / PARTS / f"part-{part:06d}.parquet"


def open_store(folder: Path, manifest: Manifest, resume: bool) -> Store:
    """Create the store of `manifest`, or with `resume` open the existing one.

    Temporary files of an interrupted run are removed. Raise `InputError` if the folder holds a store that is
    not to be resumed, or other files, if its store was made with other inputs or by other code, or if it
    cannot be written.
    """
    where = one_line(str(folder))
    exists = _is_store(folder)
    if exists and not resume:
        raise InputError(f"{where}: found a sweep, allowed an empty folder, or --resume")
    old = read_manifest(folder) if exists else None
    if old and (differing := differences(old, manifest)):
        raise InputError(f"{where}: was made with other inputs: {'; '.join(differing[:3])}")
    if old and (differing := other_code(old, manifest)):
        allowed = "a new folder, or --resume with the version that made this one"
        raise InputError(f"{where}: was made by other code: {'; '.join(differing[:2])}: allowed {allowed}")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with writing(folder / PARTS):
        make_folder(folder / PARTS)
        for path in (folder, folder / PARTS, folder / STUDIES):
            if path.is_dir() and (path == folder or not path.is_symlink()):
                remove_stale(path)
    if old is None:
        with writing(folder / NAME):
            write_whole(folder / NAME, encode(manifest))
    return Store(folder, old or manifest)


def read_store(folder: Path) -> Store:
    """Open the existing store in `folder`; raise `InputError` if there is none."""
    return Store(folder, read_manifest(folder))


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the store for writing.

    Raise `InputError` if another process holds the lock or the folder holds other files than a store.
    """
    _is_store(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as locks:
        with writing(folder / LOCK):
            try:
                locks.enter_context(lock(folder / LOCK))
            except BlockingIOError:
                reason = "another sweep is writing to this store"
                raise InputError(f"{one_line(str(folder))}: {reason}") from None
        yield


def write_part(store: Store, part: int, rows: Mapping[str, np.ndarray]) -> None:
    """Write a part atomically; raise `InputError` if it cannot be written."""
    path = store.part_path(part)
    # The next part is prepared on the other half of the cores at the same time.
    with on_half_the_cores(1), writing(path):
        write_whole(path, encode_part(store.manifest, rows))


def read_part(store: Store, part: int) -> dict[str, np.ndarray] | None:
    """Read the rows of a part; return None if it is missing, damaged, or of another sweep."""
    try:
        with open_plain(store.part_path(part)) as file:
            content = file.read()
    except OSError:
        return None
    return decode_part(store.manifest, part, content)


def kept_part(store: Store, part: int) -> dict[str, np.ndarray] | None:
    """Read the rows of a part; return None if it is missing.

    Raise `InputError` if it is damaged or of another sweep.
    """
    rows, path = read_part(store, part), store.part_path(part)
    if rows is None and os.path.lexists(path):
        reason = "found damage, or a part of something else, allowed as it was written"
        raise InputError(
            f"{one_line(str(store.folder))}: {PARTS}/{path.name}: {reason} (`jaxhil sweep --resume` makes it)"
        )
    return rows


def write_verdict(store: Store, document: Mapping[str, Any]) -> None:
    """Write the verdict atomically; raise `InputError` if it cannot be written."""
    path = store.folder / VERDICT
    with writing(path):
        write_whole(path, terminal.as_json(document).encode("ascii"))


def remove_parts(store: Store, first: int) -> None:
    """Remove the parts from number `first` on; raise `InputError` if one cannot be removed."""
    with writing(store.folder / PARTS), os.scandir(store.folder / PARTS) as entries:
        for entry in entries:
            name = PART.fullmatch(entry.name)
            if name and int(name[1]) >= first and entry.is_file(follow_symlinks=False):
                os.unlink(entry)


def read_row(store: Store, index: int) -> dict[str, Any]:
    """Read one row, arrays of length 1; raise `InputError` for an index that the store does not hold."""
    manifest = store.manifest
    where = one_line(str(store.folder))
    if not 0 <= index < manifest.scenarios:
        raise InputError(f"{where}: index: found {index}, allowed 0 to {manifest.scenarios - 1}")
    part, row = divmod(index, manifest.chunk)
    rows = kept_part(store, part)
    if rows is None:
        if manifest.until_width is not None:
            raise InputError(f"{where}: index: found {index}, allowed those before the sweep stopped")
        name = store.part_path(part).name
        raise InputError(f"{where}: {PARTS}/{name}: missing (`jaxhil sweep --resume` makes it)")
    return {name: values[row : row + 1] for name, values in rows.items()}


def _is_store(folder: Path) -> bool:
    """Return whether the folder holds a sweep's manifest; False if it is missing or empty.

    An empty store without manifest counts as empty. Raise `InputError` if the folder holds other files or
    cannot be read.
    """
    try:
        names = set(os.listdir(folder)) if os.path.lexists(folder) else set()
        if NAME in names:
            return True
        foreign = names - {LOCK, PARTS} or (set(os.listdir(folder / PARTS)) if PARTS in names else set())
        foreign = {name for name in foreign if not is_temporary(name)}
    except OSError as error:
        reason = one_line(error.strerror or str(error), 100)
        raise InputError(f"{one_line(str(folder))}: cannot be read: {reason}") from None
    if foreign:
        allowed = "an empty folder, or a sweep's and --resume"
        raise InputError(
            f"{one_line(str(folder))}: found {shown(min(foreign))} and no sweep, allowed {allowed}"
        )
    return False
