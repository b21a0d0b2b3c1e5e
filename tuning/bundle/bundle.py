"""Bundle: folder with gains and controller for a rig computer, which does not need JAX.

`build_bundle` computes the content of every file from a checked gain document. Equal gains, limits and seeds
give equal files. `write_bundle` writes all files atomically.
"""

import errno
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import (
    TEMPORARY_SUFFIX,
    exchange_names,
    remove_stale,
    report_write_errors,
    sync_folder,
    temporary_name,
)
from jaxhil.rig import GainFileError, digest
from jaxhil.rig.gain_file import read_gain_document
from tuning.bundle import selftest
from tuning.bundle.content import bundle_files
from tuning.bundle.controller_kind import ONE_AXIS, kind_of
from tuning.bundle.manifest import is_bundle
from tuning.verification.stops import ControllerStop


class Bundle(NamedTuple):
    """Files of a bundle in memory, and the comparison of its test vectors with the simulation."""

    document: dict[str, Any]  # exported gain document
    files: dict[str, bytes]  # content of every file, by its path in the bundle
    ticks: int  # number of ticks in the test vectors
    runs: int  # number of runs in the test vectors
    # for each recorded run, the reason if its comparison with the simulation ended early, else None
    ended: list[str | None]
    reasons: list[str]  # descriptions of the differences between runtime and simulation
    stop: ControllerStop | None  # first stop of the nominal run by a limit; None if no limit stops it
    passing: dict[str, float] | None  # changed limits that let the nominal run pass; None if `stop` is None


def build_bundle(
    document: Mapping[str, Any],
    formats: Sequence[str],
    limits: Mapping[str, float | None] | None = None,
    rates: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda message: None,
    sign: Callable[[bytes], bytes] | None = None,
) -> Bundle:
    """Build the bundle of a checked gain document.

    Args:
        document: gain document.
        formats: names of the additional formats of the gains.
        limits: limits for the rig [SI units]. A value of None disables a limit. Without this argument, the
            limits of the document remain.
        rates: alarm rates of the watchdog with these limits, as JSON data.
        seed: seed of the test vectors.
        progress: callback, called with the name of each step.
        sign: function that returns the signature of the manifest's bytes; None leaves the bundle unsigned.

    Returns:
        Files of the bundle, and the comparison of its test vectors with the simulation.

    Raises:
        InputError: If the runtime rejects the limits, or the compensator does not support a format.
    """
    from jaxhil.simulation.gain_file import check_document

    exported = replace_limits(document, limits, rates)
    loaded = check_document(exported, any_axes=True)
    progress("recording test vectors")
    vectors, text = _make_vectors(loaded, seed)
    progress("writing the bundle")
    files = bundle_files(exported, formats, text.encode("ascii"))
    if sign is not None:
        files[selftest.SIGNATURE_FILE] = sign(files[selftest.MANIFEST_FILE])
    runs = len({row.run for row in vectors.rows})
    comparison = vectors.ended, vectors.reasons, vectors.stop, vectors.passing
    return Bundle(exported, files, len(vectors.rows), runs, *comparison)


def _make_vectors(loaded: Any, seed: int) -> tuple[Any, str]:
    """Return the test vectors of a gain file, and the text of vectors.csv."""
    if kind_of(loaded.document) is ONE_AXIS:
        from tuning.bundle.vectors import format_csv, make_vectors

        vectors = make_vectors(loaded, seed)
        return vectors, format_csv(vectors.rows)
    from tuning.bundle.vectors_six_axes import format_six_axis_csv, make_six_axis_vectors

    vectors = make_six_axis_vectors(loaded, seed)
    return vectors, format_six_axis_csv(vectors.rows)


def replace_limits(
    document: Mapping[str, Any],
    limits: Mapping[str, float | None] | None,
    rates: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return a copy of the gain document with other limits and a new digest.

    A value of None disables a limit. The alarm rates are stored in `figures.watchdog`. If `limits` is None,
    the document stays unchanged.
    """
    if limits is None:
        return dict(document)
    figures = {**document["figures"], **({"watchdog": rates} if rates else {})}
    axes = document.get("axes", 1)
    changed = {**document, "limits": build_limits_section(limits, axes), "figures": figures}
    return {**changed, "sha256": digest(changed)}


def build_limits_section(limits: Mapping[str, float | None], axes: int = 1) -> dict[str, dict[str, Any]]:
    """Return the section `limits` of a gain file, with value and unit of each limit by its name."""
    table = kind_of({"axes": axes}).limits
    return {name: {"value": value, "unit": table[name].unit} for name, value in limits.items()}


def check_bundle_folder(folder: Path) -> None:
    """Raise `InputError` unless the folder is new, empty, or contains only an unchanged bundle.

    This protects changed and additional files from being overwritten.
    """
    where = to_one_line(str(folder))
    try:
        if not folder.exists() and not folder.is_symlink():
            return
        if not folder.is_dir():
            raise InputError(f"{where}: found a file, expected a folder for the bundle")
        _list_bundle_files(folder)
    except OSError as error:
        raise InputError(f"{where}: cannot be read: {to_one_line(error.strerror or str(error))}") from None


def check_same_mechanism(folder: Path, name: str) -> None:
    """Raise `InputError` if the folder has a bundle of a mechanism with another name."""
    try:
        earlier = read_gain_document(folder / "gains.json")["mechanism"]["name"]
    except (GainFileError, KeyError, TypeError):
        return  # there is no bundle, or one that was changed (`check_bundle_folder` reports this)
    if earlier != name:
        raise InputError(
            f"{to_one_line(str(folder))}: found a bundle of the mechanism {format_value(earlier)}, expected "
            f"{format_value(name)}: choose another folder with --output"
        )


def write_bundle(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write all files of the bundle. After an error, restore the previous state and raise `InputError`."""
    check_bundle_folder(folder)
    target = folder.resolve()
    new = target.with_name(temporary_name())
    with report_write_errors(folder):
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
            for subfolder in {(new / name).parent for name in files}:
                sync_folder(subfolder)
            _replace_folder(new, target)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise
        sync_folder(target.parent)


def _replace_folder(new: Path, target: Path) -> None:
    """Replace the folder `target` by the folder `new`, and delete the previous content."""
    if not target.exists():
        os.replace(new, target)
        return
    _exchange_folders(new, target)
    old = new
    try:
        # Check the old folder again, because another program may have added files since the first check.
        names = _list_bundle_files(old)
    except BaseException:
        _exchange_folders(old, target)
        raise
    with suppress(OSError):
        for name in names:
            (old / name).rmdir() if name.endswith("/") else (old / name).unlink()
        old.rmdir()


def _exchange_folders(new: Path, target: Path) -> None:
    """Exchange the names of two folders, in one step if the operating system can do this."""
    try:
        exchange_names(new, target)
        return
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.EINVAL):
            raise
    # This system cannot exchange names in one step. A power failure between the two steps leaves the old
    # folder under a temporary name.
    old = target.with_name(f".{target.name}.{os.getpid()}.old{TEMPORARY_SUFFIX}")
    os.replace(target, old)
    try:
        os.replace(new, target)
    except BaseException:
        os.replace(old, target)
        raise
    os.replace(old, new)


def _list_bundle_files(folder: Path) -> list[str]:
    """Return the paths of all files in an unchanged bundle, then of its subfolders, innermost first.

    Paths of subfolders end with a slash. The list is empty for an empty folder. Raise `InputError` if the
    folder contains anything but an unchanged bundle.
    """
    where = to_one_line(str(folder))
    expected = "expected a new or empty folder, or an unchanged bundle"
    inside = sorted(os.listdir(folder))
    if not inside:
        return []
    if not is_bundle(folder):
        raise InputError(f"{where}: found {format_value(inside[0])} and no bundle, {expected}")
    contents, problems = selftest.find_differences(str(folder))
    files = [*contents]
    for name, text in problems:
        if not name.endswith(selftest.PYTHON_CACHE):
            raise InputError(f"{where}: {to_one_line(name, 80)}: {text}; {expected}")
        for entry in list(os.scandir(folder / name)):
            # Delete Python's cache only if it contains nothing but compiled files.
            if not (entry.is_file(follow_symlinks=False) and entry.name.endswith(".pyc")):
                raise InputError(
                    f"{where}: {name}{to_one_line(entry.name, 80)}: is not a file of this bundle; {expected}"
                )
            files.append(name + entry.name)
    folders = {f"{name[:index]}/" for name in files for index, sign in enumerate(name) if sign == "/"}
    return [*files, *sorted(folders, key=len, reverse=True)]
