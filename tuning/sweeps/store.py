"""Store of a sweep: a folder with a manifest and one Parquet file per chunk.

    DIR/manifest.json
    DIR/parts/part-000000.parquet, part-000001.parquet, ...
    DIR/errors.png, failures.png, convergence.png
    DIR/verdict.json
    DIR/studies/drivers-1024.json, ... (`tuning.sweeps.stored_studies`)

`DIR/parts` is a Parquet dataset for pandas, DuckDB or Arrow, with units in the metadata of its fields. Chunk
files are written atomically and have a checksum (`tuning.sweeps.chunk_file`). After an interruption, the same
code computes the missing chunks; the rows equal those of an uninterrupted sweep.

A folder that holds files other than those of a store is never changed.
"""

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import (
    is_temporary,
    lock_file,
    make_folder,
    open_regular,
    remove_stale,
    report_write_errors,
    write_atomically,
)
from jaxhil.simulation.jax_environment import use_half_the_cores
from tuning import terminal
from tuning.sweeps.chunk_file import decode_chunk, encode_chunk
from tuning.sweeps.manifest import (
    MANIFEST_FILE,
    Manifest,
    encode_manifest,
    list_code_differences,
    list_input_differences,
    read_manifest,
)

CHUNK_FOLDER = "parts"
PLOTS = ("errors.png", "failures.png", "convergence.png")  # plots of the rows
STUDY_FOLDER = "studies"
VERDICT_FILE = "verdict.json"
LOCK_FILE = ".lock"
CHUNK_FILE_PATTERN = re.compile(r"part-(\d{6,})\.parquet")


class SweepStore(NamedTuple):
    """Folder of a sweep's store, with the manifest."""

    folder: Path
    manifest: Manifest

    def chunk_path(self, part: int) -> Path:
        return self.folder / CHUNK_FOLDER / f"part-{part:06d}.parquet"


def open_store(folder: Path, manifest: Manifest, resume: bool) -> SweepStore:
    """Create a store for `manifest`; if `resume` is true and a store exists, open it.

    Also remove temporary files that an interrupted run left behind.

    Raises:
        InputError: If a store exists but `resume` is false, if its inputs or code differ from those in
            `manifest`, if the folder holds files but no store, or if it cannot be written.
    """
    where = to_one_line(str(folder))
    exists = _is_store(folder)
    if exists and not resume:
        raise InputError(f"{where}: found a sweep, expected an empty folder, or --resume to continue it")
    old = read_manifest(folder) if exists else None
    if old and (differing := list_input_differences(old, manifest)):
        raise InputError(f"{where}: was made with other inputs: {'; '.join(differing[:3])}")
    if old and (differing := list_code_differences(old, manifest)):
        allowed = "a new folder, or --resume with the version that wrote this store"
        raise InputError(f"{where}: was made by other code: {'; '.join(differing[:2])}; expected {allowed}")
    with report_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with report_write_errors(folder / CHUNK_FOLDER):
        make_folder(folder / CHUNK_FOLDER)
        for path in (folder, folder / CHUNK_FOLDER, folder / STUDY_FOLDER):
            if path.is_dir() and (path == folder or not path.is_symlink()):
                remove_stale(path)
    if old is None:
        with report_write_errors(folder / MANIFEST_FILE):
            write_atomically(folder / MANIFEST_FILE, encode_manifest(manifest))
    return SweepStore(folder, old or manifest)


def read_store(folder: Path) -> SweepStore:
    """Open the existing store in `folder`; raise `InputError` if its manifest is missing or invalid."""
    return SweepStore(folder, read_manifest(folder))


@contextmanager
def lock_store(folder: Path) -> Iterator[None]:
    """Context manager: lock the store in `folder`, so that no other process writes to it.

    Raise `InputError` if another process holds the lock, or if the folder holds files other than a store's.
    """
    _is_store(folder)
    with report_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as locks:
        with report_write_errors(folder / LOCK_FILE):
            try:
                locks.enter_context(lock_file(folder / LOCK_FILE))
            except BlockingIOError:
                reason = "found another sweep that is writing, expected none; wait until it ends"
                raise InputError(f"{to_one_line(str(folder))}: {reason}") from None
        yield


def write_chunk(store: SweepStore, part: int, rows: Mapping[str, np.ndarray]) -> None:
    """Write the file of chunk number `part` atomically; raise `InputError` if writing fails."""
    path = store.chunk_path(part)
    # The next chunk is prepared at the same time, on the other half of the cores.
    with use_half_the_cores(1), report_write_errors(path):
        write_atomically(path, encode_chunk(store.manifest, rows))


def read_chunk(store: SweepStore, part: int) -> dict[str, np.ndarray] | None:
    """Read the rows of chunk number `part`; None if the file is missing, damaged or from another sweep."""
    try:
        with open_regular(store.chunk_path(part)) as file:
            content = file.read()
    except OSError:
        return None
    return decode_chunk(store.manifest, part, content)


def read_intact_chunk(store: SweepStore, part: int) -> dict[str, np.ndarray] | None:
    """Read the rows of chunk number `part`; return None if the file is missing.

    Raise `InputError` if the file is damaged or from another sweep.
    """
    rows, path = read_chunk(store, part), store.chunk_path(part)
    if rows is None and os.path.lexists(path):
        reason = "found a damaged file or one of another sweep, expected a file of this sweep"
        raise InputError(
            f"{to_one_line(str(store.folder))}: {CHUNK_FOLDER}/{path.name}: {reason} (`jaxhil sweep "
            "--resume` writes it again)"
        )
    return rows


def write_verdict(store: SweepStore, document: Mapping[str, Any]) -> None:
    """Write the sweep's verdict as a JSON file, atomically; raise `InputError` if writing fails."""
    path = store.folder / VERDICT_FILE
    with report_write_errors(path):
        write_atomically(path, terminal.format_json(document).encode("ascii"))


def remove_chunks(store: SweepStore, first: int) -> None:
    """Remove the files of chunk number `first` and all later chunks; raise `InputError` if this fails."""
    with report_write_errors(store.folder / CHUNK_FOLDER), os.scandir(store.folder / CHUNK_FOLDER) as entries:
        for entry in entries:
            name = CHUNK_FILE_PATTERN.fullmatch(entry.name)
            if name and int(name[1]) >= first and entry.is_file(follow_symlinks=False):
                os.unlink(entry)


def read_row(store: SweepStore, index: int) -> dict[str, Any]:
    """Read the row of scenario `index`, as arrays of length 1; raise `InputError` if it is not stored."""
    manifest = store.manifest
    where = to_one_line(str(store.folder))
    if not 0 <= index < manifest.scenarios:
        raise InputError(f"{where}: index: found {index}, expected 0 to {manifest.scenarios - 1}")
    part, row = divmod(index, manifest.chunk)
    rows = read_intact_chunk(store, part)
    if rows is None:
        if manifest.until_width is not None:
            raise InputError(f"{where}: index: found {index}, expected a scenario before the sweep's end")
        name = store.chunk_path(part).name
        raise InputError(f"{where}: {CHUNK_FOLDER}/{name}: missing (`jaxhil sweep --resume` computes it)")
    return {name: values[row : row + 1] for name, values in rows.items()}


def _is_store(folder: Path) -> bool:
    """Return True if the folder holds a sweep's manifest, False if the folder is missing or empty.

    Lock file, temporary files and an empty chunk folder do not count. Raise `InputError` if the folder holds
    other files or cannot be read.
    """
    try:
        names = set(os.listdir(folder)) if os.path.lexists(folder) else set()
        if MANIFEST_FILE in names:
            return True
        others = names - {LOCK_FILE, CHUNK_FOLDER} or (
            set(os.listdir(folder / CHUNK_FOLDER)) if CHUNK_FOLDER in names else set()
        )
        others = {name for name in others if not is_temporary(name)}
    except OSError as error:
        reason = to_one_line(error.strerror or str(error), 100)
        raise InputError(f"{to_one_line(str(folder))}: cannot be read: {reason}") from None
    if others:
        allowed = "an empty folder, or a sweep's folder and --resume"
        raise InputError(
            f"{to_one_line(str(folder))}: found {format_value(min(others))} and no sweep, expected {allowed}"
        )
    return False
