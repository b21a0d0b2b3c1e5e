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
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.contact_force import PlantSignals
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.loop import Loop, RigConstants
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.recording import as_arrays, begin
from jaxhil.simulation.rollout import noise_ahead, stretch_length, turn_over
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.tick import Model, RunState, actuate, contact_force, integrate, next_state, sense
from jaxhil.simulation.watch import build_rules, record_contact
from tuning.verification.stops import Stop, Witness


def run_closed_loop(loaded: LoadedGains, gain_file: GainFile, batch: Scenario) -> tuple[Metrics, Stop | None]:
    """Run the batch's first lane with the runtime's controller built from `gain_file`.

    Return its metrics (slots, 1), and the first stop by the controller's guards or its watchdog, if any.
    """
    loop = build_loop(loaded.mechanism, loaded.compensator, batch)
    gains = as_arrays(loaded.gains)
    # The run begins with the JAX controller in the loop, whose program is compiled already.
    rig, run = _first_lane(begin(loop, gains, batch))
    program = _compiled(dataclasses.replace(loop, compensator=OnTheRig(loop.compensator)))
    zeroed = loop.has_force_noise or loop.has_force_bias
    controller = Witness(gain_file)
    started = False
    # A tripped controller commands no force, so that no contact would end.
    while np.any(run.active) and not controller.controller.tripped:
        for _ in range(stretch_length(loop)):
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


class OnTheRig(Compensator):
    """Placeholder in the loop for a controller that runs outside it.

    The law itself commands the history before a run's first tick, and its initial state does not change.
    Afterwards the commands come from outside, as `Sent`.
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
        if isinstance(state, Sent):
            return state.position, state.state
        return self.law.position_command(gains, state, position, velocity, acceleration)


class Sent(NamedTuple):
    """Position command [m] from outside, and the unchanged state of the law."""

    position: Array
    state: Any


@jax.jit
def _first_lane(started: tuple[RigConstants, RunState]) -> tuple[RigConstants, RunState]:
    return jax.tree.map(lambda leaf: leaf[..., :1] if leaf.ndim else leaf, started)


class _Program(NamedTuple):
    """Steps of one loop, which are compiled at the first call."""

    sense: Callable[..., tuple[Signals, PlantSignals]]
    integrate: Callable[..., Model]
    advance: Callable[..., RunState]
    turn_over: Callable[..., RunState]


@lru_cache(maxsize=32)
def _compiled(loop: Loop) -> _Program:
    return _Program(*(jax.jit(partial(step, loop)) for step in (_sense, _integrate, _advance, _turn_over)))


def _sense(loop: Loop, rig: RigConstants, run: RunState) -> tuple[Signals, PlantSignals]:
    noise = jax.tree.map(lambda leaf: leaf[0], noise_ahead(loop, rig, run, 1))
    return sense(loop, rig, run.state, run.tick, noise)


def _integrate(loop: Loop, rig: RigConstants, run: RunState, command: Array) -> Model:
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
    actuated = actuate(loop, rig, gains, state, now, model, Sent(sent, state.controller))
    contact = contact_force(loop, rig, state, actuated.interval)
    rules, shortfall = build_rules(rig.scenario), state.plant.shortfall
    watch = record_contact(loop, rules, run.watch, signals, plant_signals, command, shortfall)
    state = next_state(state, now, plant_signals, model, actuated, contact)
    return run._replace(state=state, watch=watch, tick=now + 1)


def _turn_over(loop: Loop, rig: RigConstants, gains: Gains, run: RunState) -> RunState:
    return turn_over(loop, rig, gains, run, skip_flight=False)
