"""Timing effects of the rig: delays that vary from tick to tick, lost frames, and missed ticks.

The delay of the force reading at a tick deviates from its nominal value. The deviation is uniformly
distributed between minus and plus the jitter. The reading is the real force at exactly this delay before the
tick, from the exact motion between the samples. If a frame of the force sensor is lost, the controller reads
the last frame again. At a missed tick the controller does not run: the numerical model keeps its position and
velocity, and the drives receive the last position command again.

Like the noise of the sensors, the effects at a tick depend only on the key of the scenario, the index of the
contact, and the number of ticks since the run began. No effect occurs at the first tick of a run.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxhil.lanes import select_lanes
from jaxhil.laws.shared.ring_buffer import look_back
from jaxhil.simulation.cells import IntervalInputs, horner_series
from jaxhil.simulation.contact_force import MotionSample, Surfaces
from jaxhil.simulation.motion_simulator import apply_row, split_delay
from jaxhil.simulation.moving_average import is_before_kink, motion_rows
from jaxhil.simulation.probe import Probe
from jaxhil.simulation.scenario import TimingBatch
from jaxhil.simulation.sensors import uniform_noise

TIMING_STREAM = 0x40000000  # offset of the contact's index, which separates these numbers from the noise
SERIES_DEGREE = 16  # degree of the power series of the motion in an interval
# Largest pole of the motion simulator [rad per control period] for which the series is accurate to rounding.
MAX_SERIES_POLE = 1.0


class TimingDraws(NamedTuple):
    """Timing effects at several ticks, (ticks, *batch), or at one tick, (*batch); None for absent effects."""

    jitter: Float[Array, "..."] | None  # deviation of the force reading's delay [s]
    is_lost: Bool[Array, "..."] | None  # whether the frame of the force sensor is lost
    is_missed: Bool[Array, "..."] | None  # whether the controller misses the tick


class HeldValues(NamedTuple):
    """Last reading and command (lost frames and missed ticks repeat them), and the number of missed ticks."""

    reading: Any  # force reading [N], (*batch); with six axes, reading of the sensor's channels
    command: Any  # force command [N], (*batch); with six axes, the wrench command
    missed: Int[Array, "*batch"]  # number of missed ticks since the run began


def no_held_values(like: Float[Array, "*batch"]) -> HeldValues:
    """Return the `HeldValues` at the start of a run (all 0), for a batch with the shape of `like`."""
    return HeldValues(0 * like, 0 * like, jnp.zeros(like.shape, jnp.int32))


def update_held_values(
    before: HeldValues | None, reading: Any, command: Any, missed: Bool[Array, "*batch"] | None
) -> HeldValues | None:
    """Return the `HeldValues` after a tick with this reading and command; None without timing effects."""
    if before is None:
        return None
    count = before.missed if missed is None else before.missed + missed.astype(jnp.int32)
    return HeldValues(reading, command, count)


def draw_timing(
    timing: TimingBatch | None,
    key: UInt32[Array, "2 *batch"],
    contact: Int[Array, "*batch"],
    age: Int[Array, "ticks *batch"],
) -> TimingDraws | None:
    """Return the timing effects of scenarios at several ticks; None if they have none.

    Args:
        timing: Timing effects of the scenarios.
        key: Noise keys of the scenarios.
        contact: Index of the current contact; 0 with six axes.
        age: Number of ticks since the run began.
    """
    if timing is None:
        return None

    def share(stream, dtype):
        return uniform_noise(key, contact + TIMING_STREAM, 4 * age + stream, dtype)

    def occurs(stream, probability):
        if probability is None:
            return None
        return (share(stream, probability.dtype) < probability[None]) & (age > 0)

    jitter = timing.jitter
    if jitter is not None:
        jitter = jnp.where(age > 0, jitter[None] * (2 * share(0, jitter.dtype) - 1), 0)
    return TimingDraws(jitter, occurs(1, timing.loss), occurs(2, timing.missed))


def without_missed_ticks(scenarios: Any) -> Any:
    """Return scenarios (with one axis or six axes) in which the controller misses no tick.

    The rig's controller is compared with the simulation tick by tick and must therefore run at every tick.
    """
    timing = scenarios.timing
    return scenarios if timing is None else scenarios._replace(timing=timing._replace(missed=None))


def hold_compensator(missed: Bool[Array, "*batch"], before: Any, after: Any, ring: int) -> Any:
    """Return the compensator's next state; lanes that missed the tick keep their last state.

    Args:
        missed: Lanes that missed the tick.
        before: State before the tick.
        after: State after the tick.
        ring: Length of the compensator's delay lines [samples].
    """

    def unchanged(leaf):
        # The number of the tick, which is common to all lanes, determines the position in a delay line. The
        # samples of a lane that keeps its state must therefore move on by one position.
        is_ring = leaf.ndim > missed.ndim and leaf.shape[0] == ring
        return jnp.roll(leaf, 1, axis=0) if is_ring else leaf

    return jax.lax.cond(
        jnp.any(missed),
        lambda: select_lanes(missed, jax.tree.map(unchanged, before), after),
        lambda: after,
    )


def motion_in_interval(
    series: Float[Array, "powers columns *batch"] | None,
    window: Float[Array, "*batch"] | None,
    period: Float[Array, "*batch"],
    hold: str,
    inputs: IntervalInputs,
    s: Float[Array, "*batch"],
) -> tuple[Array, Array, Array]:
    """Return the exact position at any instant of a sampling interval, and its first two time derivatives.

    The unit of time in the derivatives is the control period.

    Args:
        series: Power series of the motion (`build_series`); unused for a moving average.
        window: Window of a moving average [s]; None for a transfer function.
        period: Control period [s].
        hold: Hold of the position command, "linear" or "zoh".
        inputs: Motion simulator's state at the interval's start, and commands at its start and end.
        s: Instant, as a fraction of the interval from its start [1].
    """
    if window is not None:
        rows = motion_rows(window, period, s, is_before_kink(window, period, s), hold)
        position, rate, bend = (apply_row(row, inputs.state, inputs.start, inputs.end) for row in rows)
        return position, rate, bend
    assert series is not None
    return horner_series(series, (*inputs.state, inputs.start, inputs.end - inputs.start), s)


def read_force(
    loop: Any,
    rig: Any,
    state: Any,
    now: Int[Array, ""],
    age: Int[Array, "*batch"],
    jitter: Float[Array, "*batch"],
    probe: Probe | None,
) -> Float[Array, "*batch"]:
    """Return the real force [N] that the sensor reads at tick `now`; 0 for an instant before the run.

    This is the force at the instant that precedes the tick by the delays and the jitter.

    Args:
        loop: Fixed properties of the loop; its contact law has no memory.
        rig: Constants of the run.
        state: State of the loop before the tick.
        now: Number of the tick.
        age: Number of ticks since the run began.
        jitter: Deviation of the delay [s].
        probe: Probe (test push on the hardware), whose force is added; None without a probe.
    """
    scenario, period = rig.scenario, rig.constants.control_period
    simulator, first = scenario.simulator, state.first_contact
    # A drawn jitter may exceed the drawn delay.
    delay = split_delay(simulator.delay + jnp.maximum(scenario.force_sensor.delay + jitter, 0), period)
    is_available = age > delay.intervals
    inputs = jax.tree.map(
        lambda leaf: look_back(leaf, now - 1, delay.intervals, is_available), state.sensed.rings.inputs
    )
    position, rate, _ = motion_in_interval(
        rig.series, simulator.window, period, loop.hold, inputs, delay.fraction
    )
    motion = MotionSample(position - scenario.contact_plane, rate / period)
    surfaces = Surfaces(loop.law, state.parameters, state.law, None)
    force = jnp.where(is_available, surfaces.force(motion)[0], 0)
    if probe is None:
        return force
    # The time of the first touch counts from the instants at which the force is sampled without jitter.
    at = (age - 1 - delay.intervals).astype(period.dtype) + delay.fraction - rig.delays.force.fraction
    since = jnp.where(first.made, at - first.time, -1e9) * period
    return force + first.side * probe.push.force(since)
