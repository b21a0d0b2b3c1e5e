"""One tick of the hardware-in-the-loop contact rig, stage by stage (model.md section 1).

    sense      read the force sensor and the position sensor
    compensate F_c from (F, x_d, v_d, x_a)
    integrate  M x_d'' = -F_c over one control period
    actuate    command -> limits, latency, hold -> motion simulator
    touch      the real contact: force where the force sensor will read it

Time runs in control periods and each lane has its own. `Loop` is what is static (it shapes the compiled
program), `RigConstants` what is constant during a run, `LoopState` (`jaxhil.simulation.loop_state`) what
evolves.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.compensators.base import Compensator, Constants, Gains, Signals
from jaxhil.contact.laws import ContactLaw, deflection
from jaxhil.ring_buffer import depend_on, look_back, write_in_turn
from jaxhil.simulation.contact_force import (
    Motion,
    PlantSignals,
    SamplingInterval,
    Surfaces,
    largest_force,
    no_contact,
    sensed_lag,
    works_along,
    works_between,
)
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.loop_state import LoopState, Plant, Rings, Sensed
from jaxhil.simulation.motion_simulator import (
    Delay,
    Propagation,
    advance,
    propagation,
    read,
    split_delay,
    steady_state,
)
from jaxhil.simulation.probe import Push, before_contact, touch
from jaxhil.simulation.rate_limits import limit_command
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.sensors import Noise, quantise, sample_force


class Delays(NamedTuple):
    """The reading of force and of position as intervals and fraction; intervals to look back for the newest
    force that has really happened by a tick; intervals after which the law is evaluated.

    One-sided, the law is evaluated as soon as the motion is known, by the transport delay ahead of time.
    Between two surfaces its parameters may change meanwhile: it is evaluated when it happens, and the other
    numbers count from then.
    """

    force: Delay
    position: Delay
    real: Int[Array, "*batch"]
    touch: Int[Array, "*batch"]


class Loop(eqx.Module):
    """What shapes the compiled loop; every field is static.

    law, compensator, integrator, hold ("linear" or "zoh"), latency (0 or 1 periods); which optional parts
    are present: force lag, force noise or bias, position noise, sample effects (quantum, dead zone, range),
    command limits, a second surface; which derivative of the mechanism's position is the first to break at
    the ticks (0: it jumps itself; 3 stands for all higher ones); samples in the delay lines of the sensors
    and of the controller; whether energies are audited, the run is probed and the command's swings followed.
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
    first_break: int = eqx.field(static=True)
    is_two_sided: bool = eqx.field(static=True)
    ring: int = eqx.field(static=True)
    controller_ring: int = eqx.field(static=True)
    energies: bool = eqx.field(static=True)
    probed: bool = eqx.field(static=True)
    chatter: bool = eqx.field(static=True)

    @property
    def has_corners(self) -> bool:
        """Whether the real force's peak may be a corner at a tick."""
        return self.first_break in (1, 2)

    @property
    def follows_intervals(self) -> bool:
        """Whether the motion is needed between samples."""
        return self.has_lag or self.has_corners or self.energies or self.law.remembers


class RigConstants(NamedTuple):
    """Constants of a run, per lane; see `Propagation` and `Delay`."""

    scenario: Scenario
    propagation: Propagation
    delays: Delays
    constants: Constants
    inverse_mass: Float[Array, "*batch"]


def build_rig_constants(loop: Loop, scenario: Scenario) -> RigConstants:
    """Discretise the linear parts exactly and split every delay into intervals and a fraction."""
    period, simulator = scenario.control_period, scenario.simulator
    delays = split_delays(scenario, loop.is_two_sided)
    return RigConstants(
        scenario=scenario,
        propagation=propagation(
            simulator.numerator,
            simulator.denominator,
            period,
            delays.force.fraction,
            delays.position.fraction,
            loop.hold,
            ends=loop.follows_intervals,
        ),
        delays=delays,
        constants=Constants(period, scenario.clearance),
        inverse_mass=1 / scenario.equivalent_mass,
    )


def split_delays(scenario: Scenario, is_two_sided: bool) -> Delays:
    """Every delay of a scenario in intervals."""
    period, simulator = scenario.control_period, scenario.simulator
    force = split_delay(simulator.delay + scenario.force_sensor.delay, period)
    position = split_delay(simulator.delay + scenario.position_sensor.delay, period)
    behind = simulator.delay / period + force.fraction
    real = jnp.ceil(behind - 1e-9).astype(jnp.int32) - 1
    now = jnp.zeros_like(real)
    if is_two_sided:
        return Delays(force._replace(intervals=force.intervals - real), position, now, real)
    return Delays(force, position, real, now)


def enter(
    loop: Loop,
    rig: RigConstants,
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
    return state._replace(
        position=position,
        velocity=velocity,
        plant=Plant(
            commands,
            stride,
            steady_state(rig.propagation, drive, stride),
            commands[0] if loop.has_limits else None,
        ),
        sensed=state.sensed._replace(
            last=no_contact(position), lagged=jnp.zeros_like(position), first_position=first_position
        ),
        law=loop.law.init(position),
        entry_velocity=velocity,
        entry_tick=jnp.broadcast_to(tick, position.shape),
        first_contact=before_contact(position) if loop.probed else None,
    )


def sense(
    loop: Loop, rig: RigConstants, state: LoopState, tick: Array, noise: Noise
) -> tuple[Signals, PlantSignals]:
    """Stage 1: what the sensors read at this tick, noise included, and the plant signals beside it."""
    scenario, sensed = rig.scenario, state.sensed
    age = tick - state.entry_tick
    rings, delays = sensed.rings, rig.delays
    force_ring = rings.plant_signals.force if rings.reading is None else rings.reading
    force = _recall(force_ring, tick, age, delays.force.intervals)
    plant_signals = jax.tree.map(lambda ring: _recall(ring, tick, age, delays.real), rings.plant_signals)
    sensor = scenario.force_sensor
    if loop.has_force_bias:
        force = force + sensor.bias
    if noise.force is not None:
        force = force + noise.force
    if loop.has_sample_effects:
        force = sample_force(force, sensor.quantum, sensor.dead_zone, sensor.range)

    intervals = delays.position.intervals
    stride = rig.constants.control_period * state.entry_velocity
    before = sensed.first_position + (age - intervals).astype(stride.dtype) * stride
    after = look_back(rings.position, tick - 1, intervals)
    position = jnp.where(age <= intervals, before, after)
    if noise.position is not None:
        position = position + noise.position
    if loop.has_sample_effects:
        position = quantise(position, scenario.position_sensor.quantum)
    return Signals(force, state.position, state.velocity, position, age), plant_signals


def drive(
    loop: Loop,
    rig: RigConstants,
    gains: Gains,
    state: LoopState,
    tick: Array,
    plant_signals: PlantSignals,
    force: Array,
    controller: Any,
    push: Push | None = None,
) -> LoopState:
    """Stages 3 to 5: integrate the numerical model under F_c, move the rig, touch the mechanism.

    A push acts on the hardware beside the contact, where the run is probed.
    """
    scenario, sensed = rig.scenario, state.sensed
    period = rig.constants.control_period
    acceleration = -force * rig.inverse_mass
    position, velocity = INTEGRATORS[loop.integrator](state.position, state.velocity, acceleration, period)
    command, controller = loop.compensator.position_command(
        gains, controller, position, velocity, acceleration
    )
    step, wanted = state.plant.step, state.plant.wanted
    if wanted is not None:
        before, wanted = wanted, command
        command, step = limit_command(
            wanted, before, state.plant.commands[0], step, period,
            scenario.simulator.velocity_limit, scenario.simulator.acceleration_limit,
        )  # fmt: skip
    commands = (command, *state.plant.commands)
    end = commands[loop.latency]
    start = commands[loop.latency + 1] if loop.hold == "linear" else end
    plant, x_now = rig.propagation, state.plant.state
    interval = _panel(plant, x_now, start, end, scenario.contact_plane)
    rings = sensed.rings
    intervals = rings.interval
    if intervals is not None:
        intervals = write_in_turn(intervals, tick, interval)
        interval = _arrived(rig, intervals, tick, tick - state.entry_tick)
    surfaces = Surfaces(loop.law, state.parameters, state.law, scenario.clearance)
    until = rig.delays.force.fraction * period
    if loop.law.remembers:
        loaded = surfaces.after(interval.start, interval.sample, until)
        real, _ = loaded.force(interval.sample)
        law = loaded.after(interval.sample, interval.end, period - until).state
    else:
        real, law = surfaces.force(interval.sample)
    now, lagged, reading = sensed.last, sensed.lagged, None
    if loop.is_two_sided or loop.energies:
        now = surfaces.touch(interval.sample, real)
    if loop.has_lag:
        time_constant = scenario.force_sensor.time_constant
        reading, lagged = sensed_lag(surfaces, lagged, interval, until, period, time_constant)
    touched, pushed = state.first_contact, real
    if touched is not None and push is not None:
        signed = deflection(interval.sample.position, scenario.clearance)
        side = jnp.sign(signed)
        now_in_run = (tick - state.entry_tick).astype(period.dtype)
        touched = touch(touched, side * signed, side * interval.sample.velocity, side, now_in_run, period)
        since = jnp.where(touched.made, now_in_run - touched.time, -1e9) * period
        pushed = real + touched.side * push.force(since)
        if reading is not None:
            time_constant = scenario.force_sensor.time_constant
            reading = reading + touched.side * push.lagged(since, time_constant)
    works = peak = None
    if loop.energies and loop.first_break == 0:
        works = works_between(sensed.last, now)
    elif loop.energies:
        works = works_along(surfaces, interval.start, interval.end, period)
    if loop.has_corners:
        peak = largest_force(surfaces, interval.start, interval.end, period)
    happened = jax.tree.map(depend_on, PlantSignals(pushed, works, peak), plant_signals)
    samples = Rings(happened, reading, read(plant.measured_position, x_now, start, end), None)
    rings = write_in_turn(rings._replace(interval=None), tick, samples)._replace(interval=intervals)
    return state._replace(
        position=position,
        velocity=velocity,
        plant=Plant(commands[: loop.latency + 1], step, advance(plant.transition, x_now, start, end), wanted),
        sensed=Sensed(rings, now, lagged, sensed.first_position),
        law=law,
        controller=controller,
        first_contact=touched,
    )


def _recall(ring, tick, age, intervals):
    """Sample of the interval `intervals` before the newest one; before the run there was no force."""
    return jnp.where(age > intervals, look_back(ring, tick - 1, intervals), 0)


def _panel(plant, state, start, end, plane):
    """Motion of the real mechanism over the interval under way, from the plane in which it touches."""

    def motion(position, velocity):
        return Motion(read(position, state, start, end) - plane, read(velocity, state, start, end))

    sample = motion(plant.position, plant.velocity)
    if plant.start is None:
        return SamplingInterval(sample, None, None)
    return SamplingInterval(sample, motion(*plant.start), motion(*plant.end))


def _arrived(rig, rings, tick, age):
    """The interval that happens now; before the run, at rest at the surface, which does not push."""
    intervals = rig.delays.touch
    return jax.tree.map(lambda ring: jnp.where(age >= intervals, look_back(ring, tick, intervals), 0), rings)
