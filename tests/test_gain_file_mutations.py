"""Corrupted gain files: rejected, or loaded with exactly the same values."""

import json
import random
from pathlib import Path

import pytest
from gain_documents import gain_document, sign

from jaxhil.errors import InputError
from jaxhil.rig import GainFileError
from jaxhil.rig.gain_file import GainFile, check_gain_document, read_gain_document
from jaxhil.rig.limits import LIMITS
from jaxhil.simulation.gain_file import load_gain_file

ALPHABET = b'0123456789.-+eE,:{}[]" \n\ttruefalsnINaity\\/\x00\xff'


def content() -> bytes:
    """Return a gain file with limits, some of which are null."""
    document = gain_document()
    document["limits"] = {
        name: {"value": None if limit.default == limit.highest else limit.default, "unit": limit.unit}
        for name, limit in LIMITS.items()
    }
    return json.dumps(sign(document), indent=2, sort_keys=True).encode()


def mutated(whole: bytes, rng: random.Random) -> bytes:
    """Return the file with a typical corruption."""
    index = rng.randrange(len(whole))
    other = rng.randrange(len(whole))
    kind = rng.randrange(9)
    if kind == 0:  # a bit is flipped
        return whole[:index] + bytes([whole[index] ^ 1 << rng.randrange(8)]) + whole[index + 1 :]
    if kind == 1:  # another character
        return whole[:index] + bytes([rng.choice(ALPHABET)]) + whole[index + 1 :]
    if kind == 2:  # an extra character
        return whole[:index] + bytes([rng.choice(ALPHABET)]) + whole[index:]
    if kind == 3:  # a lost character
        return whole[:index] + whole[index + 1 :]
    if kind == 4:  # two neighbours are swapped
        return whole[:index] + whole[index : index + 2][::-1] + whole[index + 2 :]
    if kind == 5:  # the end is lost
        return whole[:index]
    if kind == 6:  # a block is lost or duplicated
        return whole[:index] + whole[other:]
    digits = [n for n, byte in enumerate(whole) if chr(byte).isdigit()]
    index = rng.choice(digits)
    if kind == 7:  # a digit is changed
        return whole[:index] + str(rng.randrange(10)).encode() + whole[index + 1 :]
    line = whole.split(b"\n")  # lines are swapped
    first, second = rng.randrange(len(line)), rng.randrange(len(line))
    line[first], line[second] = line[second], line[first]
    return b"\n".join(line)


def check(count: int, seed: int, path: Path) -> dict[str, int]:
    """Mutate `count` times; return the numbers of rejected and loaded files.

    Raise AssertionError if a loaded file has other values.
    """
    whole = content()
    path.write_bytes(whole)
    expected = on_the_rig(path)
    assert isinstance(expected, GainFile)
    rng = random.Random(seed)
    counts = {"refused": 0, "loaded": 0}
    for _ in range(count):
        path.write_bytes(mutated(whole, rng))
        result = on_the_rig(path)
        counts["refused" if result is None else "loaded"] += 1
        assert result in (None, expected), path.read_bytes()
        if result is not None:
            # Other commands accept or reject what the rig accepts, with the same values.
            try:
                loaded = load_gain_file(path)
            except InputError as error:
                assert str(error).isprintable()
            else:
                assert loaded.gains == expected.gains and loaded.compensator == expected.compensator
    return counts


def on_the_rig(path: Path) -> GainFile | None:
    try:
        return check_gain_document(read_gain_document(path), str(path))
    except GainFileError as error:
        assert str(error).isprintable()
        return None


def test_mutated_gain_file_is_rejected_or_loads_equal_values(tmp_path):
    counts = check(1500, 0, tmp_path / "gains.json")
    assert counts["refused"] > 1000 and counts["loaded"] > 10


@pytest.mark.slow
def test_mutated_gain_file_never_loads_other_values_in_100000_mutations(tmp_path):
    counts = check(100_000, 1, tmp_path / "gains.json")
    print(counts)
    assert sum(counts.values()) == 100_000 and counts["loaded"] > 500
