"""Atomic writes, checksummed files, and protection of files that this program did not write.

The program writes regular files only. If a link, a pipe or a device has the name of an output file, the
program does not follow, open or replace it. A checksummed file begins with a line that has the SHA-256 of the
content in hexadecimal digits. The content is used only if it has this checksum.
"""

import ctypes
import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import BinaryIO

from jaxhil.errors import InputError, format_value, to_one_line

TEMPORARY_SUFFIX = ".tmp"  # suffix of the temporary name under which a file is first written
CHECKSUM_LENGTH = 65  # bytes before the content of a checksummed file: 64 hexadecimal digits and a line feed

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
_OPEN_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_PROCESS_TOKEN = secrets.token_hex(4)  # distinguishes processes, because the system reuses their numbers
_TEMPORARY_NAME_PATTERN = re.compile(rf"\.jaxhil-(\d+)-([0-9a-f]{{8}})-\d+{re.escape(TEMPORARY_SUFFIX)}")
_name_counter = count()


@contextmanager
def report_write_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Raise `InputError` if the code in the `with` block raises OSError when it writes to `path`."""
    try:
        yield
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{to_one_line(os.fspath(path))}: cannot be written: {to_one_line(reason, 100)}"
        ) from None


def to_path(path: object) -> Path:
    """Convert a user's argument to a `Path`. Raise `InputError` if the argument is not a path."""
    if isinstance(path, (str, os.PathLike)) and isinstance(os.fspath(path), str):
        return Path(path)
    raise InputError(f"path: found {format_value(path)}, expected a path")


def write_csv(path: object, columns: Mapping[str, Sequence[float]]) -> None:
    """Write columns of equal length as a CSV file with a header line; numbers keep full precision.

    Raise `InputError` if the file cannot be written.
    """
    target = to_path(path)
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows), ""]
    with report_write_errors(target):
        write_atomically(resolve_output_path(target), "\n".join(lines).encode("ascii"))


def write_atomically(path: Path, content: bytes | bytearray | memoryview, lasting: bool = True) -> None:
    """Write a file atomically; if it is `lasting`, return only when the file is safe from a power cut.

    Raise OSError if the file cannot be written, or if `path` exists and is not a regular file.
    """
    with suppress(FileNotFoundError):
        _check_regular(os.lstat(path).st_mode)
    temporary = path.with_name(temporary_name())
    with open(temporary, "xb") as file:
        try:
            file.write(content)
            file.flush()
            if lasting:
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException as error:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            if isinstance(error, OSError):
                error.filename = os.fspath(path)  # the error of a full disk has no file name
            raise
    if lasting:
        sync_folder(path.parent)


def write_new(path: Path, content: bytes | bytearray | memoryview) -> None:
    """Write a new file atomically.

    Raise FileExistsError if `path` exists, or another OSError if the file cannot be written.
    """
    temporary = path.with_name(temporary_name())
    write_atomically(temporary, content)
    try:
        os.link(temporary, path)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.ENOSYS):
            raise
        # This file system has no hard links.
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), os.fspath(path)) from None
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_checksummed(path: Path, content: bytes | bytearray | memoryview, lasting: bool = True) -> None:
    """Write a checksummed file (a line with the SHA-256 of the content, then the content) atomically."""
    checksum = hashlib.sha256(content).hexdigest().encode("ascii") + b"\n"
    write_atomically(path, checksum + bytes(content), lasting)


def read_checksummed(path: Path) -> bytes | None:
    """Return the content of a checksummed file, or None if the file cannot be read or is damaged."""
    try:
        with open_regular(path) as file:
            whole = file.read()
    except (OSError, ValueError):
        return None
    content = whole[CHECKSUM_LENGTH:]
    checksum = hashlib.sha256(content).hexdigest().encode("ascii") + b"\n"
    return content if whole[:CHECKSUM_LENGTH] == checksum else None


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading. Raise OSError, without waiting, for a link, a pipe or a device."""
    _check_regular(os.lstat(path).st_mode)
    return _open_checked(path, _OPEN_FLAGS)


def open_input(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a user's file for reading and follow links. Raise OSError for a pipe, a device or a folder."""
    mode = os.stat(path).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    _check_regular(mode)
    return _open_checked(path, _OPEN_FLAGS & ~os.O_NOFOLLOW)


def _open_checked(path: str | os.PathLike[str], flags: int) -> BinaryIO:
    """Open a file for reading. Raise OSError unless the opened file is a regular file."""
    descriptor = os.open(path, flags)
    try:
        _check_regular(os.fstat(descriptor).st_mode)
        return open(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


@contextmanager
def lock_file(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on a file, which is created if it does not exist.

    Raise BlockingIOError if the file is locked already, or another OSError if it cannot be opened.
    """
    import fcntl

    with suppress(FileNotFoundError):
        _check_regular(os.lstat(path).st_mode)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    try:
        _check_regular(os.fstat(descriptor).st_mode)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def resolve_output_path(path: str | os.PathLike[str]) -> Path:
    """Follow the links of a user's output path and return the path of the file itself.

    Raise OSError if the file exists and is not a regular file.
    """
    target = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    with suppress(FileNotFoundError):
        _check_regular(os.lstat(target).st_mode)
    return target


def exchange_names(first: Path, other: Path) -> None:
    """Exchange the names of two files or folders atomically.

    Raise OSError if the exchange fails, with errno ENOSYS or EINVAL if the system does not support it.
    """
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS)) from None
    rename.argtypes = ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint
    if rename(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) != 0:
        reason = ctypes.get_errno()
        raise OSError(reason, os.strerror(reason), os.fspath(other))


def make_folder(folder: Path) -> None:
    """Create a folder unless it exists. Raise OSError if this fails, or if `folder` is a link or a file."""
    with suppress(FileExistsError):
        folder.mkdir(parents=True)
    mode = os.lstat(folder).st_mode
    if not stat.S_ISDIR(mode):
        raise OSError(errno.EEXIST, f"found {_describe_kind(mode)}, expected a folder", os.fspath(folder))


def remove_stale(folder: Path) -> None:
    """Remove temporary files and folders in `folder` that ended processes have left there.

    Raise OSError if the folder cannot be read or a file cannot be removed.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            name = _TEMPORARY_NAME_PATTERN.fullmatch(entry.name)
            if not name or _is_process_running(int(name[1]), name[2]):
                continue
            if entry.is_file(follow_symlinks=False):
                with suppress(FileNotFoundError):
                    os.unlink(entry)
            elif entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry, ignore_errors=True)


def is_temporary(name: str) -> bool:
    """Return whether a file name has the form of the names that `temporary_name` returns."""
    return _TEMPORARY_NAME_PATTERN.fullmatch(name) is not None


def temporary_name() -> str:
    """Return a unique name for a file or folder that this process writes first and renames afterwards."""
    return f".jaxhil-{os.getpid()}-{_PROCESS_TOKEN}-{next(_name_counter)}{TEMPORARY_SUFFIX}"


def sync_folder(folder: Path) -> None:
    """Flush a folder's list of files to disk, so that it survives a power cut. Raise OSError on failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_process_running(process: int, token: str) -> bool:
    """Return whether the process named in a temporary file name (number and random token) still runs."""
    if process == os.getpid():
        return token == _PROCESS_TOKEN
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _check_regular(mode: int) -> None:
    """Raise OSError unless a file with the `st_mode` value `mode` is a regular file."""
    if not stat.S_ISREG(mode):
        raise OSError(errno.EEXIST, f"found {_describe_kind(mode)}, expected a plain file")


def _describe_kind(mode: int) -> str:
    """Return the kind of a file with the `st_mode` value `mode` in words, such as "a link"."""
    kinds = {stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFREG: "a file"}
    return kinds.get(stat.S_IFMT(mode), "a device")
