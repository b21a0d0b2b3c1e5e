"""The six-axis C99 controller and the Python controller give identical results."""

import shutil
import subprocess

import c99_cases
import numpy as np
import pytest
from c99_cases import same_bits
from gain_documents import sign
from six_axis_c99 import (
    DRIVER,
    RESULT,
    ControllerInC,
    assert_same,
    built,
    drawn_rows,
    in_python,
    pointer,
    rows_of,
    write_sources,
)
from six_axis_documents import LIMITS, six_axis_document
from six_axis_ranges import NOISE, POSE_NOISE
from six_axis_records import recorded

from jaxhil.laws import built_in_compensators
from jaxhil.mechanism.file import load_any
from jaxhil.rig import Controller6
from jaxhil.rig.faults import UNUSABLE, fault_names
from jaxhil.rig.six_axes.faults import SIX_AXIS_FAULTS
from jaxhil.rig.six_axes.limits import SIX_AXIS_LIMITS
from jaxhil.rig.six_axes.registry import ModelConstants
from tuning.bundle.c99 import generate_c99

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
LAWS = built_in_compensators(6)
SOME_LAWS = [
    pytest.param(name, marks=pytest.mark.slow if name in ("phase_lead", "response_error") else ())
    for name in LAWS
]
KINDS = ("contact", "random", "hostile")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-ffp-contract=off")


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "impulse_ledger" else pytest.mark.slow) for name in LAWS],
)
def test_six_axis_c99_sources_compile_without_warnings(name, compiler, tmp_path):
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} on this machine")
    folder = write_sources(tmp_path, six_axis_document(name, limits=LIMITS))
    for source in ("jaxhil_controller.c", "test_vectors.c"):
        command = [compiler, *STRICT, "-O2", "-c", source, "-o", "out.o"]
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        assert (ran.returncode, ran.stderr) == (0, "")


def test_six_axis_c99_gains_limits_and_constants_equal_gain_document():
    document, made = built("impulse_ledger")
    parameters = np.zeros(400)
    count = made.library.driver_exported(pointer(parameters))
    gains = [document["control_period"], *(entry["value"] for entry in document["gains"].values())]
    limits = [LIMITS.get(name, limit.default) for name, limit in SIX_AXIS_LIMITS.items()]
    constants = np.concatenate([np.ravel(document["constants"][name]) for name in ModelConstants._fields])
    expected = np.array([*gains, *limits, *constants])
    assert count == len(expected) and parameters[:count].tobytes() == expected.tobytes()


def test_six_axis_c99_header_has_fault_bits_of_python_runtime():
    header = generate_c99(six_axis_document("none"))["jaxhil_controller.h"]
    for fault in SIX_AXIS_FAULTS:
        assert f"    JAXHIL_{fault.name.upper()} = 0x{fault.bit:X},\n" in header


def test_six_axis_c99_controller_rejects_unusable_constants():
    document, made = built("impulse_ledger")
    parameters = np.zeros(400)
    made.library.driver_exported(pointer(parameters))
    first = 1 + len(document["gains"])
    second = first + len(SIX_AXIS_LIMITS)
    parts = np.split(parameters[: second + 116], [first, second])
    assert made.library.driver_init_with(made.state, *(pointer(part) for part in parts))
    for index, value in (
        *((0, np.nan), (40, np.inf), (80, 1e10), (108, -1.0), (108, 0.6), (0, -1.0)),
        *((109, 0.0), (112, np.nan)),
    ):
        changed = parts[2].copy()
        changed[index] = value
        assert not made.library.driver_init_with(
            made.state, pointer(parts[0].copy()), pointer(parts[1].copy()), pointer(changed)
        )
    rows = drawn_rows("contact", 5, np.random.default_rng(0))
    results = np.empty((5, len(RESULT)))
    made.library.driver_run(made.state, 5, pointer(rows), pointer(results))
    assert np.all(results[:, :6] == 0) and np.all(results[:, RESULT.index("cause")] == UNUSABLE)
    limits = parts[1].copy()
    limits[list(SIX_AXIS_LIMITS).index("command_lowest_x")] = 0.5
    constants = pointer(parts[2].copy())
    assert not made.library.driver_init_with(made.state, pointer(parts[0].copy()), pointer(limits), constants)


def test_six_axis_c99_sensor_conversion_equals_python_bit_for_bit(tmp_path):
    document, rng = six_axis_document(limits=LIMITS), np.random.default_rng(3)
    controllers = Controller6.from_dict(document), ControllerInC(document, tmp_path)
    for size in (0.0, 1e-9, 0.03, 1.0, 4.0, 1e300, np.nan):
        reading, pose = 100 * rng.standard_normal(6), size * rng.standard_normal(6)
        values = [controller.from_sensor(reading, pose) for controller in controllers]
        assert same_bits(*map(np.array, values)).all()


@pytest.mark.parametrize("wide", [pytest.param(False, marks=pytest.mark.slow), True], ids=["limited", "wide"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SOME_LAWS)
def test_six_axis_c99_commands_equal_python_bit_for_bit(name, kind, wide):
    document, made = built(name, wide)
    for n in range(3):
        rng = np.random.default_rng([LAWS.index(name), KINDS.index(kind), wide, n])
        rows = drawn_rows(kind, 1000, rng)
        results = made.run(rows)
        assert_same(results, in_python(document, rows), rows)
        assert np.all(np.isfinite(results[:, :12]))


def of_records():
    changes = {"rig.force_sensor.noise_std": NOISE, "rig.position_sensor.noise_std": POSE_NOISE}
    return recorded(load_any("probe-drogue", changes).mechanism, "impulse_ledger", 3)


@pytest.mark.slow
def test_six_axis_c99_commands_equal_python_on_recorded_contacts():
    document, made = built("impulse_ledger")
    for record in of_records().lanes:
        rows = rows_of(record[:4], 1e-3)
        results = made.run(rows)
        assert_same(results, in_python(document, rows), rows)
        assert np.any(results[:, :6] != 0)


def test_random_rows_of_six_axis_c99_tests_raise_all_faults_except_three():
    """Check that the rows cause all faults except three that the watchdog's tests cause."""
    seen, made = 0, built("impulse_ledger")[1]
    for n in range(150):
        rows = drawn_rows(KINDS[n % 3], 600, np.random.default_rng([5, n]))
        seen |= int(np.bitwise_or.reduce(made.run(rows)[:, RESULT.index("seen")].astype(int)))
    missing = {fault.name for fault in SIX_AXIS_FAULTS} - {*fault_names(seen, SIX_AXIS_FAULTS)}
    assert missing <= {"contact_too_long", "energy_gain", "unpaid_impulse"}


def test_six_axis_c99_export_rejects_delay_longer_than_delay_line():
    document = six_axis_document(identification_delay=0.52)
    document["gains"]["identification_delay"]["upper"] = 1.0
    with pytest.raises(ValueError, match="periods"):
        generate_c99(sign(document))


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n == "impulse_ledger" else pytest.mark.slow) for n in LAWS]
)
def test_six_axis_c99_has_no_undefined_behaviour_under_sanitizers(name, tmp_path):
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    command = [str(c99_cases.COMPILER), *c99_cases.SANITIZED, str(probe), "-o", str(tmp_path / "probe")]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("the compiler has no sanitizers")
    document = six_axis_document(name, limits=LIMITS)
    folder = write_sources(tmp_path / name, document)
    options = ("-O1", "-DDRIVER_MAIN", *c99_cases.SANITIZED)
    program = c99_cases.compiled(folder, DRIVER.name, "sanitized", *options)
    for n, kind in enumerate(KINDS * 2):
        rows = drawn_rows(kind, 800, np.random.default_rng([9, n]))
        ran = subprocess.run([str(program)], input=rows.tobytes(), capture_output=True, check=False)
        assert (ran.returncode, ran.stderr) == (0, b"")
        results = np.frombuffer(ran.stdout).reshape(len(rows), -1)
        assert_same(results, in_python(document, rows), rows)


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_six_axis_c99_commands_equal_python_over_a_million_ticks(name):
    """Run 1e6 ticks with the impulse ledger, and 1e5 with each other compensator."""
    total, chunk = (1_000_000 if name == "impulse_ledger" else 100_000), 5_000
    for n in range(total // chunk):
        document, made = built(name, wide=n % 4 == 3)
        rows = drawn_rows(KINDS[n % 3], chunk, np.random.default_rng([7, LAWS.index(name), n]))
        if n % 10 == 0:
            lanes = [rows_of(record[:4], 1e-3) for record in of_records().lanes]
            rows = np.ascontiguousarray(np.concatenate([*lanes, rows])[:chunk])
        assert_same(made.run(rows), in_python(document, rows), rows)
