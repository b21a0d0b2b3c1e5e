"""Ticks of a rig with injected faults, and the exact set of faults that each tick must raise.

The motion is scripted: in and out of contact, measured position and force delayed, force sensor noisy. Each
injected fault lasts for some ticks, and twenty ticks later the rig resets. The expected faults are derived
from the injection, without the controller. `rows` have the layout of `c99_cases.ROW`.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from c99_cases import RESET, TICK
from gain_documents import gain_document, sign

from jaxhil.rig.faults import (
    CLOCK,
    EARLY_TICK,
    FORCE_IN_FLIGHT,
    FORCE_LIMIT,
    FORCE_NOT_FINITE,
    FORCE_OUT_OF_RANGE,
    FORCE_SLEW,
    FORCE_STUCK,
    LATE_TICK,
    LAW_IN_DOUBT,
    MISSED_TICK,
    MODEL_NOT_FINITE,
    POSITION_NOT_FINITE,
    POSITION_OUT_OF_RANGE,
    POSITION_STUCK,
    STROKE,
    VELOCITY_LIMIT,
)
from jaxhil.rig.limits import LIMITS

PERIOD = 1e-3
CYCLE = 800  # length of a cycle [ticks]; a quarter of it is in contact
HELD, MISSED, CUT = 3, 4, 3
LIMITED: dict[str, float] = {
    "force_range": 1e4,
    "measured_lowest": -0.01,
    "measured_highest": 0.01,
    "held_readings": HELD,
    "force_stuck_travel": 5e-5,
    "position_stuck_travel": 5e-5,
    "free_distance": 2e-4,
    "settling": 0.02,
    "free_force": 6.0,
    "late_fraction": 0.25,
    "missed_in_a_row": MISSED,
    "force_limit": 5000.0,
    "force_slew": 1e6,
    "limited_in_a_row": CUT,
    "command_lowest": -0.02,
    "command_highest": 0.02,
    "velocity_limit": 1.0,
    "deceleration": 500.0,
    "retreat_velocity": 0.01,
    "equivalent_mass": 300.0,
    "longest_contact": 1.0,
}
FORCE, DESIRED, VELOCITY, MEASURED, TIME, MODEL = 1, 2, 3, 4, 5, 7
BETWEEN, UNTIL_RESET = 60, 20
BEFORE = 60  # ticks of approach that a compensator needs to estimate the noise
NOT_FINITE = (math.nan, math.inf, -math.inf)
# The leads are so short that only injected faults take a command to its limits.
GENTLE = {
    "multi_parameter_lead": {"force_rate_gain": 0.008},
    "position_lead": {"position_lead": 1e-3, "acceleration_lead": 1e-5},
}


class FaultRun(NamedTuple):
    """Ticks and their expected faults, (ticks,).

    `tripped` marks ticks on which the controller must be tripped. `catching_up` marks ticks after a reset on
    which the velocity limit may act, while the command returns. `entered` marks ticks of a contact with a
    reset during or shortly before the contact, and the ticks after it: a compensator with a status may report
    that it does not know this contact.
    """

    rows: np.ndarray
    faults: np.ndarray
    tripped: np.ndarray
    catching_up: np.ndarray
    entered: np.ndarray

    def wrong(self, faults: np.ndarray, tripped: np.ndarray) -> np.ndarray:
        """Return the ticks whose raised faults or trip state differ from the expectation."""
        excused = np.where(self.catching_up, VELOCITY_LIMIT, 0) | np.where(self.entered, LAW_IN_DOUBT, 0)
        return np.nonzero(((faults ^ self.faults) & ~excused != 0) | (tripped != self.tripped))[0]


def document(law: str) -> dict[str, Any]:
    """Return a gain document of the compensator with the limits of these runs."""
    made = gain_document(law, **GENTLE.get(law, {}))
    made["limits"] = {
        name: {"value": float(value), "unit": LIMITS[name].unit} for name, value in LIMITED.items()
    }
    return sign(made)


def fault_run(ticks: int, seed: int, law: str) -> FaultRun:
    """Return `ticks` ticks with a fault every `BETWEEN` ticks; force command faults only for `none`."""
    rng = np.random.default_rng(seed)
    rows = _healthy(ticks, rng)
    faults = np.zeros(ticks, np.int64)
    tripped = np.zeros(ticks, bool)
    run = FaultRun(rows, faults, tripped, np.zeros(ticks, bool), np.zeros(ticks, bool))
    in_contact = _IN_CONTACT + (_OF_COMMAND if law == "none" else ())
    # The first tick after a reset has no history, so nothing is injected before the transient has decayed.
    for begin in range(BETWEEN, ticks - BETWEEN, BETWEEN):
        window = rows[begin - 25 : begin + 25, MEASURED]
        special = ()
        if np.all(window > 0):
            special = in_contact
        elif np.all(window < -LIMITED["free_distance"]):
            special = _IN_FLIGHT
        kinds = special if special and rng.random() < 0.4 else _EVERYWHERE
        kind = kinds[rng.integers(len(kinds))]
        tick = kind(run, begin, rng)
        if tick is not None:
            end = begin + UNTIL_RESET
            assert begin <= tick < end
            tripped[tick:end] = True
            rows[end, 0] = RESET
            run.catching_up[end : end + 10] = kind is _fast_position
            if np.any(rows[end : end + BEFORE, [DESIRED]] > 0) or rows[end, MEASURED] > 0:
                run.entered[end : end + CYCLE // 2] = True
    return run


def _healthy(ticks: int, rng: np.random.Generator) -> np.ndarray:
    time = PERIOD * np.arange(ticks + 1)
    rate = 2 * math.pi / (CYCLE * PERIOD)

    def position(late: float) -> np.ndarray:
        return 1.5e-3 * np.sin(rate * (time - late)) - 1e-3

    velocity = 1.5e-3 * rate * np.cos(rate * time)
    force = 1e5 * np.maximum(position(0.014), 0.0) + np.clip(rng.standard_normal(ticks + 1), -4, 4) * 0.2
    rows = np.zeros((ticks, 10))
    rows[:, 0] = TICK
    for column, values in ((FORCE, force), (DESIRED, position(0)), (VELOCITY, velocity), (TIME, time)):
        rows[:, column] = values[:-1]
    rows[:, MEASURED] = position(0.008)[:-1]
    rows[:, 6] = 1.0
    rows[:, MODEL] = position(0)[1:]
    rows[:, 8] = velocity[1:]
    rows[:, 9] = -force[:-1] / 300.0
    return rows


def _pick(rng: np.random.Generator, values: tuple[float, ...]) -> float:
    return values[rng.integers(len(values))]


def _bad_reading(column: int, fault: int, values: tuple[float, ...]):
    def inject(run: FaultRun, begin: int, rng: np.random.Generator) -> int | None:
        """Flag each of several consecutive bad readings; the first beyond the allowed number trips."""
        length = int(rng.integers(1, HELD + 6))
        run.rows[begin : begin + length, column] = [_pick(rng, values) for _ in range(length)]
        run.faults[begin : begin + min(length, HELD + 1)] |= fault
        return begin + HELD if length > HELD else None

    return inject


def _bad_model(column: int):
    def inject(run: FaultRun, begin: int, rng: np.random.Generator) -> int | None:
        run.rows[begin, column] = _pick(rng, NOT_FINITE)
        run.faults[begin] |= MODEL_NOT_FINITE
        return begin

    return inject


def _late(run: FaultRun, begin: int, rng: np.random.Generator) -> None:
    """Delay one tick; the clock continues as before, so the next tick is early."""
    run.rows[begin, TIME] += PERIOD * rng.uniform(0.26, 0.49)
    run.faults[begin] |= LATE_TICK
    run.faults[begin + 1] |= EARLY_TICK


def _early(run: FaultRun, begin: int, rng: np.random.Generator) -> None:
    run.rows[begin, TIME] -= PERIOD * rng.uniform(0.26, 0.49)
    run.faults[begin] |= EARLY_TICK
    run.faults[begin + 1] |= LATE_TICK


def _rate(run: FaultRun, begin: int, rng: np.random.Generator) -> int:
    """Inject ticks whose period is slightly wrong; no single tick is early or late."""
    wrong = _pick(rng, (-0.24, -0.21, -0.16, 0.16, 0.21, 0.24))
    end = begin + UNTIL_RESET
    run.rows[begin:end, TIME] += PERIOD * wrong * np.arange(1, UNTIL_RESET + 1)
    run.rows[end:, TIME] += PERIOD * wrong * UNTIL_RESET
    tick, drift = begin, wrong
    while abs(drift) <= 1.5:
        tick, drift = tick + 1, 0.99 * drift + wrong
    run.faults[tick] |= CLOCK
    return tick


def _missed(run: FaultRun, begin: int, rng: np.random.Generator) -> int | None:
    missed = int(rng.integers(1, MISSED + 4))
    run.rows[begin:, TIME] += missed * PERIOD
    run.faults[begin] |= MISSED_TICK
    return begin if missed > MISSED else None


def _clock(run: FaultRun, begin: int, rng: np.random.Generator) -> int:
    before = run.rows[begin - 1, TIME]
    run.rows[begin, TIME] = _pick(rng, (*NOT_FINITE, before, before - PERIOD, -1e300))
    run.faults[begin] |= CLOCK
    return begin


def _stuck(column: int, moving: int, limit: str, fault: int):
    def inject(run: FaultRun, begin: int, rng: np.random.Generator) -> int | None:
        """Hold one reading constant until the other signals have moved too far."""
        travel = 0.0
        for tick in range(begin, begin + UNTIL_RESET):
            run.rows[tick, column] = run.rows[begin - 1, column]
            travel += abs(run.rows[tick, moving] - run.rows[tick - 1, moving])
            if travel > LIMITED[limit]:
                run.faults[tick] |= fault
                return tick
        return None

    return inject


def _bias(run: FaultRun, begin: int, rng: np.random.Generator) -> int | None:
    length = int(rng.integers(1, HELD + 6))
    run.rows[begin : begin + length, FORCE] += _pick(rng, (-1.0, 1.0)) * rng.uniform(8.0, 30.0)
    run.faults[begin : begin + min(length, HELD + 1)] |= FORCE_IN_FLIGHT
    return begin + HELD if length > HELD else None


def _stroke(run: FaultRun, begin: int, rng: np.random.Generator) -> int:
    run.rows[begin, MODEL] = _pick(rng, (0.0201, -0.0201, 1e300, -1e300))
    run.faults[begin] |= STROKE
    return begin


def _fast_position(run: FaultRun, begin: int, rng: np.random.Generator) -> int | None:
    """Inject a jump of the model's position by a few millimetres, and back after 8 ticks.

    The command moves by at most 1 mm per tick; the model moves by at most 12 um per tick without the fault.
    """
    cuts = int(rng.integers(1, CUT + 2))
    length = 8
    run.rows[begin : begin + length, MODEL] += _pick(rng, (-1.0, 1.0)) * (cuts + 0.5) * 1e-3
    run.faults[begin : begin + cuts] |= VELOCITY_LIMIT
    if cuts > CUT:
        return begin + CUT
    run.faults[begin + length : begin + length + cuts] |= VELOCITY_LIMIT
    return None


def _strong_force(run: FaultRun, begin: int, rng: np.random.Generator) -> int:
    run.rows[begin, FORCE] = _pick(rng, (-1.0, 1.0)) * rng.uniform(5001.0, 9999.0)
    run.faults[begin] |= FORCE_LIMIT
    return begin


def _fast_force(run: FaultRun, begin: int, rng: np.random.Generator) -> int | None:
    """Inject a jump of the force reading by some thousand newtons, and back after 8 ticks.

    The limit is a change of 1000 N per tick; the force of a contact is at most 50 N.
    """
    cuts = int(rng.integers(1, CUT + 2))
    length = 8
    run.rows[begin : begin + length, FORCE] += _pick(rng, (-1.0, 1.0)) * (cuts + 0.5) * 1000.0
    run.faults[begin : begin + cuts] |= FORCE_SLEW
    if cuts > CUT:
        return begin + CUT
    run.faults[begin + length : begin + length + cuts] |= FORCE_SLEW
    return None


_EVERYWHERE = (
    _bad_reading(FORCE, FORCE_NOT_FINITE, NOT_FINITE),
    _bad_reading(FORCE, FORCE_OUT_OF_RANGE, (1e4, -1e4, 1.0001e4, -1.7e308)),
    _bad_reading(MEASURED, POSITION_NOT_FINITE, NOT_FINITE),
    _bad_reading(MEASURED, POSITION_OUT_OF_RANGE, (0.0101, -0.0101, 1e300)),
    *(_bad_model(column) for column in (DESIRED, VELOCITY, MODEL, MODEL + 1, MODEL + 2)),
    _stuck(MEASURED, DESIRED, "position_stuck_travel", POSITION_STUCK),
    *(_late, _early, _rate, _missed, _clock, _stroke, _fast_position),
)
_IN_CONTACT = (_stuck(FORCE, MEASURED, "force_stuck_travel", FORCE_STUCK),)
_IN_FLIGHT = (_bias,)
_OF_COMMAND = (_strong_force, _fast_force)
