"""Files are written whole or not at all, and what cannot be written is one line."""

import os

import pytest

from jaxhil.errors import InputError
from tuning.files import write_whole, writing


def test_a_file_is_replaced(tmp_path):
    path = tmp_path / "file"
    for content in (b"old", bytearray(b"new")):
        write_whole(path, content)
        assert path.read_bytes() == content and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_what_fails_midway_leaves_the_file_as_it_was(tmp_path, monkeypatch, step):
    path = tmp_path / "file"
    write_whole(path, b"old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(InputError, match=r"^[^\n]*file: cannot be written: No space left on device$"):
        with writing(path):
            write_whole(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_a_line_about_something_else_stays(tmp_path):
    with pytest.raises(InputError, match=r"^something else$"), writing(tmp_path):
        raise InputError("something else")
