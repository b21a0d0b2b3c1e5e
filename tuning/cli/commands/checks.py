"""What commands check beside the front door's arguments; each raises `InputError`, one line. No jax here."""

import json
from collections.abc import Sequence
from pathlib import Path

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import follow, open_plain, remove_stale, writing
from tuning.cli.options import PICTURES


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


def own_results(document: Path, mark: str, pictures: Sequence[str]) -> None:
    """What is to be replaced in the document's folder is of an earlier run: the document, a JSON object with
    the key `mark`, and the pictures beside it."""
    names = [name for name in (document.name, *pictures) if (document.parent / name).exists()]
    if names and not _has(document, mark):
        where = one_line(str(document.parent / names[0]))
        raise InputError(
            f"{where}: found a file of something else, allowed a folder without one, or --output"
        )


def _has(document: Path, mark: str) -> bool:
    try:
        with open_plain(document) as opened:
            return mark in json.loads(opened.read())
    except (OSError, ValueError, TypeError, RecursionError):
        return False
