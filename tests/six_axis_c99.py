"""Helpers that run the six-axis controllers in C and in Python with the same inputs.

A row holds the inputs of one tick (see `c99_driver_six_axes.c`), a result the outputs of either controller.
"""

import ctypes
import functools
import shutil
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from c99_cases import (
    COMMAND_FIRST,
    HOSTILE,
    NEXT_CONTACT,
    RELEASE,
    RESET,
    STEP_ONLY,
    STOP,
    TARE,
    compiled,
    same_bits,
)
from six_axis_documents import LIMITS, six_axis_document
from six_axis_records import random_readings

import jaxhil.rig.six_axes
from jaxhil.rig.law_status import STATUSES
from jaxhil.rig.six_axes import Controller6
from tuning.bundle.c99 import generate_c99
from tuning.bundle.single_file import build_runtime_source

DRIVER = Path(__file__).with_name("c99_driver_six_axes.c")
SIX = ("x", "y", "z", "rx", "ry", "rz")
RESULT = (
    *(f"wrench_{axis}" for axis in SIX),
    *(f"pose_{axis}" for axis in SIX),
    *(f"bias_{axis}" for axis in SIX),
    *("law_status", "faults", "seen", "cause", "channels", "missed_ticks", "late_ticks", "at_rest"),
    *("tripped", "answer", "loop_delay", "unpaid_impulse", "momentum_error", "energy_gain", "unpaid"),
    *("contact", "contact_status", "ticks", "unsure", "saturated", "too_short", "noisy"),
)
STATUS_NUMBERS = {status.name: status.number for status in STATUSES}
WIDTH = 39
_BUILT = tempfile.TemporaryDirectory(prefix="jaxhil-c99-six-axes-")


class SixAxisBatch:
    """Compiled controller of one gain document."""

    def __init__(self, library):
        self.library = ctypes.CDLL(str(library))
        self.library.driver_size.restype = ctypes.c_size_t
        self.library.driver_exported.restype = ctypes.c_size_t
        self.library.driver_ticks.restype = ctypes.c_double
        self.state = (ctypes.c_double * (self.library.driver_size() // 8 + 1))()

    def run(self, rows):
        """Restart the controller and return its results for the rows."""
        assert self.library.driver_init(self.state)
        results = np.empty((len(rows), len(RESULT)))
        self.library.driver_run(self.state, ctypes.c_size_t(len(rows)), pointer(rows), pointer(results))
        return results


class ControllerInC:
    """Compiled controller of one gain document, with the methods of `Controller6` that a loop calls."""

    def __init__(self, document, folder):
        sources = write_sources(folder, document)
        self._library = ctypes.CDLL(
            str(compiled(sources, DRIVER.name, "driver.so", "-O2", "-shared", "-fPIC"))
        )
        self._library.driver_size.restype = ctypes.c_size_t
        self._library.driver_faults.restype = ctypes.c_uint32
        for name in ("tare", "reset", "tripped"):
            getattr(self._library, f"jaxhil_{name}").restype = ctypes.c_bool
        self._state = (ctypes.c_double * (self._library.driver_size() // 8 + 1))()
        self.control_period = document["control_period"]
        assert self._library.driver_init(self._state)

    @property
    def tripped(self):
        return self._library.jaxhil_tripped(self._state)

    @property
    def status(self):
        return "tripped" if self.tripped else "ok"

    @property
    def faults(self):
        return self._library.driver_faults(self._state)

    @property
    def last_contact(self):
        number = self._library.driver_contact_status(self._state)
        return SimpleNamespace(status=next(name for name, n in STATUS_NUMBERS.items() if n == number))

    def step(self, wrench, pose_desired, twist_desired, pose_measured, time=None):
        time = None if time is None else ctypes.byref(ctypes.c_double(time))
        vectors = wrench, pose_desired, twist_desired, pose_measured
        return self._vector(self._library.jaxhil_step, vectors, time)

    def pose_command(self, *vectors):
        return self._vector(self._library.jaxhil_pose_command, vectors)

    def from_sensor(self, *vectors):
        return self._vector(self._library.jaxhil_from_sensor, vectors)

    def tare(self, wrench):
        return self._library.jaxhil_tare(self._state, pointer(np.array(wrench, float)))

    def reset(self):
        return self._library.jaxhil_reset(self._state)

    def next_contact(self):
        self._library.jaxhil_next_contact(self._state)

    def _vector(self, function, vectors, *more):
        arguments, result = [np.array(vector, float) for vector in vectors], np.empty(6)
        function(self._state, *map(pointer, arguments), *more, pointer(result))
        return result.tolist()


def controller_of_bundle(document):
    """Return a controller of the bundle's single Python file."""
    namespace = {"__name__": "jaxhil_runtime"}
    source = build_runtime_source(document["compensator"], jaxhil.rig.six_axes, "SIX_AXIS_COMPENSATORS")
    exec(compile(source, "jaxhil_runtime.py", "exec"), namespace)
    return namespace["Controller6"].from_dict(document)


def pointer(values):
    assert values.dtype == np.float64 and values.flags.c_contiguous
    return values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def write_sources(folder, document):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in generate_c99(document).items():
        (folder / name).write_text(text)
    shutil.copy(DRIVER, folder)
    return folder


@functools.cache
def built(name, wide=False):
    """Return a compensator's document and compiled controller; if `wide`, with default limits."""
    document = six_axis_document(name, limits={} if wide else LIMITS)
    folder = write_sources(Path(_BUILT.name) / f"{name}{wide}", document)
    library = compiled(folder, DRIVER.name, "driver.so", "-O2", "-shared", "-fPIC")
    return document, SixAxisBatch(library)


def rows_of(readings, period):
    """Convert four arrays of readings (ticks, 6) to rows."""
    wrench, desired, twist, measured = readings
    count = len(wrench) - 1
    time = period * np.arange(count)[:, None]
    head = np.zeros((count, 1))
    columns = (
        head,
        wrench[:-1],
        desired[:-1],
        twist[:-1],
        measured[:-1],
        time,
        head + 1,
        desired[1:],
        twist[1:],
    )
    return np.ascontiguousarray(np.concatenate(columns, axis=1))


def drawn_rows(kind, count, rng, period=1e-3):
    """Draw rows of a kind: `contact`, `random` or `hostile` values, with occasional events."""
    readings = random_readings(rng, count + 1, period)
    if rng.random() < 0.5:
        # The rows stay within `LIMITS`, so that some runs do not trip on their first tick.
        readings = (0.1 * readings[0], *(0.3 * part for part in readings[1:]))
    rows = rows_of(readings, period)
    if kind != "contact":
        changed = rng.random((count, WIDTH - 1)) < rng.choice([0.001, 0.02, 0.3])
        size = 10 ** rng.uniform(-12, 3, (count, WIDTH - 1))
        rows[:, 1:] = np.where(changed, size * rng.standard_normal(size.shape), rows[:, 1:])
        rows[:, 26] = rng.random(count) < 0.8
        jitter = rng.choice([0.0, 0.3, -0.3, 2.0], count, p=[0.97, 0.01, 0.01, 0.01])
        rows[:, 25] += period * jitter
        begin, columns = int(rng.integers(count)), slice(*(((1, 7), (19, 25))[rng.integers(2)]))
        rows[begin : begin + 300, columns] = rows[begin, columns]  # a stuck sensor
        if rng.random() < 0.3:
            rows[:4, 0] = TARE
            rows[:4, 1:7] = rng.choice([0.1, 10.0]) * rng.standard_normal((4, 6))
    if kind == "hostile":
        taken = rng.random((count, WIDTH - 1)) < rng.choice([0.0005, 0.01, 0.2])
        taken[:, 25] = False
        rows[:, 1:] = np.where(taken, rng.choice(HOSTILE, taken.shape), rows[:, 1:])
        rows[:, 0] = rng.choice(
            [0.0, RESET, NEXT_CONTACT, STOP, RELEASE, TARE, COMMAND_FIRST, STEP_ONLY],
            count,
            p=[0.93, 0.02, 0.01, 0.002, 0.008, 0.01, 0.01, 0.01],
        )
    return rows


def in_python(document, rows):
    """Return the Python controller's results for the rows."""
    rig = Controller6.from_dict(document)
    watchdog = rig._watchdog
    results = np.zeros((len(rows), len(RESULT)))
    for row, result in zip(rows.tolist(), results, strict=True):
        answer = _event(rig, row)
        result[:6] = rig.step(row[1:7], row[7:13], row[13:19], row[19:25], row[25] if row[26] else None)
        result[6:12] = [0.0] * 6 if row[0] == STEP_ONLY else rig.pose_command(row[27:33], row[33:39])
        result[12:18] = rig.bias
        number, status, *counts = rig.last_contact
        result[18:] = (
            *(STATUS_NUMBERS[rig.law_status], rig.faults, rig.seen, rig.cause, rig.channels),
            *(rig.missed_ticks, rig.late_ticks, rig.at_rest, rig.tripped, answer),
            *(rig.loop_delay, rig.unpaid_impulse),
            *(watchdog.momentum_error, watchdog.energy_gain, watchdog.unpaid_impulse),
            *(number, STATUS_NUMBERS[status], *counts),
        )
    return results


def _event(rig, row):
    code = row[0]
    if code == RESET:
        return rig.reset()
    if code == TARE:
        return rig.tare(row[1:7])
    if code == COMMAND_FIRST:
        return rig.pose_command(row[27:33], row[33:39])[2]
    if code == NEXT_CONTACT:
        rig.next_contact()
    elif code in (STOP, RELEASE):
        rig.emergency_stop(code == STOP)
    return 0.0


def assert_same(found, expected, rows):
    """Raise AssertionError if C and Python differ; name the first such tick and column."""
    same = same_bits(np.ascontiguousarray(found), np.ascontiguousarray(expected))
    if not same.all():
        tick, column = (int(index) for index in np.argwhere(~same)[0])
        raise AssertionError(
            f"tick {tick}: {RESULT[column]}: C {found[tick, column]!r}, Python {expected[tick, column]!r}, "
            f"row {rows[tick].tolist()}"
        )
