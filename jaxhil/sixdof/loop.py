"""Loop of the six-axis rig, tick by tick.

A tick has four steps. The sensors read the delayed wrench of the real contact and the pose of the hardware.
The compensator computes the wrench command. The numerical model integrates the motion of both bodies under
this wrench. The motion simulator receives the relative pose of the bodies as its command.

The contact wrench is computed at the hardware's pose, in the axes of target frame T and about T's origin. It
acts on the numerical model at the origin of the model's frame T.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS
from jaxhil.laws.simulation_base import Gains
from jaxhil.laws.six_axis_base import SixAxisConstants, SixAxisSignals
from jaxhil.simulation.sensors import apply_lag, quantise, white_noise
from jaxhil.sixdof.axes import (
    Axes,
    AxisMotion,
    Hardware,
    actuate,
    build_axes,
    read_samples,
    start_uniform_motion,
    static_lags,
)
from jaxhil.sixdof.bodies import SHARES
from jaxhil.sixdof.forces import ContactGroup, Forces, Memory, contact_wrench
from jaxhil.sixdof.kinematics import Kinematics, RigidMotion, to_rigid_motion
from jaxhil.sixdof.latch import Latch, LatchState, init_latch, latch_wrench
from jaxhil.sixdof.numerical_model import controller_constants, model_motion
from jaxhil.sixdof.relative import (
    Pair,
    Pose,
    States,
    Twist,
    Wrench,
    advance,
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
from jaxhil.sixdof.vectors import vector

SIDES = ("fixed", "moving")  # sides of the rig on which the force sensor may be
# Minimum number of ticks for settling before a run, if axis positions are not linear functions of the
# coordinates; a power of two.
SETTLING_TICKS = 256


class Loop(eqx.Module):
    """Structure of the loop: static fields, for each combination of which a program is compiled."""

    integrator: str = eqx.field(static=True)  # integrator of the numerical model, a name of `SHARES`
    hold: str = eqx.field(static=True)  # hold of the command within a period, "linear" or "zoh"
    latency: int = eqx.field(static=True)  # latency of the command [control periods], 0 or 1
    # length of the delay line [control periods], a power of two above the longest delay
    ring: int = eqx.field(static=True)
    side: str = eqx.field(static=True, default="fixed")  # side of the force sensor, one of `SIDES`
    has_noise: bool = eqx.field(static=True, default=False)  # whether the force sensor has noise
    has_lag: bool = eqx.field(static=True, default=True)  # whether the force sensor has a lag
    # whether the force sensor has a quantum, a dead zone or a range
    has_sample_effects: bool = eqx.field(static=True, default=True)
    has_pose_errors: bool = eqx.field(static=True, default=False)  # whether the pose has noise or a quantum
    # whether the pose is measured even if neither the sensor's tool nor the compensator needs it
    measures_pose: bool = eqx.field(static=True, default=False)
    # length of the compensator's own delay line [control periods], a power of two
    controller_ring: int = eqx.field(static=True, default=1)
    # name of the compensator, one of `SIX_AXIS_COMPENSATORS`
    compensator: str = eqx.field(static=True, default="none")
    episodes: int = eqx.field(static=True, default=1)  # number of evaluated episodes
    # whether a run continues after its last evaluated episode until the end of its duration
    whole: bool = eqx.field(static=True, default=False)


class RigConstants(NamedTuple):
    """Constants of a batch of runs: bodies, hardware, sensors and compensator."""

    bodies: Pair  # bodies of the numerical model
    axes: Axes  # axes of the motion simulator, with the sensors' delays
    kinematics: Kinematics
    groups: tuple[ContactGroup, ...]  # groups of shape pairs that may touch
    latches: tuple[Latch, ...]
    sensor: Sensor
    period: Float[Array, "*batch"]  # control period T [s]
    key: UInt32[Array, "2 *batch"]  # key of the sensors' noise
    gains: Gains  # gains of the compensator, (*batch)
    constants: SixAxisConstants  # constants of the rig that the compensator knows
    prepared: Any  # constants that the compensator's `prepare` computes


class NumericalController(NamedTuple):
    """States of the force sensor's lag and of the compensator."""

    # last input and last output of the lag; None without a lag
    lag: tuple[Wrench, Wrench] | None
    law: Any  # state of the compensator


class RunState(NamedTuple):
    """State of a batch of runs between two ticks."""

    states: States  # states of the numerical model's bodies
    near: Float[Array, "6 *batch"]  # coordinates of the numerical model's pose
    twist: Float[Array, "6 *batch"]  # twist of the numerical model
    hardware: Hardware
    memories: tuple[Memory, ...]  # states of the contact and friction laws
    latch_states: tuple[LatchState, ...]  # states of the latches
    controller: NumericalController
    tick: Int[Array, ""]  # index of the next tick


class Tick(NamedTuple):
    """Record of one tick: numerical model, hardware, and wrenches."""

    states: States  # states of the numerical model's bodies at the tick
    pose: Pose  # pose of the hardware at the force sensor's sampling instant
    twist: Twist  # twist of the hardware at the force sensor's sampling instant
    contact: Wrench  # wrench of contacts and latches at the sampling instant
    forces: tuple[Forces, ...]  # contact forces of each group at the sampling instant
    latch_states: tuple[LatchState, ...]  # states of the latches
    signals: SixAxisSignals  # inputs of the compensator
    command: Wrench  # wrench command, which acts on the numerical model
    sent: Float[Array, "6 *batch"]  # pose command after the tick [m, rad]


class Sensed(NamedTuple):
    """Real contact and sensor readings of a tick."""

    motion: RigidMotion  # motion of the hardware at the force sensor's sampling instant
    contact: Wrench  # wrench of contacts and latches at the sampling instant
    forces: tuple[Forces, ...]  # contact forces of each group at the sampling instant
    memories: tuple[Memory, ...]  # next states of the contact laws
    latch_states: tuple[LatchState, ...]  # next states of the latches
    lag: tuple[Wrench, Wrench] | None  # next state of the force sensor's lag
    signals: SixAxisSignals  # inputs of the compensator


def build_loop(scenario: Scenario, **static: Any) -> Loop:
    """Build the loop for a batch of scenarios; `static` sets the fields that scenarios do not determine."""
    sensor, period = scenario.sensor, np.asarray(scenario.control_period)
    errors = sensor.errors
    slowest = np.maximum(sensor.delay, sensor.position_delay)[None] + np.asarray(scenario.simulator.delay)
    intervals = int(np.max(slowest / period[None])) + 2
    law = SIX_AXIS_COMPENSATORS[static.get("compensator", "none")]
    # A compensator may estimate the delay of the whole loop, with an error of up to 100 %.
    whole = int(np.max((slowest + static_lags(scenario.simulator)) / period[None]))
    loop = Loop(
        ring=1 << intervals.bit_length(),
        controller_ring=1 << (2 * whole + 4).bit_length() if law.reads_pose else 1,
        has_lag=bool(np.any(np.asarray(sensor.time_constant) > 0)),
        has_sample_effects=bool(
            np.any(np.asarray(errors.quantum) > 0)
            or np.any(np.asarray(errors.dead_zone) > 0)
            or np.any(np.isfinite(errors.range))
        ),
        **static,
    )
    return loop


def build_rig_constants(loop: Loop, gains: Gains, scenario: Scenario) -> RigConstants:
    """Discretise the axes and prepare the compensator; each gain is a scalar or has the batch shape."""
    sensor, period, law = scenario.sensor, scenario.control_period, SIX_AXIS_COMPENSATORS[loop.compensator]
    has_tool = loop.side == "moving"
    axes = build_axes(
        scenario.simulator,
        sensor.delay,
        sensor.position_delay,
        period,
        loop.hold,
        has_tool,
        has_tool or law.reads_pose or loop.measures_pose,
    )
    full = {name: jnp.zeros_like(period) + value for name, value in gains.items()}
    constants = controller_constants(scenario, has_tool)
    return RigConstants(
        bodies=scenario.bodies,
        axes=axes,
        kinematics=scenario.kinematics,
        groups=scenario.groups,
        latches=scenario.latches,
        sensor=sensor,
        period=period,
        key=scenario.key,
        gains=full,
        constants=constants,
        prepared=law.prepare(full, constants),
    )


def begin(loop: Loop, rig: RigConstants, states: States) -> RunState:
    """Return the state of the loop before tick 0, from the states of the bodies at tick 0.

    Before tick 0, the pose command is assumed to move uniformly with the bodies' relative rates.
    """
    law = SIX_AXIS_COMPENSATORS[loop.compensator]
    position, rates, twist = model_motion(rig.bodies, states)
    stride = rates * rig.period[None]
    # A multiple of the delay line's length, because `start_uniform_motion` fills the line for a start at tick
    # 0.
    history = 0 if rig.kinematics.is_linear else max(SETTLING_TICKS, loop.ring)
    sent = law.pose_command(rig.gains, position, rates)
    legs, leg_rates = jax.jvp(rig.kinematics.command, (sent - history * stride,), (stride,))
    hardware = start_uniform_motion(rig.axes, legs, leg_rates, rig.period, loop.hold, loop.latency, loop.ring)

    def before(hardware, tick):
        command = rig.kinematics.command(sent + (tick + 1).astype(position.dtype) * stride)
        return actuate(rig.axes, hardware, tick, command, loop.hold, loop.latency), None

    hardware, _ = lax.scan(before, hardware, jnp.arange(-history, 0, dtype=jnp.int32))
    zero = vector(jnp.zeros_like(position[:3]))
    nothing = Wrench(zero, zero)
    pose, _ = relative(rig.bodies, states)
    start = SixAxisSignals(
        wrench=tuple(jax.tree.leaves(nothing)),
        pose_desired=position,
        twist_desired=twist,
        pose_measured=None,
        age=jnp.zeros(rig.period.shape, jnp.int32),
    )
    return RunState(
        states=states,
        near=position,
        twist=twist,
        hardware=hardware,
        memories=tuple(group.init() for group in rig.groups),
        latch_states=tuple(init_latch(latch, pose) for latch in rig.latches),
        controller=NumericalController(
            (nothing, nothing) if loop.has_lag else None,
            law.init(rig.prepared, rig.constants, start, loop.controller_ring),
        ),
        tick=jnp.array(0, jnp.int32),
    )


def run(loop: Loop, gains: Gains, scenario: Scenario, ticks: int) -> tuple[RunState, Tick]:
    """Run a batch of scenarios for `ticks` ticks; return the final state and one record per tick."""
    rig = build_rig_constants(loop, gains, scenario)
    state = begin(loop, rig, scenario.start)
    return lax.scan(lambda state, _: tick(loop, rig, state), state, None, length=ticks)


def tick(loop: Loop, rig: RigConstants, state: RunState) -> tuple[RunState, Tick]:
    """Simulate one control period; return the next state and the record of the tick."""
    sensed, law = sense(loop, rig, state), SIX_AXIS_COMPENSATORS[loop.compensator]
    # The compensator of a sensor without a tool is given the measured pose only if it reads it.
    signals = sensed.signals
    signals = signals if law.reads_pose else signals._replace(pose_measured=None)
    commands, law_state = law.step(rig.prepared, state.controller.law, signals, state.tick)
    command = jax.tree.unflatten(jax.tree.structure(sensed.contact), commands)
    states, position, rates, twist = integrate(loop, rig, state, command)
    sent = law.pose_command(rig.gains, position, rates)
    after = actuated(loop, rig, state, sensed, (states, position, twist), sent)
    seen = Tick(
        states=state.states,
        pose=sensed.motion.pose,
        twist=sensed.motion.twist,
        contact=sensed.contact,
        forces=sensed.forces,
        latch_states=sensed.latch_states,
        signals=sensed.signals,
        command=command,
        sent=sent,
    )
    controller = NumericalController(sensed.lag, law_state)
    return after._replace(controller=controller), seen


def sense(loop: Loop, rig: RigConstants, state: RunState) -> Sensed:
    """Return the real contact at a tick, and the readings of force sensor and position sensor."""
    samples = read_samples(rig.axes, state.hardware, state.tick)
    motion = to_rigid_motion(rig.kinematics.coordinates(samples.motion, state.near))
    pose, twist, _ = motion
    contact, forces, memories = contact_wrench(rig.groups, state.memories, pose, twist, rig.period)
    latched = []
    for latch, before in zip(rig.latches, state.latch_states, strict=True):
        latch_force, latch_state = latch_wrench(latch, before, pose, twist)
        contact = jax.tree.map(jnp.add, contact, latch_force)
        latched.append(latch_state)
    measured = None if samples.measured is None else _measured_pose(loop, rig, state, samples.measured)
    wrench, lag = _measured_wrench(loop, rig, state, contact, motion, measured)
    signals = SixAxisSignals(
        wrench=tuple(jax.tree.leaves(wrench)),
        pose_desired=state.near,
        twist_desired=state.twist,
        pose_measured=measured,
        age=jnp.broadcast_to(state.tick, rig.period.shape),
    )
    return Sensed(motion, contact, forces, memories, tuple(latched), lag, signals)


def integrate(
    loop: Loop, rig: RigConstants, state: RunState, command: Wrench
) -> tuple[States, Array, Array, Array]:
    """Return the numerical model's next states, and its next coordinates, rates and twist (6, *batch)."""
    states = advance(rig.bodies, state.states, command, rig.period, SHARES[loop.integrator])
    return states, *model_motion(rig.bodies, states)


def actuated(
    loop: Loop,
    rig: RigConstants,
    state: RunState,
    sensed: Sensed,
    model: tuple[States, Array, Array],
    sent: Float[Array, "6 *batch"],
) -> RunState:
    """Return the state after a tick; only the compensator's state is still the old one.

    Args:
        loop: structure of the loop.
        rig: constants of the run.
        state: state before the tick.
        sensed: real contact and readings of the tick.
        model: next states, coordinates and twist of the numerical model.
        sent: pose command [m, rad].
    """
    states, position, twist = model
    hardware = actuate(
        rig.axes, state.hardware, state.tick, rig.kinematics.command(sent), loop.hold, loop.latency
    )
    return RunState(
        states=states,
        near=position,
        twist=twist,
        hardware=hardware,
        memories=sensed.memories,
        latch_states=sensed.latch_states,
        controller=state.controller._replace(lag=sensed.lag),
        tick=state.tick + 1,
    )


def _measured_pose(loop: Loop, rig: RigConstants, state: RunState, measured: Array) -> Array:
    """Convert the measured axis positions to measured coordinates, including noise and rounding."""
    still = AxisMotion(measured, jnp.zeros_like(measured), None)
    position = rig.kinematics.coordinates(still, state.near).position
    if not loop.has_pose_errors:
        return position
    noisy = position + rig.sensor.position_noise_std * _noise(rig, state.tick, 1)
    return quantise(noisy, rig.sensor.position_quantum)


def _measured_wrench(
    loop: Loop,
    rig: RigConstants,
    state: RunState,
    contact: Wrench,
    motion: RigidMotion,
    measured: Array | None,
) -> tuple[Wrench, tuple[Wrench, Wrench] | None]:
    """Return the measured wrench about T's origin, and the next state of the sensor's lag."""
    sensor, last = rig.sensor, state.controller
    if motion.acceleration is None:
        raw = read_fixed(contact, sensor.mounting)
    else:
        load = tool_load(sensor.tool, motion.pose, motion.twist, motion.acceleration, sensor.gravity)
        raw = read_moving(contact, load, motion.pose)
    lagged = raw if last.lag is None else _lagged_reading(rig, state.tick, raw, *last.lag)
    noise = sensor.noise_std * _noise(rig, state.tick, 0) if loop.has_noise else None
    reading = sample(lagged, sensor.errors, noise, loop.has_sample_effects)
    unbiased: Wrench = jax.tree.map(jnp.subtract, reading, _wrench(sensor.assumed_bias))
    if motion.acceleration is None:
        wrench = undo_fixed(unbiased, sensor.mounting)
    else:
        assert measured is not None
        pose = Pose(vector(measured[:3]), exponential(vector(measured[3:])))
        load = weight(sensor.assumed_tool, pose.attitude, sensor.assumed_gravity)
        wrench = undo_moving(unbiased, load, pose)
    return wrench, None if last.lag is None else (raw, lagged)


def _lagged_reading(rig: RigConstants, now: Array, raw: Wrench, last: Wrench, lagged: Wrench) -> Wrench:
    """Return the output of the force sensor's lag; its input is interpolated linearly between ticks."""
    first, zero = now == 0, jnp.zeros_like(rig.period)

    def lagged_channel(now: Array, before: Array, lagged: Array) -> Array:
        before, lagged = jnp.where(first, now, before), jnp.where(first, now, lagged)
        middle = (before + now) / 2
        return apply_lag(lagged, zero, rig.period, zero, [before, middle, now], rig.sensor.time_constant)

    reading: Wrench = jax.tree.map(lagged_channel, raw, last, lagged)
    return reading


def _wrench(channels: Array) -> Wrench:
    """Convert six channels (6, *batch) to a wrench."""
    return Wrench(vector(channels[:3]), vector(channels[3:]))


def _noise(rig: RigConstants, now: Array, sensor: int) -> Array:
    """Return standard normal noise for the six channels of a sensor: 0 for the force, 1 for the pose."""
    channel = jnp.arange(6, dtype=jnp.int32).reshape(6, *[1] * rig.period.ndim)
    count = jnp.broadcast_to(6 * now + channel, (6, *rig.period.shape))
    stream = jnp.full(rig.period.shape, sensor, jnp.int32)
    return white_noise(rig.key, stream, count, rig.period.dtype)
