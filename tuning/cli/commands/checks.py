"""Checks of output paths and earlier results, which commands run before they import jax.

Each check raises `InputError` with a message of one line.
"""

import hashlib
import json
import os
import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import open_regular, remove_stale, report_write_errors, resolve_output_path
from tuning.cli.options import PLOT_SUFFIXES

# Names that Windows reserves for devices, with any ending; results may be copied to such a system.
RESERVED_NAME = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.I)
MAX_FOLDER_NAME_BYTES = 120  # bytes of a folder's name; file systems allow 255, some tools less
MAX_NAMES_IN_MESSAGE = 3  # largest number of names in a message


def check_plot(path: str) -> None:
    """Check that a plot can be written to `path`; create its parent folders."""
    if Path(path).suffix.lower() not in PLOT_SUFFIXES:
        raise InputError(
            f"--plot: found {format_value(path)}, expected a name that ends in {', '.join(PLOT_SUFFIXES)}"
        )
    check_file_path(path)


def check_file_path(path: str) -> None:
    """Check that a file can be written to `path`; create its parent folders, delete stale temporary files."""
    target = Path(path)
    with report_write_errors(target):
        target = resolve_output_path(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_stale(target.parent)


def prepare_output_folder(folder: Path) -> None:
    """Check that results can be written to a folder; create it, and delete stale temporary files."""
    with report_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_stale(folder)


def make_folder_name(name: str) -> str:
    """Return a folder name made from a mechanism's name: letters and digits of any script, in NFC.

    Different mechanisms may get the same folder name; `check_earlier_results` then raises an error for the
    second one.
    """
    composed = unicodedata.normalize("NFC", name)
    spaced = "".join(character if _is_permitted(character) else " " for character in composed)
    folder = re.sub(" +", "_", spaced).strip("._") or "mechanism"
    if RESERVED_NAME.fullmatch(folder):
        folder = f"name_{folder}"
    if len(folder.encode()) > MAX_FOLDER_NAME_BYTES:
        end = f"-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
        folder = folder.encode()[: MAX_FOLDER_NAME_BYTES - len(end)].decode(errors="ignore") + end
    return folder


def _is_permitted(character: str) -> bool:
    """Return whether a folder's name may contain a character: letter, mark, digit, dot, dash, underscore."""
    return character.isalnum() or character in "._-" or unicodedata.category(character)[0] == "M"


def check_earlier_results(
    document: Path, mark: str, plots: Sequence[str], mechanisms: Collection[str] = ()
) -> dict[str, Any]:
    """Check that the files to be replaced come from an earlier run, and return the earlier document.

    Args:
        document: path of the document, a JSON object.
        mark: key that an earlier document has.
        plots: file names of the plots beside the document.
        mechanisms: names of the mechanisms that the document may be about; empty for any.

    Returns:
        The earlier document; an empty dictionary if there is none.

    Raises:
        InputError: If other files, or results for other mechanisms, would be lost.
    """
    with report_write_errors(document):
        os.fsencode(document)  # raises an error if the locale cannot encode the path
    names = [name for name in (document.name, *plots) if os.path.lexists(document.parent / name)]
    earlier = _read_document(document)
    if names and mark not in earlier:
        where = to_one_line(str(document.parent / names[0]))
        raise InputError(
            f"{where}: found a file of something else, expected a folder without one, or --output"
        )
    lost = sorted(mechanism_names(earlier) - {*mechanisms})
    if mechanisms and lost:
        where, allowed = (
            to_one_line(str(document)),
            " or ".join(map(format_value, sorted(mechanisms)[:MAX_NAMES_IN_MESSAGE])),
        )
        others = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
        raise InputError(
            f"{where}: found results of mechanism {format_value(lost[0])}{others}, expected those of "
            f"{allowed}, or "
            "none: name another folder by --output, or the mechanism otherwise"
        )
    return earlier


def mechanism_names(document: Mapping[str, Any]) -> set[str]:
    """Return the names of the mechanisms that a document of results is about."""
    entries = [document, *(document.get("mechanisms") or ())]
    labels = [entry.get("mechanism") for entry in entries if isinstance(entry, Mapping)]
    names = [label.get("name") if isinstance(label, Mapping) else label for label in labels]
    return {name for name in names if isinstance(name, str)}


def _read_document(document: Path) -> dict[str, Any]:
    """Return the JSON object in a file, or an empty one if there is none."""
    try:
        with open_regular(document) as opened:
            content = json.loads(opened.read())
    except (OSError, ValueError, TypeError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
