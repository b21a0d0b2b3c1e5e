"""A bundle: the folder in which gains leave for a rig computer that has never heard of jax.

`build_bundle` makes the content of every file from a checked gain file; equal gains, limits and seed make
equal files. `write_bundle` puts them in place as a whole or not at all.
"""

import errno
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import TEMPORARY, exchange, remove_stale, sync_folder, temporary_name, writing
from jaxhil.rig import GainFileError, digest
from jaxhil.rig.gain_file import read_gain_document
from jaxhil.rig.limits import LIMITS
from tuning.bundle import selftest
from tuning.bundle.content import bundle_files
from tuning.bundle.manifest import is_bundle
from tuning.verification.stops import Stop


class Bundle(NamedTuple):
    """A bundle in memory, and what its vectors say."""

    document: dict[str, Any]  # the gain document as exported
    files: dict[str, bytes]  # the content of every file, by its path
    ticks: int  # of the vectors
    runs: int  # of the vectors
    # what ended the comparison with the simulation in each recorded run; None: nothing
    ended: list[str | None]
    reasons: list[str]  # what disagrees, in words
    stop: Stop | None  # what the limits act on in the nominal run; None: nothing
    passing: dict[str, float] | None  # limits with which that run passes; None if there are none


def build_bundle(
    document: Mapping[str, Any],
    formats: Sequence[str],
    limits: Mapping[str, float | None] | None = None,
    rates: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda message: None,
    sign: Callable[[bytes], bytes] | None = None,
) -> Bundle:
    """The bundle of a checked gain document, with `limits` for the rig [SI units] if there are any.

    `rates`, plain data, say what is known of the watchdog's alarms under these limits. `progress` is given
    what begins. `sign` makes the signature of the manifest's bytes; None: the bundle is not signed. Raises
    `InputError` for limits that the runtime refuses or a compensator that a format lacks.
    """
    from jaxhil.simulation.gain_file import check_document
    from tuning.bundle.vectors import as_csv, make_vectors

    exported = with_limits(document, limits, rates)
    loaded = check_document(exported)
    progress("recording test vectors")
    vectors = make_vectors(loaded, seed)
    progress("writing the bundle")
    files = bundle_files(exported, formats, as_csv(vectors.rows).encode("ascii"))
    if sign is not None:
        files[selftest.SIGNATURE] = sign(files[selftest.MANIFEST])
    runs = len({row.run for row in vectors.rows})
    found = vectors.ended, vectors.reasons, vectors.stop, vectors.passing
    return Bundle(exported, files, len(vectors.rows), runs, *found)


def with_limits(
    document: Mapping[str, Any],
    limits: Mapping[str, float | None] | None,
    rates: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The gain document with these limits, None for no limit, signed anew; without limits as it is.

    The rates become `figures.watchdog`.
    """
    if limits is None:
        return dict(document)
    figures = {**document["figures"], **({"watchdog": rates} if rates else {})}
    changed = {**document, "limits": limits_section(limits), "figures": figures}
    return {**changed, "sha256": digest(changed)}


def limits_section(limits: Mapping[str, float | None]) -> dict[str, dict[str, Any]]:
    """The `limits` of a gain file: value and unit by name."""
    return {name: {"value": value, "unit": LIMITS[name].unit} for name, value in limits.items()}


def check_target(folder: Path) -> None:
    """A bundle may be written there: there is nothing, an empty folder, or a bundle as it was exported.

    Raises `InputError` otherwise: what someone has changed or added is not to be lost.
    """
    where = one_line(str(folder))
    try:
        if not folder.exists() and not folder.is_symlink():
            return
        if not folder.is_dir():
            raise InputError(f"{where}: found a file, allowed a folder for the bundle")
        _own_files(folder)
    except OSError as error:
        raise InputError(f"{where}: cannot be read: {one_line(error.strerror or str(error))}") from None


def check_mechanism(folder: Path, name: str) -> None:
    """Check that a bundle there is of the mechanism of that name. Raise `InputError` otherwise."""
    try:
        there = read_gain_document(folder / "gains.json")["mechanism"]["name"]
    except (GainFileError, KeyError, TypeError):
        return  # nothing, or no bundle as it was exported, which `check_target` refuses
    if there != name:
        found = f"found the bundle of mechanism {shown(there)}, expected that of {shown(name)}"
        raise InputError(f"{one_line(str(folder))}: {found}, or none: name another folder by --output")


def write_bundle(folder: Path, files: Mapping[str, bytes]) -> None:
    """The bundle is there as a whole or, after an error, what was there before. Raises `InputError`."""
    check_target(folder)
    target = folder.resolve()
    new = target.with_name(temporary_name())
    with writing(folder):
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_stale(target.parent)
        new.mkdir()
        try:
            for name, content in files.items():
                path = new / name
                path.parent.mkdir(parents=True, exist_ok=True)
                with path.open("xb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            for place in {(new / name).parent for name in files}:
                sync_folder(place)
            _put(new, target)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise
        sync_folder(target.parent)


def _put(new: Path, target: Path) -> None:
    """The new folder in the place of the old one, which is removed."""
    if not target.exists():
        os.replace(new, target)
        return
    _swap(new, target)
    old = new
    try:
        # Looked at once more where nobody writes any longer: what was put there in between stays.
        own = _own_files(old)
    except BaseException:
        _swap(old, target)
        raise
    with suppress(OSError):
        for name in own:
            (old / name).rmdir() if name.endswith("/") else (old / name).unlink()
        old.rmdir()


def _swap(new: Path, target: Path) -> None:
    """Each of two folders gets the other's name."""
    try:
        exchange(new, target)
        return
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.EINVAL):
            raise
    # Here a power cut between the two leaves the old one under its other name, which nothing removes.
    old = target.with_name(f".{target.name}.{os.getpid()}.old{TEMPORARY}")
    os.replace(target, old)
    try:
        os.replace(new, target)
    except BaseException:
        os.replace(old, target)
        raise
    os.replace(old, new)


def _own_files(folder: Path) -> list[str]:
    """The paths of an intact bundle's files, then of the folders within it, which end with a stroke, the
    innermost first; none in an empty folder.

    Raises `InputError` for a folder in which there is anything else.
    """
    where, allowed = one_line(str(folder)), "allowed a new or empty folder, or a bundle as it was exported"
    inside = sorted(os.listdir(folder))
    if not inside:
        return []
    if not is_bundle(folder):
        raise InputError(f"{where}: found {shown(inside[0])} and no bundle, {allowed}")
    found, problems = selftest.differences(str(folder))
    files = [*found]
    for name, text in problems:
        if not name.endswith(selftest.CACHE):
            raise InputError(f"{where}: {one_line(name, 80)}: {text}; {allowed}")
        for entry in list(os.scandir(folder / name)):
            # Of Python's own making, and nothing but that.
            if not (entry.is_file(follow_symlinks=False) and entry.name.endswith(".pyc")):
                raise InputError(f"{where}: {name}{one_line(entry.name, 80)}: no file of a bundle; {allowed}")
            files.append(name + entry.name)
    folders = {f"{name[:place]}/" for name in files for place, sign in enumerate(name) if sign == "/"}
    return [*files, *sorted(folders, key=len, reverse=True)]
