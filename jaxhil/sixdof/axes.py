"""Drives of the motion simulator: axes that each have a model and a delay.

An axis is a coordinate, a robot's coordinate or a leg; axes are the leading dimension, (axes, *batch). Each
follows its command like the single axis of `jaxhil.simulation.motion_simulator`, discretised exactly. The
hardware's pose at an instant needs the positions of all axes at this instant. As delays differ, each axis is
sampled at its own fraction of a sampling interval, and looked up as many intervals back as its delay is long.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.simulation.motion_simulator import (
    Propagation,
    SplitDelay,
    advance_state,
    apply_row,
    discretise,
    rate_row,
    read_measured_position,
    split_delay,
    steady_state,
)
from jaxhil.simulation.scenario import MotionSimulatorBatch


class Axes(NamedTuple):
    """Discretised axes of a motion simulator, with the sensors' sampling instants."""

    propagation: Propagation  # each axis's motion simulator, (..., axes, *batch)
    # row at the force sensor's sampling instant [1/s^2]; None unless a tool is weighed
    acceleration: Float[Array, "columns axes *batch"] | None
    force: SplitDelay  # delay of each axis plus the force sensor, (axes, *batch)
    position: SplitDelay  # delay of each axis plus the position sensor, (axes, *batch)


class Motion(NamedTuple):
    """Positions of the axes, in their units, and rates per second."""

    position: Float[Array, "..."]  # (axes, *batch)
    rate: Float[Array, "..."]  # (axes, *batch)
    acceleration: Float[Array, "..."] | None  # (axes, *batch); None if unused


class Samples(NamedTuple):
    """Motion of the axes at the sensors' sampling instants."""

    motion: Motion  # at the force sensor's sampling instant
    measured: Float[Array, "..."] | None  # positions at the position sensor's; None if unused


class Hardware(NamedTuple):
    """State of the axes and their delay line."""

    commands: tuple[Array, ...]  # c(n), c(n-1), ... as sent to the drives, (axes, *batch) each
    state: tuple[Array, ...]  # state of the axes
    ring: Float[Array, "rows *batch"]  # delay line; rows are (intervals, sampled quantities, axes), flattened


def build_axes(
    simulator: MotionSimulatorBatch,
    force_delay: Float[Array, "*batch"],
    position_delay: Float[Array, "*batch"],
    control_period: Float[Array, "*batch"],
    hold: str,
    weighed: bool = False,
    measured: bool = False,
) -> Axes:
    """Return axes without limits, leaves (..., axes, *batch), sampled by sensors with delays [s].

    `weighed` adds accelerations, for the weight of a tool, and `measured` the positions that the position
    sensor reads.
    """
    period = jnp.broadcast_to(control_period[None], simulator.delay.shape)
    force, position = (
        split_delay(simulator.delay + delay[None], period) for delay in (force_delay, position_delay)
    )
    instant = position.fraction if measured else None
    exact = discretise(simulator.numerator, simulator.denominator, period, force.fraction, instant, hold)
    acceleration = rate_row(exact.velocity, simulator.denominator, period) if weighed else None
    return Axes(exact, acceleration, force, position)


def lags(simulator: MotionSimulatorBatch) -> np.ndarray:
    """Return the lag -G'(0) [s] of each axis, (axes, *batch), without its transport delay."""
    numerator, denominator = (np.asarray(part) for part in (simulator.numerator, simulator.denominator))
    if len(denominator) == 1:
        return np.zeros(simulator.delay.shape)
    lead = numerator[-2] / numerator[-1] if len(numerator) > 1 else 0.0
    return denominator[-2] / denominator[-1] - lead


def enter(
    axes: Axes, at: Array, stride: Array, period: Array, hold: str, latency: int, ring: int
) -> Hardware:
    """Return the hardware in uniform motion, at positions `at` that grow by `stride` in a control period [s].

    Both are (axes, *batch). `ring` is the length of the delay line: a power of two, longer than any delay.
    """
    commands = tuple(at - back * stride for back in range(latency + 1))
    drive = commands[-1] if hold == "linear" else commands[-1] + stride
    start = drive - stride
    end = drive if hold == "linear" else start
    rows = axes.propagation
    settled = steady_state(rows, start, stride)
    position, measured = (
        apply_row(rows.position, settled, start, end),
        read_measured_position(rows, settled, start, end),
    )
    newest = _samples(axes, position, stride / period[None], 0 * stride, measured)
    growth = _samples(axes, stride, 0 * stride, 0 * stride, stride)
    # The delay line contains the uniform motion of the past intervals.
    back = jnp.arange(1 - ring, 1, dtype=jnp.int32).astype(stride.dtype).reshape(-1, 1, *[1] * stride.ndim)
    newest, growth = (jnp.stack(jax.tree.leaves(samples))[None] for samples in (newest, growth))
    return Hardware(
        commands, steady_state(rows, drive, stride), (newest + back * growth).reshape(-1, *period.shape)
    )


def sampled(axes: Axes, hardware: Hardware, tick: Int[Array, ""]) -> Samples:
    """Return the samples that the sensors read at `tick`, counted from the start of the run."""
    force = axes.force.intervals
    delays, structure = jax.tree.flatten(_samples(axes, force, force, force, axes.position.intervals))
    size = force.size
    ring = hardware.ring.reshape(-1)
    last = ring.size // (len(delays) * size) - 1
    lane = jnp.arange(size, dtype=force.dtype).reshape(force.shape)
    samples = []
    for kind, delay in enumerate(delays):
        # The delay line is read up to its length back: an index below 0 wraps.
        index = ((tick - 1 - delay) & last) * (len(delays) * size) + (kind * size + lane)
        samples.append(ring.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False))
    return structure.unflatten(samples)


def actuate(
    axes: Axes, hardware: Hardware, tick: Int[Array, ""], command: Array, hold: str, latency: int
) -> Hardware:
    """Return the hardware after the control period of `tick`, at whose end `command` is sent."""
    commands = (command, *hardware.commands)
    end = commands[latency]
    start = commands[latency + 1] if hold == "linear" else end
    exact, state, ring = axes.propagation, hardware.state, hardware.ring
    rows = _samples(axes, exact.position, exact.velocity, axes.acceleration, exact.measured_position)
    kinds = jax.tree.leaves(rows)
    last = ring.size // (len(kinds) * command.size) - 1
    for kind, row in enumerate(kinds):
        index = ((tick & last) * len(kinds) + kind) * len(command)
        ring = lax.dynamic_update_slice_in_dim(ring, apply_row(row, state, start, end), index, 0)
    return Hardware(commands[: latency + 1], advance_state(exact.transition, state, start, end), ring)


def _samples(axes: Axes, position: Any, rate: Any, acceleration: Any, measured: Any) -> Samples:
    """Return the samples that are used."""
    return Samples(
        Motion(position, rate, acceleration if axes.acceleration is not None else None),
        measured if axes.propagation.measured_position is not None else None,
    )
