"""Sensors of the six-axis rig: real contact at a tick, and the readings of wrench and pose."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxhil.lanes import as_complex, select_lanes
from jaxhil.laws.six_axis_base import SixAxisSignals
from jaxhil.mechanism.sensor_filter import FilterModes
from jaxhil.simulation.sensors import BIAS_WALK_STREAM, apply_lag, follow_ramp, quantise, white_noise
from jaxhil.simulation.timing import TimingDraws, draw_timing
from jaxhil.sixdof.axes import AxisMotion, read_late_motion, read_samples
from jaxhil.sixdof.forces import contact_wrench
from jaxhil.sixdof.kinematics import RigidMotion, to_rigid_motion
from jaxhil.sixdof.latch import latch_wrench
from jaxhil.sixdof.loop_state import Loop, RigConstants, RunState, Sensed
from jaxhil.sixdof.relative import Pose, Wrench
from jaxhil.sixdof.rotations import exponential
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
    timing, read_contact, read_motion = _draw_timing(rig, state.tick), contact, motion
    if timing is not None and timing.jitter is not None:
        late = read_late_motion(rig.axes, state.hardware, state.tick, timing.jitter, loop.hold)
        read_motion = to_rigid_motion(rig.kinematics.coordinates(late, state.near))
        # The contact and friction laws have no memory.
        read_contact, _, _ = contact_wrench(
            rig.groups, state.memories, read_motion.pose, read_motion.twist, rig.period
        )
    bias_walk = _advance_bias(rig, state)
    reading, lag = _read_sensor(loop, rig, state, read_contact, read_motion, bias_walk)
    if timing is not None and timing.is_lost is not None and state.controller.held is not None:
        reading = select_lanes(timing.is_lost, state.controller.held.reading, reading)
    wrench = _undo_mounting(loop, rig.sensor, reading, measured)
    signals = SixAxisSignals(
        wrench=tuple(jax.tree.leaves(wrench)),
        pose_desired=state.near,
        twist_desired=state.twist,
        pose_measured=measured,
        age=jnp.broadcast_to(state.tick, rig.period.shape),
    )
    return Sensed(
        motion=motion,
        contact=contact,
        forces=forces,
        memories=memories,
        latch_states=tuple(latched),
        lag=lag,
        signals=signals,
        reading=None if timing is None else reading,
        missed=None if timing is None else timing.is_missed,
        bias_walk=bias_walk,
    )


def start_filter(modes: FilterModes | None, nothing: Wrench) -> Any:
    """Return the initial state of the force sensor's lag or filter; `nothing` is a zero wrench (no input)."""
    if modes is None:
        return nothing
    return (jax.tree.map(as_complex, nothing),) * len(modes.rates)


def _draw_timing(rig: RigConstants, now: Array) -> TimingDraws | None:
    """Draw jitter, lost frame and missed tick of the tick `now`, (*batch); None without timing effects."""
    if rig.timing is None:
        return None
    age = jnp.broadcast_to(now, (1, *rig.period.shape))
    return jax.tree.map(lambda leaf: leaf[0], draw_timing(rig.timing, rig.key, jnp.zeros_like(age[0]), age))


def _measured_pose(loop: Loop, rig: RigConstants, state: RunState, measured: Array) -> Array:
    """Convert the measured axis positions to measured coordinates, including noise and rounding."""
    still = AxisMotion(measured, jnp.zeros_like(measured), None)
    position = rig.kinematics.coordinates(still, state.near).position
    if not loop.has_pose_errors:
        return position
    noisy = position + rig.sensor.position_noise_std * _noise(rig, state.tick, 1)
    return quantise(noisy, rig.sensor.position_quantum)


def _advance_bias(rig: RigConstants, state: RunState) -> Array | None:
    """Return the change of the force sensor's bias since tick 0, (6, *batch); None for a constant bias."""
    walk, before = rig.sensor.bias_walk, state.controller.bias_walk
    if walk is None or before is None:
        return None
    step = walk * jnp.sqrt(rig.period)[None] * _noise(rig, state.tick, BIAS_WALK_STREAM)
    return before + jnp.where(state.tick > 0, step, 0)


def _read_sensor(
    loop: Loop,
    rig: RigConstants,
    state: RunState,
    contact: Wrench,
    motion: RigidMotion,
    bias_walk: Array | None,
) -> tuple[Wrench, tuple[Wrench, Any] | None]:
    """Return the reading of the sensor's channels, and the next state of the sensor's lag or filter."""
    sensor, last = rig.sensor, state.controller
    if motion.acceleration is None:
        raw = read_fixed(contact, sensor.mounting)
    else:
        load = tool_load(sensor.tool, motion.pose, motion.twist, motion.acceleration, sensor.gravity)
        raw = read_moving(contact, load, motion.pose)
    lagged = raw if last.lag is None else _advance_filter(loop, rig, state.tick, raw, *last.lag)
    reading = _read_filter(loop.sensor_filter, lagged)
    noise = sensor.noise_std * _noise(rig, state.tick, 0) if loop.has_noise else None
    if bias_walk is not None:
        noise = bias_walk if noise is None else noise + bias_walk
    reading = sample(reading, sensor.errors, noise, loop.has_sample_effects, loop.cuts_dead_zone)
    return reading, None if last.lag is None else (raw, lagged)


def _undo_mounting(loop: Loop, sensor: Sensor, reading: Wrench, measured: Array | None) -> Wrench:
    """Reconstruct the contact's wrench about T's origin from a reading, as the controller does."""
    unbiased: Wrench = jax.tree.map(jnp.subtract, reading, _wrench(sensor.assumed_bias))
    if loop.side == "fixed":
        return undo_fixed(unbiased, sensor.mounting)
    assert measured is not None
    pose = Pose(vector(measured[:3]), exponential(vector(measured[3:])))
    load = weight(sensor.assumed_tool, pose.attitude, sensor.assumed_gravity)
    return undo_moving(unbiased, load, pose)


def _advance_filter(loop: Loop, rig: RigConstants, now: Array, raw: Wrench, last: Wrench, state: Any) -> Any:
    """Return the next state of the force sensor's lag or filter; its input is linear between ticks."""
    first, zero = now == 0, jnp.zeros_like(rig.period)

    def lagged_channel(now: Array, before: Array, lagged: Array) -> Array:
        before, lagged = jnp.where(first, now, before), jnp.where(first, now, lagged)
        middle = (before + now) / 2
        return apply_lag(lagged, zero, rig.period, zero, [before, middle, now], rig.sensor.time_constant)

    if loop.sensor_filter is None:
        reading: Wrench = jax.tree.map(lagged_channel, raw, last, state)
        return reading

    def filtered_channel(rate: complex, now: Array, before: Array, mode: Array) -> Array:
        before, mode = jnp.where(first, now, before), jnp.where(first, as_complex(now), mode)
        return follow_ramp(mode, before, now, rate * as_complex(rig.sensor.cutoff * rig.period))

    return tuple(
        jax.tree.map(partial(filtered_channel, rate), raw, last, mode)
        for rate, mode in zip(loop.sensor_filter.rates, state, strict=True)
    )


def _read_filter(modes: FilterModes | None, state: Any) -> Wrench:
    """Return the output of the force sensor's lag or filter."""
    if modes is None:
        return state

    def channel(*parts: Array) -> Array:
        terms = [jnp.real(weight * part) for weight, part in zip(modes.weights, parts, strict=True)]
        return sum(terms[1:], terms[0])

    return jax.tree.map(channel, *state)


def _wrench(channels: Array) -> Wrench:
    """Convert six channels (6, *batch) to a wrench."""
    return Wrench(vector(channels[:3]), vector(channels[3:]))


def _noise(rig: RigConstants, now: Array, stream: int) -> Array:
    """Return standard normal noise for six channels; `stream` is 0 for the force and 1 for the pose."""
    channel = jnp.arange(6, dtype=jnp.int32).reshape(6, *[1] * rig.period.ndim)
    count = jnp.broadcast_to(6 * now + channel, (6, *rig.period.shape))
    streams = jnp.full(rig.period.shape, stream, jnp.int32)
    return white_noise(rig.key, streams, count, rig.period.dtype)
