"""Checkpoints: exact values after reading, and no value for other inputs, other code or damaged files."""

import math
import struct
from typing import NamedTuple

import numpy as np
import pytest

from tuning.caches import checkpoints
from tuning.caches.checkpoints import Checkpoints, decode_value, encode_value


class Point(NamedTuple):
    name: str
    gains: dict[str, float]
    curvature: np.ndarray
    weight: float | None = None


NUMBERS = [0.1, -0.0, 5e-324, math.inf, -math.inf, math.nan, 1.7976931348623157e308]
POINT = Point("a", {"z": 1.5, "a": math.nan}, np.array([[1.0, np.nan], [-0.0, 3.0]]), None)


def test_checkpoint_values_are_read_back_bit_for_bit():
    result = decode_value(encode_value(NUMBERS), list[float])
    assert [struct.pack("d", one) for one in result] == [struct.pack("d", one) for one in NUMBERS]
    point = decode_value(encode_value(POINT), Point)
    assert type(point) is Point and point.curvature.tobytes() == POINT.curvature.tobytes()
    # The order of keys determines the order of rows in tables.
    assert list(point.gains) == ["z", "a"] and point.weight is None
    for array in (np.arange(6, dtype=np.int32).reshape(2, 3), np.array([True, False]), np.empty((0, 2))):
        again = decode_value(encode_value(array), np.ndarray)
        assert again.dtype == array.dtype and again.shape == array.shape and (again == array).all()
    assert decode_value(encode_value(np.float64(0.1)), float) == 0.1


@pytest.mark.parametrize("thing", [print, object(), np.array([print]), {"a": lambda: 1}])
def test_checkpoint_of_object_that_is_not_plain_data_raises_type_error(thing):
    with pytest.raises(TypeError):
        encode_value(thing)


def test_checkpoint_of_other_inputs_or_sources_is_ignored(tmp_path, monkeypatch):
    inputs = {"seed": 1, "limit": math.inf, "gains": POINT}
    Checkpoints(tmp_path).write("one", inputs, POINT)
    reader = Checkpoints(tmp_path, resume=True)
    assert reader.read("one", dict(reversed(inputs.items())), Point).name == "a"
    assert reader.read("other", inputs, Point) is None and reader.other == []
    assert Checkpoints(tmp_path).read("one", inputs, Point) is None
    assert Checkpoints().read("one", inputs, Point) is None
    for changed in ({**inputs, "seed": 2}, {**inputs, "limit": 1.0}, {**inputs, "gains": POINT[:3]}):
        assert reader.read("one", changed, Point) is None
    assert reader.other == ["one"] * 3
    # Reading as another type returns None.
    assert reader.read("one", inputs, int) is None
    for name in ("sources_sha256", "dependency_versions", "active_xla_flags"):
        with monkeypatch.context() as patched:
            patched.setattr(checkpoints, name, lambda: "others")
            assert reader.read("one", inputs, Point) is None
    assert reader.read("one", inputs, Point) is not None


def test_checkpoint_with_a_flipped_bit_is_not_used(tmp_path):
    Checkpoints(tmp_path).write("one", 1, POINT)
    (path,) = tmp_path.iterdir()
    content = path.read_bytes()
    places = np.random.default_rng(0).integers(0, 8 * len(content), 1000)
    for folder in places:
        flipped = bytearray(content)
        flipped[folder // 8] ^= 1 << folder % 8
        path.write_bytes(flipped)
        assert Checkpoints(tmp_path, resume=True).read("one", 1, Point) is None
    for length in (0, 1, 64, 65, 66, len(content) - 1):
        path.write_bytes(content[:length])
        assert Checkpoints(tmp_path, resume=True).read("one", 1, Point) is None


def test_step_checkpoints_are_removed_after_final_checkpoint_is_saved(tmp_path):
    made = []

    def run(stop, resume=True):
        journal = Checkpoints(tmp_path, resume).journal("work", "inputs")
        for number in range(4):
            if number == stop:
                return None
            journal.step("round", int, lambda number=number: made.append(number) or number)
        journal.step("end", int, lambda: 7)
        return journal

    run(stop=2)
    assert made == [0, 1]
    journal = run(stop=None)
    assert made == [0, 1, 2, 3]
    # Without resuming, all is computed again.
    run(stop=2, resume=False)
    assert made == [0, 1, 2, 3, 0, 1]
    (folder,) = tmp_path.iterdir()
    (folder / "notes.txt").write_text("a user's")
    journal.finish()
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


def test_failed_checkpoint_write_does_not_stop_the_computation(tmp_path):
    (tmp_path / "taken").touch()
    for folder in (tmp_path / "taken", tmp_path / "link"):
        checkpoints = Checkpoints(folder)
        (tmp_path / "elsewhere").mkdir(exist_ok=True)
        if folder.name == "link":
            folder.symlink_to(tmp_path / "elsewhere")
        checkpoints.write("one", 1, 2)
        journal = checkpoints.journal("work", 1)
        assert journal.step("round", int, lambda: 5) == 5
        journal.finish()
        assert checkpoints.unwritten and all("\n" not in str(error) for error in checkpoints.unwritten)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_similar_checkpoint_names_are_stored_in_separate_files(tmp_path):
    written = Checkpoints(tmp_path)
    names = ["a b", "a-b", "../a", "A" * 300, "A" * 301, "ä", "ö"]
    for number, name in enumerate(names):
        written.write(name, 0, number)
    assert written.unwritten == [] and len(list(tmp_path.iterdir())) == len(names)
    reader = Checkpoints(tmp_path, resume=True)
    assert [reader.read(name, 0, int) for name in names] == list(range(len(names)))
