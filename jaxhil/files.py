"""Files of ours: written whole or not at all, sealed where a flipped bit would count, nobody else's touched.

What we write is a plain file. A link, a pipe or a device that stands in its place is neither followed, nor
opened, nor replaced. A sealed file begins with the SHA-256 of what follows, as a line of hexadecimal digits;
it is checked before anything looks at the content.
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

from jaxhil.errors import InputError, one_line, shown

TEMPORARY = ".tmp"  # end of the name under which a file is written first
SEAL = 65  # bytes before the content of a sealed file

_HERE, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
_PLAIN = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_THIS_PROCESS = secrets.token_hex(4)  # numbers of processes come again
_OURS = re.compile(rf"\.jaxhil-(\d+)-([0-9a-f]{{8}})-\d+{re.escape(TEMPORARY)}")
_numbers = count()


@contextmanager
def writing(path: str | os.PathLike[str]) -> Iterator[None]:
    """What cannot be written there is an `InputError`, one line."""
    try:
        yield
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{one_line(os.fspath(path))}: cannot be written: {one_line(reason, 100)}") from None


def as_path(path: object) -> Path:
    """What a caller gives as a path. Raises `InputError` if it is none."""
    if isinstance(path, (str, os.PathLike)) and isinstance(os.fspath(path), str):
        return Path(path)
    raise InputError(f"path: found {shown(path)}, allowed a path")


def write_csv(path: object, columns: Mapping[str, Sequence[float]]) -> None:
    """Columns of one length as a table, a row a line, under a line of their names; numbers to the last bit.

    Raises `InputError` when the file cannot be written.
    """
    target = as_path(path)
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows), ""]
    with writing(target):
        write_whole(follow(target), "\n".join(lines).encode("ascii"))


def write_whole(path: Path, content: bytes | bytearray | memoryview, lasting: bool = True) -> None:
    """The file is there as a whole, or as it was; if it is to be `lasting`, after a power cut too.

    Raises OSError when it cannot be written, or when what is there is no plain file.
    """
    with suppress(FileNotFoundError):
        _check_plain(os.lstat(path).st_mode)
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
                error.filename = os.fspath(path)  # a full disk names none
            raise
    if lasting:
        sync_folder(path.parent)


def write_new(path: Path, content: bytes | bytearray | memoryview) -> None:
    """The file is there as a whole, where nothing was before.

    Raises FileExistsError if something was, or another OSError when it cannot be written.
    """
    temporary = path.with_name(temporary_name())
    write_whole(temporary, content)
    try:
        os.link(temporary, path)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.ENOSYS):
            raise
        # A file system without links.
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), os.fspath(path)) from None
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_sealed(path: Path, content: bytes | bytearray | memoryview, lasting: bool = True) -> None:
    """`write_whole` of the content under its seal, which shows what a power cut took of it."""
    seal = hashlib.sha256(content).hexdigest().encode("ascii") + b"\n"
    write_whole(path, seal + bytes(content), lasting)


def read_sealed(path: Path) -> bytes | None:
    """What `write_sealed` wrote; None if there is nothing, or anything else, down to the last bit."""
    try:
        with open_plain(path) as file:
            found = file.read()
    except (OSError, ValueError):
        return None
    content = found[SEAL:]
    return content if found[:SEAL] == hashlib.sha256(content).hexdigest().encode("ascii") + b"\n" else None


def open_plain(path: str | os.PathLike[str]) -> BinaryIO:
    """A plain file, to read. Raises OSError for a link, a pipe or a device, and waits for none."""
    _check_plain(os.lstat(path).st_mode)
    return _open_checked(path, _PLAIN)


def open_input(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a file that a user names, to read; a link stands for its file.

    Raise OSError for a pipe, a device or a folder, without waiting for one.
    """
    mode = os.stat(path).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    _check_plain(mode)
    return _open_checked(path, _PLAIN & ~os.O_NOFOLLOW)


def _open_checked(path: str | os.PathLike[str], flags: int) -> BinaryIO:
    descriptor = os.open(path, flags)
    try:
        _check_plain(os.fstat(descriptor).st_mode)
        return open(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


@contextmanager
def lock(path: Path) -> Iterator[None]:
    """Nobody else holds the lock meanwhile. Raises BlockingIOError if somebody does, or another OSError."""
    import fcntl

    with suppress(FileNotFoundError):
        _check_plain(os.lstat(path).st_mode)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    try:
        _check_plain(os.fstat(descriptor).st_mode)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def follow(path: str | os.PathLike[str]) -> Path:
    """Where a path leads that the user names for output: a link stands for its file, which may be replaced.

    Raises OSError for what is no plain file.
    """
    target = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    with suppress(FileNotFoundError):
        _check_plain(os.lstat(target).st_mode)
    return target


def exchange(one: Path, other: Path) -> None:
    """Each has the other's name, from one moment to the next. Raises OSError: ENOSYS or EINVAL where the
    system cannot do that."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS)) from None
    rename.argtypes = ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint
    if rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) != 0:
        reason = ctypes.get_errno()
        raise OSError(reason, os.strerror(reason), os.fspath(other))


def make_folder(folder: Path) -> None:
    """A folder of ours within one that the user named, made if need be. Raises OSError, for a link too."""
    with suppress(FileExistsError):
        folder.mkdir(parents=True)
    mode = os.lstat(folder).st_mode
    if not stat.S_ISDIR(mode):
        raise OSError(errno.EEXIST, f"found {_kind(mode)}, allowed a folder", os.fspath(folder))


def remove_stale(folder: Path) -> None:
    """Remove what processes that were killed while they wrote left there. Raises OSError."""
    with os.scandir(folder) as entries:
        for entry in entries:
            name = _OURS.fullmatch(entry.name)
            if not name or _is_writing(int(name[1]), name[2]):
                continue
            if entry.is_file(follow_symlinks=False):
                with suppress(FileNotFoundError):
                    os.unlink(entry)
            elif entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry, ignore_errors=True)


def is_temporary(name: str) -> bool:
    """Whether a file of that name was left when writing was interrupted."""
    return _OURS.fullmatch(name) is not None


def temporary_name() -> str:
    """A name for a file or folder until it is whole: of this process, used once."""
    return f".jaxhil-{os.getpid()}-{_THIS_PROCESS}-{next(_numbers)}{TEMPORARY}"


def sync_folder(folder: Path) -> None:
    """Names given in the folder so far survive a power cut. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_writing(process: int, token: str) -> bool:
    if process == os.getpid():
        return token == _THIS_PROCESS
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _check_plain(mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise OSError(errno.EEXIST, f"found {_kind(mode)}, allowed a plain file")


def _kind(mode: int) -> str:
    kinds = {stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFREG: "a file"}
    return kinds.get(stat.S_IFMT(mode), "a device")
