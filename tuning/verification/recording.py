"""The loop laid open tick by tick: recorded with jax, or closed over the runtime that goes to the rig.

`record_lanes` keeps what the controller read and commanded at every tick of a batch of runs: what
verification replays, and what a bundle for the rig carries as test vectors. `run_closed_loop` runs the
contacts of one scenario with the runtime in the place of the jax controller.
"""

import dataclasses
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxhil.compensators import Compensator, Gain, Gains, Signals
from jaxhil.mechanism.structs import Mechanism, value_at
from jaxhil.mechanism.uncertainty import draw
from jaxhil.runtime import Controller
from jaxhil.runtime.gain_file import GainFile
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.contact_force import PlantSignals
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.loop import Loop, RigConstants, build_rig_constants, drive, sense
from jaxhil.simulation.metrics import Metrics, build_rules, observe
from jaxhil.simulation.rollout import Run, Tick, noise_ahead, start, stretch, stretch_length, turn_over
from jaxhil.simulation.scenario import Scenario, build_scenarios
from tuning.gain_file import LoadedGains

CHUNK = 512  # ticks recorded by one call of the compiled program


class Lane(NamedTuple):
    """What the controller read and commanded [N] in one lane, (ticks,), up to the end of its last contact.

    `sent` is the position command [m] that it made of the numerical model's motion after each tick.
    `identified` is what it made of stiffness [N/m] and damping [N s/m], where it identifies them. With
    `zeroed`, the loop takes F_c = 0 at the first tick of a run, whatever the controller says: before t = 0
    there is no force, though a noisy or biased sensor reads some.
    """

    signals: Signals
    command: np.ndarray | Array
    identified: tuple[np.ndarray | Array, np.ndarray | Array] | None
    zeroed: bool
    sent: np.ndarray | Array | None = None


def nominal_and_draws(mechanism: Mechanism, number: int, seed: int) -> Scenario:
    """A batch of `number` >= 1 lanes: the nominal run, then draws of the mechanism's uncertain numbers."""
    draws = {}
    for path, drawn in draw(mechanism, number - 1, seed).items():
        nominal = np.broadcast_to(np.asarray(value_at(mechanism, path), float), drawn.shape[1:])
        draws[path] = np.concatenate([nominal[None], drawn])
    return build_scenarios(mechanism, draws, seed=seed)


def record_lanes(loaded: LoadedGains, batch: Scenario) -> tuple[Metrics, list[Lane]]:
    """Run the loop with jax until every lane is done: metrics (slots, lanes), and each lane's record.

    Free flight between two surfaces is not skipped: the rig does not skip it either. A record ends before its
    first number that is not finite.
    """
    loop = build_loop(loaded.mechanism, loaded.compensator, batch)
    metrics, seen = record_ticks(loop, loaded.gains, batch)
    zeroed = loop.has_force_noise or loop.has_force_bias
    return metrics, [
        _lane(jax.tree.map(lambda leaf, index=index: leaf[:, index], seen), zeroed)
        for index in range(seen.active.shape[1])
    ]


def record_ticks(loop: Loop, gains: dict[str, float], batch: Scenario) -> tuple[Metrics, Tick]:
    """Run the loop with jax until every lane is done: metrics (slots, lanes), every tick (ticks, lanes)."""
    arrays = _arrays(gains)
    program = _compiled(loop)
    rig, run = program.begin(arrays, batch)
    chunks = []
    while np.any(run.active):
        run, ticks = program.record_chunk(rig, arrays, run)
        chunks.append(jax.device_get(ticks))
    return jax.device_get(run.metrics), jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)


def prepare_recording(loaded: LoadedGains, batch: Scenario) -> None:
    """Compile what `record_lanes` will run on such arguments, without running it."""
    program = _compiled(build_loop(loaded.mechanism, loaded.compensator, batch))
    gains = _arrays(loaded.gains)
    rig, run = jax.eval_shape(program.begin, gains, batch)
    program.begin.lower(gains, batch).compile()
    program.record_chunk.lower(rig, gains, run).compile()


def run_closed_loop(loaded: LoadedGains, gain_file: GainFile, batch: Scenario) -> Metrics:
    """Metrics (slots, 1) of the batch's first lane under the runtime's controller made of `gain_file`.

    Sensors, motion simulator, contact and bookkeeping are the loop's own, in jax; the controller and the
    position command from the numerical model are the runtime's, in plain Python, tick by tick as on the rig.
    """
    loop = build_loop(loaded.mechanism, loaded.compensator, batch)
    gains = _arrays(loaded.gains)
    # A batch begins as it does with the jax controller in the loop, which is then compiled already.
    rig, run = _first_lane(_compiled(loop).begin(gains, batch))
    program = _compiled(dataclasses.replace(loop, compensator=OnTheRig(loop.compensator)))
    zeroed = loop.has_force_noise or loop.has_force_bias
    controller = Controller(gain_file)
    started = False
    # A controller that has tripped commands nothing any more: no contact of it would end.
    while np.any(run.active) and controller.status == "ok":
        for _ in range(stretch_length(loop)):
            signals, plant_signals = program.sense(rig, run)
            force, position, velocity, measured, age = (float(leaf[0]) for leaf in jax.device_get(signals))
            if age == 0 and started:
                controller.next_contact()
            command = controller.step(force, position, velocity, measured)
            if age == 0 and zeroed:
                command = 0.0
            force_command = np.array([command])
            moved = program.integrate(rig, run, force_command)
            sent = controller.position_command(*(float(leaf[0]) for leaf in jax.device_get(moved)))
            run = program.advance(rig, gains, run, signals, plant_signals, force_command, np.array([sent]))
            started = True
        run = program.turn_over(rig, gains, run)
    return jax.device_get(run.metrics)


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


def _arrays(gains: dict[str, float]) -> Gains:
    return {name: jnp.asarray(value) for name, value in gains.items()}


def _lane(seen: Tick, zeroed: bool) -> Lane:
    # A pause between two contacts still is the controller's; what follows the last active tick is not.
    end = int(np.max(np.nonzero(seen.active)[0], initial=-1)) + 1
    numbers = [*seen.signals, seen.command, seen.sent, *(seen.identified or ())]
    finite = np.all(np.isfinite(np.stack(numbers)[:, :end]), axis=0)
    end = end if np.all(finite) else int(np.argmin(finite))
    seen = jax.tree.map(lambda leaf: leaf[:end], seen)
    return Lane(seen.signals, seen.command, seen.identified, zeroed, seen.sent)


@jax.jit
def _first_lane(started: tuple[RigConstants, Run]) -> tuple[RigConstants, Run]:
    return jax.tree.map(lambda leaf: leaf[..., :1] if leaf.ndim else leaf, started)


class _Program(NamedTuple):
    """The steps of one loop, compiled when first called."""

    begin: Callable[..., tuple[RigConstants, Run]]
    record_chunk: Callable[..., tuple[Run, Tick]]
    sense: Callable[..., tuple[Signals, PlantSignals]]
    integrate: Callable[..., tuple[Array, Array, Array]]
    advance: Callable[..., Run]
    turn_over: Callable[..., Run]


@lru_cache(maxsize=32)
def _compiled(loop: Loop) -> _Program:
    steps = (_begin, _record_chunk, _sense, _integrate, _advance, _turn_over)
    return _Program(*(jax.jit(partial(step, loop)) for step in steps))


def _begin(loop: Loop, gains: Gains, scenario: Scenario) -> tuple[RigConstants, Run]:
    rig = build_rig_constants(loop, scenario)
    return rig, start(loop, rig, gains)


def _record_chunk(loop: Loop, rig: RigConstants, gains: Gains, run: Run) -> tuple[Run, Tick]:
    def body(run, _):
        run, ticks = stretch(loop, rig, gains, run, record=True)
        return turn_over(loop, rig, gains, run, skip_flight=False), ticks

    run, ticks = lax.scan(body, run, None, length=CHUNK // stretch_length(loop))
    return run, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), ticks)


def _sense(loop: Loop, rig: RigConstants, run: Run) -> tuple[Signals, PlantSignals]:
    noise = jax.tree.map(lambda leaf: leaf[0], noise_ahead(loop, rig, run, 1))
    return sense(loop, rig, run.state, run.tick, noise)


def _integrate(loop: Loop, rig: RigConstants, run: Run, command: Array) -> tuple[Array, Array, Array]:
    """Position [m], velocity [m/s] and acceleration [m/s^2] that the numerical model will have next tick."""
    acceleration = -command * rig.inverse_mass
    period, state = rig.constants.control_period, run.state
    moved = INTEGRATORS[loop.integrator](state.position, state.velocity, acceleration, period)
    return *moved, acceleration


def _advance(
    loop: Loop,
    rig: RigConstants,
    gains: Gains,
    run: Run,
    signals: Signals,
    plant_signals: PlantSignals,
    command: Array,
    sent: Array,
) -> Run:
    """The tick's bookkeeping, then stages 3 to 5 under the command and the position sent to the drives."""
    rules = build_rules(rig.scenario)
    shortfall = run.state.plant.shortfall
    watch = observe(loop, rig.constants, rules, run.watch, signals, plant_signals, command, shortfall)
    controller = Sent(sent, run.state.controller)
    state = drive(loop, rig, gains, run.state, run.tick, plant_signals, command, controller)
    return run._replace(state=state, watch=watch, tick=run.tick + 1)


def _turn_over(loop: Loop, rig: RigConstants, gains: Gains, run: Run) -> Run:
    return turn_over(loop, rig, gains, run, skip_flight=False)
