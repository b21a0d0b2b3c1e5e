"""Test vectors of a six-axis bundle: recorded and corrupted inputs, with the controller's commands.

The recorded runs are the nominal run, and runs with drawn uncertain values. The motion of the numerical model
is taken from the record, whose commands the controller must reproduce.
"""

import random
from collections.abc import Iterator, Sequence
from math import inf, nan
from typing import NamedTuple

import numpy as np

from jaxhil.rig.faults import LAW_IN_DOUBT, fault_names
from jaxhil.rig.six_axes import Controller6
from jaxhil.rig.six_axes.faults import SIX_AXIS_FAULTS
from jaxhil.rig.six_axes.gain_file import SixAxisGainFile, check_six_axis_document
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.sixdof.controller_record import ControllerRecord
from tuning.bundle.vector_replay import SIX_AXIS_VECTOR_COLUMNS
from tuning.bundle.vectors import (
    DAMAGED_RUN_TICKS,
    DAMAGED_RUNS,
    DAMAGED_TICK_SHARE,
    DEFAULT_DRAWS,
    EXTREME_VALUES,
    NEXT_CONTACT,
    RUN_START,
    RecordedVectors,
)
from tuning.verification.six_axis_replay import SIX_AXIS_REPLAY_LIMIT, command_difference, record_runs

MAX_SIX_AXIS_TICKS = 800  # maximum number of ticks of a recorded run; limits the size of a bundle
NAN_VECTOR = [nan] * 6


class SixAxisInputs(NamedTuple):
    """Inputs of the controller in one tick, and the simulated command."""

    run: int  # number of the run
    event: int  # `RUN_START`, `NEXT_CONTACT`, or 0
    wrench: list[float]  # measured wrench [N, N m]
    pose_desired: list[float]  # pose of the numerical model [m, rad]
    twist_desired: list[float]  # twist of the numerical model [m/s, rad/s]
    pose_measured: list[float]  # measured pose [m, rad]
    time: float | None  # time of the tick by the rig's clock [s]; None without a clock
    pose: list[float]  # pose of the numerical model after the tick [m, rad]
    twist: list[float]  # twist of the numerical model after the tick [m/s, rad/s]
    simulated: list[float] = NAN_VECTOR  # simulated wrench command [N, N m]; NaN if it cannot be compared


class SixAxisRow(NamedTuple):
    """Row of vectors.csv: inputs and commands of the controller in one tick."""

    inputs: SixAxisInputs
    wrench_command: list[float]  # [N, N m]
    pose_command: list[float]  # [m, rad]
    faults: int  # bits of the controller's faults
    acting: int  # bits of those faults that change a command

    @property
    def run(self) -> int:
        """Return the index of the run, counted from 0."""
        return self.inputs.run

    def fields(self) -> list[float | None]:
        """Return the row's fields in the order of the file's columns."""
        inputs = self.inputs
        before = [*inputs.wrench, *inputs.pose_desired, *inputs.twist_desired, *inputs.pose_measured]
        after = [*inputs.pose, *inputs.twist, *self.wrench_command, *self.pose_command]
        return [inputs.run, inputs.event, *before, inputs.time, *after, self.faults, *inputs.simulated]


def make_six_axis_vectors(loaded: LoadedGains, seed: int, draws: int = DEFAULT_DRAWS) -> RecordedVectors:
    """Return the test vectors of a six-axis bundle: the recorded runs, then runs with corrupted inputs."""
    gain_file = check_six_axis_document(loaded.document)
    subject = loaded.mechanism, loaded.compensator, loaded.gains
    records = [*record_runs(*subject, 0, seed)[1], *record_runs(*subject, draws, seed)[1]]
    rows, ended, reasons = [], [], []
    for run, record in enumerate(records):
        inputs = list(record_inputs(run, record, gain_file.control_period))
        run_rows, end, reason = compare_with_record(run_controller(gain_file, inputs), record)
        rows += run_rows
        ended.append(end)
        if reason:
            reasons.append(f"{'the nominal run' if run == 0 else f'draw {run}'}, {reason}")
    nominal = [row.inputs for row in rows if row.run == 0]
    for inputs in _damaged_runs(nominal, gain_file.control_period, len(records), seed):
        rows += run_controller(gain_file, inputs)
    return RecordedVectors(rows, nan, ended, reasons, None, None)


def record_inputs(run: int, record: ControllerRecord, period: float) -> Iterator[SixAxisInputs]:
    """Yield the controller's inputs in each tick of a recorded run except the last tick."""
    columns = [column[: MAX_SIX_AXIS_TICKS + 1].tolist() for column in record[:5]]
    wrench, desired, twist, measured, command = columns
    for tick in range(len(wrench) - 1):
        yield SixAxisInputs(
            run=run,
            event=RUN_START if tick == 0 else 0,
            wrench=wrench[tick],
            pose_desired=desired[tick],
            twist_desired=twist[tick],
            pose_measured=measured[tick],
            time=tick * period,
            pose=desired[tick + 1],
            twist=twist[tick + 1],
            simulated=command[tick],
        )


def run_controller(gain_file: SixAxisGainFile, inputs: Sequence[SixAxisInputs]) -> list[SixAxisRow]:
    """Run a new controller with these inputs; return the rows of the test vectors."""
    controller, rows = Controller6(gain_file), []
    for reading in inputs:
        if reading.event == NEXT_CONTACT:
            controller.next_contact()
        command = controller.step(*reading[2:7])
        sent = controller.pose_command(reading.pose, reading.twist)
        acting = controller.faults & ~LAW_IN_DOUBT | controller.cause
        rows.append(SixAxisRow(reading, command, sent, controller.faults, acting))
    return rows


def compare_with_record(
    rows: list[SixAxisRow], record: ControllerRecord
) -> tuple[list[SixAxisRow], str | None, str | None]:
    """Compare the controller's commands with the record, up to the first fault that changes a command.

    Returns:
        Three values: the rows; a description of this fault or None; and a description of the first difference
        or None. In the rows, the simulated wrench is NaN from this fault or difference on.
    """
    acting = [tick for tick, row in enumerate(rows) if row.acting]
    end, end_reason = len(rows), None
    if acting:
        end = acting[0]
        names = ", ".join(fault_names(rows[end].acting, SIX_AXIS_FAULTS))
        end_reason = f"tick {end}: the controller acts on {names}"
    reason = None
    for name, found, expected in (
        ("wrench command", [row.wrench_command for row in rows[:end]], record.command[:end]),
        ("pose command", [row.pose_command for row in rows[:end]], record.sent[:end]),
    ):
        error = command_difference(np.reshape(found, (-1, 6)), expected)
        wrong = np.flatnonzero(error > SIX_AXIS_REPLAY_LIMIT)
        if len(wrong) and reason is None:
            tick = int(wrong[0])
            limit = f"expected {SIX_AXIS_REPLAY_LIMIT:.0e}"
            reason = f"tick {tick}: {name}: found {error[tick]:.1e} of its range from the simulated, {limit}"
            end = min(end, tick)
    blank = [row._replace(inputs=row.inputs._replace(simulated=NAN_VECTOR)) for row in rows[end:]]
    return [*rows[:end], *blank], end_reason, reason


def format_six_axis_csv(rows: Sequence[SixAxisRow]) -> str:
    """Return the text of vectors.csv: a header, then one line for each row.

    Numbers have the shortest notation that preserves their bits; None becomes an empty field.
    """
    lines = [SIX_AXIS_VECTOR_COLUMNS]
    lines += [",".join("" if field is None else repr(field) for field in row.fields()) for row in rows]
    return "\n".join(lines) + "\n"


def _damaged_runs(
    nominal: Sequence[SixAxisInputs], period: float, first: int, seed: int
) -> Iterator[list[SixAxisInputs]]:
    """Yield the inputs of each damaged run: a random segment of the nominal run with corrupted inputs."""
    source = random.Random(seed)
    for run in range(first, first + DAMAGED_RUNS):
        begin = source.randrange(max(1, len(nominal) - DAMAGED_RUN_TICKS))
        segment = nominal[begin : begin + DAMAGED_RUN_TICKS]
        yield list(_damaged(source, run, segment, period))


def _damaged(
    source: random.Random, run: int, segment: Sequence[SixAxisInputs], period: float
) -> Iterator[SixAxisInputs]:
    """Yield randomly corrupted inputs of the controller for each tick of a segment."""
    timed, time = source.random() < 0.8, source.uniform(0.0, 1e3)
    for tick, inputs in enumerate(segment):
        event = RUN_START if tick == 0 else NEXT_CONTACT if source.random() < DAMAGED_TICK_SHARE / 4 else 0
        damaged = inputs._replace(run=run, event=event, simulated=NAN_VECTOR, time=time)
        if source.random() < DAMAGED_TICK_SHARE:
            name = source.choice((*SixAxisInputs._fields[2:6], "time", "pose", "twist"))
            if name == "time":
                time += source.choice((1e-9, 0.4, 0.7, 1.6, 3.0, -1.0, 1e12)) * period
                damaged = damaged._replace(time=source.choice((time, time, nan, inf)))
            else:
                vector = list(getattr(damaged, name))
                index = source.randrange(6)
                vector[index] = source.choice((*EXTREME_VALUES, 1e3 * vector[index], -vector[index]))
                damaged = damaged._replace(**{name: vector})
        yield damaged if timed else damaged._replace(time=None)
        time += period
