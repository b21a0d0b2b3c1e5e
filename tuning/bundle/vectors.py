"""Test vectors: inputs and commands of the runtime in each tick, to test other builds of the controller.

`record_vectors` simulates the nominal run and random draws, and replays them through the runtime. The vectors
contain the commands of the simulation and of the runtime. `make_damaged_rows` adds segments of the nominal
run with corrupted inputs: readings and model states that are infinite, NaN, huge or stuck, and clocks that
jump or run backwards. The numerical model moves under the runtime's force command.
"""

import csv
import io
import random
from collections.abc import Iterator, Sequence
from math import inf, nan
from typing import Any, NamedTuple

import numpy as np

from jaxhil.mechanism.correlation import fix_at_nominal
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import Controller
from jaxhil.rig.faults import LAW_IN_DOUBT, fault_names
from jaxhil.rig.gain_file import GainFile, check_gain_document
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.recording import LaneRecord, nominal_and_draws, record_lanes
from tuning.verification.runtime_replay import (
    REPLAY_LIMIT,
    compute_command_range,
    compute_relative_difference,
    find_divergence_tick,
    find_threshold_ticks,
)
from tuning.verification.stops import ControllerStop, find_passing_limits, find_stop

RUN_START, NEXT_CONTACT = 1, 2  # events that a tick can start with; 0 for no event
DEFAULT_DRAWS = 3  # number of random draws besides the nominal run
MAX_RUN_TICKS = 6000  # largest number of ticks of a recorded run, to limit the size of a bundle
DAMAGED_RUNS, DAMAGED_RUN_TICKS = 48, 60  # number of damaged runs, and number of ticks in each
DAMAGED_TICK_SHARE = 0.06  # fraction of ticks in a damaged run at which damage starts
KEYS_FIXED_BY_GAIN_FILE = ("rig.control_period", "contact.clearance")  # not drawn: the gain file fixes them
EXTREME_VALUES = (nan, inf, -inf, 1e308, -1e308, 1e30, -1e200, 5e-324, -0.0)  # values for damaged inputs


class ControllerInputs(NamedTuple):
    """Inputs of the controller in one tick, and the command that the simulation computed for this tick."""

    run: int  # number of the run
    event: int  # `RUN_START`, `NEXT_CONTACT`, or 0
    force_measured: float  # measured force [N]
    position_desired: float  # position of the numerical model [m]
    velocity_desired: float  # velocity of the numerical model [m/s]
    position_measured: float  # measured position of the mechanism [m]
    time: float | None  # time of the rig's clock [s]; None without a clock
    # position [m], velocity [m/s] and acceleration [m/s^2] of the numerical model after the tick; None to
    # integrate the model under the force command
    motion: tuple[float, float, float] | None = None
    force_simulated: float = nan  # force command in the simulation [N]
    zeroed: bool = False  # whether no force acts on the numerical model, whatever the force command


class VectorRow(NamedTuple):
    """Row of vectors.csv: inputs and commands of the controller in one tick."""

    run: int  # number of the run
    event: int  # `RUN_START`, `NEXT_CONTACT`, or 0
    force_measured: float  # measured force [N]
    position_desired: float  # position of the numerical model before the tick [m]
    velocity_desired: float  # velocity of the numerical model before the tick [m/s]
    position_measured: float  # measured position of the mechanism [m]
    time: float | None  # time of the rig's clock [s]; None without a clock
    position: float  # position of the numerical model after the tick [m]
    velocity: float  # velocity of the numerical model after the tick [m/s]
    acceleration: float  # acceleration of the numerical model in the tick [m/s^2]
    force_command: float  # force command of the runtime [N]
    position_command: float  # position command of the runtime [m]
    faults: int  # bits of the controller's faults
    force_simulated: float  # force command in the simulation [N]; NaN if it is not comparable


class RecordedVectors(NamedTuple):
    """Test vectors, and the comparison of the recorded runs with the simulation."""

    rows: list[Any]  # rows of all runs: `VectorRow`, or in six axes `vectors_six_axes.SixAxisRow`
    mass: float  # equivalent mass in the nominal run [kg]
    # for each recorded run, the reason if its comparison with the simulation ended early, else None
    ended: list[str | None]
    reasons: list[str]  # descriptions of the differences between runtime and simulation
    stop: ControllerStop | None  # first stop of the nominal run by a limit; None if no limit stops it
    passing: dict[str, float] | None  # changed limits that let the nominal run pass; None if `stop` is None


def record_vectors(
    loaded: LoadedGains, gain_file: GainFile, seed: int, draws: int = DEFAULT_DRAWS
) -> RecordedVectors:
    """Simulate the nominal run and runs with drawn uncertain values, and replay them in the rig's runtime."""
    mechanism = remove_fixed_uncertainty(loaded.mechanism)
    batch = nominal_and_draws(mechanism, 1 + draws, seed)
    _, lanes = record_lanes(loaded, batch)
    rows, ended, reasons = [], [], []
    for run, lane in enumerate(lanes):
        mass = float(batch.equivalent_mass[run])
        controller = Controller(gain_file)
        inputs = list(_lane_inputs(run, lane, gain_file.control_period))
        run_rows, identified, acting = _run_controller(
            controller, inputs, mechanism.rig.integrator, mass, gain_file
        )
        run_rows, end, reason = _compare_with_simulation(
            run_rows, inputs, identified, acting, lane, gain_file
        )
        rows += run_rows
        ended.append(end)
        if reason:
            reasons.append(f"{'the nominal run' if run == 0 else f'draw {run}'}, {reason}")
    stop = find_stop(gain_file, lanes[0])
    passing = None if stop is None else find_passing_limits(gain_file, lanes[0])
    return RecordedVectors(rows, float(batch.equivalent_mass[0]), ended, reasons, stop, passing)


def make_damaged_rows(
    nominal: Sequence[VectorRow], integrator: str, mass: float, gain_file: GainFile, seed: int
) -> list[VectorRow]:
    """Return rows from random segments of the nominal run, with randomly corrupted inputs.

    `mass` is the equivalent mass of the numerical model [kg], `integrator` its integration rule.
    """
    source = random.Random(seed)
    rows: list[VectorRow] = []
    for run in range(DAMAGED_RUNS):
        begin = source.randrange(max(1, len(nominal) - DAMAGED_RUN_TICKS))
        segment = nominal[begin : begin + DAMAGED_RUN_TICKS]
        inputs = list(_damage_inputs(source, run, segment, gain_file.control_period))
        rows += _run_controller(Controller(gain_file), inputs, integrator, mass, gain_file)[0]
    return rows


def make_vectors(loaded: LoadedGains, seed: int, draws: int = DEFAULT_DRAWS) -> RecordedVectors:
    """Return the test vectors of a one-axis bundle: the recorded runs, then runs with corrupted inputs."""
    gain_file = check_gain_document(loaded.document)
    vectors = record_vectors(loaded, gain_file, seed, draws)
    nominal = [row for row in vectors.rows if row.run == 0]
    damaged = make_damaged_rows(nominal, loaded.mechanism.rig.integrator, vectors.mass, gain_file, seed)
    last = max((row.run for row in vectors.rows), default=-1) + 1
    return vectors._replace(rows=[*vectors.rows, *(row._replace(run=last + row.run) for row in damaged)])


def format_csv(rows: Sequence[VectorRow]) -> str:
    """Return the text of vectors.csv: a header, then one line for each row.

    Numbers have the shortest notation that preserves their bits; None becomes an empty field.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(VectorRow._fields)
    writer.writerows(["" if value is None else repr(value) for value in row] for row in rows)
    return text.getvalue()


def remove_fixed_uncertainty(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism without the uncertainty of values that a gain file fixes."""
    return fix_at_nominal(mechanism, KEYS_FIXED_BY_GAIN_FILE)


def _lane_inputs(run: int, lane: LaneRecord, period: float) -> Iterator[ControllerInputs]:
    """Yield the controller's inputs in each tick of one simulated run."""
    readings = zip(*(leaf.tolist() for leaf in lane.signals), strict=True)
    for tick, (force, position, velocity, measured, age) in enumerate(readings):
        if tick == MAX_RUN_TICKS:
            return
        event = RUN_START if tick == 0 else NEXT_CONTACT if age == 0 else 0
        zeroed = bool(age == 0 and lane.zeroed)
        simulated = nan if zeroed else float(lane.command[tick])
        yield ControllerInputs(
            run, event, force, position, velocity, measured, tick * period, None, simulated, zeroed
        )


def _damage_inputs(
    source: random.Random, run: int, segment: Sequence[VectorRow], period: float
) -> Iterator[ControllerInputs]:
    """Yield randomly corrupted inputs of the controller for each tick of a segment."""
    timed = source.random() < 0.8
    time, stuck = source.uniform(0.0, 1e3), {}
    for tick, row in enumerate(segment):
        event = RUN_START if tick == 0 else NEXT_CONTACT if source.random() < DAMAGED_TICK_SHARE / 4 else 0
        inputs = ControllerInputs(run, event, *row[2:6], time)
        damage = source.choice(_DAMAGE_KINDS) if source.random() < DAMAGED_TICK_SHARE else ""
        if damage in ControllerInputs._fields[2:6]:
            inputs = inputs._replace(**{damage: _draw_extreme(source, getattr(inputs, damage))})
        elif damage == "stuck":
            name = source.choice(ControllerInputs._fields[2:6])
            stuck[name] = (getattr(inputs, name), source.randrange(1, 40))
        elif damage == "clock":
            time += source.choice((1e-9, 0.4, 0.7, 1.6, 3.0, 50.0, -1.0, -50.0, 1e12)) * period
            inputs = inputs._replace(time=source.choice((time, time, time, nan, inf, -inf)))
        elif damage == "motion":
            motion = [row.position, row.velocity, row.acceleration]
            motion[source.randrange(3)] = _draw_extreme(source, row.position)
            inputs = inputs._replace(motion=tuple(motion))
        for name, (value, left) in list(stuck.items()):
            inputs = inputs._replace(**{name: value})
            stuck[name] = (value, left - 1)
            if left <= 1:
                del stuck[name]
        yield inputs if timed else inputs._replace(time=None)
        time += period


_DAMAGE_KINDS = (*ControllerInputs._fields[2:6], "stuck", "clock", "motion")


def _draw_extreme(source: random.Random, value: float) -> float:
    """Return a random extreme value, or `value` with its sign, size or digits changed."""
    return source.choice((*EXTREME_VALUES, 1e3 * value, -value, value + source.gauss(0.0, 1.0)))


def _run_controller(
    controller: Controller,
    inputs: Sequence[ControllerInputs],
    integrator: str,
    mass: float,
    gain_file: GainFile,
) -> tuple[list[VectorRow], list[tuple[float, float]], list[int]]:
    """Run the controller with the inputs.

    Return three lists with one entry per tick: rows of the test vectors; stiffness [N/m] and damping [N s/m]
    that the controller identified; and faults that change a command, as bits of an integer.
    """
    rows, identified, acting = [], [], []
    move = INTEGRATORS[integrator]
    inverse_mass, period = 1.0 / mass, gain_file.control_period
    for reading in inputs:
        if reading.event == NEXT_CONTACT:
            controller.next_contact()
        force = controller.step(*reading[2:6], reading.time)
        if reading.motion is None:
            acceleration = -(0.0 if reading.zeroed else force) * inverse_mass
            position, velocity = move(
                reading.position_desired, reading.velocity_desired, acceleration, period
            )
            motion = (float(position), float(velocity), acceleration)
        else:
            motion = reading.motion
        command = controller.position_command(*motion)
        # The faults of a tick are complete only after the calls of `step` and `position_command`.
        faults = controller.faults
        rows.append(VectorRow(*reading[:7], *motion, force, command, faults, reading.force_simulated))
        identified.append(controller.identified)
        # The fault LAW_IN_DOUBT changes no command. A trip between two contacts is in `controller.cause`, but
        # not in the faults of a tick.
        acting.append(faults & ~LAW_IN_DOUBT | controller.cause)
    return rows, identified, acting


def _compare_with_simulation(
    rows: list[VectorRow],
    inputs: Sequence[ControllerInputs],
    identified: Sequence[tuple[float, float]],
    acting: Sequence[int],
    lane: LaneRecord,
    gain_file: GainFile,
) -> tuple[list[VectorRow], str | None, str | None]:
    """Compare the runtime's rows with the simulation.

    The comparison ends before the first tick in which a fault changes a command, or in which a rounding error
    decides whether a value exceeds a threshold. Return three values: the rows; the reason for an early end or
    None; and a description of the first difference or None. In the rows, the simulated force is NaN from the
    end or from the first differing force on.
    """
    number = len(rows)
    if not number:
        return rows, None, None
    faulty = np.flatnonzero(acting)
    forces = np.array([row.force_command for row in rows])
    expected = np.array([reading.force_simulated for reading in inputs])
    error, _ = compute_relative_difference(forces, expected)
    near = find_threshold_ticks(type(lane.signals)(*(leaf[:number] for leaf in lane.signals)), gain_file)
    end, end_reason = number, None
    if len(faulty):
        end = int(faulty[0])
        end_reason = f"tick {end}: the controller acts on {', '.join(fault_names(acting[end]))}"
    parted = find_divergence_tick(error, list(np.array(identified).T), lane.identified, near)
    if parted is not None and parted < end:
        end = parted
        end_reason = f"tick {end}: rounding decides at a threshold"
    reason = _disagreement("force command", "N", forces, expected, end)
    if reason is None and lane.sent is not None:
        positions = np.array([row.position_command for row in rows])[:end]
        reason = _disagreement("position command", "m", positions, np.asarray(lane.sent)[:end], end)
    # The range of commands must come from the compared ticks, the only simulated commands in vectors.csv.
    comparable = expected.copy()
    comparable[end:] = nan
    exceeding = np.flatnonzero(np.abs(forces - comparable) > REPLAY_LIMIT * compute_command_range(comparable))
    if len(exceeding):
        comparable[int(exceeding[0]) :] = nan
    return (
        [row._replace(force_simulated=float(force)) for row, force in zip(rows, comparable, strict=True)],
        end_reason,
        reason,
    )


def _disagreement(name: str, unit: str, found: np.ndarray, simulated: np.ndarray, end: int) -> str | None:
    """Describe the first command before tick `end` that differs from the simulated one, or return None."""
    error, span = compute_relative_difference(found, simulated)
    wrong = np.flatnonzero(error[:end] > REPLAY_LIMIT)
    if not len(wrong):
        return None
    tick = int(wrong[0])
    return (
        f"tick {tick}: {name}: found {found[tick].item()!r} {unit}, expected {simulated[tick].item()!r} "
        f"{unit} (simulation): the difference is {error[tick]:.1e} of the command's range {span:.4g} {unit}, "
        f"expected {REPLAY_LIMIT:.0e} or less"
    )
