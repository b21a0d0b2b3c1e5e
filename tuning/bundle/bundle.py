"""A bundle: the folder in which gains leave for a rig computer that has never heard of jax.

`build_bundle` makes the content of every file from a checked gain file; equal gains, limits and seed make
equal files. `write_bundle` puts them in place as a whole or not at all.
"""

import errno
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxhil.errors import InputError, one_line, shown
from jaxhil.runtime import digest
from jaxhil.runtime.limits import LIMITS
from tuning.bundle import selftest
from tuning.bundle.manifest import is_bundle, manifest_text
from tuning.files import TEMPORARY, exchange, remove_stale, sync_folder, temporary_name, writing

TUNING = Path(__file__).parents[1]
# Files that a bundle holds as they are here.
COPIED = ("bundle/selftest.py", "rig/udp_controller.py", "rig/udp_protocol.py")


class Bundle(NamedTuple):
    """A bundle in memory, and what its vectors say."""

    document: dict[str, Any]  # the gain document as exported
    files: dict[str, bytes]  # the content of every file, by its path
    ticks: int  # of the vectors
    runs: int  # of the vectors
    # what ended the comparison with the simulation in each recorded run; None: nothing
    ended: list[str | None]
    reasons: list[str]  # what disagrees, in words


def build_bundle(
    document: Mapping[str, Any],
    formats: Sequence[str],
    limits: Mapping[str, float | None] | None = None,
    rates: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda message: None,
) -> Bundle:
    """The bundle of a checked gain document, with `limits` for the rig [SI units] if there are any.

    `rates`, plain data, say what is known of the watchdog's alarms under these limits. `progress` is given
    what begins. Raises `InputError` for limits that the runtime refuses or a compensator that a format lacks.
    """
    from jaxhil.simulation.gain_file import check_document
    from tuning.bundle.readme import readme_text
    from tuning.bundle.single_file import runtime_source
    from tuning.bundle.summary import summary_html
    from tuning.bundle.vectors import as_csv, make_vectors
    from tuning.bundle.writers import WRITERS

    exported = with_limits(document, limits, rates)
    loaded = check_document(exported)
    progress("recording test vectors")
    vectors = make_vectors(loaded, seed)
    progress("writing the bundle")
    files = {
        "gains.json": (json.dumps(exported, indent=2, sort_keys=True, allow_nan=False) + "\n").encode(
            "ascii"
        ),
        "jaxhil_runtime.py": runtime_source(loaded.compensator).encode(),
        "vectors.csv": as_csv(vectors.rows).encode("ascii"),
        "summary.html": summary_html(exported),
        **{Path(name).name: (TUNING / name).read_bytes() for name in COPIED},
    }
    for name in formats:
        files.update(WRITERS[name](exported))
    files["README.md"] = readme_text(exported, files).encode()
    files[selftest.MANIFEST] = manifest_text(files, exported)
    runs = len({row.run for row in vectors.rows})
    return Bundle(exported, files, len(vectors.rows), runs, vectors.ended, vectors.reasons)


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
    """A bundle may be written there: there is nothing, an empty folder, or a bundle without other files.

    Raises `InputError` otherwise.
    """
    where = one_line(str(folder))
    try:
        if not folder.exists() and not folder.is_symlink():
            return
        if not folder.is_dir():
            raise InputError(f"{where}: found a file, allowed a folder for the bundle")
        inside = sorted(os.listdir(folder))
        if not inside:
            return
        files = _files_of(folder)
    except OSError as error:
        raise InputError(f"{where}: cannot be read: {one_line(error.strerror or str(error))}") from None
    if files is None:
        found = shown(inside[0])
        raise InputError(f"{where}: found {found} and no bundle, allowed a new or empty folder, or a bundle")
    other = next(iter(selftest.unknown_files(str(folder), files)), None)
    if other is not None:
        raise InputError(f"{where}: found {shown(other)} beside a bundle, allowed a bundle's own files")


def write_bundle(folder: Path, files: Mapping[str, bytes]) -> None:
    """The bundle is there as a whole or, after an error, what was there before. Raises `InputError`."""
    check_target(folder)
    target = folder.resolve()
    new = target.with_name(temporary_name())
    try:
        with writing(folder):
            target.parent.mkdir(parents=True, exist_ok=True)
            remove_stale(target.parent)
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
            sync_folder(target.parent)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def _put(new: Path, target: Path) -> None:
    """The new folder in the place of the old one, which is then where the new one was."""
    if not target.exists():
        os.replace(new, target)
        return
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


def _files_of(folder: Path) -> Mapping[str, Any] | None:
    """The files that the folder's manifest names; None where there is no manifest of a bundle."""
    if not is_bundle(folder):
        return None
    try:
        manifest = json.loads((folder / selftest.MANIFEST).read_bytes())
        return manifest["files"] if manifest["schema"] == selftest.SCHEMA else None
    except (FileNotFoundError, ValueError, KeyError, TypeError, RecursionError):
        return None
