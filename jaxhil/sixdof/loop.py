"""Loop of the rig in six degrees of freedom, tick by tick.

A tick reads the delayed wrench of the real contact, compensates it, moves the two bodies of the numerical
model by it, and sends their relative pose to the motion simulator, which carries the contact. The wrench is
computed at the hardware's pose, in T axes about T's origin, and acts at the model's T.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS
from jaxhil.laws.phase_lead_per_axis.simulation import PhaseLeadPerAxis
from jaxhil.laws.simulation_base import Gains, KnownConstants, Signals
from jaxhil.simulation.sensors import apply_lag, white_noise
from jaxhil.sixdof.axes import Axes, Hardware, Motion, actuate, build_axes, enter, sampled
from jaxhil.sixdof.bodies import SHARES
from jaxhil.sixdof.forces import ContactGroup, Forces, Memory, contact_wrench
from jaxhil.sixdof.kinematics import Kinematics, Moving, moving
from jaxhil.sixdof.latch import Held, Latch, init_latch, latch_wrench
from jaxhil.sixdof.relative import (
    Pair,
    Pose,
    States,
    Twist,
    Wrench,
    advance,
    coordinates,
    relative,
)
from jaxhil.sixdof.rotations import exponential
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.sensor import (
    Sensor,
    read_fixed,
    read_moving,
    sample,
    tool_load,
    undo_fixed,
    undo_moving,
    weight,
)
from jaxhil.sixdof.vectors import assembled, vector

SIDES = ("fixed", "moving")  # sides of the rig on which the force sensor may be
HISTORY = 256  # ticks simulated before a run if the axes are not linear in the coordinates


class Loop(eqx.Module):
    """Structure of the loop, which determines the compiled program; every field is static."""

    integrator: str = eqx.field(static=True)  # integrator of the numerical model, a name of `SHARES`
    hold: str = eqx.field(static=True)  # hold of the command within a period, "linear" or "zoh"
    latency: int = eqx.field(static=True)  # latency of the command, 0 or 1 periods
    ring: int = eqx.field(static=True)  # length of the delay line, a power of two above the longest delay
    side: str = eqx.field(static=True, default="fixed")  # side of the force sensor, one of `SIDES`
    has_noise: bool = eqx.field(static=True, default=False)  # whether the force sensor has noise
    has_lag: bool = eqx.field(static=True, default=True)  # whether the force sensor has a lag
    has_sample_effects: bool = eqx.field(static=True, default=True)  # quantum, dead zone or range
    compensator: str = eqx.field(
        static=True, default="none"
    )  # name of the compensator, one of `SIX_AXIS_COMPENSATORS`
    episodes: int = eqx.field(static=True, default=1)  # number of evaluated episodes
    whole: bool = eqx.field(static=True, default=False)  # whether a run lasts its whole duration
    pushed: bool = eqx.field(static=True, default=False)  # whether readings without a contact are not 0


class Rig(NamedTuple):
    """Constants of a run."""

    bodies: Pair  # bodies of the numerical model
    axes: Axes  # axes of the motion simulator, with the sensors' delays
    kinematics: Kinematics
    groups: tuple[ContactGroup, ...]  # candidates of the real contact
    latches: tuple[Latch, ...]
    sensor: Sensor
    period: Float[Array, "*batch"]  # T [s]
    key: UInt32[Array, "2 *batch"]  # key of the sensor's noise
    gains: Gains  # gains of the compensator, (6, *batch)


class Channels(NamedTuple):
    """State of the force sensor's channels and of their compensators."""

    # last reading before the lag and behind it; None without a lag
    lag: tuple[Wrench, Wrench] | None
    controller: tuple[Any, ...]  # state of the compensator of each channel


class RunState(NamedTuple):
    """State from tick to tick."""

    states: States  # bodies of the numerical model
    near: Float[Array, "6 *batch"]  # coordinates of C against T in these states
    hardware: Hardware
    memories: tuple[Memory, ...]  # states of the contact's laws
    held: tuple[Held, ...]  # states of the latches
    channels: Channels
    tick: Int[Array, ""]


class Tick(NamedTuple):
    """Record of a tick."""

    states: States  # bodies of the numerical model, at the tick
    pose: Pose  # pose of the hardware at the force sensor's sampling instant
    twist: Twist  # twist likewise
    contact: Wrench  # wrench of the real contact then, latches included
    forces: tuple[Forces, ...]  # forces of the candidates
    held: tuple[Held, ...]  # states of the latches
    command: Wrench  # wrench on the numerical model


def build_loop(scenario: Scenario, **static: Any) -> Loop:
    """Return the loop of a batch of scenarios; `static` are the fields that these do not determine."""
    sensor, period = scenario.sensor, np.asarray(scenario.control_period)
    errors = sensor.errors
    slowest = np.maximum(sensor.delay, sensor.position_delay)[None] + np.asarray(scenario.simulator.delay)
    intervals = int(np.max(slowest / period[None])) + 2
    loop = Loop(
        ring=1 << intervals.bit_length(),
        has_lag=bool(np.any(np.asarray(sensor.time_constant) > 0)),
        has_sample_effects=bool(
            np.any(np.asarray(errors.quantum) > 0)
            or np.any(np.asarray(errors.dead_zone) > 0)
            or np.any(np.isfinite(errors.range))
        ),
        **static,
    )
    biased = bool(np.any(np.asarray(errors.bias) != np.asarray(sensor.assumed_bias)))
    return replace(loop, pushed=loop.side == "moving" or loop.has_noise or biased)


def build_rig(loop: Loop, gains: Gains, scenario: Scenario) -> Rig:
    """Discretise the axes; `gains` are scalars, or of the batch shape, or (6, *batch)."""
    sensor, period = scenario.sensor, scenario.control_period
    weighed = loop.side == "moving"
    axes = build_axes(scenario.simulator, sensor.delay, sensor.position_delay, period, loop.hold, weighed)
    return Rig(
        bodies=scenario.bodies,
        axes=axes,
        kinematics=scenario.kinematics,
        groups=scenario.groups,
        latches=scenario.latches,
        sensor=sensor,
        period=period,
        key=scenario.key,
        gains={name: _six(jnp.asarray(value), period) for name, value in gains.items()},
    )


def begin(loop: Loop, rig: Rig, states: States) -> RunState:
    """Return the state before tick 0.

    Before it the command was in uniform motion, at the states' relative pose and rates.
    """
    pose, twist = relative(rig.bodies, states)
    at, rates = (jnp.stack(jax.tree.leaves(part)) for part in coordinates(pose, twist))
    stride = rates * rig.period[None]
    history = 0 if rig.kinematics.is_linear else HISTORY
    first = at - history * stride
    legs, leg_rates = jax.jvp(rig.kinematics.command, (first,), (stride,))
    hardware = enter(rig.axes, legs, leg_rates, rig.period, loop.hold, loop.latency, loop.ring)

    def before(hardware, tick):
        command = rig.kinematics.command(first + (tick + 1).astype(at.dtype) * stride)
        return actuate(rig.axes, hardware, tick, command, loop.hold, loop.latency), None

    hardware, _ = lax.scan(before, hardware, jnp.arange(history, dtype=jnp.int32))
    zero = vector(jnp.zeros_like(at[:3]))
    nothing = Wrench(zero, zero)
    law, constants = SIX_AXIS_COMPENSATORS[loop.compensator], _constants(rig)
    controllers = tuple(law.init(_gains(loop, rig, channel), constants, 1) for channel in range(6))
    return RunState(
        states,
        at,
        hardware,
        tuple(group.init() for group in rig.groups),
        tuple(init_latch(latch, pose) for latch in rig.latches),
        Channels((nothing, nothing) if loop.has_lag else None, controllers),
        jnp.array(history, jnp.int32),
    )


def run(loop: Loop, gains: Gains, scenario: Scenario, ticks: int) -> tuple[RunState, Tick]:
    """Return the state after `ticks` ticks, and every tick, (ticks, ...)."""
    rig = build_rig(loop, gains, scenario)
    state = begin(loop, rig, scenario.start)
    return lax.scan(lambda state, _: tick(loop, rig, state), state, None, length=ticks)


def tick(loop: Loop, rig: Rig, state: RunState) -> tuple[RunState, Tick]:
    """Run one control period; return the next state and the tick's record."""
    samples = sampled(rig.axes, state.hardware, state.tick)
    motion = moving(rig.kinematics.coordinates(samples.motion, state.near))
    pose, twist, _ = motion
    contact, forces, memories = contact_wrench(rig.groups, state.memories, pose, twist, rig.period)
    latched = []
    for latch, before in zip(rig.latches, state.held, strict=True):
        caught, now = latch_wrench(latch, before, pose, twist)
        contact = jax.tree.map(jnp.add, contact, caught)
        latched.append(now)
    measured = None
    if samples.measured is not None:
        still = Motion(samples.measured, jnp.zeros_like(samples.measured), None)
        at = rig.kinematics.coordinates(still, state.near).position
        measured = Pose(vector(at[:3]), exponential(vector(at[3:])))
    command, channels = _sense(loop, rig, state, contact, motion, measured)
    states = advance(rig.bodies, state.states, command, rig.period, SHARES[loop.integrator])
    position, _ = command_of(rig.bodies, states)
    sent = rig.kinematics.command(position)
    hardware = actuate(rig.axes, state.hardware, state.tick, sent, loop.hold, loop.latency)
    seen = Tick(state.states, pose, twist, contact, forces, tuple(latched), command)
    return RunState(states, position, hardware, memories, tuple(latched), channels, state.tick + 1), seen


def command_of(bodies: Pair, states: States) -> tuple[Array, Array]:
    """Return the coordinates (6, *batch) of C against T in the numerical model, and their rates."""
    at, rates = coordinates(*relative(bodies, states))
    return assembled(at), assembled(rates)


def _sense(
    loop: Loop, rig: Rig, state: RunState, contact: Wrench, motion: Moving, measured: Pose | None
) -> tuple[Wrench, Channels]:
    """Return the wrench on the numerical model, from sensor and controller, and the channels' next state."""
    sensor, channels = rig.sensor, state.channels
    if motion.acceleration is None:
        raw = read_fixed(contact, sensor.mounting)
    else:
        load = tool_load(sensor.tool, motion.pose, motion.twist, motion.acceleration, sensor.gravity)
        raw = read_moving(contact, load, motion.pose)
    lagged = raw if channels.lag is None else _behind_lag(rig, state.tick, raw, *channels.lag)
    noise = _noise(rig, state.tick) if loop.has_noise else None
    reading = sample(lagged, sensor.errors, noise, loop.has_sample_effects)
    unbiased: Wrench = jax.tree.map(jnp.subtract, reading, _wrench(sensor.assumed_bias))
    if measured is None:
        contact = undo_fixed(unbiased, sensor.mounting)
    else:
        load = weight(sensor.assumed_tool, measured.attitude, sensor.assumed_gravity)
        contact = undo_moving(unbiased, load, measured)
    command, controller = _compensate(loop, rig, contact, channels.controller, state.tick)
    return command, Channels(None if channels.lag is None else (raw, lagged), controller)


def _behind_lag(rig: Rig, now: Array, raw: Wrench, last: Wrench, lagged: Wrench) -> Wrench:
    """Return the reading behind the sensor's lag; the input is a straight line between two ticks."""
    first, zero = now == (0 if rig.kinematics.is_linear else HISTORY), jnp.zeros_like(rig.period)

    def late(now: Array, before: Array, lagged: Array) -> Array:
        before, lagged = jnp.where(first, now, before), jnp.where(first, now, lagged)
        middle = (before + now) / 2
        return apply_lag(lagged, zero, rig.period, zero, [before, middle, now], rig.sensor.time_constant)

    reading: Wrench = jax.tree.map(late, raw, last, lagged)
    return reading


def _compensate(loop: Loop, rig: Rig, contact: Wrench, states: tuple, now: Array) -> tuple[Wrench, tuple]:
    """Apply the compensator to each channel separately."""
    law, constants = SIX_AXIS_COMPENSATORS[loop.compensator], _constants(rig)
    forces, structure = jax.tree.flatten(contact)
    zero, age = jnp.zeros_like(rig.period), jnp.zeros(rig.period.shape, jnp.int32) + now
    commands, next_states = [], []
    for channel, (force, state) in enumerate(zip(forces, states, strict=True)):
        prepared = law.prepare(_gains(loop, rig, channel), constants)
        signals = Signals(force, zero, zero, zero, age)
        command, state = law.step(prepared, state, signals, now)
        commands.append(command)
        next_states.append(state)
    return structure.unflatten(commands), tuple(next_states)


def _wrench(channels: Array) -> Wrench:
    """Return six channels, (6, *batch), as a wrench."""
    return Wrench(vector(channels[:3]), vector(channels[3:]))


def _gains(loop: Loop, rig: Rig, channel: int) -> Gains:
    """Return the gains of a channel."""
    law = SIX_AXIS_COMPENSATORS[loop.compensator]
    gains = {name: value[channel] for name, value in rig.gains.items()}
    return law.channel(gains, channel) if isinstance(law, PhaseLeadPerAxis) else gains


def _constants(rig: Rig) -> KnownConstants:
    """Return the rig data that the controller knows."""
    return KnownConstants(rig.period, jnp.full_like(rig.period, jnp.inf))


def _noise(rig: Rig, now: Array) -> Array:
    """Return the noise of six channels [N, N m] at a tick."""
    channel = jnp.arange(6, dtype=jnp.int32).reshape(6, *[1] * rig.period.ndim)
    count = jnp.broadcast_to(6 * now + channel, (6, *rig.period.shape))
    episode = jnp.zeros(rig.period.shape, jnp.int32)
    return rig.sensor.noise_std * white_noise(rig.key, episode, count, rig.period.dtype)


def _six(value: Array, like: Array) -> Array:
    """Return the value for each of six channels, (6, *batch)."""
    if value.ndim <= like.ndim:
        value = jnp.broadcast_to(value, like.shape)[None]
    return jnp.broadcast_to(value, (6, *like.shape))
