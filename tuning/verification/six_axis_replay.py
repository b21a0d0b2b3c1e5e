"""Recorded runs of a simulated six-axis rig, and their replay through the rig's controller."""

import dataclasses
from collections.abc import Iterator, Mapping
from math import inf
from typing import Any

import jax.numpy as jnp
import msgspec
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.rig.six_axes import Controller6
from jaxhil.simulation.timing import without_missed_ticks
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.controller_record import ControllerRecord, record_controller
from jaxhil.sixdof.loop_state import Loop
from jaxhil.sixdof.metrics import Metrics
from jaxhil.sixdof.scenario import Scenario

SIX_AXIS_REPLAY_LIMIT = 1e-9  # maximum accepted difference of commands, divided by their range [1]


class SixAxisReplay(msgspec.Struct, frozen=True):
    """Comparison of one recorded run with its replay through the controller."""

    ticks: int  # number of recorded ticks
    difference: float  # largest difference of wrench commands, divided by their range [1]
    worst_tick: int  # tick with this difference
    pose_difference: float  # largest difference of pose commands, divided by their range [1]
    status: str  # status of the controller at the end of the run


def six_axis_loop(mechanism: SixAxisMechanism, compensator: str, scenario: Scenario) -> Loop:
    """Build the simulated loop of a batch of scenarios; always measure the pose, even if nothing reads it."""
    return dataclasses.replace(make_loop(mechanism, compensator, scenario), measures_pose=True)


def draw_scenarios(mechanism: SixAxisMechanism, number: int, seed: int) -> Scenario:
    """Draw `number` scenarios with nominal control period; if `number` is 0, return the nominal scenario."""
    if not number:
        return build_drawn_scenarios(mechanism, {}, seed)
    return build_drawn_scenarios(mechanism, draw(mechanism, number, seed), seed)


def build_drawn_scenarios(
    mechanism: SixAxisMechanism, draws: Mapping[str, Any], seed: int, first: int = 0
) -> Scenario:
    """Build scenarios with drawn values, but with the nominal control period, which the gain file fixes.

    The scenarios have no missed ticks.
    """
    drawn = {path: values for path, values in draws.items() if path != "rig.control_period"}
    return without_missed_ticks(build_scenarios(mechanism, drawn, seed, first))


def record_runs(
    mechanism: SixAxisMechanism, compensator: str, gains: Mapping[str, float], number: int, seed: int
) -> tuple[Metrics, list[ControllerRecord]]:
    """Return metrics and records of `number` drawn runs; if `number` is 0, those of the nominal run."""
    return record_scenarios(mechanism, compensator, gains, draw_scenarios(mechanism, number, seed))


def record_scenarios(
    mechanism: SixAxisMechanism, compensator: str, gains: Mapping[str, float], scenario: Scenario
) -> tuple[Metrics, list[ControllerRecord]]:
    """Simulate a batch of scenarios; return their metrics and the controller's record of each run."""
    loop = six_axis_loop(mechanism, compensator, scenario)
    return record_controller(loop, {name: jnp.asarray(value) for name, value in gains.items()}, scenario)


def replay_record(controller: Controller6, record: ControllerRecord) -> tuple[np.ndarray, np.ndarray]:
    """Return a controller's wrench commands (ticks, 6) and pose commands (ticks - 1, 6) for a recorded run.

    The last tick has no pose command, because the record lacks the numerical model's motion after it.
    """
    commands, sent = zip(*replay_ticks(controller, record), strict=True)
    return np.reshape(commands, (-1, 6)), np.reshape(sent[:-1], (-1, 6))


def replay_ticks(
    controller: Controller6, record: ControllerRecord
) -> Iterator[tuple[list[float], list[float] | None]]:
    """Run a controller with the readings of a recorded run; yield its wrench and pose command of each tick.

    The last tick has no pose command.
    """
    columns = [column.tolist() for column in record[:4]]
    for tick, readings in enumerate(zip(*columns, strict=True)):
        command, sent = controller.step(*readings), None
        if tick + 1 < len(columns[0]):
            sent = controller.pose_command(columns[1][tick + 1], columns[2][tick + 1])
        yield command, sent


def compare_record(controller: Controller6, record: ControllerRecord) -> SixAxisReplay:
    """Replay a recorded run; compare the controller's commands with the recorded commands."""
    commands, sent = replay_record(controller, record)
    error = command_difference(commands, record.command)
    worst = int(np.argmax(error))
    return SixAxisReplay(
        ticks=len(error),
        difference=float(error[worst]),
        worst_tick=worst,
        pose_difference=float(np.max(command_difference(sent, record.sent[:-1]), initial=0.0)),
        status=controller.status,
    )


def command_difference(commands: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return the largest relative difference of `commands` and `expected` in each tick, (ticks,).

    A difference is divided by the range of the expected values, including 0. Force and torque (or
    translation and rotation) have separate ranges.
    """
    worst = np.zeros(len(commands))
    for part in (slice(0, 3), slice(3, 6)):
        values = expected[:, part]
        span = np.max(values, initial=0.0) - np.min(values, initial=0.0)
        error = np.max(np.abs(commands[:, part] - values), axis=1)
        worst = np.maximum(worst, error / span if span > 0 else np.where(error == 0, 0.0, inf))
    return worst
