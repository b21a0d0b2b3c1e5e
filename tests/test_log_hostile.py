"""Truncated, corrupted or shuffled logs: read as finite numbers or rejected in one line."""

import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_cases import read, sway, touches, write_csv

from jaxhil.errors import InputError
from tuning.identification.logs.mapping_draft import draft_mapping

CELLS = [
    "",
    "nan",
    "-inf",
    "1e999",
    "-1e29",
    "1e-320",
    "0",
    "-0",
    "abc",
    '"',
    "1,2",
    "\x00",
    "\ufeff",
    "9" * 400,
    "\n\n",
    "#",
]
LOGS = {"contact": touches(1, noise=0.5), "free": sway(400)}

mutations = st.lists(
    st.one_of(
        st.tuples(st.just("cell"), st.integers(0, 400), st.integers(0, 6), st.sampled_from(CELLS)),
        st.tuples(st.just("drop"), st.integers(1, 400), st.integers(1, 60)),
        st.tuples(st.just("repeat"), st.integers(1, 400), st.integers(1, 5)),
        st.tuples(st.just("swap"), st.integers(1, 390), st.integers(1, 9)),
        st.tuples(st.just("cut"), st.integers(0, 20_000)),
        st.tuples(st.just("flip"), st.integers(0, 20_000), st.integers(1, 255)),
        st.tuples(st.just("zero"), st.integers(0, 6)),
    ),
    min_size=1,
    max_size=3,
)


def mutated(text: bytes, changes) -> bytes:
    for kind, *numbers in changes:
        lines = text.split(b"\n")
        if kind == "cell":
            cells = lines[numbers[0] % len(lines)].split(b",")
            cells[numbers[1] % len(cells)] = numbers[2].encode()
            lines[numbers[0] % len(lines)] = b",".join(cells)
        elif kind == "drop":
            del lines[numbers[0] : sum(numbers)]
        elif kind == "repeat":
            lines[numbers[0] : numbers[0]] = lines[numbers[0] : sum(numbers)]
        elif kind == "swap":
            lines[numbers[0] : sum(numbers)] = lines[numbers[0] : sum(numbers)][::-1]
        elif kind == "zero":
            rows = [line.split(b",") for line in lines]
            rows[1:] = [[*row[: numbers[0]], b"0", *row[numbers[0] + 1 :]] for row in rows[1:]]
            lines = [b",".join(row) for row in rows]
        text = b"\n".join(lines)
        if kind == "cut":
            text = text[: numbers[0]]
        elif kind == "flip" and text:
            index = numbers[0] % len(text)
            text = text[:index] + bytes([text[index] ^ numbers[1]]) + text[index + 1 :]
    return text


def check(kind, changes, timing):
    with tempfile.TemporaryDirectory() as folder:
        path = write_csv(Path(folder) / "a.csv", LOGS[kind])
        path.write_bytes(mutated(path.read_bytes(), changes))
        with suppress(InputError):
            assert draft_mapping([path]).startswith("# A draft")
        try:
            result = read(path, kind, timing=timing)
        except InputError as error:
            assert str(error).isprintable() and str(error).startswith(f"{path}: ")
            return
        for run in result.runs:
            assert np.all(np.diff(run.tick) == 1)
            assert np.all(np.isfinite(run.position_desired))
            assert np.all(np.isfinite(run.position_measured[run.valid]))
            assert len(run.valid) == len(run.tick) == len(run.position_measured)


CLOCKS = st.sampled_from([{}, {"clock": "index"}, {"row": "sent"}])


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(sorted(LOGS)), mutations, CLOCKS)
def test_damaged_log_is_read_or_rejected_with_one_line_message(kind, changes, timing):
    check(kind, changes, timing)


@pytest.mark.slow
@settings(deadline=None, max_examples=5000)
@given(st.sampled_from(sorted(LOGS)), mutations, CLOCKS)
def test_many_damaged_logs_are_read_or_rejected_with_one_line_message(kind, changes, timing):
    check(kind, changes, timing)
