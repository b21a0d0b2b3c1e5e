"""Cache of compiled programs in checksummed files.

JAX has its own cache but does not verify the content of its files if zstandard is installed: a flipped bit is
executed as machine code. It also never replaces a damaged file, and warns about it every time. Therefore this
module reads and writes the programs in our folder. JAX has no public interface for this. If the private one
is missing, programs are not cached, which costs only time.
"""

import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from jaxhil.files import read_checksummed, remove_stale, write_checksummed

EXECUTABLE_SUFFIX = ".executable"  # suffix of the file names

_folders: set[str] = set()
_this_thread = threading.local()  # its `key` is that of the program last read from or written to a folder


def use_checksummed_cache(folder: str | os.PathLike[str]) -> bool:
    """Make JAX use checksummed files in the folder from now on; return False if this JAX cannot."""
    try:
        from jax._src import compilation_cache
        from jax._src.compilation_cache_interface import CacheInterface

        original = compilation_cache.get_file_cache
    except (ImportError, AttributeError):
        return False

    class SealedCache(CacheInterface):
        """JAX cache whose files have a checksum."""

        def __init__(self, path: str) -> None:
            self._path = Path(path)
            with suppress(OSError):
                remove_stale(self._path)

        def get(self, key: str) -> bytes | None:
            """Return the program with this key, or None if it is missing or damaged."""
            content = read_checksummed(self._path / f"{key}{EXECUTABLE_SUFFIX}")
            if content is not None:
                _this_thread.key = key
            return content

        def put(self, key: str, value: bytes) -> None:
            """Write a program; errors of the file system are ignored."""
            # With a full or read-only folder only the next call takes longer.
            with suppress(OSError):
                write_checksummed(self._path / f"{key}{EXECUTABLE_SUFFIX}", value, lasting=False)
                _this_thread.key = key

    def get_file_cache(path: str):
        """Return our cache for our folders, JAX's cache for others."""
        return (SealedCache(path), path) if path in _folders else original(path)

    if not _folders:
        compilation_cache.get_file_cache = get_file_cache
    _folders.add(os.fspath(folder))
    return True


def compile_with_key(lowered: Any) -> tuple[Any, str | None]:
    """Compile a lowered program; return it with its key in our folder, or None if it is not cached there."""
    _this_thread.key = None
    return lowered.compile(), _this_thread.key
