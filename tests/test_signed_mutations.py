"""Gain files changed with a valid digest: rejected in one line, or loaded and within the code's bounds.

Loaded controllers run with hostile readings in Python and in C, which agree to the bit.
"""

import hashlib
import json
import math
import random
from collections.abc import Collection
from pathlib import Path

import c99_cases
import numpy as np
import pytest
from c99_cases import (
    COMMAND_FIRST,
    NEXT_CONTACT,
    STEP_ONLY,
    TICK,
    assert_same,
    controller_in_python,
    drawn_rows,
    packed,
)
from gain_documents import gain_document, sign
from gain_mutations import anything_changed, numbers_changed, text_of
from guarded import LIMITED

from jaxhil.rig import COMPENSATORS, GainFileError, digest
from jaxhil.rig.bounds import CONTROL_PERIODS, FORCES, POSITIONS, SPEEDS
from jaxhil.rig.controller import Controller
from jaxhil.rig.gain_file import GainFile, check_gain_document, read_gain_document
from jaxhil.rig.limits import LIMITS, NO_LIMITS

TICKS = 12
COMPILED = "phase_lead", "response_error"  # every day: compiling takes long


def load(path: Path) -> GainFile | None:
    """Load a file into the runtime; return None if the file is rejected."""
    try:
        gain_file = check_gain_document(read_gain_document(path), str(path))
        Controller(gain_file, str(path))
    except GainFileError as error:
        assert str(error).isprintable() and len(str(error)) < 1500
        return None
    return gain_file


def is_within_bounds(gain_file: GainFile) -> bool:
    """Return whether the code's bounds admit every number."""
    gains, limits = COMPENSATORS[gain_file.compensator].gains, gain_file.limits
    return (
        CONTROL_PERIODS[0] <= gain_file.control_period <= CONTROL_PERIODS[1]
        and (0.0 <= gain_file.clearance <= 10.0 or gain_file.clearance == math.inf)
        and gains.keys() == gain_file.gains.keys()
        and all(gains[name].admits(value) for name, value in gain_file.gains.items())
        and LIMITS.keys() == limits.keys()
        and all(LIMITS[name].admits(value) for name, value in limits.items())
        and limits["measured_lowest"] < limits["measured_highest"]
        and limits["command_lowest"] < limits["command_highest"]
        and limits["retreat_velocity"] <= limits["velocity_limit"]
    )


def drive(gain_file: GainFile, rows: np.ndarray, in_c: Collection[str]) -> None:
    """Check that commands stay within the limits of controller and code, and that C agrees with Python."""
    results = controller_in_python(gain_file, rows)
    limits, period = gain_file.limits, gain_file.control_period
    force, position = results[:, 0], results[:, 1]
    assert np.all(np.abs(force) <= min(limits["force_limit"], FORCES[1]))
    assert np.all((position >= POSITIONS[0]) & (position <= POSITIONS[1]))
    same_run = rows[1:, 0] != NEXT_CONTACT
    # Commands outside the stroke are allowed only if the drives were there at the start, and never further
    # out.
    outside = np.maximum(limits["command_lowest"] - position, position - limits["command_highest"])
    assert np.all(np.diff(np.maximum(outside, 0.0))[same_run] <= 0.0)
    moved = np.abs(np.diff(position))[same_run]
    most = min(limits["velocity_limit"], SPEEDS[1]) * period
    assert np.all(moved <= most * (1 + 1e-9) + 1e-14)
    if gain_file.compensator in in_c:
        made = c99_cases.loaded(gain_file.compensator)
        assert made.begin(packed(gain_file.compensator, gain_file))
        assert_same(made.run(rows, True), results, rows)


def as_numbers(document: dict) -> GainFile:
    """Return the numbers of a document with valid structure."""

    def number(value: float) -> float:
        try:
            return float(value)
        except OverflowError:
            return math.nan

    limits = {
        name: number(one["value"])
        for name, one in document.get("limits", {}).items()
        if one["value"] is not None
    }
    return GainFile(
        document["compensator"],
        {name: number(one["value"]) for name, one in document["gains"].items()},
        number(document["control_period"]),
        number(document["mechanism"]["contact"].get("clearance", math.inf)),
        {**NO_LIMITS, **limits},
    )


def longest_line(gain_file: GainFile) -> float:
    """Return the longest delay in control periods; 0 if the control period is invalid."""
    numbers = {**gain_file.limits, **gain_file.gains}
    period = gain_file.control_period
    delays = c99_cases.delays(gain_file.compensator) if period > 0.0 else ()
    return max((numbers[name] / period for name in delays), default=0.0)


def check(count: int, seed: int, path: Path, laws: Collection[str]) -> dict[str, int]:
    """Change and sign `count` files; return how many were loaded and rejected.

    The given `laws` also run in C.
    """
    in_c = laws if c99_cases.COMPILER is not None else ()
    rng = random.Random(seed)
    source = np.random.default_rng(seed)
    pool = [drawn_rows("hostile", TICKS, source, period) for period in (1e-5, 1e-3, 0.1) for _ in range(60)]
    for rows in pool:  # one command per tick
        rows[np.isin(rows[:, 0], (COMMAND_FIRST, STEP_ONLY)), 0] = TICK
    counts = {"loaded": 0, "refused": 0}
    for number in range(count):
        only_numbers = number % 2 == 0
        document = (numbers_changed if only_numbers else anything_changed)(rng)
        text = text_of(document, rng)
        path.write_bytes(text.encode("ascii"))
        gain_file = load(path)
        counts["refused" if gain_file is None else "loaded"] += 1
        if gain_file is not None:
            assert is_within_bounds(gain_file), text
            drive(gain_file, rng.choice(pool), in_c)
        elif only_numbers:
            # Structure and digest are valid, so C must reject the file for its numbers.
            numbers = as_numbers(document)
            if numbers.compensator in in_c and text == json.dumps(document):
                line = longest_line(numbers)
                assert line > 100_000.0 or not is_within_bounds(numbers), text
                # C checks the length of a delay line in whole periods.
                if not 100_000.0 < line < 100_002.0:
                    made = c99_cases.loaded(numbers.compensator)
                    assert not made.begin(packed(numbers.compensator, numbers)), text
    return counts


def test_mutated_gain_files_with_valid_digest_are_rejected_or_stay_within_bounds(tmp_path):
    counts = check(500, 0, tmp_path / "gains.json", COMPILED)
    assert counts["loaded"] > 50 and counts["refused"] > 200, counts


@pytest.mark.slow
def test_hundred_thousand_mutated_gain_files_are_rejected_or_stay_within_bounds(tmp_path):
    counts = check(100_000, 1, tmp_path / "gains.json", {*COMPENSATORS})
    print(counts)
    assert counts["loaded"] > 10_000 and counts["refused"] > 40_000


def test_gain_file_with_any_of_1000_flipped_bits_loads_no_other_content(tmp_path):
    path = tmp_path / "gains.json"
    document = gain_document()
    document["limits"] = {name: {"value": one, "unit": LIMITS[name].unit} for name, one in LIMITED.items()}
    whole = json.dumps(sign(document), indent=2, sort_keys=True).encode()
    path.write_bytes(whole)
    expected = load(path)
    rng = random.Random(int(hashlib.sha256(whole).hexdigest(), 16))
    loaded = 0
    for bit in rng.sample(range(8 * len(whole)), 1000):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        result = load(path)
        if result is not None:
            loaded += 1
            assert result == expected and digest(read_gain_document(path)) == document["sha256"]
    # The digest does not cover date, timings and white space.
    assert loaded < 200
