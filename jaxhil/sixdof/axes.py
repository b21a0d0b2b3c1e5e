"""The drives of the motion simulator: some axes, each with a model and a delay of its own.

An axis is a coordinate, a robot's coordinate or a leg; axes lie along the leading dimension, (axes, *batch).
Each follows its command as on one axis (`jaxhil.simulation.motion_simulator`), propagated exactly. The
hardware's pose at one time needs every axis at that time: as each has its own delay, each is sampled at its
own place in a sampling interval, and looked up as many intervals back as its delay is long.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.compensators.ring_buffer import look_back, write_in_turn
from jaxhil.simulation.motion_simulator import (
    Delay,
    Propagation,
    advance,
    propagation,
    rate_row,
    read,
    split_delay,
    steady_state,
)
from jaxhil.simulation.scenario import MotionSimulator


class Axes(NamedTuple):
    """Axes of a motion simulator, discretised, and where the sensors sample them."""

    propagation: Propagation  # of each axis, (..., axes, *batch)
    acceleration: Float[Array, "columns axes *batch"]  # row at the force sensor's place [1/s^2]
    force: Delay  # of each axis and the force sensor together, (axes, *batch)
    position: Delay  # of each axis and the position sensor together, (axes, *batch)


class Motion(NamedTuple):
    """Positions of the axes, in their units, and rates per second."""

    position: Float[Array, "..."]  # (axes, *batch)
    rate: Float[Array, "..."]  # (axes, *batch)
    acceleration: Float[Array, "..."] | None  # (axes, *batch); None where nobody needs it


class Samples(NamedTuple):
    """What the sensors meet."""

    motion: Motion  # at the force sensor's sampling time
    measured: Float[Array, "..."] | None  # positions at the position sensor's; None where nobody needs them


class Hardware(NamedTuple):
    """What evolves of the axes and their samples."""

    commands: tuple[Array, ...]  # c(n), c(n-1), ... as sent to the drives, (axes, *batch) each
    state: tuple[Array, ...]  # of the axes
    samples: Samples  # ring of the samples of each sampling interval, (samples, axes, *batch)
    before: Samples  # of the sampling interval before the run
    stride: Float[Array, "axes *batch"]  # growth in a period, before the run


def build_axes(
    simulator: MotionSimulator,
    force_delay: Float[Array, "*batch"],
    position_delay: Float[Array, "*batch"],
    control_period: Float[Array, "*batch"],
    hold: str,
) -> Axes:
    """Axes without limits, leaves (..., axes, *batch), sampled by sensors with delays [s]."""
    period = jnp.broadcast_to(control_period[None], simulator.delay.shape)
    force, position = (
        split_delay(simulator.delay + delay[None], period) for delay in (force_delay, position_delay)
    )
    exact = propagation(
        simulator.numerator, simulator.denominator, period, force.fraction, position.fraction, hold
    )
    return Axes(exact, rate_row(exact.velocity, simulator.denominator, period), force, position)


def enter(
    axes: Axes, at: Array, stride: Array, period: Array, hold: str, latency: int, ring: int, weighed: bool
) -> Hardware:
    """The hardware in uniform motion, `at` now and growing by `stride` in a control period [s], both
    (axes, *batch); `ring`, a power of two, is longer than any delay in periods. Accelerations and measured
    positions are followed where a tool is `weighed`."""
    commands = tuple(at - back * stride for back in range(latency + 1))
    drive = commands[-1] if hold == "linear" else commands[-1] + stride
    start = drive - stride
    end = drive if hold == "linear" else start
    rows = axes.propagation
    settled = steady_state(rows, start, stride)
    still = jnp.zeros_like(stride) if weighed else None
    motion = Motion(read(rows.position, settled, start, end), stride / period[None], still)
    before = Samples(motion, read(rows.measured_position, settled, start, end) if weighed else None)
    return Hardware(
        commands=commands,
        state=steady_state(rows, drive, stride),
        samples=jax.tree.map(lambda leaf: jnp.zeros((ring, *leaf.shape), leaf.dtype), before),
        before=before,
        stride=stride,
    )


def sampled(axes: Axes, hardware: Hardware, tick: Int[Array, ""]) -> Samples:
    """What the sensors meet that read at `tick`, counted from the start of the run."""
    stride, before = hardware.stride, hardware.before

    def look(delay: Delay, ring: Array | None, steady: Array | None, growth: Array) -> Array | None:
        if ring is None or steady is None:
            return None
        # Rings are read up to one ring behind: an index below 0 wraps, and is not taken.
        found = look_back(ring, tick - 1, delay.intervals)
        uniform = steady + (tick - delay.intervals).astype(growth.dtype) * growth
        return jnp.where(tick > delay.intervals, found, uniform)

    at, now = hardware.samples, before.motion
    position, rate, acceleration = (
        look(axes.force, ring, steady, growth)
        for ring, steady, growth in zip(at.motion, now, (stride, 0 * stride, 0 * stride), strict=True)
    )
    assert position is not None and rate is not None
    measured = look(axes.position, at.measured, before.measured, stride)
    return Samples(Motion(position, rate, acceleration), measured)


def actuate(
    axes: Axes, hardware: Hardware, tick: Int[Array, ""], command: Array, hold: str, latency: int
) -> Hardware:
    """The hardware after the control period of `tick`, which ends with `command` sent."""
    commands = (command, *hardware.commands)
    end = commands[latency]
    start = commands[latency + 1] if hold == "linear" else end
    rows, state = axes.propagation, hardware.state

    def at(row: Array, wanted: Array | None) -> Array | None:
        return None if wanted is None else read(row, state, start, end)

    before = hardware.before
    motion = Motion(
        read(rows.position, state, start, end),
        read(rows.velocity, state, start, end),
        at(axes.acceleration, before.motion.acceleration),
    )
    sample = Samples(motion, at(rows.measured_position, before.measured))
    return hardware._replace(
        commands=commands[: latency + 1],
        state=advance(rows.transition, state, start, end),
        samples=write_in_turn(hardware.samples, tick, sample),
    )
