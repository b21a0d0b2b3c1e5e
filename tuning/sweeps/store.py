"""The store of a sweep: a folder with a manifest and one Parquet file per chunk.

    DIR/manifest.json
    DIR/parts/part-000000.parquet, part-000001.parquet, ...
    DIR/errors.png, failures.png, convergence.png
    DIR/verdict.json
    DIR/studies/drivers-1024.json, ... (`tuning.sweeps.stored_studies`)

`DIR/parts` is a Parquet dataset, for pandas, DuckDB or Arrow; units are in the fields' metadata. A part is
there as a whole or not at all: it is written under another name, forced to disk, then renamed. It shows
whether it is as it was written (`tuning.sweeps.parts`). Whatever interrupts a sweep, what is missing can be
computed later, by the same code, and the store is the same, row for row.

Nothing is touched in a folder that holds anything but a store.
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
PICTURES = ("errors.png", "failures.png", "convergence.png")  # made of the rows, not part of them
STUDIES = "studies"
VERDICT = "verdict.json"
LOCK = ".lock"
PART = re.compile(r"part-(\d{6,})\.parquet")


class Store(NamedTuple):
    """An open store."""

    folder: Path
    manifest: Manifest

    def part_path(self, part: int) -> Path:
        return self.folder / PARTS / f"part-{part:06d}.parquet"


def open_store(folder: Path, manifest: Manifest, resume: bool) -> Store:
    """A store for the sweep of `manifest`: a new one or, to `resume`, the one that is there, if any.

    What an interruption left unfinished is removed. Raises `InputError` when the folder holds something
    and is not to be resumed, when its store was made with other inputs or by other code, or when it cannot
    be written.
    """
    where = one_line(str(folder))
    there = _is_store(folder)
    if there and not resume:
        raise InputError(f"{where}: found a sweep, allowed an empty folder, or --resume")
    old = read_manifest(folder) if there else None
    if old and (differing := differences(old, manifest)):
        raise InputError(f"{where}: was made with other inputs: {'; '.join(differing[:3])}")
    if old and (differing := other_code(old, manifest)):
        allowed = "a new folder, or --resume with the version that made this one"
        raise InputError(f"{where}: was made by other code: {'; '.join(differing[:2])}: allowed {allowed}")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with writing(folder / PARTS):
        make_folder(folder / PARTS)
        for place in (folder, folder / PARTS, folder / STUDIES):
            if place.is_dir() and (place == folder or not place.is_symlink()):
                remove_stale(place)
    if old is None:
        with writing(folder / NAME):
            write_whole(folder / NAME, encode(manifest))
    return Store(folder, old or manifest)


def read_store(folder: Path) -> Store:
    """The store that is there. Raises `InputError` if there is none."""
    return Store(folder, read_manifest(folder))


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Nobody else writes to the store meanwhile. Raises `InputError` if somebody does, or if the folder holds
    anything but a store."""
    _is_store(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        with writing(folder / LOCK):
            try:
                held.enter_context(lock(folder / LOCK))
            except BlockingIOError:
                reason = "another sweep is writing to this store"
                raise InputError(f"{one_line(str(folder))}: {reason}") from None
        yield


def write_part(store: Store, part: int, rows: Mapping[str, np.ndarray]) -> None:
    """Write a part, whole or not at all. Raises `InputError` when it cannot be written."""
    path = store.part_path(part)
    # The next part is computed meanwhile, prepared on the other half.
    with on_half_the_cores(1), writing(path):
        write_whole(path, encode_part(store.manifest, rows))


def read_part(store: Store, part: int) -> dict[str, np.ndarray] | None:
    """A part's rows, as `write_part` got them; None if it is missing, damaged, or not of this sweep."""
    try:
        with open_plain(store.part_path(part)) as file:
            content = file.read()
    except OSError:
        return None
    return decode_part(store.manifest, part, content)


def kept_part(store: Store, part: int) -> dict[str, np.ndarray] | None:
    """A part's rows, where nothing is to be made anew: None if there is none.

    Raises `InputError` for one that is damaged or not of this sweep.
    """
    rows, path = read_part(store, part), store.part_path(part)
    if rows is None and os.path.lexists(path):
        found = "found damage, or a part of something else, allowed as it was written"
        raise InputError(
            f"{one_line(str(store.folder))}: {PARTS}/{path.name}: {found} (`jaxhil sweep --resume` makes it)"
        )
    return rows


def write_verdict(store: Store, document: Mapping[str, Any]) -> None:
    """Write the verdict, whole or not at all. Raises `InputError` when it cannot be written."""
    path = store.folder / VERDICT
    with writing(path):
        write_whole(path, terminal.as_json(document).encode("ascii"))


def remove_parts(store: Store, first: int) -> None:
    """Remove the parts from number `first` on. Raises `InputError` when they cannot be."""
    with writing(store.folder / PARTS), os.scandir(store.folder / PARTS) as entries:
        for entry in entries:
            name = PART.fullmatch(entry.name)
            if name and int(name[1]) >= first and entry.is_file(follow_symlinks=False):
                os.unlink(entry)


def read_row(store: Store, index: int) -> dict[str, Any]:
    """One row, arrays of length 1. Raises `InputError` for an index that the store does not hold."""
    manifest = store.manifest
    where = one_line(str(store.folder))
    if not 0 <= index < manifest.scenarios:
        raise InputError(f"{where}: index: found {index}, allowed 0 to {manifest.scenarios - 1}")
    part, place = divmod(index, manifest.chunk)
    rows = kept_part(store, part)
    if rows is None:
        if manifest.until_width is not None:
            raise InputError(f"{where}: index: found {index}, allowed those before the sweep stopped")
        name = store.part_path(part).name
        raise InputError(f"{where}: {PARTS}/{name}: missing (`jaxhil sweep --resume` makes it)")
    return {name: values[place : place + 1] for name, values in rows.items()}


def _is_store(folder: Path) -> bool:
    """Whether a sweep's manifest is there; False where there is nothing, or the beginning of a store.

    Raises `InputError` for a folder that holds anything else, or cannot be read.
    """
    try:
        found = set(os.listdir(folder)) if os.path.lexists(folder) else set()
        if NAME in found:
            return True
        other = found - {LOCK, PARTS} or (set(os.listdir(folder / PARTS)) if PARTS in found else set())
        other = {name for name in other if not is_temporary(name)}
    except OSError as error:
        reason = one_line(error.strerror or str(error), 100)
        raise InputError(f"{one_line(str(folder))}: cannot be read: {reason}") from None
    if other:
        allowed = "an empty folder, or a sweep's and --resume"
        raise InputError(
            f"{one_line(str(folder))}: found {shown(min(other))} and no sweep, allowed {allowed}"
        )
    return False
