"""Controller in C and controller in Python on the same rows.

A row holds the inputs of one tick (see `c99_driver.c`), a result the outputs of either controller.
"""

import ctypes
import functools
import math
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gain_documents import GAINS, gain_document, sign

from jaxhil.rig import COMPENSATORS, Controller
from jaxhil.rig.bounds import CONTROL_PERIODS
from jaxhil.rig.filters import DelayLine
from jaxhil.rig.gain_file import GainFile
from jaxhil.rig.law_status import STATUSES
from jaxhil.rig.limits import LIMITS, NO_LIMITS, complete_limits
from tuning.bundle.c99 import COMPILER_FLAGS, generate_c99

COMPILER = shutil.which("cc")
DRIVER = Path(__file__).with_name("c99_driver.c")
ROW = ("event", "force", "desired", "velocity", "measured", "time", "timed", "x", "v", "a")
RESULT = (
    *("force", "position", "stiffness", "damping", "law_status", "faults", "seen", "cause"),
    *("missed_ticks", "late_ticks", "at_rest", "tripped", "bias", "answer"),
    *("contacts", "restitution", "expected", "balance"),
    *("last_contact", "contact_status", "contact_ticks", "unsure", "saturated", "too_short", "noisy"),
    "force_delay",
)
STATUS_NUMBERS = {status.name: status.number for status in STATUSES}
TICK, RESET, NEXT_CONTACT, STOP, RELEASE, TARE, COMMAND_FIRST, STEP_ONLY = map(float, range(8))
EVENTS = (TICK, RESET, NEXT_CONTACT, STOP, RELEASE, TARE, COMMAND_FIRST, STEP_ONLY)
PERIOD = 0.001
CAPACITY = 64  # longest delay with random gains [periods]
LINES = DelayLine.MAX_DELAY_PERIODS  # longest delay that the compiled compensators support [periods]
SANITIZED = ("-fsanitize=undefined,address,float-cast-overflow", "-fno-sanitize-recover=all", "-g")
SANE_LIMITS = {
    "force_range": 2000.0,
    "measured_lowest": -1e-3,
    "measured_highest": 2e-3,
    "held_readings": 3.0,
    "force_stuck_travel": 2e-4,
    "position_stuck_travel": 1e-4,
    "free_distance": 1e-4,
    "settling": 0.01,
    "free_force": 1.0,
    "late_fraction": 0.25,
    "missed_in_a_row": 4.0,
    "tare_ticks": 3.0,
    "tare_spread": 4.0,
    "bias_limit": 20.0,
    "force_limit": 1000.0,
    "force_slew": 1e5,
    "limited_in_a_row": 3.0,
    "command_lowest": -1e-3,
    "command_highest": 1e-3,
    "velocity_limit": 0.05,
    "deceleration": 0.5,
    "retreat_velocity": 0.01,
    "equivalent_mass": 350.0,
    "longest_contact": 0.2,
    "energy_balance": 1e3,
    "restitution_margin": 5.0,
    "reference_stiffness": 1.2e5,
    "reference_velocity": 0.005,
    "softness_lowest": -0.5,
    "speed_lowest": -0.5,
}
AUDIT = {"settling", *list(LIMITS)[list(LIMITS).index("equivalent_mass") :]}
HOSTILE = np.array([
    0.0, -0.0, 5e-324, -5e-324, 1e-310, 2.3e-308, 1e-160, 1e-16, 1.0, -1.0, 1e16, -1e160, 1e300, -1e308,
    1.7976931348623157e308, -1.7976931348623157e308, math.inf, -math.inf, math.nan,
])  # fmt: skip


class Batch:
    """Compiled controller with one compensator, which processes rows."""

    def __init__(self, library: Path, law: str) -> None:
        self._library = ctypes.CDLL(str(library))
        self._library.driver_size.restype = ctypes.c_size_t
        self._state = (ctypes.c_double * (self._library.driver_size() // 8 + 1))()
        self.law = law

    def exported(self) -> np.ndarray:
        """Return the controller with gains and limits compiled in."""
        parameters = np.empty(2 + len(COMPENSATORS[self.law].gains) + len(LIMITS))
        self._library.driver_exported.restype = ctypes.c_size_t
        assert self._library.driver_exported(_pointer(parameters)) == parameters.size
        return parameters

    def fault_name(self, bit: int) -> str:
        self._library.jaxhil_fault_name.restype = ctypes.c_char_p
        return self._library.jaxhil_fault_name(ctypes.c_uint32(bit)).decode()

    def status_name(self, status: int) -> str:
        self._library.jaxhil_law_status_name.restype = ctypes.c_char_p
        return self._library.jaxhil_law_status_name(status).decode()

    def begin(self, parameters: np.ndarray) -> bool:
        return bool(self._library.driver_init(self._state, _pointer(parameters)))

    def run(self, rows: np.ndarray, guarded: bool) -> np.ndarray:
        results = np.empty((len(rows), len(RESULT)))
        run = self._library.driver_run if guarded else self._library.driver_law
        run(self._state, ctypes.c_size_t(len(rows)), _pointer(rows), _pointer(results))
        return results


@functools.cache
def loaded(law: str) -> Batch:
    """Compile the compensator for the longest delay of the runtime and load it, once for all modules."""
    folder = write_sources(Path(_BUILT.name) / law, long_document(law))
    return Batch(compiled(folder, "c99_driver.c", "driver.so", "-O2", "-shared", "-fPIC"), law)


_BUILT = tempfile.TemporaryDirectory(prefix="jaxhil-c99-")


def _pointer(values: np.ndarray):
    assert values.dtype == np.float64 and values.flags.c_contiguous
    return values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def write_sources(folder: Path, document: Mapping[str, Any]) -> Path:
    """Write the controller's files and the driver to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = generate_c99(document)
    for name, text in texts.items():
        (folder / name).write_text(text)
    # If a division or a square root may fail, the compensator's step has an error flag.
    fails = re.search(
        r"^static double jaxhil_law_step\([^)]*bool \*error\)", texts["jaxhil_controller.c"], re.M
    )
    (folder / DRIVER.name).write_text(("#define LAW_CAN_FAIL\n" if fails else "") + DRIVER.read_text())
    return folder


def compiled(folder: Path, source: str, output: str, *options: str) -> Path:
    """Compile `source` in `folder` with the flags that the interface requires."""
    command = [str(COMPILER), *COMPILER_FLAGS, *options, source, "-o", output, "-lm"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr == ""
    return folder / output


def long_document(law: str) -> dict[str, Any]:
    """Return a gain document whose delays have the maximum length of the runtime."""
    period = CONTROL_PERIODS[0]
    document = gain_document(law, control_period=period)
    document["limits"] = {}
    for name in delays(law):
        if name in document["gains"]:
            document["gains"][name] |= {"value": LINES * period, "upper": LINES * period}
        else:
            document["limits"][name] = {"value": LINES * period, "unit": LIMITS[name].unit}
    return sign(document)


def delays(law: str) -> set[str]:
    """Return the names of gains and limits that are delays of delay lines in the C controller."""
    return {"alignment", "identification_delay"} & {*LIMITS, *COMPENSATORS[law].gains}


def packed(law: str, gain_file: GainFile) -> np.ndarray:
    """Return gains and limits as C structs."""
    gains = [gain_file.gains[name] for name in COMPENSATORS[law].gains]
    limits = [gain_file.limits[name] for name in LIMITS]
    return np.array([gain_file.control_period, gain_file.clearance, *gains, *limits])


def drawn_gains(law: str, rng: np.random.Generator, hostile: bool, period: float | None = None) -> GainFile:
    """Draw admissible gains, near the nominal gains or from the whole range."""
    gains = {}
    period = period or PERIOD * float(rng.choice([0.25, 1.0, 1.7]))
    for name, specification in COMPENSATORS[law].gains.items():
        value = GAINS[law][name]["value"] * float(np.exp(0.5 * rng.standard_normal()))
        if hostile and rng.random() < 0.5:
            value = float(rng.choice(HOSTILE)) if rng.random() < 0.5 else float(10 ** rng.uniform(-320, 300))
        if name == "sensor_lag" and rng.random() < 0.5:
            value = 0.0  # not specified
        if name in delays(law):
            value = float(rng.choice([0.0, 1.0, 7.0, rng.uniform(0, CAPACITY)])) * period
        # Replace NaN by a bound.
        gains[name] = max(min(specification.highest, value), specification.lowest)
    clearance = float(rng.choice([math.inf, 0.0, 1e-4, 0.02]))
    return GainFile(law, gains, period, clearance, drawn_limits(law, rng, hostile, period))


def drawn_limits(law: str, rng: np.random.Generator, hostile: bool, period: float) -> Mapping[str, float]:
    """Draw limits that are sometimes reached, some of them missing; if `hostile`, of any size."""
    limits = {}
    only_audited = rng.random() < 0.4  # without guard limits, which would stop contacts
    for name, specification in LIMITS.items():
        if (only_audited and name not in AUDIT) or (rng.random() < 0.3 and name != "equivalent_mass"):
            continue
        usual = 0.1 if name.startswith("expected_") else 1.0
        value = SANE_LIMITS.get(name, usual) * float(np.exp(0.5 * rng.standard_normal()))
        if hostile and rng.random() < 0.3:
            value = float(rng.choice(HOSTILE)) if rng.random() < 0.5 else float(10 ** rng.uniform(-320, 300))
        if name in delays(law):
            value = float(rng.choice([0.0, 1.0, 7.0, rng.uniform(0, CAPACITY)])) * period
        if specification.admits(value):
            limits[name] = value
    try:
        return complete_limits(limits)
    except ValueError:
        return NO_LIMITS


def contact_rows(
    count: int, rng: np.random.Generator, period: float, phase: float, rate: float, amplitude: float
) -> np.ndarray:
    """Return ticks of successive noisy contacts of this phase, rate [rad/s] and amplitude [m]."""
    time = period * np.arange(count)

    def motion(late: float) -> np.ndarray:
        return amplitude * (np.sin(rate * (time - late) + phase) - 0.3)

    speed = amplitude * rate * np.cos(rate * time + phase)
    force = 1.2e5 * np.maximum(motion(0.009), 0.0) + rng.standard_normal(count)
    measured = motion(0.006) + 1e-7 * rng.standard_normal(count)
    rows = np.zeros((count, len(ROW)))
    rows[:, 1:] = np.stack(
        [force, motion(0), speed, measured, time, np.ones(count), motion(0), speed, -force / 350], axis=1
    )
    return rows


def drawn_rows(kind: str, count: int, rng: np.random.Generator, period: float) -> np.ndarray:
    """Draw ticks of the given kind: "contact", "random" or "hostile".

    On some ticks the controller is reset, or the next contact is announced.
    """
    phase, rate, amplitude = rng.uniform(0, 2 * np.pi), rng.uniform(10, 60), 10 ** rng.uniform(-5, -3)
    rows = contact_rows(count, rng, period, phase, rate, amplitude)
    time = rows[:, 5].copy()
    if kind != "contact":
        size = 10 ** rng.uniform(-12, 12, (count, 9))
        rows[:, 1:] = np.where(
            rng.random((count, 9)) < 0.5, rows[:, 1:], size * rng.standard_normal((count, 9))
        )
        rows[:, 6] = rng.random(count) < 0.7
        rows[:, 5] = time + period * rng.choice([0.0, 0.4, -1.0, 3.0], count)
    if kind == "hostile":
        taken = rng.random((count, 9)) < rng.choice([0.001, 0.03, 0.5])
        taken[:, 5] = False
        rows[:, 1:] = np.where(taken, rng.choice(HOSTILE, (count, 9)), rows[:, 1:])
    rows[:, 0] = rng.choice(EVENTS, count, p=[0.87, 0.03, 0.02, 0.002, 0.01, 0.038, 0.02, 0.01])
    if rng.random() < 0.5:  # a rig that starts with a tare and whose force sensor has a coarse resolution
        rows[:6, 0] = TARE
        rows[:, 1] = np.where(np.abs(rows[:, 1]) < 1e6, 50.0 * np.round(rows[:, 1] / 50.0), rows[:, 1])
        rows[:6, 1] = 3.0 * rng.standard_normal(6)
    if rng.random() < 0.3:  # a position sensor whose reading is stuck
        begin = int(rng.integers(count))
        rows[begin : begin + count // 5, 4] = rows[begin, 4]
    return rows


def drawn_exactly(law: str, count: int, rng: np.random.Generator) -> tuple[GainFile, np.ndarray]:
    """Draw gains, limits and rows from few values, so that many comparisons are ties.

    Positions are multiples of the distance that 1 m/s covers in a period.
    """
    period = 2.0**-10
    per_period = {"N/s": 1 / period, "m": period, "m/s^2": 1 / period, "s": period}
    limits = {}
    only_expected = rng.random() < 0.5  # without limits that would stop contacts
    for name, specification in LIMITS.items():
        guards = name not in AUDIT or name in ("energy_balance", "restitution_margin", "longest_contact")
        if (only_expected and guards) or (rng.random() < 0.4 and name != "equivalent_mass"):
            continue
        value = float(rng.integers(1, 5)) * per_period.get(specification.unit, 1.0)
        if name in ("late_fraction", "restitution_margin"):
            value *= 0.25
        if name.startswith("expected"):
            value *= 0.125
        limits[name] = -value if name.endswith("_lowest") else value
    try:
        limits = complete_limits(limits)
    except ValueError:
        limits = NO_LIMITS
    clearance = float(rng.choice([math.inf, 1.0, 2.0, 4.0])) * period
    gain_file = drawn_gains(law, rng, hostile=False)._replace(
        control_period=period, clearance=clearance, limits=limits
    )
    whole = {}
    for name, specification in COMPENSATORS[law].gains.items():
        value = float(rng.integers(1, 4)) * per_period.get(specification.unit, 1.0)
        whole[name] = value if specification.admits(value) else specification.highest
    whole |= {"forgetting": 0.5} if "forgetting" in whole else {}
    gain_file = gain_file._replace(gains=whole)
    rows = np.zeros((count, len(ROW)))
    rows[:, 1:] = rng.integers(-3, 4, (count, 9))
    if rng.random() < 0.7:  # random walks, which stay on the same side of zero for some time
        rows[:, 1:] = np.clip(np.cumsum(rng.integers(-1, 2, (count, 9)), axis=0), -4, 4)
        rows[:, 4] = np.where(rng.random(count) < 0.5, rows[:, 2], rows[:, 4])
    rows[:, [2, 4, 7]] *= period
    gaps = rng.choice([1.0, 1.25, 1.5, 2.0, 3.0, 5.0, 1e6 - 0.5], count, p=[0.9, 0.03, 0.03, *[0.01] * 4])
    rows[:, 5] = period * np.cumsum(gaps)
    rows[:, 6] = 1.0
    rows[:, 0] = rng.choice(EVENTS, count, p=[0.77, 0.08, 0.02, 0.005, 0.045, 0.05, 0.02, 0.01])
    if only_expected:  # without a stopped clock or emergency stop
        rows[:, 0] = np.where(rows[:, 0] == NEXT_CONTACT, NEXT_CONTACT, TICK)
        rows[:, 6] = 0.0
    return gain_file, rows


def law_in_python(gain_file: GainFile, rows: np.ndarray) -> np.ndarray:
    """Return the force commands of the Python compensator, without the controller's guards."""
    law = COMPENSATORS[gain_file.compensator](gain_file.gains, gain_file.control_period, gain_file.clearance)
    results = np.zeros((len(rows), len(RESULT)))
    for row, result in zip(rows.tolist(), results, strict=True):
        if row[0] == RESET:
            law.reset()
        elif row[0] == NEXT_CONTACT:
            law.next_contact()
        try:
            force = law.step(*row[1:5])
        except ArithmeticError:
            force = math.nan
        result[:5] = force, law.position_command(*row[7:]), *law.identified, law.status
    return results


def controller_in_python(gain_file: GainFile, rows: np.ndarray) -> np.ndarray:
    """Return the outputs of the Python controller for the rows."""
    controller = Controller(gain_file)
    watchdog = controller._watchdog
    results = np.zeros((len(rows), len(RESULT)))
    for row, result in zip(rows.tolist(), results, strict=True):
        answer = _event(controller, row)
        result[0] = controller.step(*row[1:5], row[5] if row[6] else None)
        result[1] = 0.0 if row[0] == STEP_ONLY else controller.position_command(*row[7:])
        result[2:4] = controller.identified
        result[4] = STATUS_NUMBERS[controller.law_status]
        result[5:8] = controller.faults, controller.seen, controller.cause
        number, status, *counts = controller.last_contact
        result[8:] = (
            *(controller.missed_ticks, controller.late_ticks, controller.at_rest, controller.tripped),
            *(controller.bias, answer),
            *(watchdog.contacts, watchdog.restitution, watchdog.expected, watchdog.balance),
            *(number, STATUS_NUMBERS[status], *counts),
            controller.force_delay,
        )
    return results


def _event(controller: Controller, row: list[float]) -> float:
    code = row[0]
    if code == RESET:
        return controller.reset()
    if code == TARE:
        return controller.tare(row[1])
    if code == COMMAND_FIRST:
        return controller.position_command(*row[7:])
    if code == NEXT_CONTACT:
        controller.next_contact()
    elif code in (STOP, RELEASE):
        controller.emergency_stop(code == STOP)
    return False


def same_bits(result: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return where two arrays of doubles have equal bits or are both NaN."""
    return (result.view(np.uint64) == expected.view(np.uint64)) | (np.isnan(result) & np.isnan(expected))


def assert_same(result: np.ndarray, expected: np.ndarray, rows: np.ndarray) -> None:
    """Raise AssertionError with the first tick and column in which C and Python differ."""
    same = same_bits(result, expected)
    if not same.all():
        tick, column = (int(index) for index in np.argwhere(~same)[0])
        raise AssertionError(
            f"tick {tick}: {RESULT[column]}: C {result[tick, column]!r}, Python {expected[tick, column]!r}, "
            f"row {rows[tick].tolist()}"
        )
