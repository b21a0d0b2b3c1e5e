"""The rig's loop in six degrees of freedom: one tick after the other.

A tick reads the wrench that the real contact had a force delay ago, compensates it, moves the two bodies of
the numerical model by it, and sends their relative pose to the motion simulator, on which the contact is.
The wrench is formed on the hardware's pose, in T axes about T's origin, and acts at the model's T.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.laws.compensators import SIX_AXES
from jaxhil.laws.phase_lead_per_axis.simulation import PhaseLeadPerAxis
from jaxhil.laws.simulation_base import Constants, Gains, Signals
from jaxhil.simulation.sensors import lag, white_noise
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

SIDES = ("fixed", "moving")  # of the force sensor
HISTORY = 256  # ticks before a run in which axes follow what is no straight line to them


class Loop(eqx.Module):
    """What shapes the compiled loop; every field is static."""

    integrator: str = eqx.field(static=True)  # of the numerical model, a name of `SHARES`
    hold: str = eqx.field(static=True)  # of the command within a period, "linear" or "zoh"
    latency: int = eqx.field(static=True)  # of the command, 0 or 1 periods
    ring: int = eqx.field(static=True)  # samples that are kept, a power of two beyond the longest delay
    side: str = eqx.field(static=True, default="fixed")  # of the force sensor, one of `SIDES`
    has_noise: bool = eqx.field(static=True, default=False)  # whether the force sensor has noise
    has_lag: bool = eqx.field(static=True, default=True)  # whether it has a lag
    has_sample_effects: bool = eqx.field(static=True, default=True)  # quantum, dead zone or range
    compensator: str = eqx.field(static=True, default="none")  # one of `SIX_AXES`
    episodes: int = eqx.field(static=True, default=1)  # that are judged
    whole: bool = eqx.field(static=True, default=False)  # whether a run lasts its whole duration
    pushed: bool = eqx.field(static=True, default=False)  # whether readings without a contact are not 0


class Rig(NamedTuple):
    """What stays constant during a run."""

    bodies: Pair  # of the numerical model
    axes: Axes  # of the motion simulator, with the sensors' delays
    kinematics: Kinematics
    groups: tuple[ContactGroup, ...]  # the real contact
    latches: tuple[Latch, ...]
    sensor: Sensor
    period: Float[Array, "*batch"]  # T [s]
    key: UInt32[Array, "2 *batch"]  # of the sensor's noise
    gains: Gains  # of the compensator, (6, *batch)


class Channels(NamedTuple):
    """The force sensor's channels and the controller's memory of them."""

    # reading of the last tick before the lag and behind it; None without one
    lag: tuple[Wrench, Wrench] | None
    controller: tuple[Any, ...]  # state of the compensator of each channel


class RunState(NamedTuple):
    """What is carried from tick to tick."""

    states: States  # of the numerical model
    near: Float[Array, "6 *batch"]  # coordinates of C against T then
    hardware: Hardware
    memories: tuple[Memory, ...]  # of the contact's laws
    held: tuple[Held, ...]  # by the latches
    channels: Channels
    tick: Int[Array, ""]


class Tick(NamedTuple):
    """What is recorded of a tick."""

    states: States  # of the numerical model, at the tick
    pose: Pose  # of the hardware, when the force sensor samples it
    twist: Twist  # likewise
    contact: Wrench  # of the real contact then, latches included
    forces: tuple[Forces, ...]  # of its candidates
    held: tuple[Held, ...]  # by the latches
    command: Wrench  # that moves the numerical model


def build_loop(scenario: Scenario, **static: Any) -> Loop:
    """The loop of a batch of scenarios; `static` are the fields of `Loop` that those do not tell."""
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
    """Before tick 0: so far the command was in uniform motion, at the states' relative pose and rates."""
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
    law, constants = SIX_AXES[loop.compensator], _constants(rig)
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
    """The state after so many ticks, and every tick, (ticks, ...)."""
    rig = build_rig(loop, gains, scenario)
    state = begin(loop, rig, scenario.start)
    return lax.scan(lambda state, _: tick(loop, rig, state), state, None, length=ticks)


def tick(loop: Loop, rig: Rig, state: RunState) -> tuple[RunState, Tick]:
    """One control period."""
    found = sampled(rig.axes, state.hardware, state.tick)
    here = moving(rig.kinematics.coordinates(found.motion, state.near))
    contact, forces, memories = contact_wrench(rig.groups, state.memories, here.pose, here.twist, rig.period)
    held = []
    for latch, before in zip(rig.latches, state.held, strict=True):
        caught, now = latch_wrench(latch, before, here.pose, here.twist)
        contact = jax.tree.map(jnp.add, contact, caught)
        held.append(now)
    measured = None
    if found.measured is not None:
        still = Motion(found.measured, jnp.zeros_like(found.measured), None)
        at = rig.kinematics.coordinates(still, state.near).position
        measured = Pose(vector(at[:3]), exponential(vector(at[3:])))
    command, channels = _sense(loop, rig, state, contact, here, measured)
    states = advance(rig.bodies, state.states, command, rig.period, SHARES[loop.integrator])
    position, _ = command_of(rig.bodies, states)
    sent = rig.kinematics.command(position)
    hardware = actuate(rig.axes, state.hardware, state.tick, sent, loop.hold, loop.latency)
    seen = Tick(state.states, here.pose, here.twist, contact, forces, tuple(held), command)
    return RunState(states, position, hardware, memories, tuple(held), channels, state.tick + 1), seen


def command_of(bodies: Pair, states: States) -> tuple[Array, Array]:
    """Coordinates (6, *batch) of C against T in the numerical model, and their rates."""
    at, rates = coordinates(*relative(bodies, states))
    return assembled(at), assembled(rates)


def _sense(
    loop: Loop, rig: Rig, state: RunState, contact: Wrench, here: Moving, measured: Pose | None
) -> tuple[Wrench, Channels]:
    """What the sensor and the controller make of the contact: the wrench on the numerical model."""
    sensor, channels = rig.sensor, state.channels
    if here.acceleration is None:
        raw = read_fixed(contact, sensor.mounting)
    else:
        load = tool_load(sensor.tool, here.pose, here.twist, here.acceleration, sensor.gravity)
        raw = read_moving(contact, load, here.pose)
    lagged = raw if channels.lag is None else _behind_lag(rig, state.tick, raw, *channels.lag)
    noise = _noise(rig, state.tick) if loop.has_noise else None
    reading = sample(lagged, sensor.errors, noise, loop.has_sample_effects)
    given: Wrench = jax.tree.map(jnp.subtract, reading, _wrench(sensor.assumed_bias))
    if measured is None:
        found = undo_fixed(given, sensor.mounting)
    else:
        load = weight(sensor.assumed_tool, measured.attitude, sensor.assumed_gravity)
        found = undo_moving(given, load, measured)
    command, controller = _compensate(loop, rig, found, channels.controller, state.tick)
    return command, Channels(None if channels.lag is None else (raw, lagged), controller)


def _behind_lag(rig: Rig, now: Array, raw: Wrench, last: Wrench, lagged: Wrench) -> Wrench:
    """Behind the sensor's lag, of a reading that is a straight line between two ticks."""
    first, never = now == (0 if rig.kinematics.is_linear else HISTORY), jnp.zeros_like(rig.period)

    def late(now: Array, before: Array, lagged: Array) -> Array:
        before, lagged = jnp.where(first, now, before), jnp.where(first, now, lagged)
        middle = (before + now) / 2
        return lag(lagged, never, rig.period, never, [before, middle, now], rig.sensor.time_constant)

    found: Wrench = jax.tree.map(late, raw, last, lagged)
    return found


def _compensate(loop: Loop, rig: Rig, found: Wrench, states: tuple, now: Array) -> tuple[Wrench, tuple]:
    """The compensator on each channel by itself."""
    law, constants = SIX_AXES[loop.compensator], _constants(rig)
    forces, structure = jax.tree.flatten(found)
    never, age = jnp.zeros_like(rig.period), jnp.zeros(rig.period.shape, jnp.int32) + now
    passed, after = [], []
    for channel, (force, state) in enumerate(zip(forces, states, strict=True)):
        prepared = law.prepare(_gains(loop, rig, channel), constants)
        signals = Signals(force, never, never, never, age)
        command, state = law.step(prepared, state, signals, now)
        passed.append(command)
        after.append(state)
    return structure.unflatten(passed), tuple(after)


def _wrench(channels: Array) -> Wrench:
    return Wrench(vector(channels[:3]), vector(channels[3:]))


def _gains(loop: Loop, rig: Rig, channel: int) -> Gains:
    law = SIX_AXES[loop.compensator]
    gains = {name: value[channel] for name, value in rig.gains.items()}
    return law.channel(gains, channel) if isinstance(law, PhaseLeadPerAxis) else gains


def _constants(rig: Rig) -> Constants:
    return Constants(rig.period, jnp.full_like(rig.period, jnp.inf))


def _noise(rig: Rig, now: Array) -> Array:
    channel = jnp.arange(6, dtype=jnp.int32).reshape(6, *[1] * rig.period.ndim)
    count = jnp.broadcast_to(6 * now + channel, (6, *rig.period.shape))
    episode = jnp.zeros(rig.period.shape, jnp.int32)
    return rig.sensor.noise_std * white_noise(rig.key, episode, count, rig.period.dtype)


def _six(value: Array, like: Array) -> Array:
    """The value for each of six channels, (6, *batch)."""
    if value.ndim <= like.ndim:
        value = jnp.broadcast_to(value, like.shape)[None]
    return jnp.broadcast_to(value, (6, *like.shape))
