"""Replay of recorded test vectors by a bundle's C test program, which must detect a single wrong bit."""

import math
import subprocess

import c99_cases
import numpy as np
import pytest
from c99_cases import (
    PERIOD,
    compiled,
    drawn_rows,
)
from gain_documents import gain_document, sign

from jaxhil.rig import COMPENSATORS
from jaxhil.rig.gain_file import check_gain_document
from jaxhil.rig.limits import LIMITS

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
LAWS = tuple(COMPENSATORS)


VECTORS_LIMITS = {"held_readings": 4.0, "late_fraction": 0.25, "force_slew": 1e5, "limited_in_a_row": 50.0}


def vectors_document():
    """Return a gain document whose limits are sometimes active, without an immediate trip."""
    document = gain_document()
    document["limits"] = {
        name: {"value": value, "unit": LIMITS[name].unit} for name, value in VECTORS_LIMITS.items()
    }
    return sign(document)


def vectors(*kinds: str) -> list[str]:
    """Return the lines of a vectors.csv from the Python controller, with one run for each kind of rows."""
    gain_file = check_gain_document(vectors_document())
    lines = [
        "run,event,force_measured,position_desired,velocity_desired,position_measured,time,position,velocity,"
        "acceleration,force_command,position_command,faults,force_simulated"
    ]
    for run, kind in enumerate(kinds):
        rows = drawn_rows(kind, 200, np.random.default_rng([9, run]), PERIOD)
        rows[:, 0] = c99_cases.TICK
        rows[100, 0] = c99_cases.NEXT_CONTACT
        results = c99_cases.controller_in_python(gain_file, rows)
        for n, (row, result) in enumerate(zip(rows.tolist(), results.tolist(), strict=True)):
            event = 1 if n == 0 else int(row[0])
            readings = [repr(number) for number in row[1:6]]
            if not row[6]:
                readings[-1] = ""
            numbers = [*row[7:], *result[:2], int(result[c99_cases.RESULT.index("faults")]), math.nan]
            lines.append(",".join([str(run), str(event), *readings, *(repr(number) for number in numbers)]))
    return lines


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    """Return `replay(lines)`: exit code and output of the exported test program."""
    folder = c99_cases.write_sources(tmp_path_factory.mktemp("vectors"), vectors_document())
    program = compiled(folder, "test_vectors.c", "test_vectors", "-O2", "jaxhil_controller.c")

    def run(lines):
        (folder / "vectors.csv").write_text("\n".join(lines) + "\n")
        ran = subprocess.run([str(program), "vectors.csv"], cwd=folder, capture_output=True, text=True)
        return ran.returncode, ran.stdout + ran.stderr

    return run


def test_c99_test_program_replays_recorded_vectors(replay):
    lines = vectors("contact", "contact", "random", "hostile", "hostile")
    assert len({line.split(",")[12] for line in lines[1:]}) > 3
    assert replay(lines) == (0, "vectors.csv: 1000 ticks, the same bit for bit\n")


def test_c99_test_program_detects_one_missing_fault(replay):
    lines = vectors("contact")
    fields = lines[20].split(",")
    fields[12] = str(int(fields[12]) ^ 8)
    lines[20] = ",".join(fields)
    code, output = replay(lines)
    assert code == 1 and output.startswith("vectors.csv:21: faults: found ")


@pytest.mark.parametrize("column", ["force_command", "position_command"])
def test_c99_test_program_detects_one_wrong_bit_of_a_command(column, replay):
    lines = vectors("contact", "contact")
    index = lines[0].split(",").index(column)
    fields = lines[150].split(",")
    value = float(fields[index])
    fields[index] = repr(math.nextafter(value, math.inf))
    lines[150] = ",".join(fields)
    expected = f"found {value:.17g}, expected {math.nextafter(value, math.inf):.17g}\n"
    assert replay(lines) == (1, f"vectors.csv:151: {column}: {expected}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:1], "no rows"),
        (lambda lines: [lines[0] + ",more", *lines[1:]], "unknown columns"),
        (lambda lines: [*lines, "1,0,1.0"], "not a row of numbers"),
        (lambda lines: [*lines, lines[5].replace(",", ";", 3)], "not a row of numbers"),
        (lambda lines: [lines[0], *lines[2:]], "an unknown event, or a tick before a run"),
    ],
)
def test_c99_test_program_reports_unreadable_vector_file(change, message, replay):
    code, output = replay(change(vectors("contact")))
    assert code == 2 and message in output
