"""The controller in C99 is the runtime in Python, bit for bit, and compiles without a warning."""

import ctypes
import functools
import math
import re
import shutil
import struct
import subprocess
from pathlib import Path

import c99_cases
import numpy as np
import pytest
from c99_cases import (
    CAPACITY,
    PERIOD,
    SANITIZED,
    Batch,
    assert_same,
    compiled,
    drawn_exactly,
    drawn_gains,
    drawn_rows,
    packed,
)
from gain_documents import gain_document, sign
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from jaxhil.errors import InputError
from jaxhil.runtime import COMPENSATORS, GainFileError
from jaxhil.runtime.faults import FAULTS, LAW_IN_DOUBT, names
from jaxhil.runtime.gain_file import GainFile, check_gain_document
from jaxhil.runtime.law_status import STATUSES
from jaxhil.runtime.limits import LIMITS, complete
from tuning.bundle import c99
from tuning.bundle.c99 import c99_texts
from tuning.bundle.c99_tables import UNUSABLE, decimal

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
LAWS = tuple(COMPENSATORS)
KINDS = ("contact", "random", "hostile")


@pytest.fixture(scope="module")
def batch():
    """`batch(law)`: the law, compiled and loaded."""
    return c99_cases.loaded


def sanitized(tmp_path: Path, law: str) -> Path:
    """The driver as a program that stops where C leaves its behaviour open; skips where it cannot be made."""
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    command = [str(c99_cases.COMPILER), *SANITIZED, str(probe), "-o", str(tmp_path / "probe")]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("the compiler has no sanitizers")
    folder = c99_cases.write_sources(tmp_path / law, c99_cases.long_document(law))
    return compiled(folder, "c99_driver.c", "sanitized", "-O1", "-DDRIVER_MAIN", *SANITIZED)


# Sources


@pytest.fixture(scope="module")
def controller_object(tmp_path_factory):
    """`controller_object(law)`: the folder with the law's sources and its controller.o."""

    @functools.cache
    def made(law):
        folder = c99_cases.write_sources(tmp_path_factory.mktemp(law), gain_document(law))
        strict = ("-Wconversion", "-Wshadow", "-Wstrict-prototypes", "-Wfloat-conversion")
        compiled(folder, "jaxhil_controller.c", "controller.o", "-c", "-O2", *strict)
        return folder

    return made


@pytest.mark.parametrize("law", LAWS)
def test_every_law_compiles_without_a_warning(law, controller_object):
    compiled(controller_object(law), "test_vectors.c", "test.o", "-c", "-O0")


@pytest.mark.parametrize("law", LAWS)
def test_controller_keeps_no_memory_of_its_own_and_calls_nothing_but_math(law, controller_object):
    if shutil.which("nm") is None:
        pytest.skip("no nm on this machine")
    folder = controller_object(law)
    listed = subprocess.run(["nm", "-P", "controller.o"], cwd=folder, capture_output=True, text=True).stdout
    symbols = [line.split()[:2] for line in listed.splitlines()]
    # memset, memcpy and memmove are what compilers make of loops and assignments, also for a free-standing
    # program.
    wanted = {name for name, kind in symbols if kind == "U"}
    assert wanted <= {
        "floor",
        "sqrt",
        "memset",
        "memcpy",
        "memmove",
        "_GLOBAL_OFFSET_TABLE_",
        "__stack_chk_fail",
    }
    assert not [name for name, kind in symbols if kind in "BbDdC"]
    visible = {name for name, kind in symbols if kind == "T"}
    assert {"jaxhil_init", "jaxhil_step"} <= visible
    assert all(name.startswith("jaxhil_") for name in visible)


def test_header_can_be_used_from_cpp(tmp_path):
    if shutil.which("c++") is None:
        pytest.skip("no C++ compiler (c++) on this machine")
    folder = c99_cases.write_sources(tmp_path, gain_document())
    (folder / "use.cpp").write_text('#include "jaxhil_controller.h"\njaxhil_controller controller;\n')
    command = ["c++", "-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-c", "use.cpp"]
    assert subprocess.run(command, cwd=folder).returncode == 0


def test_unsafe_arithmetic_is_refused_by_the_header(tmp_path):
    folder = c99_cases.write_sources(tmp_path, gain_document())
    command = [str(c99_cases.COMPILER), *c99.FLAGS, "-ffast-math", "-fsyntax-only", "jaxhil_controller.c"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert ran.returncode != 0 and "-ffast-math loses" in ran.stderr


def test_only_what_the_law_needs_is_exported():
    texts = c99_texts(gain_document("phase_lead"))
    assert "jaxhil_lead_filter_step" in texts["jaxhil_controller.c"]
    assert "identification" not in texts["jaxhil_controller.c"]
    assert "IDENTIFICATION" not in texts["jaxhil_controller.h"]
    includes = set(re.findall(r"#include <(.*)>", texts["jaxhil_controller.h"]))
    assert includes <= {"float.h", "math.h", "stdbool.h", "stddef.h", "stdint.h"}
    assert texts == c99_texts(gain_document("phase_lead"))


def test_law_without_a_c_file_is_named(monkeypatch):
    class Toy(COMPENSATORS["none"]):
        pass

    monkeypatch.setitem(COMPENSATORS, "toy", Toy)
    document = sign(gain_document("none") | {"compensator": "toy"})
    with pytest.raises(InputError, match=r"^jaxhil/c99/laws/toy\.c: found no such file"):
        c99_texts(document)


def test_document_that_the_runtime_refuses_is_refused():
    document = gain_document()
    document["gains"]["forgetting"]["value"] = 0.99
    with pytest.raises(GainFileError, match="sha256"):
        c99_texts(document)


def test_faults_are_those_of_the_runtime(batch):
    header = c99_texts(gain_document("none"))["jaxhil_controller.h"]
    bits = {
        name: int(bit, 16) for name, bit in re.findall(r"^    JAXHIL_(\w+) = (0x[0-9A-F]+)", header, re.M)
    }
    assert bits == {**{fault.name.upper(): fault.bit for fault in FAULTS}, "UNUSABLE": UNUSABLE}
    made = batch("none")
    assert [made.fault_name(fault.bit) for fault in FAULTS] == [fault.name for fault in FAULTS]
    assert made.fault_name(UNUSABLE) == "unusable" and made.fault_name(3) == made.fault_name(0) == ""


def test_statuses_are_those_of_the_runtime(batch):
    header = c99_texts(gain_document("none"))["jaxhil_controller.h"]
    (listed,) = re.findall(r"enum \{\n([^}]*JAXHIL_UNSTATED[^}]*)\}", header)
    assert re.findall(r"^    JAXHIL_(\w+)", listed, re.M) == [status.name.upper() for status in STATUSES]
    made = batch("none")
    assert [made.status_name(number) for number in range(-1, len(STATUSES) + 1)] == [
        *("", *(status.name for status in STATUSES), "")
    ]


# Gains and limits


@pytest.mark.parametrize("delay", [101_000.0 * PERIOD, 1e306])
def test_delay_that_the_runtime_refuses_is_refused(delay):
    document = gain_document()
    document["gains"]["identification_delay"] |= {"value": delay, "upper": delay}
    with pytest.raises(GainFileError, match="delay"):
        c99_texts(sign(document))


@pytest.mark.parametrize("law", LAWS)
def test_compiler_reads_the_gains_back_exactly(law, tmp_path):
    """Gains of every size, each of them where its law is defined."""
    rng = np.random.default_rng(1)
    document = gain_document(law)
    wide = drawn_gains(law, rng, hostile=True)
    for name, entry in document["gains"].items():
        if name not in c99_cases.delays(law):
            entry |= {"value": wide.gains[name], "lower": wide.gains[name], "upper": wide.gains[name]}
    gain_file = check_gain_document(sign(document))
    folder = c99_cases.write_sources(tmp_path, document)
    made = Batch(compiled(folder, "c99_driver.c", "driver.so", "-shared", "-fPIC"), law)
    assert made.exported().tobytes() == packed(law, gain_file).tobytes()


def test_compiler_reads_any_double_back(tmp_path):
    rng = np.random.default_rng(2)
    values = rng.integers(0, 2**64, 5000, dtype=np.uint64).view(np.float64)
    values = np.concatenate([values[np.isfinite(values)], c99_cases.HOSTILE[:-1], np.arange(5.0)])
    numbers = ",\n".join(decimal(float(value)) for value in values)
    (tmp_path / "numbers.c").write_text(
        f"#include <math.h>\nextern const double numbers[];\nconst double numbers[] = {{\n{numbers}}};\n"
    )
    library = ctypes.CDLL(str(compiled(tmp_path, "numbers.c", "numbers.so", "-shared", "-fPIC")))
    found = np.array((ctypes.c_double * len(values)).in_dll(library, "numbers"))
    assert found.tobytes() == values.tobytes()


@given(value=st.floats(allow_nan=False))
def test_decimal_is_a_floating_constant_that_is_the_value(value):
    text = decimal(value)
    assert math.isinf(value) or (re.fullmatch(r"-?\d+(\.\d+)?(e[-+]\d+)?", text) and set(text) & set(".e"))
    assert struct.pack("d", float(text.replace("INFINITY", "inf"))) == struct.pack("d", value)


@pytest.mark.parametrize("law", LAWS)
def test_gains_are_admitted_where_python_admits_them(law, batch):
    """A loaded struct is checked as a gain file is."""
    made = batch(law)
    sane = drawn_gains(law, np.random.default_rng(3), hostile=False)
    assert made.begin(packed(law, sane))
    for name, specification in COMPENSATORS[law].gains.items():
        for value in (*c99_cases.HOSTILE.tolist(), 0.5, 1.0 + 2**-52):
            if name in c99_cases.delays(law) and not value <= CAPACITY * sane.control_period:
                continue
            changed = sane._replace(gains={**sane.gains, name: value})
            allowed = math.isfinite(value) and specification.admits(value)
            assert made.begin(packed(law, changed)) == allowed, (name, value)
    for period in (0.0, -1.0, math.nan, math.inf):
        assert not made.begin(packed(law, sane._replace(control_period=period)))
    for clearance in (-1.0, math.nan, -math.inf):
        assert not made.begin(packed(law, sane._replace(clearance=clearance)))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("delay", [1.01 * (CAPACITY + 1), 1e6, 1e300, math.nan, math.inf])
def test_delay_longer_than_its_line_is_refused_and_stays_so(law, delay, batch):
    made = batch(law)
    sane = drawn_gains(law, np.random.default_rng(4), hostile=False)
    rows = drawn_rows("random", 1000, np.random.default_rng(5), PERIOD)
    for name in c99_cases.delays(law):
        assert made.begin(packed(law, sane))
        late = {name: delay * sane.control_period}
        changed = (
            sane._replace(gains={**sane.gains, **late})
            if name in sane.gains
            else sane._replace(limits={**sane.limits, **late})
        )
        assert not made.begin(packed(law, changed))
        results = made.run(rows, True)
        assert np.all(results[:, 0] == 0.0) and np.all(
            results[:, c99_cases.RESULT.index("cause")] == UNUSABLE
        )
        # The drives are held where the numerical model, or else the sensor, was first.
        assert len(np.unique(results[:, 1])) == 1


def test_limits_are_admitted_where_python_admits_them(batch):
    made = batch("none")
    plain = check_gain_document(gain_document("none"))
    assert made.begin(packed("none", plain))
    admitted = 0
    for name, specification in LIMITS.items():
        for value in (*c99_cases.HOSTILE.tolist(), 0.01):
            if name in c99_cases.delays("none") and not value <= CAPACITY * PERIOD:
                continue
            allowed = value == specification.default or (
                math.isfinite(value) and value >= specification.lowest
            )
            try:
                limits = complete({name: value})
            except ValueError:
                allowed = False
                limits = {**plain.limits, name: value}
            assert made.begin(packed("none", plain._replace(limits=limits))) == allowed, (name, value)
            admitted += allowed
    assert admitted > 100


@pytest.mark.parametrize("low", [-1.0, 0.0, 1.0, 2.0])
@pytest.mark.parametrize("high", [-1.0, 1.0, 2.0])
def test_limits_that_clash_are_refused_as_in_python(low, high, batch):
    made = batch("none")
    plain = check_gain_document(gain_document("none"))
    for names_of in (
        ("measured_lowest", "measured_highest"),
        ("command_lowest", "command_highest"),
        ("retreat_velocity", "velocity_limit"),
    ):
        limits = dict(zip(names_of, (low, high), strict=True))
        try:
            complete(limits)
            allowed = all(value >= LIMITS[name].lowest for name, value in limits.items())
        except ValueError:
            allowed = False
        changed = plain._replace(limits={**plain.limits, **limits})
        assert made.begin(packed("none", changed)) == allowed, limits


# Bits


def compare(made: Batch, gain_file: GainFile, rows: np.ndarray) -> None:
    """The law alone and the whole controller, C beside Python."""
    gains = packed(made.law, gain_file)
    assert made.begin(gains)
    assert_same(made.run(rows, False), c99_cases.law_in_python(gain_file, rows), rows)
    assert made.begin(gains)
    results = made.run(rows, True)
    assert_same(results, c99_cases.controller_in_python(gain_file, rows), rows)
    assert np.all(np.isfinite(results[:, :2]))


def test_retreat_of_a_command_from_one_end_of_the_range_to_the_other_is_finite(batch):
    gain_file = GainFile("none", {}, PERIOD, math.inf, complete({"deceleration": 1.0}))
    rows = np.zeros((6, len(c99_cases.ROW)))
    rows[:2, 7] = 1e308, -1e308
    rows[3, 0] = c99_cases.STOP
    compare(batch("none"), gain_file, rows)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("law", LAWS)
def test_same_bits(law, kind, batch):
    rng = np.random.default_rng([LAWS.index(law), KINDS.index(kind)])
    for n in range(12):
        gain_file = drawn_gains(law, rng, hostile=n % 2 == 1)
        compare(batch(law), gain_file, drawn_rows(kind, 1000, rng, gain_file.control_period))


@pytest.mark.parametrize("law", LAWS)
def test_same_bits_where_what_is_compared_is_equal(law, batch):
    rng = np.random.default_rng([10, LAWS.index(law)])
    for _ in range(25):
        compare(batch(law), *drawn_exactly(law, 300, rng))


def test_the_rows_reach_everything(batch):
    """Every fault but that of laws with a status, audits that pass, an identified stiffness that moves."""
    made = batch("response_error")
    rng = np.random.default_rng(6)
    seen, audited, identified = 0, set(), set()
    for n in range(150):
        gain_file = drawn_gains("response_error", rng, hostile=n % 2 == 1)
        rows = drawn_rows(KINDS[n % 3], 1000, rng, gain_file.control_period)
        assert made.begin(packed("response_error", gain_file))
        results = made.run(rows, True)
        seen |= int(np.bitwise_or.reduce(results[:, c99_cases.RESULT.index("seen")].astype(int)))
        audited |= set(results[:, c99_cases.RESULT.index("expected")].tolist())
        identified |= set(results[:, c99_cases.RESULT.index("stiffness")].tolist())
    assert names(seen) == [fault.name for fault in FAULTS if fault.bit != LAW_IN_DOUBT]
    assert len(audited) > 10 and len(identified) > 1000


@st.composite
def cases(draw):
    law = draw(st.sampled_from(LAWS))
    any_float = st.one_of(st.floats(), st.sampled_from(c99_cases.HOSTILE.tolist()), st.floats(-1e3, 1e3))
    gains = {}
    for name, specification in COMPENSATORS[law].gains.items():
        finite = st.floats(
            specification.lowest if math.isfinite(specification.lowest) else None,
            specification.highest if math.isfinite(specification.highest) else None,
            allow_nan=False,
            allow_infinity=False,
            exclude_min=specification.exclusive,
        )
        gains[name] = draw(st.floats(0.0, CAPACITY * PERIOD) if name in c99_cases.delays(law) else finite)
    clearance = draw(st.one_of(st.just(math.inf), st.floats(0.0, allow_nan=False)))
    number = st.tuples(
        st.sampled_from([0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0]),
        *[any_float] * 5,
        st.sampled_from([0.0, 1.0]),
        *[any_float] * 3,
    )
    rows = draw(st.lists(number, min_size=1, max_size=20))
    some = draw(st.sets(st.sampled_from(list(LIMITS)), max_size=10))
    try:
        limits = complete({name: draw(limit_values(law, name)) for name in sorted(some)})
    except ValueError:
        reject()
    return GainFile(law, gains, PERIOD, clearance, limits), np.array(rows)


def limit_values(law, name):
    if name in c99_cases.delays(law):
        return st.floats(0.0, CAPACITY * PERIOD)
    lowest = LIMITS[name].lowest
    # Halves of the drawn limits are of a size that binds.
    return st.one_of(
        st.floats(max(lowest, -1e3), 1e3),
        st.floats(lowest if math.isfinite(lowest) else None, allow_nan=False, allow_infinity=False),
    )


@settings(max_examples=150)
@given(case=cases())
def test_same_bits_whatever_comes(case, batch):
    gain_file, rows = case
    compare(batch(gain_file.compensator), gain_file, rows)


@pytest.mark.parametrize("law", LAWS)
def test_no_undefined_behaviour(law, tmp_path):
    """Address and undefined-behaviour sanitizers, float conversions included, on hostile rows."""
    program = sanitized(tmp_path, law)
    rng = np.random.default_rng(7)
    for guarded in (True, False):
        gain_file = drawn_gains(law, rng, hostile=True)
        rows = drawn_rows("hostile", 4000, rng, gain_file.control_period)
        rows[::100, 0] = c99_cases.RESET
        command = [str(program), *([] if guarded else ["law"])]
        ran = subprocess.run(
            command,
            input=packed(law, gain_file).tobytes() + rows.tobytes(),
            capture_output=True,
            env={"ASAN_OPTIONS": "detect_leaks=0"},
        )
        assert ran.returncode == 0, ran.stderr.decode()
        results = np.frombuffer(ran.stdout).reshape(len(rows), -1)
        python = c99_cases.controller_in_python if guarded else c99_cases.law_in_python
        assert_same(np.array(results), python(gain_file, rows), rows)


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_same_bits_over_ten_million_ticks(law, batch):
    """1e7 ticks in all over the laws, law alone and controller each."""
    rng = np.random.default_rng([8, LAWS.index(law)])
    chunk = 20_000
    for n in range(math.ceil(1e7 / len(LAWS) / chunk)):
        gain_file = drawn_gains(law, rng, hostile=n % 2 == 1)
        compare(batch(law), gain_file, drawn_rows(KINDS[n % 3], chunk, rng, gain_file.control_period))


# Vectors


VECTORS_LIMITS = {"held_readings": 4.0, "late_fraction": 0.25, "force_slew": 1e5, "limited_in_a_row": 50.0}


def vectors_document():
    """A gain document whose limits bind now and then, without a trip at once."""
    document = gain_document()
    document["limits"] = {
        name: {"value": value, "unit": LIMITS[name].unit} for name, value in VECTORS_LIMITS.items()
    }
    return sign(document)


def vectors(*kinds: str) -> list[str]:
    """A vectors.csv of the Python controller's own ticks, one run per kind of rows, as lines."""
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
    """`replay(lines)`: exit code and output of the exported test program."""
    folder = c99_cases.write_sources(tmp_path_factory.mktemp("vectors"), vectors_document())
    program = compiled(folder, "test_vectors.c", "test_vectors", "-O2", "jaxhil_controller.c")

    def run(lines):
        (folder / "vectors.csv").write_text("\n".join(lines) + "\n")
        ran = subprocess.run([str(program), "vectors.csv"], cwd=folder, capture_output=True, text=True)
        return ran.returncode, ran.stdout + ran.stderr

    return run


def test_recorded_vectors_are_replayed(replay):
    """Of contacts, and of what is not finite, late, or without a time."""
    lines = vectors("contact", "contact", "random", "hostile", "hostile")
    assert len({line.split(",")[12] for line in lines[1:]}) > 3
    assert replay(lines) == (0, "vectors.csv: 1000 ticks, the same bit for bit\n")


def test_one_expected_fault_that_did_not_happen_is_found(replay):
    lines = vectors("contact")
    fields = lines[20].split(",")
    fields[12] = str(int(fields[12]) ^ 8)
    lines[20] = ",".join(fields)
    code, output = replay(lines)
    assert code == 1 and output.startswith("vectors.csv:21: faults: found ")


@pytest.mark.parametrize("column", ["force_command", "position_command"])
def test_one_bit_of_an_expected_command_is_found(column, replay):
    lines = vectors("contact", "contact")
    place = lines[0].split(",").index(column)
    fields = lines[150].split(",")
    value = float(fields[place])
    fields[place] = repr(math.nextafter(value, math.inf))
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
def test_vectors_that_cannot_be_read_are_named(change, message, replay):
    code, output = replay(change(vectors("contact")))
    assert code == 2 and message in output
