"""The loop closed over the runtime's controller: the contacts of one scenario as the rig will run them.

Sensors, motion simulator and contact are those of the simulation, in jax; in the place of its controller
stands that of `jaxhil.rig`, in plain Python, called tick by tick.
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
    """Run the batch's first lane under the runtime's controller made of `gain_file`.

    Returns its metrics (slots, 1), and what the controller's guards or its watchdog acted on first.

    Sensors, motion simulator, contact and bookkeeping are the loop's own, in jax; the controller and the
    position command from the numerical model are the runtime's, in plain Python, tick by tick as on the rig.
    """
    loop = build_loop(loaded.mechanism, loaded.compensator, batch)
    gains = as_arrays(loaded.gains)
    # A batch begins as it does with the jax controller in the loop, which is then compiled already.
    rig, run = _first_lane(begin(loop, gains, batch))
    program = _compiled(dataclasses.replace(loop, compensator=OnTheRig(loop.compensator)))
    zeroed = loop.has_force_noise or loop.has_force_bias
    controller = Witness(gain_file)
    started = False
    # A controller that has tripped commands nothing any more: no contact of it would end.
    while np.any(run.active) and not controller.controller.tripped:
        for _ in range(stretch_length(loop)):
            signals, plant_signals = program.sense(rig, run)
            force, position, velocity, measured, age = (float(leaf[0]) for leaf in jax.device_get(signals))
            if age == 0 and started:
                controller.next_contact()
            if age == 0:
                # As a rig does that has been brought there: drives in motion are read behind the model.
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
    # The last contact is audited too, as on a rig that goes on.
    controller.next_contact()
    return jax.device_get(run.metrics), controller.stop()


class OnTheRig(Compensator):
    """Stands in the loop for a controller that runs outside it.

    A run's history before its first tick is commanded by the law itself, whose initial state is all that is
    carried; from then on the commands come from outside, as `Sent`.
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
            return state.position, state.kept
        return self.law.position_command(gains, state, position, velocity, acceleration)


class Sent(NamedTuple):
    """A position command [m] from outside, and the state to go on with."""

    position: Array
    kept: Any


@jax.jit
def _first_lane(started: tuple[RigConstants, RunState]) -> tuple[RigConstants, RunState]:
    return jax.tree.map(lambda leaf: leaf[..., :1] if leaf.ndim else leaf, started)


class _Program(NamedTuple):
    """The steps of one loop, compiled when first called."""

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
    """Stages 3 to 6 of a tick under the command and the position sent to the drives."""
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
