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
from jaxhil.files import open_regular, remove_stale, report_write_errors, resolve_output_path, write_new
from tuning.cli.options import PLOT_SUFFIXES

# Names that Windows reserves for devices, even with a suffix; results may be copied to a Windows system.
RESERVED_NAME = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.I)
MAX_FOLDER_NAME_BYTES = 120  # longest folder name [bytes]; file systems allow 255, but some tools allow less
MAX_NAMES_IN_MESSAGE = 3  # largest number of mechanism names listed in a message


def check_plot(path: str) -> None:
    """Check that a plot can be written to `path`; create its parent folders."""
    if Path(path).suffix.lower() not in PLOT_SUFFIXES:
        raise InputError(
            f"--plot: found {format_value(path)}, expected a name that ends in {', '.join(PLOT_SUFFIXES)}"
        )
    check_file_path(path)


def check_file_path(path: str) -> None:
    """Check that a file can be written to `path`; create parent folders, and delete stale temporary files."""
    target = Path(path)
    with report_write_errors(target):
        target = resolve_output_path(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_stale(target.parent)


def check_is_new(option: str, path: Path) -> None:
    """Check that no file has the name that `option` gives to a new mechanism file."""
    if os.path.lexists(path):
        problem = "found an existing file, expected a new name: no file is overwritten"
        raise InputError(f"{option}: {to_one_line(str(path))}: {problem}")


def write_mechanism_file(option: str, path: Path, text: str) -> None:
    """Write a new mechanism file. Raise `InputError` if the file exists or cannot be written."""
    with report_write_errors(path):
        try:
            write_new(path, text.encode())
        except FileExistsError:
            check_is_new(option, path)
            raise


def prepare_output_folder(folder: Path) -> None:
    """Check that results can be written to a folder; create the folder, and delete stale temporary files."""
    with report_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_stale(folder)


def make_folder_name(name: str) -> str:
    """Convert a mechanism's name to a valid folder name, with letters and digits of any script (Unicode NFC).

    Two mechanisms may get the same folder name; `check_earlier_results` then raises an error for the second
    mechanism.
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
    return character.isalnum() or character in "._-" or unicodedata.category(character)[0] == "M"


def check_earlier_results(
    document: Path, mark: str, plots: Sequence[str], mechanisms: Collection[str] = ()
) -> dict[str, Any]:
    """Check that a command overwrites only results of an earlier run; return the document of that run.

    Args:
        document: path of the JSON document that the command writes.
        mark: key that shows that this command wrote a document.
        plots: file names of the plots that the command writes to the same folder.
        mechanisms: names of the mechanisms whose earlier results may be overwritten; empty for all.

    Returns:
        The earlier JSON document; an empty dictionary if there is none.

    Raises:
        InputError: If the command would overwrite a file that jaxhil did not write, or results of a mechanism
            that is not in `mechanisms`.
    """
    with report_write_errors(document):
        os.fsencode(document)  # raises an error if the locale cannot encode the path
    names = [name for name in (document.name, *plots) if os.path.lexists(document.parent / name)]
    earlier = _read_document(document)
    if names and mark not in earlier:
        where = to_one_line(str(document.parent / names[0]))
        raise InputError(
            f"{where}: found a file that jaxhil did not write, expected none: choose another folder by "
            "--output"
        )
    lost = sorted(mechanism_names(earlier) - {*mechanisms})
    if mechanisms and lost:
        where = to_one_line(str(document))
        allowed = " or ".join(map(format_value, sorted(mechanisms)[:MAX_NAMES_IN_MESSAGE]))
        others = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
        raise InputError(
            f"{where}: found results of mechanism {format_value(lost[0])}{others}, expected results of "
            f"{allowed} or none: choose another folder with --output, or rename the mechanism"
        )
    return earlier


def mechanism_names(document: Mapping[str, Any]) -> set[str]:
    """Return the names of the mechanisms whose results a command's JSON document contains."""
    entries = [document, *(document.get("mechanisms") or ())]
    labels = [entry.get("mechanism") for entry in entries if isinstance(entry, Mapping)]
    names = [label.get("name") if isinstance(label, Mapping) else label for label in labels]
    return {name for name in names if isinstance(name, str)}


def _read_document(document: Path) -> dict[str, Any]:
    """Return the JSON object in a file; an empty dictionary if the file contains none or cannot be read."""
    try:
        with open_regular(document) as opened:
            content = json.loads(opened.read())
    except (OSError, ValueError, TypeError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
