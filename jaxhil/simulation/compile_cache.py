"""Compile cache: machine code of compiled programs in checksummed files, read and written for JAX.

JAX has its own cache of machine code. If zstandard is installed, JAX's cache does not verify the content of
its files, so that a flipped bit is executed as machine code. JAX also never replaces a damaged file, and
warns about the damage at every use. This module therefore replaces JAX's cache in the folders of this
project. This module uses a private interface of JAX, because JAX has no public one. If that interface is
missing, nothing is cached, which costs only time.
"""

import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from jaxhil.files import read_checksummed, remove_stale, write_checksummed

EXECUTABLE_SUFFIX = ".executable"  # suffix of the names of the cached files

_folders: set[str] = set()
# Per thread; the attribute `key` is the key of the program that this thread last read or wrote.
_this_thread = threading.local()


def use_checksummed_cache(folder: str | os.PathLike[str]) -> bool:
    """Make JAX cache machine code in `folder` as checksummed files; return False if impossible."""
    try:
        from jax._src import compilation_cache
        from jax._src.compilation_cache_interface import CacheInterface

        original = compilation_cache.get_file_cache
    except (ImportError, AttributeError):
        return False

    class ChecksummedCache(CacheInterface):
        """Replacement for JAX's cache class; its files contain a checksum."""

        def __init__(self, path: str) -> None:
            self._path = Path(path)
            with suppress(OSError):
                remove_stale(self._path)

        def get(self, key: str) -> bytes | None:
            """Return the machine code stored under a key; None if its file is missing or damaged."""
            content = read_checksummed(self._path / f"{key}{EXECUTABLE_SUFFIX}")
            if content is not None:
                _this_thread.key = key
            return content

        def put(self, key: str, value: bytes) -> None:
            """Store machine code under a key; ignore errors of the file system."""
            # If the folder is full or read-only, later processes compile again, which costs only time.
            with suppress(OSError):
                write_checksummed(self._path / f"{key}{EXECUTABLE_SUFFIX}", value, lasting=False)
                _this_thread.key = key

    def get_file_cache(path: str):
        """Return the checksummed cache if the folder belongs to this project, else JAX's own cache."""
        return (ChecksummedCache(path), path) if path in _folders else original(path)

    if not _folders:
        compilation_cache.get_file_cache = get_file_cache
    _folders.add(os.fspath(folder))
    return True


def compile_with_key(lowered: Any) -> tuple[Any, str | None]:
    """Return a lowered program in compiled form, and its cache key; the key is None if nothing was cached."""
    _this_thread.key = None
    return lowered.compile(), _this_thread.key
