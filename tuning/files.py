"""Files written whole or not at all, whatever interrupts the writing, and one line for what cannot be."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxhil.errors import InputError, one_line

TEMPORARY = ".tmp"  # end of the name under which a file is written first


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """What cannot be written there is an `InputError`, one line."""
    try:
        yield
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{one_line(str(path))}: cannot be written: {one_line(reason, 100)}") from None


def write_whole(path: Path, content: bytes | bytearray | memoryview) -> None:
    """The file is there as a whole, on disk, or as it was. Raises OSError when it cannot be written."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY}")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        try:
            temporary.unlink(missing_ok=True)
        except OSError:
            pass
    # The new name, too, has to survive a power cut.
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
