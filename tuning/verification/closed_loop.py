"""Closed-loop simulation of one scenario with the rig's controller instead of the simulated one.

JAX simulates sensors, motion simulator and contact. The controller of `jaxhil.rig`, in plain Python, computes
the commands in every tick.
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
from jaxhil.simulation.contact_tracking import build_end_conditions, record_contact
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.loop import Loop, RigConstants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.recording import convert_gains, start_batch
from jaxhil.simulation.rollout import begin_next_contacts, draw_segment_noise, segment_length
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.sensors import SensorNoise
from jaxhil.simulation.tick import (
    ModelState,
    RunState,
    actuate,
    advance_bias,
    compute_contact,
    integrate,
    sense,
    update_state,
)
from jaxhil.simulation.timing import TimingDraws
from tuning.verification.stops import ControllerStop, RecordingController


def run_closed_loop(
    loaded: LoadedGains, gain_file: GainFile, batch: Scenario
) -> tuple[Metrics, ControllerStop | None]:
    """Simulate the first scenario of `batch` with the rig's controller, built from `gain_file`.

    Return the metrics of its contacts, (slots, 1), and the first stop by a guard or the watchdog (None if the
    controller does not stop).
    """
    loop = build_loop(loaded.mechanism, loaded.compensator, batch)
    gains = convert_gains(loaded.gains)
    # The JAX controller starts the run, because its program is already compiled.
    rig, run = _select_first_lane(start_batch(loop, gains, batch))
    program = _compile_loop(dataclasses.replace(loop, compensator=ExternalController(loop.compensator)))
    zeroed = loop.has_force_noise or loop.has_force_bias
    controller = RecordingController(gain_file)
    started = False
    # A tripped controller commands no force, so that its contact would never end.
    while np.any(run.active) and not controller.controller.tripped:
        for _ in range(segment_length(loop)):
            signals, plant_signals = program.sense(rig, run)
            force, position, velocity, measured, age = (float(leaf[0]) for leaf in jax.device_get(signals))
            if age == 0 and started:
                controller.next_contact()
            if age == 0:
                # The first position command tells the controller that the numerical model already moves.
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
    # The watchdog audits the last contact when the next contact is announced.
    controller.next_contact()
    return jax.device_get(run.metrics), controller.stop()


class ExternalController(Compensator):
    """Placeholder in the simulated loop for a controller that runs outside JAX.

    Before a run's first tick, the simulated compensator `law` computes the position commands. From then on,
    `SentCommand` contains the commands of the external controller. The state of the compensator does not
    change.
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
        raise NotImplementedError("the external controller computes the force command")

    def position_command(self, gains, state, position, velocity, acceleration):
        if isinstance(state, SentCommand):
            return state.position, state.state
        return self.law.position_command(gains, state, position, velocity, acceleration)


class SentCommand(NamedTuple):
    """Position command of the external controller."""

    position: Array  # position command [m]
    state: Any  # unchanged state of the simulated compensator


@jax.jit
def _select_first_lane(started: tuple[RigConstants, RunState]) -> tuple[RigConstants, RunState]:
    return jax.tree.map(lambda leaf: leaf[..., :1] if leaf.ndim else leaf, started)


class _LoopProgram(NamedTuple):
    """Compiled functions for the parts of a tick; each is compiled at its first call."""

    sense: Callable[..., tuple[Signals, PlantSignals]]  # read the sensors
    integrate: Callable[..., ModelState]  # advance the numerical model
    advance: Callable[..., RunState]  # advance the rig by one tick
    turn_over: Callable[..., RunState]  # begin the next contacts at the end of a segment


@lru_cache(maxsize=32)
def _compile_loop(loop: Loop) -> _LoopProgram:
    return _LoopProgram(
        *(jax.jit(partial(step, loop)) for step in (_sense, _integrate, _advance, _turn_over))
    )


def _sense(loop: Loop, rig: RigConstants, run: RunState) -> tuple[Signals, PlantSignals]:
    noise, timing = _draw_noise(loop, rig, run)
    return sense(loop, rig, advance_bias(run.state, noise), run.tick, noise, timing)


def _draw_noise(loop: Loop, rig: RigConstants, run: RunState) -> tuple[SensorNoise, TimingDraws | None]:
    """Return the sensors' noise and the timing effects at the next tick."""
    return jax.tree.map(lambda leaf: leaf[0], draw_segment_noise(loop, rig, run, 1))


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
    """Complete a tick after the controller, with its force command [N] and position command `sent` [m]."""
    state, now = advance_bias(run.state, _draw_noise(loop, rig, run)[0]), run.tick
    model = integrate(loop, rig, state, command)
    actuated = actuate(loop, rig, gains, state, now, model, SentCommand(sent, state.controller))
    contact = compute_contact(loop, rig, state, actuated.interval)
    rules, shortfall = build_end_conditions(rig.scenario), state.plant.shortfall
    tracker = record_contact(loop, rules, run.tracker, signals, plant_signals, command, shortfall)
    state = update_state(state, now, plant_signals, model, actuated, contact)
    if state.held is not None:
        state = state._replace(held=state.held._replace(reading=signals.force_measured, command=command))
    return run._replace(state=state, tracker=tracker, tick=now + 1)


def _turn_over(loop: Loop, rig: RigConstants, gains: Gains, run: RunState) -> RunState:
    return begin_next_contacts(loop, rig, gains, run, skip_flight=False)
