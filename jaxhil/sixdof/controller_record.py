"""Records of a six-axis compensator's readings and commands on every tick, as NumPy arrays."""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.laws.six_axis_base import SixAxisConstants
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, supported_options
from jaxhil.sixdof.loop import run
from jaxhil.sixdof.loop_state import Loop
from jaxhil.sixdof.metrics import Metrics, evaluate
from jaxhil.sixdof.numerical_model import controller_constants
from jaxhil.sixdof.scenario import Scenario

MIN_TICKS = 256  # minimum number of ticks of a program, a power of two, so that most runs share a program


class ControllerRecord(NamedTuple):
    """Readings and commands of the compensator in one run; arrays have the shape (ticks, 6)."""

    wrench: np.ndarray  # measured wrench, about T's origin [N, N m]
    pose_desired: np.ndarray  # pose of the numerical model [m, rad]
    twist_desired: np.ndarray  # twist of the numerical model [m/s, rad/s]
    pose_measured: np.ndarray  # measured pose of the hardware [m, rad]
    command: np.ndarray  # wrench on the numerical model about T's origin [N, N m]
    sent: np.ndarray  # pose command after the tick [m, rad]


def record_controller(
    loop: Loop, gains: dict[str, Any], scenario: Scenario
) -> tuple[Metrics, list[ControllerRecord]]:
    """Return the metrics of all lanes (runs), and each lane's readings and commands until its run ends.

    `loop.measures_pose` must be true.
    """
    program = _compiled()
    metrics, final = jax.device_get(program.evaluate(loop, gains, scenario))
    ends = np.maximum(np.round(final / np.asarray(scenario.control_period)).astype(int), 2)
    length = max(MIN_TICKS, 1 << (int(np.max(ends)) - 1).bit_length())
    columns = jax.device_get(program.record(loop, length, gains, scenario))
    return metrics, [
        ControllerRecord(*(np.asarray(column, float)[:end, :, lane] for column in columns))
        for lane, end in enumerate(ends)
    ]


@partial(jax.jit, static_argnums=0)
def known_constants(loop: Loop, scenario: Scenario) -> SixAxisConstants:
    """Return the constants that the compensator knows about the rig; the last dimension is the lane."""
    return controller_constants(scenario, loop.side == "moving")


class _Programs(NamedTuple):
    """Compiled functions of this module."""

    evaluate: Any  # compiled `_evaluate`
    record: Any  # compiled `_record`


@cache
def _compiled() -> _Programs:
    options = supported_options(SINGLE_RUN_OPTIONS)
    return _Programs(
        jax.jit(_evaluate, static_argnums=0, compiler_options=options),
        jax.jit(_record, static_argnums=(0, 1), compiler_options=options),
    )


def _evaluate(loop: Loop, gains: dict[str, Any], scenario: Scenario) -> tuple[Metrics, Any]:
    """Return the metrics of all lanes (runs), and the simulated duration [s] of each run, (lanes,)."""
    result = evaluate(loop, gains, scenario)
    return result.metrics, result.final_time


def _record(loop: Loop, ticks: int, gains: dict[str, Any], scenario: Scenario) -> tuple[Any, ...]:
    """Return the columns of `ControllerRecord`, (ticks, 6, lanes)."""
    _, seen = run(loop, gains, scenario, ticks)
    signals = seen.signals
    return (
        jnp.stack(signals.wrench, axis=1),
        signals.pose_desired,
        signals.twist_desired,
        signals.pose_measured,
        jnp.stack(jax.tree.leaves(seen.command), axis=1),
        seen.sent,
    )
