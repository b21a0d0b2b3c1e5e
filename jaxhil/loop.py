"""One tick of the hardware-in-the-loop contact rig, stage by stage (model.md section 1).

    sense      read the force sensor and the position sensor
    compensate F_c from (F, x_d, v_d, x_a)
    integrate  M x_d'' = -F_c over one control period
    actuate    command -> limits, latency, hold -> motion simulator
    touch      the real contact: force where the force sensor will read it

Time runs in control periods and each lane has its own. `Loop` is what is static (it shapes the compiled
program), `Rig` what is constant during a run, `LoopState` what evolves.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.compensators.base import Compensator, Constants, Gains, Signals
from jaxhil.contact import ContactLaw, ContactParameters, two_sided
from jaxhil.integrators import INTEGRATORS
from jaxhil.limits import limit_command
from jaxhil.ring import look_back, tie, write_in_turn
from jaxhil.scenario import Scenario
from jaxhil.sensors import lag, quantise, sample_force, white_noise
from jaxhil.simulator import (
    Delay,
    Propagation,
    advance,
    propagation,
    read,
    split_delay,
    steady_state,
)


class Loop(eqx.Module):
    """What shapes the compiled loop; every field is static.

    law, compensator, integrator, hold ("linear" or "zoh"), latency (0 or 1 periods); which optional parts
    are present: force lag, force noise or bias, position noise, sample effects (quantum, dead zone, range),
    command limits, a second surface; samples in the delay lines of the sensors and of the controller;
    whether energies are audited.
    """

    law: ContactLaw = eqx.field(static=True)
    compensator: Compensator = eqx.field(static=True)
    integrator: str = eqx.field(static=True)
    hold: str = eqx.field(static=True)
    latency: int = eqx.field(static=True)
    has_lag: bool = eqx.field(static=True)
    has_force_bias: bool = eqx.field(static=True)
    has_force_noise: bool = eqx.field(static=True)
    has_position_noise: bool = eqx.field(static=True)
    has_sample_effects: bool = eqx.field(static=True)
    has_limits: bool = eqx.field(static=True)
    is_two_sided: bool = eqx.field(static=True)
    ring: int = eqx.field(static=True)
    controller_ring: int = eqx.field(static=True)
    energies: bool = eqx.field(static=True)


class Rig(NamedTuple):
    """Constants of a run, per lane; see `Propagation` and `Delay`."""

    scenario: Scenario
    propagation: Propagation
    force_delay: Delay
    position_delay: Delay
    real_panels: Int[Array, "*batch"]
    constants: Constants
    inverse_mass: Float[Array, "*batch"]


class Plant(NamedTuple):
    """Motion simulator and drives: recent commands c(n), c(n-1) [m], last step of the command [m], state."""

    commands: tuple[Array, ...]
    step: Array
    state: tuple[Array, ...]


class Sensed(NamedTuple):
    """What the sensors will read: rings of true force, of position, and, where the loop has them, of the
    force's lagged reading and of work increments; the last sample as `_sample` takes it, the lag's
    reading, the position sample of the panel before the run."""

    force: Any
    position: Any
    reading: Float[Array, "samples *batch"] | None
    work: Float[Array, "samples *batch"] | None
    last: tuple[Array, Array, Array, Array]
    lagged: Array
    first_position: Array


class LoopState(NamedTuple):
    """All that evolves: the model's position [m] and velocity [m/s], and the rest. The run under way was
    entered at `entry_tick`, in uniform motion of `entry_velocity` [m/s]."""

    position: Float[Array, "*batch"]
    velocity: Float[Array, "*batch"]
    plant: Plant
    sensed: Sensed
    law: tuple[Array, ...]
    controller: Any
    parameters: ContactParameters
    entry_velocity: Float[Array, "*batch"]
    entry_tick: Int[Array, "*batch"]


class Truth(NamedTuple):
    """What really happens at a tick: contact force [N] at the mechanism, work increment [J]."""

    force: Float[Array, "*batch"]
    work: Float[Array, "*batch"] | None


def build_rig(loop: Loop, scenario: Scenario) -> Rig:
    """Discretise the linear parts exactly and split every delay into panels and a fraction."""
    period, simulator = scenario.control_period, scenario.simulator
    force_delay, position_delay, real_panels = split_delays(scenario)
    return Rig(
        scenario=scenario,
        propagation=propagation(
            simulator.numerator,
            simulator.denominator,
            period,
            force_delay.fraction,
            position_delay.fraction,
            loop.hold,
        ),
        force_delay=force_delay,
        position_delay=position_delay,
        real_panels=real_panels,
        constants=Constants(period, scenario.clearance),
        inverse_mass=1 / scenario.equivalent_mass,
    )


def split_delays(scenario: Scenario) -> tuple[Delay, Delay, Int[Array, "*batch"]]:
    """Delay of the force reading and of the position reading, and how many panels back lies the newest force
    sample that has really happened by a tick."""
    period, simulator = scenario.control_period, scenario.simulator
    force = split_delay(simulator.delay + scenario.force_sensor.delay, period)
    position = split_delay(simulator.delay + scenario.position_sensor.delay, period)
    behind = simulator.delay / period + force.fraction
    return force, position, jnp.ceil(behind - 1e-9).astype(jnp.int32) - 1


def enter(
    loop: Loop,
    rig: Rig,
    gains: Gains,
    state: LoopState,
    position: Array,
    velocity: Array,
    tick: Array,
) -> LoopState:
    """Start a run at `tick` in uniform motion at `position` [m], `velocity` [m/s]; rings need no filling.

    The motion simulator is in the steady state of the held history of that motion.
    """
    stride = rig.constants.control_period * velocity
    commands = tuple(
        loop.compensator.position_command(
            gains, state.controller, position - back * stride, velocity, jnp.zeros_like(velocity)
        )[0]
        for back in range(loop.latency + 1)
    )
    drive = commands[-1] if loop.hold == "linear" else commands[-1] + stride
    start = drive - stride
    end = drive if loop.hold == "linear" else start
    first_position = read(
        rig.propagation.measured_position,
        steady_state(rig.propagation, start, stride),
        start,
        end,
    )
    zeros = jnp.zeros_like(position)
    outside = jnp.full_like(position, -1)
    return state._replace(
        position=position,
        velocity=velocity,
        plant=Plant(commands, stride, steady_state(rig.propagation, drive, stride)),
        sensed=state.sensed._replace(
            last=(outside, zeros, zeros, zeros + 1), lagged=zeros, first_position=first_position
        ),
        law=loop.law.init(position),
        entry_velocity=velocity,
        entry_tick=jnp.broadcast_to(tick, position.shape),
    )


def sense(loop: Loop, rig: Rig, state: LoopState, tick: Array) -> tuple[Signals, Truth]:
    """Stage 1: what the sensors read at this tick, and the truth beside it."""
    scenario, sensed = rig.scenario, state.sensed
    age = tick - state.entry_tick
    force_ring = sensed.force if sensed.reading is None else sensed.reading
    force = _recall(force_ring, tick, age, rig.force_delay.panels)
    real = _recall(sensed.force, tick, age, rig.real_panels)
    work = None
    if sensed.work is not None:
        work = _recall(sensed.work, tick, age, rig.real_panels)
    sensor = scenario.force_sensor
    if loop.has_force_bias:
        force = force + sensor.bias
    if loop.has_force_noise:
        force = force + white_noise(scenario.key, 2 * tick, sensor.noise_std)
    if loop.has_sample_effects:
        force = sample_force(force, sensor.quantum, sensor.dead_zone, sensor.range)

    panels = rig.position_delay.panels
    stride = rig.constants.control_period * state.entry_velocity
    before = sensed.first_position + (age - panels).astype(stride.dtype) * stride
    after = look_back(sensed.position, tick - 1, panels)
    position = jnp.where(age <= panels, before, after)
    if loop.has_position_noise:
        sensor = scenario.position_sensor
        position = position + white_noise(scenario.key, 2 * tick + 1, sensor.noise_std)
    if loop.has_sample_effects:
        position = quantise(position, scenario.position_sensor.quantum)
    return Signals(force, state.position, state.velocity, position, age), Truth(real, work)


def drive(
    loop: Loop,
    rig: Rig,
    gains: Gains,
    state: LoopState,
    tick: Array,
    truth: Truth,
    force: Array,
    controller: Any,
) -> LoopState:
    """Stages 3 to 5: integrate the numerical model under F_c, move the rig, touch the mechanism."""
    scenario, sensed = rig.scenario, state.sensed
    period = rig.constants.control_period
    acceleration = -force * rig.inverse_mass
    position, velocity = INTEGRATORS[loop.integrator](state.position, state.velocity, acceleration, period)
    command, controller = loop.compensator.position_command(
        gains, controller, position, velocity, acceleration
    )
    step = state.plant.step
    if loop.has_limits:
        command, step = limit_command(
            command, state.plant.commands[0], state.plant.step, position - state.position, period,
            scenario.simulator.velocity_limit, scenario.simulator.acceleration_limit,
        )  # fmt: skip
    commands = (command, *state.plant.commands)
    end = commands[loop.latency]
    start = commands[loop.latency + 1] if loop.hold == "linear" else end
    plant, x_now = rig.propagation, state.plant.state
    x_actual = read(plant.position, x_now, start, end)
    v_actual = read(plant.velocity, x_now, start, end)
    real, law = two_sided(loop.law, state.parameters, state.law, x_actual, v_actual, scenario.clearance)
    samples = {
        "force": tie(real, truth.force),
        "position": read(plant.measured_position, x_now, start, end),
    }
    now, lagged = sensed.last, sensed.lagged
    if loop.has_lag or loop.energies or loop.is_two_sided:
        now = _sample(loop, rig, state.parameters, x_actual, v_actual, real)
    if sensed.reading is not None:
        time_constant = scenario.force_sensor.time_constant
        lagged = lag(sensed.lagged, sensed.last[:3], now[:3], period, time_constant)
        samples["reading"] = lagged
    if sensed.work is not None and truth.work is not None:
        samples["work"] = tie(_work(sensed.last, now), truth.work)
    rings = write_in_turn({name: getattr(sensed, name) for name in samples}, tick, samples)
    return state._replace(
        position=position,
        velocity=velocity,
        plant=Plant(commands[: loop.latency + 1], step, advance(plant.transition, x_now, start, end)),
        sensed=sensed._replace(**rings, last=now, lagged=lagged),
        law=law,
        controller=controller,
    )


def _recall(ring, tick, age, panels):
    """Sample of the panel `panels` before the newest one; before the run there was no force."""
    return jnp.where(age > panels, look_back(ring, tick - 1, panels), 0)


def _sample(loop, rig, parameters, position, velocity, force):
    """(distance into the nearer surface, force, its limit at the surface, side of the surface)."""
    far = -rig.scenario.clearance - position
    beyond = jnp.where(far > position, far, position)
    side = jnp.where(far > position, -1, 1).astype(position.dtype)
    return beyond, force, side * loop.law.edge(parameters, side * velocity), side


def _work(before, now):
    """Work [J] done on the mechanism over one period, exact for a force straight in the penetration."""
    depth_0 = jnp.where(before[0] > 0, before[0], 0)
    depth_1 = jnp.where(now[0] > 0, now[0], 0)
    force_0 = jnp.where(before[0] > 0, before[1], now[2])
    force_1 = jnp.where(now[0] > 0, now[1], before[2])
    side = jnp.where(now[0] > 0, now[3], before[3])
    return side * (force_0 + force_1) / 2 * (depth_1 - depth_0)
