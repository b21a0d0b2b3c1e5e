"""Axes of the motion simulator, each with its own transfer function and delay.

An axis is a coordinate of the pose, a coordinate of one of two robots, or a leg of a hexapod. Arrays have the
shape (axes, *batch). Each axis follows its command like the single axis of
`jaxhil.simulation.motion_simulator`, with an exact discretisation. A sensor needs the positions of all axes
at one instant, but the delays of the axes differ. Therefore each axis is sampled at its own fraction of a
sampling interval, and a delay line stores the samples for the whole intervals of the delay.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.laws.shared.ring_buffer import look_back, write_sample, write_samples
from jaxhil.simulation.cells import IntervalInputs, build_series
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
from jaxhil.simulation.moving_average import (
    discretise_moving_average,
    is_before_kink,
    motion_rows,
    read_leaving_commands,
)
from jaxhil.simulation.scenario import MotionSimulatorBatch
from jaxhil.simulation.timing import SERIES_DEGREE, motion_in_interval


class LateSampling(NamedTuple):
    """Constants of force readings whose delay varies from tick to tick (jitter)."""

    axis_delay: Float[Array, "axes *batch"]  # delay of each axis [s]
    sensor_delay: Float[Array, "*batch"]  # nominal delay of the force sensor [s]
    period: Float[Array, "axes *batch"]  # control period [s]
    # power series of the motion in a sampling interval (`build_series`), and window of a moving average [s];
    # one of both is None
    series: Float[Array, "powers columns axes *batch"] | None
    window: Float[Array, "axes *batch"] | None


class Axes(NamedTuple):
    """Discretised axes of a motion simulator, with the delays of the two sensors."""

    propagation: Propagation  # matrices and output rows of the discretised axes, (..., axes, *batch)
    # output row of the acceleration at the force sensor's sampling instant [1/s^2]; None if not needed
    acceleration: Float[Array, "columns axes *batch"] | None
    force: SplitDelay  # sum of the delays of each axis and of the force sensor, (axes, *batch)
    position: SplitDelay  # sum of the delays of each axis and of the position sensor, (axes, *batch)
    late: LateSampling | None = None  # constants of readings with jitter; None without jitter


class AxisMotion(NamedTuple):
    """Positions, rates and accelerations of the axes or of the pose coordinates, (axes, *batch)."""

    position: Float[Array, "..."]  # [m or rad]
    rate: Float[Array, "..."]  # [m/s or rad/s]
    acceleration: Float[Array, "..."] | None  # [m/s^2 or rad/s^2]; None if not needed


class Samples(NamedTuple):
    """Motion of the axes at the sensors' sampling instants."""

    motion: AxisMotion  # motion at the force sensor's sampling instant
    measured: Float[Array, "..."] | None  # positions at the position sensor's instant; None if not needed


class Hardware(NamedTuple):
    """State of the axes, with their latest commands and their delay line."""

    commands: tuple[Array, ...]  # commands c(n), c(n-1), ... to the drives, (axes, *batch) each
    state: tuple[Array, ...]  # states of the axes' transfer functions
    ring: Float[Array, "rows *batch"]  # delay line of the samples, (intervals x quantities x axes, *batch)
    # delay line of the commands at the end of each interval; None unless the axes are moving averages
    past: Float[Array, "intervals axes *batch"] | None = None
    # delay line of the inputs of each interval, (intervals, axes, *batch); None without jitter
    inputs: IntervalInputs | None = None


def build_axes(
    simulator: MotionSimulatorBatch,
    force_delay: Float[Array, "*batch"],
    position_delay: Float[Array, "*batch"],
    control_period: Float[Array, "*batch"],
    hold: str,
    has_tool: bool = False,
    measured: bool = False,
    has_jitter: bool = False,
) -> Axes:
    """Discretise the axes of a motion simulator without limits, for sensors with the given delays [s].

    `has_tool` adds the accelerations, which cause the inertia force of a tool. `measured` adds the positions
    at the position sensor's sampling instant. `has_jitter` adds the constants for `read_late_motion`.
    """
    period = jnp.broadcast_to(control_period[None], simulator.delay.shape)
    force, position = (
        split_delay(simulator.delay + delay[None], period) for delay in (force_delay, position_delay)
    )
    instant = position.fraction if measured else None
    late = _build_late_sampling(simulator, force_delay, period) if has_jitter else None
    if simulator.window is not None:
        averages = _build_averages(simulator.window, period, force, position, instant, hold, has_tool)
        return averages._replace(late=late)
    exact = discretise(simulator.numerator, simulator.denominator, period, force.fraction, instant, hold)
    acceleration = rate_row(exact.velocity, simulator.denominator, period) if has_tool else None
    return Axes(exact, acceleration, force, position, late)


def _build_late_sampling(simulator, force_delay, period) -> LateSampling:
    """Return the constants of force readings whose delay has jitter."""
    series = None
    if simulator.window is None:
        series = build_series(simulator.numerator, simulator.denominator, period, SERIES_DEGREE)
    return LateSampling(simulator.delay, force_delay, period, series, simulator.window)


def _build_averages(window, period, force, position, instant, hold, has_tool) -> Axes:
    """Discretise axes that follow the moving average of their commands."""
    exact = discretise_moving_average(window, period, force.fraction, instant, hold)
    acceleration = None
    if has_tool:
        is_before = is_before_kink(window, period, force.fraction)
        acceleration = motion_rows(window, period, force.fraction, is_before, hold)[2] / period[None] ** 2
    return Axes(exact, acceleration, force, position)


def static_lags(simulator: MotionSimulatorBatch) -> np.ndarray:
    """Return each axis' lag -G'(0) [s], (axes, *batch); the transfer function G(s) excludes the delay."""
    if simulator.window is not None:
        return np.asarray(simulator.window) / 2
    numerator, denominator = (np.asarray(part) for part in (simulator.numerator, simulator.denominator))
    if len(denominator) == 1:
        return np.zeros(simulator.delay.shape)
    lead = numerator[-2] / numerator[-1] if len(numerator) > 1 else 0.0
    return denominator[-2] / denominator[-1] - lead


def start_uniform_motion(
    axes: Axes, at: Array, stride: Array, period: Array, hold: str, latency: int, ring: int
) -> Hardware:
    """Return the hardware state in steady uniform motion.

    Args:
        axes: Discretised axes.
        at: Latest position command, (axes, *batch).
        stride: Change of the command in a control period, (axes, *batch).
        period: Control period [s].
        hold: Hold of the command, "linear" or "zoh".
        latency: Latency of the command [control periods].
        ring: Length of the delay line [control periods]: a power of two, longer than any delay.
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
    rate, acceleration = stride / period[None], 0 * stride
    if hold == "zoh":  # Drives that hold each command do not move evenly within a period.
        rate = apply_row(rows.velocity, settled, start, end)
        if axes.acceleration is not None:
            acceleration = apply_row(axes.acceleration, settled, start, end)
    newest = _samples(axes, position, rate, acceleration, measured)
    growth = _samples(axes, stride, 0 * stride, 0 * stride, stride)
    # The delay line starts with the samples of the past uniform motion.
    back = jnp.arange(1 - ring, 1, dtype=jnp.int32).astype(stride.dtype).reshape(-1, 1, *[1] * stride.ndim)
    newest, growth = (jnp.stack(jax.tree.leaves(samples))[None] for samples in (newest, growth))
    inputs = None
    if axes.late is not None:
        changes = IntervalInputs(steady_state(rows, stride, 0 * stride), stride, stride, None)
        inputs = jax.tree.map(
            lambda last, change: last[None] + back[:, 0] * change[None],
            IntervalInputs(settled, start, end, None),
            changes,
        )
    return Hardware(
        commands,
        steady_state(rows, drive, stride),
        (newest + back * growth).reshape(-1, *period.shape),
        None if rows.window is None else commands[-1][None] + back[:, 0] * stride[None],
        inputs,
    )


def read_samples(axes: Axes, hardware: Hardware, tick: Int[Array, ""]) -> Samples:
    """Return the samples that the sensors read at a tick; ticks are counted from the start of the run."""
    force = axes.force.intervals
    delays, structure = jax.tree.flatten(_samples(axes, force, force, force, axes.position.intervals))
    size = force.size
    ring = hardware.ring.reshape(-1)
    last = ring.size // (len(delays) * size) - 1
    lane = jnp.arange(size, dtype=force.dtype).reshape(force.shape)
    samples = []
    for kind, delay in enumerate(delays):
        # The bit mask wraps the index around the ring buffer.
        index = ((tick - 1 - delay) & last) * (len(delays) * size) + (kind * size + lane)
        samples.append(ring.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False))
    return structure.unflatten(samples)


def read_late_motion(
    axes: Axes, hardware: Hardware, tick: Int[Array, ""], jitter: Float[Array, "*batch"], hold: str
) -> AxisMotion:
    """Return the exact motion of the axes at the instant whose force the sensor reads at a tick.

    For each axis, this instant precedes the tick by the axis' delay, the sensor's delay and the `jitter` [s].
    """
    late, inputs = axes.late, hardware.inputs
    assert late is not None and inputs is not None
    # A drawn jitter may exceed the drawn delay.
    sensor_delay = jnp.maximum(late.sensor_delay + jitter, 0)
    delay = split_delay(late.axis_delay + sensor_delay[None], late.period)
    chosen = jax.tree.map(lambda ring: look_back(ring, tick - 1, delay.intervals), inputs)
    position, rate, bend = motion_in_interval(
        late.series, late.window, late.period, hold, chosen, delay.fraction
    )
    acceleration = None if axes.acceleration is None else bend / late.period**2
    return AxisMotion(position, rate / late.period, acceleration)


def actuate(
    axes: Axes, hardware: Hardware, tick: Int[Array, ""], command: Array, hold: str, latency: int
) -> Hardware:
    """Advance the hardware by one control period; `command` is the command for the end of the period."""
    commands = (command, *hardware.commands)
    end = commands[latency]
    start = commands[latency + 1] if hold == "linear" else end
    exact, state, ring, past = axes.propagation, hardware.state, hardware.ring, hardware.past
    inputs = hardware.inputs
    if past is not None and exact.window is not None:
        past = write_sample(past, tick, end)
        state = read_leaving_commands(past, tick, exact.window, state)
    rows = _samples(axes, exact.position, exact.velocity, axes.acceleration, exact.measured_position)
    kinds = jax.tree.leaves(rows)
    last = ring.size // (len(kinds) * command.size) - 1
    for kind, row in enumerate(kinds):
        index = ((tick & last) * len(kinds) + kind) * len(command)
        ring = lax.dynamic_update_slice_in_dim(ring, apply_row(row, state, start, end), index, 0)
    if inputs is not None:
        inputs = write_samples(inputs, tick, IntervalInputs(state, start, end, None))
    state = advance_state(exact.transition, state, start, end)
    return Hardware(commands[: latency + 1], state, ring, past, inputs)


def _samples(axes: Axes, position: Any, rate: Any, acceleration: Any, measured: Any) -> Samples:
    """Return the arguments as `Samples`, with None for quantities that the loop does not need."""
    return Samples(
        AxisMotion(position, rate, acceleration if axes.acceleration is not None else None),
        measured if axes.propagation.measured_position is not None else None,
    )
