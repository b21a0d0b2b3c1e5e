"""What commands check beside the front door's arguments; each raises `InputError`, one line. No jax here."""

import hashlib
import json
import os
import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import follow, open_plain, remove_stale, writing
from tuning.cli.options import PICTURES

# Names, with any ending, that Windows keeps for devices: results may lie on a disk that both read.
DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.I)
LONGEST_NAME = 120  # bytes of a folder's name; file systems allow 255, some tools fewer
MOST_NAMES = 3  # names that a message lists


def picture(path: str) -> None:
    """A picture can be written there; folders on the way are made."""
    if Path(path).suffix.lower() not in PICTURES:
        raise InputError(f"--plot: found {shown(path)}, allowed a name that ends in {', '.join(PICTURES)}")
    file(path)


def file(path: str) -> None:
    """A file can be written there: folders on the way are made, the last rid of what was left unfinished."""
    target = Path(path)
    with writing(target):
        target = follow(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_stale(target.parent)


def output(folder: Path) -> None:
    """Results can be written to a folder: made if need be, and rid of what was left unfinished there."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_stale(folder)


def folder_name(name: str) -> str:
    """Return a mechanism's name as the name of a folder: letters and digits of any script, in NFC.

    Names may share one; `own_results` refuses the second.
    """
    composed = unicodedata.normalize("NFC", name)
    kept = "".join(one if _is_kept(one) else " " for one in composed)
    folder = re.sub(" +", "_", kept).strip("._") or "mechanism"
    if DEVICE.fullmatch(folder):
        folder = f"name_{folder}"
    if len(folder.encode()) > LONGEST_NAME:
        end = f"-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
        folder = folder.encode()[: LONGEST_NAME - len(end)].decode(errors="ignore") + end
    return folder


def _is_kept(character: str) -> bool:
    """Whether a folder's name may have it: a letter with its marks, a digit, a dot, a line."""
    return character.isalnum() or character in "._-" or unicodedata.category(character)[0] == "M"


def own_results(
    document: Path, mark: str, pictures: Sequence[str], mechanisms: Collection[str] = ()
) -> dict[str, Any]:
    """Check that what is to be replaced in the document's folder is of an earlier run, and return it.

    That is the document, a JSON object with the key `mark`, and the pictures beside it; of no other mechanism
    than those named, if any are. Raise `InputError` otherwise.
    """
    with writing(document):
        os.fsencode(document)  # a locale may lack the letters
    names = [name for name in (document.name, *pictures) if os.path.lexists(document.parent / name)]
    found = _read(document)
    if names and mark not in found:
        where = one_line(str(document.parent / names[0]))
        raise InputError(
            f"{where}: found a file of something else, allowed a folder without one, or --output"
        )
    lost = sorted(mechanisms_in(found) - {*mechanisms})
    if mechanisms and lost:
        where, allowed = one_line(str(document)), " or ".join(map(shown, sorted(mechanisms)[:MOST_NAMES]))
        others = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
        raise InputError(
            f"{where}: found results of mechanism {shown(lost[0])}{others}, expected those of {allowed}, or "
            "none: name another folder by --output, or the mechanism otherwise"
        )
    return found


def mechanisms_in(document: Mapping[str, Any]) -> set[str]:
    """Return the names of the mechanisms that a document of results is about."""
    entries = [document, *(document.get("mechanisms") or ())]
    named = [entry.get("mechanism") for entry in entries if isinstance(entry, Mapping)]
    names = [one.get("name") if isinstance(one, Mapping) else one for one in named]
    return {name for name in names if isinstance(name, str)}


def _read(document: Path) -> dict[str, Any]:
    """Return a JSON object, an empty one where there is none."""
    try:
        with open_plain(document) as opened:
            found = json.loads(opened.read())
    except (OSError, ValueError, TypeError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
