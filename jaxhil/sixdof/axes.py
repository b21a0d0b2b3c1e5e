"""The drives of the motion simulator: some axes, each with a model and a delay of its own.

An axis is a coordinate, a robot's coordinate or a leg; axes lie along the leading dimension, (axes, *batch).
Each follows its command as on one axis (`jaxhil.simulation.motion_simulator`), propagated exactly. The
hardware's pose at one time needs every axis at that time: as each has its own delay, each is sampled at its
own place in a sampling interval, and looked up as many intervals back as its delay is long.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.simulation.motion_simulator import (
    Delay,
    Propagation,
    advance,
    propagation,
    rate_row,
    read,
    read_measured,
    split_delay,
    steady_state,
)
from jaxhil.simulation.scenario import MotionSimulator


class Axes(NamedTuple):
    """Axes of a motion simulator, discretised, and where the sensors sample them."""

    propagation: Propagation  # of each axis, (..., axes, *batch)
    # row at the force sensor's place [1/s^2]; None where no tool is weighed
    acceleration: Float[Array, "columns axes *batch"] | None
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
    ring: Float[Array, "rows *batch"]  # what each interval has been sampled for: samples, kinds, axes in one


def build_axes(
    simulator: MotionSimulator,
    force_delay: Float[Array, "*batch"],
    position_delay: Float[Array, "*batch"],
    control_period: Float[Array, "*batch"],
    hold: str,
    weighed: bool = False,
) -> Axes:
    """Axes without limits, leaves (..., axes, *batch), sampled by sensors with delays [s]. Accelerations and
    measured positions are followed where a tool is `weighed`."""
    period = jnp.broadcast_to(control_period[None], simulator.delay.shape)
    force, position = (
        split_delay(simulator.delay + delay[None], period) for delay in (force_delay, position_delay)
    )
    measured = position.fraction if weighed else None
    exact = propagation(simulator.numerator, simulator.denominator, period, force.fraction, measured, hold)
    acceleration = rate_row(exact.velocity, simulator.denominator, period) if weighed else None
    return Axes(exact, acceleration, force, position)


def enter(
    axes: Axes, at: Array, stride: Array, period: Array, hold: str, latency: int, ring: int
) -> Hardware:
    """The hardware in uniform motion, `at` now and growing by `stride` in a control period [s], both
    (axes, *batch); `ring`, a power of two, is longer than any delay in periods."""
    commands = tuple(at - back * stride for back in range(latency + 1))
    drive = commands[-1] if hold == "linear" else commands[-1] + stride
    start = drive - stride
    end = drive if hold == "linear" else start
    rows = axes.propagation
    settled = steady_state(rows, start, stride)
    position, measured = read(rows.position, settled, start, end), read_measured(rows, settled, start, end)
    newest = _samples(axes, position, stride / period[None], 0 * stride, measured)
    growth = _samples(axes, stride, 0 * stride, 0 * stride, stride)
    # The past fills the ring, one interval after the other.
    back = jnp.arange(1 - ring, 1, dtype=jnp.int32).astype(stride.dtype).reshape(-1, 1, *[1] * stride.ndim)
    newest, growth = (jnp.stack(jax.tree.leaves(samples))[None] for samples in (newest, growth))
    return Hardware(
        commands, steady_state(rows, drive, stride), (newest + back * growth).reshape(-1, *period.shape)
    )


def sampled(axes: Axes, hardware: Hardware, tick: Int[Array, ""]) -> Samples:
    """What the sensors meet that read at `tick`, counted from the start of the run."""
    force = axes.force.intervals
    delays, structure = jax.tree.flatten(_samples(axes, force, force, force, axes.position.intervals))
    size = force.size
    ring = hardware.ring.reshape(-1)
    last = ring.size // (len(delays) * size) - 1
    lane = jnp.arange(size, dtype=force.dtype).reshape(force.shape)
    found = []
    for kind, delay in enumerate(delays):
        # A ring is read up to one ring behind: an index below 0 wraps.
        place = ((tick - 1 - delay) & last) * (len(delays) * size) + (kind * size + lane)
        found.append(ring.at[place].get(mode="promise_in_bounds", wrap_negative_indices=False))
    return structure.unflatten(found)


def actuate(
    axes: Axes, hardware: Hardware, tick: Int[Array, ""], command: Array, hold: str, latency: int
) -> Hardware:
    """The hardware after the control period of `tick`, which ends with `command` sent."""
    commands = (command, *hardware.commands)
    end = commands[latency]
    start = commands[latency + 1] if hold == "linear" else end
    exact, state, ring = axes.propagation, hardware.state, hardware.ring
    rows = _samples(axes, exact.position, exact.velocity, axes.acceleration, exact.measured_position)
    kinds = jax.tree.leaves(rows)
    last = ring.size // (len(kinds) * command.size) - 1
    for kind, row in enumerate(kinds):
        place = ((tick & last) * len(kinds) + kind) * len(command)
        ring = lax.dynamic_update_slice_in_dim(ring, read(row, state, start, end), place, 0)
    return Hardware(commands[: latency + 1], advance(exact.transition, state, start, end), ring)


def _samples(axes: Axes, position: Any, rate: Any, acceleration: Any, measured: Any) -> Samples:
    """Of all that may be sampled what is."""
    weighed = axes.acceleration is not None
    return Samples(Motion(position, rate, acceleration if weighed else None), measured if weighed else None)
