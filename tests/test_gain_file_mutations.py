"""A gain file that is corrupted in any way is refused, or loads the very same values; never anything else."""

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
    """A gain file with limits, some of them null."""
    document = gain_document()
    document["limits"] = {
        name: {"value": None if one.default == one.highest else one.default, "unit": one.unit}
        for name, one in LIMITS.items()
    }
    return json.dumps(sign(document), indent=2, sort_keys=True).encode()


def mutated(whole: bytes, rng: random.Random) -> bytes:
    """The file with one of the ways in which files go wrong."""
    place = rng.randrange(len(whole))
    other = rng.randrange(len(whole))
    kind = rng.randrange(9)
    if kind == 0:  # a bit falls over
        return whole[:place] + bytes([whole[place] ^ 1 << rng.randrange(8)]) + whole[place + 1 :]
    if kind == 1:  # another character
        return whole[:place] + bytes([rng.choice(ALPHABET)]) + whole[place + 1 :]
    if kind == 2:  # one too many
        return whole[:place] + bytes([rng.choice(ALPHABET)]) + whole[place:]
    if kind == 3:  # one is lost
        return whole[:place] + whole[place + 1 :]
    if kind == 4:  # two neighbours change places
        return whole[:place] + whole[place : place + 2][::-1] + whole[place + 2 :]
    if kind == 5:  # the end is lost
        return whole[:place]
    if kind == 6:  # a block is lost, or there twice
        return whole[:place] + whole[other:]
    digits = [n for n, byte in enumerate(whole) if chr(byte).isdigit()]
    place = rng.choice(digits)
    if kind == 7:  # a digit is another
        return whole[:place] + str(rng.randrange(10)).encode() + whole[place + 1 :]
    line = whole.split(b"\n")  # lines change places
    first, second = rng.randrange(len(line)), rng.randrange(len(line))
    line[first], line[second] = line[second], line[first]
    return b"\n".join(line)


def check(count: int, seed: int, path: Path) -> dict[str, int]:
    """Mutate `count` times; how many were refused and loaded. Raises AssertionError for what must not be."""
    whole = content()
    path.write_bytes(whole)
    expected = on_the_rig(path)
    assert isinstance(expected, GainFile)
    rng = random.Random(seed)
    counts = {"refused": 0, "loaded": 0}
    for _ in range(count):
        path.write_bytes(mutated(whole, rng))
        found = on_the_rig(path)
        counts["refused" if found is None else "loaded"] += 1
        assert found in (None, expected), path.read_bytes()
        if found is not None:
            # What the rig takes, every other command takes or refuses, with the same values.
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


def test_mutations_are_refused_or_load_the_same_values(tmp_path):
    counts = check(1500, 0, tmp_path / "gains.json")
    assert counts["refused"] > 1000 and counts["loaded"] > 10


@pytest.mark.slow
def test_a_hundred_thousand_mutations_are_refused_or_load_the_same_values(tmp_path):
    counts = check(100_000, 1, tmp_path / "gains.json")
    print(counts)
    assert sum(counts.values()) == 100_000 and counts["loaded"] > 500
