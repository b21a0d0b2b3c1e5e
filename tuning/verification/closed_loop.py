"""Closed loop of the rig runtime's controller with the simulation: contacts of one scenario.

Sensors, motion simulator and contact are those of the simulation, in JAX. Its controller is replaced by that
of `jaxhil.rig`, in plain Python, which is called at every tick.
"""

import dataclasses
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from jaxhil.laws.simulation_base import Compensator, Gain, Gains, Signals
from jaxhil.rig.gain_file import GainFile
from jaxhil.simulation.contact_force import PlantSignals
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.loop import Loop, RigConstants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.recording import convert_gains, start_batch
from jaxhil.simulation.rollout import begin_next_contacts, draw_segment_noise, segment_length
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.tick import (
    ModelState,
    RunState,
    actuate,
    compute_contact,
    integrate,
    sense,
    update_state,
)
from jaxhil.simulation.watch import build_end_conditions, record_contact
from tuning.verification.stops import ControllerStop, RecordingController


def run_closed_loop(
    loaded: LoadedGains, gain_file: GainFile, batch: Scenario
) -> tuple[Metrics, ControllerStop | None]:
    """Run the batch's first lane with the runtime's controller built from `gain_file`.

    Return its metrics (slots, 1), and the first stop by the controller's guards or its watchdog, if any.
    """
    loop = build_loop(loaded.mechanism, loaded.compensator, batch)
    gains = convert_gains(loaded.gains)
    # The run begins with the JAX controller in the loop, whose program is compiled already.
    rig, run = _select_first_lane(start_batch(loop, gains, batch))
    program = _compile_loop(dataclasses.replace(loop, compensator=ExternalController(loop.compensator)))
    zeroed = loop.has_force_noise or loop.has_force_bias
    controller = RecordingController(gain_file)
    started = False
    # A tripped controller commands no force, so that no contact would end.
    while np.any(run.active) and not controller.controller.tripped:
        for _ in range(segment_length(loop)):
            signals, plant_signals = program.sense(rig, run)
            force, position, velocity, measured, age = (float(leaf[0]) for leaf in jax.device_get(signals))
            if age == 0 and started:
                controller.next_contact()
            if age == 0:
                # The first position command tells the controller that the model is moving already.
                controller.start(position, velocity)
            command = controller.step(force, position, velocity, measured)
            if age == 0 and zeroed:
                command = 0.0
            force_command = np.array([command])
            moved = program.integrate(rig, run, force_command)
            sent = controller.position_command(*(float(leaf[0]) for leaf in jax.device_get(moved)))
            run = program.advance(rig, gains, run, signals, plant_signals, force_command, np.array([sent]))
            started = True
        run = program.turn_over(rig, gains, run)
    # Announcing a further contact makes the watchdog audit the last one.
    controller.next_contact()
    return jax.device_get(run.metrics), controller.stop()


class ExternalController(Compensator):
    """Placeholder in the loop for a controller that runs outside it.

    The law itself commands the history before a run's first tick, and its initial state does not change.
    Afterwards the commands come from outside, as `SentCommand`.
    """

    law: Compensator
    name: ClassVar[str] = "on_the_rig"
    knows: ClassVar[tuple[str, ...]] = ()
    gains: ClassVar[tuple[Gain, ...]] = ()

    def init(self, gains, constants, ring):
        return self.law.init(gains, constants, ring)

    def restart(self, gains, state, begins, fresh):
        return self.law.restart(gains, state, begins, fresh)

    def step(self, prepared, state, signals, tick):
        raise NotImplementedError("the controller runs outside the loop")

    def position_command(self, gains, state, position, velocity, acceleration):
        if isinstance(state, SentCommand):
            return state.position, state.state
        return self.law.position_command(gains, state, position, velocity, acceleration)


class SentCommand(NamedTuple):
    """Position command [m] from outside, and the unchanged state of the law."""

    position: Array
    state: Any


@jax.jit
def _select_first_lane(started: tuple[RigConstants, RunState]) -> tuple[RigConstants, RunState]:
    return jax.tree.map(lambda leaf: leaf[..., :1] if leaf.ndim else leaf, started)


class _LoopProgram(NamedTuple):
    """Steps of one loop, which are compiled at the first call."""

    sense: Callable[..., tuple[Signals, PlantSignals]]
    integrate: Callable[..., ModelState]
    advance: Callable[..., RunState]
    turn_over: Callable[..., RunState]


@lru_cache(maxsize=32)
def _compile_loop(loop: Loop) -> _LoopProgram:
    return _LoopProgram(
        *(jax.jit(partial(step, loop)) for step in (_sense, _integrate, _advance, _turn_over))
    )


def _sense(loop: Loop, rig: RigConstants, run: RunState) -> tuple[Signals, PlantSignals]:
    noise = jax.tree.map(lambda leaf: leaf[0], draw_segment_noise(loop, rig, run, 1))
    return sense(loop, rig, run.state, run.tick, noise)


def _integrate(loop: Loop, rig: RigConstants, run: RunState, command: Array) -> ModelState:
    return integrate(loop, rig, run.state, command)


def _advance(
    loop: Loop,
    rig: RigConstants,
    gains: Gains,
    run: RunState,
    signals: Signals,
    plant_signals: PlantSignals,
    command: Array,
    sent: Array,
) -> RunState:
    """Compute stages 3 to 6 of a tick with the force command and the position sent to the drives."""
    state, now = run.state, run.tick
    model = integrate(loop, rig, state, command)
    actuated = actuate(loop, rig, gains, state, now, model, SentCommand(sent, state.controller))
    contact = compute_contact(loop, rig, state, actuated.interval)
    rules, shortfall = build_end_conditions(rig.scenario), state.plant.shortfall
    watch = record_contact(loop, rules, run.watch, signals, plant_signals, command, shortfall)
    state = update_state(state, now, plant_signals, model, actuated, contact)
    return run._replace(state=state, watch=watch, tick=now + 1)


def _turn_over(loop: Loop, rig: RigConstants, gains: Gains, run: RunState) -> RunState:
    return begin_next_contacts(loop, rig, gains, run, skip_flight=False)
