"""Bit-for-bit agreement of the C99 controller with the Python runtime: gains, limits, commands, faults."""

import ctypes
import math
import re
import struct
import subprocess
from pathlib import Path

import c99_cases
import numpy as np
import pytest
from c99_cases import (
    CAPACITY,
    LINES,
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

from jaxhil.rig import COMPENSATORS, GainFileError
from jaxhil.rig.bounds import CONTROL_PERIODS, DISTANCES
from jaxhil.rig.faults import FAULTS, LAW_IN_DOUBT, fault_names
from jaxhil.rig.gain_file import GainFile, check_gain_document
from jaxhil.rig.law_status import STATUS_NAMES, STATUSES, UNSTATED
from jaxhil.rig.limits import LIMITS, complete_limits
from tuning.bundle.c99 import generate_c99
from tuning.bundle.c99_tables import UNUSABLE, format_double

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
LAWS = tuple(COMPENSATORS)
# These compensators cover most of the C code.
LONG_CODE = ("impulse_ledger",)
KINDS = ("contact", "random", "hostile")


@pytest.fixture(scope="module")
def batch():
    """Return `batch(law)`: the compiled and loaded compensator."""
    return c99_cases.loaded


def sanitized(tmp_path: Path, law: str) -> Path:
    """Compile the driver as a program that stops at undefined behaviour; skip if that is impossible."""
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    command = [str(c99_cases.COMPILER), *SANITIZED, str(probe), "-o", str(tmp_path / "probe")]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("the compiler has no sanitizers")
    folder = c99_cases.write_sources(tmp_path / law, c99_cases.long_document(law))
    return compiled(folder, "c99_driver.c", "sanitized", "-O1", "-DDRIVER_MAIN", *SANITIZED)


def test_c99_faults_match_runtime(batch):
    header = generate_c99(gain_document("none"))["jaxhil_controller.h"]
    bits = {
        name: int(bit, 16) for name, bit in re.findall(r"^    JAXHIL_(\w+) = (0x[0-9A-F]+)", header, re.M)
    }
    assert bits == {**{fault.name.upper(): fault.bit for fault in FAULTS}, "UNUSABLE": UNUSABLE}
    made = batch("none")
    assert [made.fault_name(fault.bit) for fault in FAULTS] == [fault.name for fault in FAULTS]
    assert made.fault_name(UNUSABLE) == "unusable" and made.fault_name(3) == made.fault_name(0) == ""


def test_c99_status_codes_match_runtime(batch):
    header = generate_c99(gain_document("none"))["jaxhil_controller.h"]
    (listed,) = re.findall(r"enum \{\n([^}]*JAXHIL_UNSTATED[^}]*)\}", header)
    numbers = {name: int(number) for name, number in re.findall(r"^    JAXHIL_(\w+) = (\d+)", listed, re.M)}
    assert numbers == {status.name.upper(): status.number for status in STATUSES}
    made = batch("none")
    for number in range(-1, 1 + max(numbers.values()) + 1):
        assert made.status_name(number) == STATUS_NAMES.get(number, "")


@pytest.mark.parametrize("delay", [101_000.0 * PERIOD, 1e306])
def test_c99_export_rejects_the_same_delays_as_python_runtime(delay):
    document = gain_document()
    document["gains"]["identification_delay"] |= {"value": delay, "upper": delay}
    with pytest.raises(GainFileError, match="delay"):
        generate_c99(sign(document))


@pytest.mark.parametrize("law", LAWS)
def test_c99_source_reproduces_gain_values_bit_for_bit(law, tmp_path):
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


def test_c99_source_reproduces_decimal_constants_bit_for_bit(tmp_path):
    rng = np.random.default_rng(2)
    values = rng.integers(0, 2**64, 5000, dtype=np.uint64).view(np.float64)
    values = np.concatenate([values[np.isfinite(values)], c99_cases.HOSTILE[:-1], np.arange(5.0)])
    numbers = ",\n".join(format_double(float(value)) for value in values)
    (tmp_path / "numbers.c").write_text(
        f"#include <math.h>\nextern const double numbers[];\nconst double numbers[] = {{\n{numbers}}};\n"
    )
    library = ctypes.CDLL(str(compiled(tmp_path, "numbers.c", "numbers.so", "-shared", "-fPIC")))
    result = np.array((ctypes.c_double * len(values)).in_dll(library, "numbers"))
    assert result.tobytes() == values.tobytes()


@given(value=st.floats(allow_nan=False))
def test_c99_decimal_literal_has_exact_double_value(value):
    text = format_double(value)
    assert math.isinf(value) or (re.fullmatch(r"-?\d+(\.\d+)?(e[-+]\d+)?", text) and set(text) & set(".e"))
    assert struct.pack("d", float(text.replace("INFINITY", "inf"))) == struct.pack("d", value)


@pytest.mark.parametrize("law", LAWS)
def test_c99_controller_accepts_the_same_gains_as_python_runtime(law, batch):
    made = batch(law)
    sane = drawn_gains(law, np.random.default_rng(3), hostile=False)
    assert made.begin(packed(law, sane))
    for name, specification in COMPENSATORS[law].gains.items():
        ends = specification.lowest, specification.highest
        beyond = math.nextafter(ends[0], -math.inf), math.nextafter(ends[1], math.inf)
        for value in (*c99_cases.HOSTILE.tolist(), *ends, *beyond):
            changed = sane._replace(gains={**sane.gains, name: value})
            assert made.begin(packed(law, changed)) == specification.admits(value), (name, value)
    for period in (0.0, -1.0, 9.9e-6, 0.11, math.nan, math.inf):
        assert not made.begin(packed(law, sane._replace(control_period=period)))
    for clearance in (-1.0, 10.1, math.nan, -math.inf):
        assert not made.begin(packed(law, sane._replace(clearance=clearance)))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("delay", [1.01 * (LINES + 1), 1e6, 1e300, math.nan, math.inf])
def test_c99_controller_commands_zero_force_if_delay_exceeds_delay_line(law, delay, batch):
    made = batch(law)
    sane = drawn_gains(law, np.random.default_rng(4), hostile=False, period=CONTROL_PERIODS[0])
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
        assert np.all(results[:, c99_cases.RESULT.index("law_status")] == UNSTATED)
        # The drives hold the first position reading or, without one, the position of the numerical model.
        commanded = rows[:, 0] != c99_cases.STEP_ONLY
        assert len(np.unique(results[commanded, 1])) == 1


def test_c99_controller_accepts_the_same_limits_as_python_runtime(batch):
    made = batch("none")
    plain = check_gain_document(gain_document("none"))
    assert made.begin(packed("none", plain))
    admitted = 0
    for name, specification in LIMITS.items():
        ends = specification.lowest, specification.highest
        beyond = math.nextafter(ends[0], -math.inf), math.nextafter(ends[1], math.inf)
        for value in (*c99_cases.HOSTILE.tolist(), *ends, *beyond, 0.01):
            allowed = specification.admits(value)
            try:
                limits = complete_limits({name: value})
            except ValueError:
                allowed = False
                limits = {**plain.limits, name: value}
            assert made.begin(packed("none", plain._replace(limits=limits))) == allowed, (name, value)
            admitted += allowed
    assert admitted > 100


@pytest.mark.parametrize("low", [-1.0, 0.0, 1.0, 2.0])
@pytest.mark.parametrize("high", [-1.0, 1.0, 2.0])
def test_c99_controller_rejects_the_same_conflicting_limits_as_python_runtime(low, high, batch):
    made = batch("none")
    plain = check_gain_document(gain_document("none"))
    for names_of in (
        ("measured_lowest", "measured_highest"),
        ("command_lowest", "command_highest"),
        ("retreat_velocity", "velocity_limit"),
    ):
        limits = dict(zip(names_of, (low, high), strict=True))
        try:
            complete_limits(limits)
            allowed = all(LIMITS[name].admits(value) for name, value in limits.items())
        except ValueError:
            allowed = False
        changed = plain._replace(limits={**plain.limits, **limits})
        assert made.begin(packed("none", changed)) == allowed, limits


# Bits


def compare(made: Batch, gain_file: GainFile, rows: np.ndarray) -> None:
    """Compare C and Python bit for bit: first the compensator alone, then the whole controller."""
    gains = packed(made.law, gain_file)
    assert made.begin(gains)
    assert_same(made.run(rows, False), c99_cases.law_in_python(gain_file, rows), rows)
    assert made.begin(gains)
    results = made.run(rows, True)
    assert_same(results, c99_cases.controller_in_python(gain_file, rows), rows)
    assert np.all(np.isfinite(results[:, :2]))


def test_c99_retreat_command_is_finite_for_infinite_limits(batch):
    gain_file = GainFile("none", {}, PERIOD, math.inf, complete_limits({"deceleration": 1.0}))
    rows = np.zeros((6, len(c99_cases.ROW)))
    rows[:2, 7] = 10.0, -10.0
    rows[3, 0] = c99_cases.STOP
    compare(batch("none"), gain_file, rows)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("law", LAWS)
def test_c99_commands_equal_python_bit_for_bit(law, kind, batch):
    rng = np.random.default_rng([LAWS.index(law), KINDS.index(kind)])
    for n in range(12):
        gain_file = drawn_gains(law, rng, hostile=n % 2 == 1)
        compare(batch(law), gain_file, drawn_rows(kind, 1000, rng, gain_file.control_period))


@pytest.mark.slow
def test_c99_impulse_ledger_contacts_equal_python_bit_for_bit(batch):
    law, statuses = "impulse_ledger", set()
    for n in range(12):
        rng = np.random.default_rng([11, n])
        drawn = drawn_gains(law, rng, hostile=False, period=PERIOD)
        gain_file = drawn if n % 2 else check_gain_document(gain_document(law))
        gains = gain_file.gains | ({"delay_spread": 0.002} if n % 3 == 1 else {})
        limits = complete_limits({"equivalent_mass": 350.0, "settling": 0.02})
        clearance = math.inf if n % 4 else 1e-4
        gain_file = gain_file._replace(gains=gains, limits=limits, clearance=clearance)
        motion = rng.uniform(0, 6), rng.uniform(8, 60), 10 ** rng.uniform(-4.5, -2.7)
        rows = c99_cases.contact_rows(2000, rng, PERIOD, *motion)
        if n % 4 == 0:  # sensor without delay and noise
            rows[:, 1] = 1.2e5 * np.maximum(rows[:, 4], 0.0) + 0.1 * rng.standard_normal(len(rows))
        if n % 4 == 2:  # a contact that ends soon
            rows[:, 1] *= 300.0
        compare(batch(law), gain_file, rows)
        assert batch(law).begin(packed(law, gain_file))
        statuses |= set(batch(law).run(rows, True)[:, c99_cases.RESULT.index("law_status")].tolist())
    assert {STATUS_NAMES[status] for status in statuses} == {*STATUS_NAMES.values()} - {
        "unstated",
        "not_reached",
    }


@pytest.mark.parametrize("law", LAWS)
def test_c99_commands_equal_python_for_values_exactly_at_thresholds(law, batch):
    rng = np.random.default_rng([10, LAWS.index(law)])
    for _ in range(25):
        compare(batch(law), *drawn_exactly(law, 300, rng))


def test_random_ticks_of_c99_tests_raise_every_fault(batch):
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
    assert fault_names(seen) == [fault.name for fault in FAULTS if fault.bit != LAW_IN_DOUBT]
    assert len(audited) > 10 and len(identified) > 1000


@st.composite
def cases(draw):
    law = draw(st.sampled_from(LAWS))
    any_float = st.one_of(st.floats(), st.sampled_from(c99_cases.HOSTILE.tolist()), st.floats(-1e3, 1e3))
    gains = {}
    for name, specification in COMPENSATORS[law].gains.items():
        finite = st.floats(specification.lowest, specification.highest)
        gains[name] = draw(st.floats(0.0, CAPACITY * PERIOD) if name in c99_cases.delays(law) else finite)
    clearance = draw(st.one_of(st.just(math.inf), st.floats(*DISTANCES)))
    number = st.tuples(
        st.sampled_from([c99_cases.TICK] * 3 + list(c99_cases.EVENTS)),
        *[any_float] * 5,
        st.sampled_from([0.0, 1.0]),
        *[any_float] * 3,
    )
    rows = draw(st.lists(number, min_size=1, max_size=20))
    chosen = draw(st.sets(st.sampled_from(list(LIMITS)), max_size=10))
    try:
        limits = complete_limits({name: draw(limit_values(law, name)) for name in sorted(chosen)})
    except ValueError:
        reject()
    return GainFile(law, gains, PERIOD, clearance, limits), np.array(rows)


def limit_values(law, name):
    if name in c99_cases.delays(law):
        return st.floats(0.0, CAPACITY * PERIOD)
    lowest, highest = LIMITS[name].lowest, LIMITS[name].highest
    # Draw half of the limits so that they become active.
    return st.one_of(st.floats(max(lowest, -1e3), min(highest, 1e3)), st.floats(lowest, highest))


@settings(max_examples=150)
@given(case=cases())
def test_c99_commands_equal_python_for_ticks_generated_by_hypothesis(case, batch):
    gain_file, rows = case
    compare(batch(gain_file.compensator), gain_file, rows)


@pytest.mark.parametrize(
    "law", [pytest.param(law, marks=() if law in LONG_CODE else pytest.mark.slow) for law in LAWS]
)
def test_c99_has_no_undefined_behaviour_under_sanitizers(law, tmp_path):
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
def test_c99_commands_equal_python_over_ten_million_ticks(law, batch):
    rng = np.random.default_rng([8, LAWS.index(law)])
    chunk = 20_000
    for n in range(math.ceil(1e7 / len(LAWS) / chunk)):
        gain_file = drawn_gains(law, rng, hostile=n % 2 == 1)
        compare(batch(law), gain_file, drawn_rows(KINDS[n % 3], chunk, rng, gain_file.control_period))
