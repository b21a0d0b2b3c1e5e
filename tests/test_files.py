"""File functions: atomic writes, checksummed reads, and protection of third-party files."""

import errno
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from jaxhil.errors import InputError
from jaxhil.files import (
    make_folder,
    open_regular,
    read_checksummed,
    remove_stale,
    report_write_errors,
    resolve_output_path,
    write_atomically,
    write_checksummed,
    write_new,
)


def test_atomic_write_replaces_the_file(tmp_path):
    path = tmp_path / "file"
    for content in (b"old", bytearray(b"new"), memoryview(b"newer")):
        write_atomically(path, content)
        assert path.read_bytes() == content and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("has_links", [True, False])
def test_writing_a_new_file_never_overwrites_a_file(tmp_path, monkeypatch, has_links):
    def refuse(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    if not has_links:
        monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "file"
    write_new(path, b"first")
    with pytest.raises(FileExistsError):
        write_new(path, b"second")
    assert path.read_bytes() == b"first" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_failed_atomic_write_keeps_the_old_file(tmp_path, monkeypatch, step):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(InputError, match=r"^[^\n]*file: cannot be written: No space left on device$"):
        with report_write_errors(path):
            write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_report_write_errors_does_not_change_other_errors(tmp_path):
    with pytest.raises(InputError, match=r"^something else$"), report_write_errors(tmp_path):
        raise InputError("something else")


def not_plain(folder):
    """Create links, a pipe and a folder instead of files; return their names and the link's target."""
    target = folder / "thesis"
    target.write_bytes(b"years")
    (folder / "link").symlink_to(target)
    (folder / "dangling").symlink_to(folder / "nowhere")
    (folder / "device").symlink_to("/dev/zero")
    os.mkfifo(folder / "pipe")
    (folder / "folder").mkdir()
    return ["link", "dangling", "device", "pipe", "folder"], target


def test_file_functions_reject_anything_but_plain_files(tmp_path):
    names, target = not_plain(tmp_path)
    before = sorted(os.listdir(tmp_path))
    for name in names:
        path = tmp_path / name
        kind = os.lstat(path).st_mode
        with pytest.raises(InputError, match=r"cannot be written: found a .*, expected a plain file"):
            with report_write_errors(path):
                write_atomically(path, b"ours")
        assert read_checksummed(path) is None
        with pytest.raises(OSError):
            open_regular(path)
        assert os.lstat(path).st_mode == kind
    assert target.read_bytes() == b"years" and sorted(os.listdir(tmp_path)) == before


def test_folder_creation_rejects_links(tmp_path):
    for name in ("new/inner", "new"):
        make_folder(tmp_path / name)
    assert (tmp_path / "new/inner").is_dir()
    names, _ = not_plain(tmp_path)
    (tmp_path / "elsewhere").symlink_to(tmp_path / "folder")
    for name in ("elsewhere", *(name for name in names if name != "folder")):
        with (
            pytest.raises(InputError, match=r"found a .*, expected a folder"),
            report_write_errors(tmp_path / name),
        ):
            make_folder(tmp_path / name)


def test_output_path_given_as_link_is_written_through_the_link(tmp_path):
    _, target = not_plain(tmp_path)
    write_atomically(resolve_output_path(tmp_path / "link"), b"picture")
    assert (tmp_path / "link").is_symlink() and target.read_bytes() == b"picture"
    assert resolve_output_path(tmp_path / "new.png") == tmp_path / "new.png"
    with pytest.raises(OSError, match="a device"):
        write_atomically(resolve_output_path(tmp_path / "device"), b"picture")


def test_checksummed_file_is_read_back_exactly_or_ignored(tmp_path):
    path = tmp_path / "file"
    generator = np.random.default_rng(0)
    assert read_checksummed(path) is None
    for size in (0, 1, 5000):
        content = generator.bytes(size)
        write_checksummed(path, content)
        assert read_checksummed(path) == content
        whole = path.read_bytes()
        for bit in generator.integers(0, 8 * len(whole), 300):
            harmed = bytearray(whole)
            harmed[bit // 8] ^= 1 << int(bit % 8)
            path.write_bytes(harmed)
            assert read_checksummed(path) is None
        for cut in (0, 64, 65, len(whole) - 1):
            if cut < len(whole):
                path.write_bytes(whole[:cut])
                assert read_checksummed(path) is None


def test_only_temporary_files_of_killed_processes_are_removed_as_stale(tmp_path):
    killed = """
import os, signal, sys
from pathlib import Path
from jaxhil import files
os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
files.write_atomically(Path(sys.argv[1]) / "file", b"new")
"""
    ended = subprocess.run([sys.executable, "-c", killed, tmp_path], timeout=60)
    assert ended.returncode == -signal.SIGKILL
    (stale,) = tmp_path.iterdir()
    users = [".thesis.docx.tmp", ".jaxhil.tmp", ".jaxhil-12-cafe.tmp", f"{stale.name}.tmp", f"a{stale.name}"]
    for name in users:
        (tmp_path / name).write_text("years")
    # Also create a file that a live process is writing, and a link with such a name.
    writes = stale.name.replace(stale.name.split("-")[1], str(os.getppid()))
    (tmp_path / writes).write_text("half")
    linked = stale.name.replace("-0.tmp", "-1.tmp")
    (tmp_path / linked).symlink_to(tmp_path / users[0])
    remove_stale(tmp_path)
    assert sorted(os.listdir(tmp_path)) == sorted([*users, writes, linked])
    assert (tmp_path / users[0]).read_text() == "years"
