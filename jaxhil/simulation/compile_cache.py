"""What the compiler made, kept between calls in sealed files.

jax keeps compiled programs by itself, but reads what it finds: with zstandard installed nothing checks the
content, and a flipped bit is run as machine code. What is bad stays, since it replaces no entry, and warns
every time. Programs in our folder are therefore read and written here. jax has no public place for that:
where the one used is not there, no compiled programs are kept, which costs time alone.
"""

import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from jaxhil.files import read_sealed, remove_stale, write_sealed

ENDING = ".executable"  # of the files' names

_folders: set[str] = set()
_this_thread = threading.local()  # its `key`: that of the program last found or put into a folder


def keep_sealed(folder: str | os.PathLike[str]) -> bool:
    """From here on, what jax keeps in the folder is sealed; False where this jax cannot do that."""
    try:
        from jax._src import compilation_cache
        from jax._src.compilation_cache_interface import CacheInterface

        of_jax = compilation_cache.get_file_cache
    except (ImportError, AttributeError):
        return False

    class SealedCache(CacheInterface):
        def __init__(self, path: str) -> None:
            self._path = Path(path)
            with suppress(OSError):
                remove_stale(self._path)

        def get(self, key: str) -> bytes | None:
            found = read_sealed(self._path / f"{key}{ENDING}")
            if found is not None:
                _this_thread.key = key
            return found

        def put(self, key: str, value: bytes) -> None:
            # A folder that has become full or read-only costs only the next call's time.
            with suppress(OSError):
                write_sealed(self._path / f"{key}{ENDING}", value, lasting=False)
                _this_thread.key = key

    def get_file_cache(path: str):
        return (SealedCache(path), path) if path in _folders else of_jax(path)

    if not _folders:
        compilation_cache.get_file_cache = get_file_cache
    _folders.add(os.fspath(folder))
    return True


def compiled(lowered: Any) -> tuple[Any, str | None]:
    """A lowered program compiled, and its key in our folder; None if it is not kept there."""
    _this_thread.key = None
    return lowered.compile(), _this_thread.key
