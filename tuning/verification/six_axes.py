"""Verification that the rig's six-axis controller behaves like the simulation.

There are two comparisons, both with the gains of a gain file. *Replay*: recorded runs are replayed through
the rig's controller without limits; its commands must equal the recorded commands within a tolerance.
*Closed loop*: JAX simulates sensors, motion simulator, contact and numerical model of the nominal run, and
the controller with the file's limits computes the commands; the final twist must equal that of the simulation
with the JAX compensator within a tolerance.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from jaxhil.rig.six_axes import Controller6
from jaxhil.rig.six_axes.gain_file import SixAxisGainFile, check_six_axis_document
from jaxhil.rig.six_axes.limits import NO_SIX_AXIS_LIMITS
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.sixdof.loop import begin, build_rig_constants, complete_tick, integrate, run
from jaxhil.sixdof.loop_state import Loop, RigConstants, RunState, Sensed
from jaxhil.sixdof.numerical_model import model_motion
from jaxhil.sixdof.relative import Wrench
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.sensing import sense
from jaxhil.sixdof.vectors import vector
from tuning.verification.six_axis_replay import (
    SIX_AXIS_REPLAY_LIMIT,
    SixAxisReplay,
    compare_record,
    draw_scenarios,
    record_runs,
    six_axis_loop,
)

SIX_AXIS_CLOSED_LOOP_LIMIT = 1e-8  # maximum accepted difference of the final twist, as in `FinalTwist` [1]


class FinalTwist(msgspec.Struct, frozen=True):
    """Twist of the numerical model at the end of the nominal run."""

    found: list[float]  # result with the rig's controller in the loop [m/s, rad/s]
    simulated: list[float]  # result with the JAX compensator [m/s, rad/s]
    difference: float  # largest difference, divided by the largest (angular) velocity [1]
    ticks: int  # number of ticks
    status: str  # status of the controller at the end of the run


class SixAxisVerification(msgspec.Struct, frozen=True):
    """Verdict and comparisons of a six-axis verification."""

    verdict: bool  # whether controller and simulation agree in all comparisons
    reasons: tuple[str, ...]  # reasons for a negative verdict; empty if it is positive
    compensator: str  # name of the compensator
    replay_limit: float  # largest accepted difference of commands, divided by their range [1]
    closed_loop_limit: float  # largest accepted difference of the final twist [1]
    replay: tuple[SixAxisReplay, ...]  # one comparison for each replayed run
    closed_loop: FinalTwist
    axes: int = 6


def verify_six_axes(
    loaded: LoadedGains,
    scenarios: int,
    seed: int = 0,
    progress: Callable[[str], None] = lambda message: None,
) -> SixAxisVerification:
    """Verify that the rig's controller behaves like the simulation with the gains of a gain file.

    Args:
        loaded: six-axis gain file.
        scenarios: number of replayed runs: the nominal run and random draws.
        seed: seed of the draws.
        progress: callback, called with a description of each stage.
    """
    gain_file = check_six_axis_document(loaded.document)
    subject = loaded.mechanism, loaded.compensator, loaded.gains
    progress(f"recording {scenarios} runs")
    records = record_runs(*subject, 0, seed)[1]
    if scenarios > 1:
        records += record_runs(*subject, scenarios - 1, seed)[1]
    progress(f"replaying {sum(len(record.command) for record in records)} ticks through the runtime")
    # The replay compares only the compensators, because the limits may stop some draws for good reasons.
    free = gain_file._replace(limits=NO_SIX_AXIS_LIMITS)
    replays = tuple(compare_record(Controller6(free), record) for record in records)
    progress("running the nominal contacts with the runtime in the loop")
    closed = run_six_axis_loop(loaded, gain_file, len(records[0].command), seed)
    reasons = (*_replay_reasons(replays), *_closed_loop_reasons(closed))
    return SixAxisVerification(
        verdict=not reasons,
        reasons=reasons,
        compensator=loaded.compensator,
        replay_limit=SIX_AXIS_REPLAY_LIMIT,
        closed_loop_limit=SIX_AXIS_CLOSED_LOOP_LIMIT,
        replay=replays,
        closed_loop=closed,
    )


def run_six_axis_loop(
    loaded: LoadedGains, gain_file: SixAxisGainFile, ticks: int, seed: int = 0
) -> FinalTwist:
    """Simulate the nominal run with the rig's and with the JAX controller; compare the final twists."""
    scenario = draw_scenarios(loaded.mechanism, 0, seed)
    loop = six_axis_loop(loaded.mechanism, loaded.compensator, scenario)
    gains = {name: jnp.asarray(value) for name, value in loaded.gains.items()}
    simulated = np.asarray(_simulated_twist(loop, ticks, gains, scenario))[:, 0]
    rig, state = _start(loop, gains, scenario)
    controller = Controller6(gain_file)
    for _ in range(ticks):
        sensed = _sense(loop, rig, state)
        signals = jax.device_get(sensed.signals)
        command = controller.step(
            [float(channel[0]) for channel in signals.wrench],
            np.asarray(signals.pose_desired)[:, 0].tolist(),
            np.asarray(signals.twist_desired)[:, 0].tolist(),
            np.asarray(signals.pose_measured)[:, 0].tolist(),
        )
        column = np.array(command)[:, None]
        model = _integrate(loop, rig, state, column)
        position, twist = (np.asarray(part)[:, 0].tolist() for part in (model[1], model[3]))
        sent = controller.pose_command(position, twist)
        next_model = model[0], model[1], model[3]
        state = _advance(loop, rig, state, sensed, column, next_model, np.array(sent)[:, None])
    controller.next_contact()
    found = np.asarray(state.twist)[:, 0]
    return compare_final_twists(found, simulated, ticks, controller.status)


def compare_final_twists(found: np.ndarray, simulated: np.ndarray, ticks: int, status: str) -> FinalTwist:
    """Compare the final twist `found` of a run with the `simulated` final twist, both (6,) [m/s, rad/s]."""
    worst = 0.0
    for part in (slice(0, 3), slice(3, 6)):
        size = float(np.max(np.abs(simulated[part])))
        error = float(np.max(np.abs(found[part] - simulated[part])))
        worst = max(worst, error / size if size > 0 else error)
    return FinalTwist(found.tolist(), simulated.tolist(), worst, ticks, status)


@partial(jax.jit, static_argnums=0)
def _start(loop: Loop, gains: dict[str, Any], scenario: Scenario) -> tuple[RigConstants, RunState]:
    """Return constants and initial state of the loop."""
    rig = build_rig_constants(loop, gains, scenario)
    return rig, begin(loop, rig, scenario.start)


@partial(jax.jit, static_argnums=0)
def _sense(loop: Loop, rig: RigConstants, state: RunState) -> Sensed:
    """Return the real contact and the sensor readings of a tick."""
    return sense(loop, rig, state)


@partial(jax.jit, static_argnums=0)
def _integrate(loop: Loop, rig: RigConstants, state: RunState, command: Any) -> tuple[Any, ...]:
    """Return the numerical model's state and motion after a tick with the wrench `command` (6, lanes)."""
    return integrate(loop, rig, state, _wrench(command))


@partial(jax.jit, static_argnums=0)
def _advance(
    loop: Loop, rig: RigConstants, state: RunState, sensed: Sensed, command: Any, model: Any, sent: Any
) -> RunState:
    """Return the state after a tick with the wrench `command` and the pose command `sent`, (6, lanes)."""
    return complete_tick(loop, rig, state, sensed, _wrench(command), model, sent)[0]


def _wrench(command: Any) -> Wrench:
    """Convert an array (6, lanes) to a wrench."""
    return Wrench(vector(command[:3]), vector(command[3:]))


@partial(jax.jit, static_argnums=(0, 1))
def _simulated_twist(loop: Loop, ticks: int, gains: dict[str, Any], scenario: Scenario) -> Any:
    """Return the numerical model's twist (6, lanes) after `ticks` ticks with the JAX compensator."""
    state, _ = run(loop, gains, scenario, ticks)
    return model_motion(scenario.bodies, state.states)[2]


def _replay_reasons(replays: tuple[SixAxisReplay, ...]) -> Iterator[str]:
    """Yield a text for each disagreement between replayed and recorded commands."""
    for number, lane in enumerate(replays):
        run = "the nominal run" if number == 0 else f"draw {number}"
        if lane.status != "ok":
            yield f"replay, {run}: the controller {lane.status}"
        for what, difference in (("wrench", lane.difference), ("pose", lane.pose_difference)):
            if not difference <= SIX_AXIS_REPLAY_LIMIT:
                yield (
                    f"replay, {run}: {what} commands differ by {difference:.1e} of their range, expected "
                    f"{SIX_AXIS_REPLAY_LIMIT:.0e} or less"
                )


def _closed_loop_reasons(closed: FinalTwist) -> Iterator[str]:
    """Yield a text if the closed-loop run disagrees with the simulation."""
    if closed.status != "ok":
        yield f"closed loop: the controller {closed.status}"
    elif not closed.difference <= SIX_AXIS_CLOSED_LOOP_LIMIT:
        yield (
            f"closed loop: final twist: found {closed.found!r}, expected {closed.simulated!r} (simulation): "
            f"they differ by {closed.difference:.1e}, expected {SIX_AXIS_CLOSED_LOOP_LIMIT:.0e} or less"
        )
