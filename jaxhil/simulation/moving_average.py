"""Motion simulator whose position is the mean of the command during the last `window` seconds.

Industrial robots smooth their commands in this way. With time in control periods, a command u, its integral
U and the window w, the position at the time t is x_a(t) = (U(t) - U(t - w))/w. At the fraction s of the
sampling interval that starts at tick m,

    x_a(m + s) = x_a(m) + (A(s) - B(s))/w,

where A(s) is the integral of the command that enters the window, and B(s) the integral of the command that
leaves it. The command is a straight line in each interval. The start of the window passes a tick at the
fraction f of every interval, where w = N + f with a whole number N. The motion is therefore one parabola
before f and another one after f.

The state is (x_a(m), a, b, c). Here a, b and c are the commands at the three ticks m - N - 1, m - N and
m - N + 1, between which the start of the window moves during the interval. These commands come from a delay
line (`read_leaving_commands`). All rows have the form that `Propagation` describes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.shared.ring_buffer import look_back
from jaxhil.simulation.motion_simulator import Propagation, SimulatorState, SplitWindow

# distance from a whole number of periods [periods] within which a window counts as whole (`split_delay`)
TOLERANCE = 1e-9
DEGREE = 2  # degree of the position as a polynomial in time


class UniformCommand(NamedTuple):
    """Uniformly moving drive command before the start of a run."""

    last: Float[Array, "*batch"]  # command at the end of the last interval before the run [m]
    stride: Float[Array, "*batch"]  # increase of the command per control period [m]
    age: Int[Array, "*batch"]  # number of ticks since the start of the run


def split_window(window: Float[Array, "*batch"], control_period: Float[Array, "*batch"]) -> SplitWindow:
    """Divide a window [s] into whole control periods and a fraction."""
    periods = window / control_period
    whole = jax.lax.stop_gradient(jnp.floor(periods + TOLERANCE))
    return SplitWindow(whole.astype(jnp.int32), periods - whole)


def discretise_moving_average(
    window: Float[Array, "*batch"],
    control_period: Float[Array, "*batch"],
    force_fraction: Float[Array, "*batch"],
    position_fraction: Float[Array, "*batch"] | None,
    hold: str,
    ends: bool = False,
) -> Propagation:
    """Discretise exactly a motion simulator whose position is the moving average of its command.

    Args:
        window: Length of the window [s].
        control_period: Control period [s].
        force_fraction: Fraction of the interval at which the force is sampled.
        position_fraction: Fraction of the interval at which the position is sampled; None if unused.
        hold: Hold of the position command, "linear" or "zoh" (zero-order hold).
        ends: Whether to return the rows of the interval's start and end too.
    """
    split = split_window(window, control_period)
    zeros, ones = jnp.zeros_like(control_period), jnp.ones_like(control_period)

    def motion(s, is_before):
        position, velocity, _ = motion_rows(window, control_period, s, is_before, hold)
        return position, velocity / control_period[None]

    def reading(s):
        return motion(s, is_before_kink(window, control_period, s))

    position, velocity = reading(force_fraction)
    measured = None if position_fraction is None else reading(position_fraction)[0]
    end = motion(ones, zeros > 0)
    identity = jnp.eye(6, dtype=end[0].dtype).reshape(6, 6, *[1] * zeros.ndim)[1:4]
    unchanged = jnp.broadcast_to(identity, (3, *end[0].shape))
    return Propagation(
        transition=jnp.concatenate([end[0][None], unchanged]),
        position=position,
        velocity=velocity,
        measured_position=measured,
        start=motion(zeros, split.fraction > 0) if ends else None,
        end=end if ends else None,
        steady_command=jnp.stack([ones] * 4),
        steady_velocity=_steady_velocity(split, window / control_period, hold),
        window=split,
    )


def is_before_kink(window: Array, control_period: Array, s: Array) -> Bool[Array, "*batch"]:
    """Return whether the fraction `s` of an interval is before the kink of a moving average's motion.

    The kink is at the instant at which the start of the averaging window passes a tick. A reading at this
    instant has the value just before it.
    """
    return s <= split_window(window, control_period).fraction + TOLERANCE


def motion_rows(
    window: Array, control_period: Array, s: Array, is_before: Array, hold: str
) -> tuple[Array, Array, Array]:
    """Return the row vectors of `Propagation` for position, velocity and acceleration; time is in periods.

    Args:
        window: Length of the window [s].
        control_period: Control period [s].
        s: Fraction of the interval at which the rows give the motion.
        is_before: Whether the window's start has not yet passed a tick at the fraction `s`.
        hold: Hold of the command.
    """
    width, fraction = window / control_period, split_window(window, control_period).fraction
    zeros, ones = jnp.zeros_like(s + width), jnp.ones_like(s + width)
    early = jnp.where(is_before, s, fraction)  # time before the window's start passes a tick
    late = jnp.where(is_before, 0, s - fraction)
    late_share = jnp.where(is_before, 0, ones)
    if hold == "linear":
        begin, stop = 1 - fraction, 1 - fraction + early  # fractions of the line from a to b
        first = (stop**2 - begin**2) / 2
        entering = s - s**2 / 2, s**2 / 2
        leaving = early - first, first + late - late**2 / 2, late**2 / 2
        rate_in = 1 - s, s + zeros
        rate_out = (1 - late_share) * (1 - stop), jnp.where(is_before, stop, 1 - late), late
        bend_in, bend_out = (-ones, ones), (late_share - 1, ones - 2 * late_share, late_share)
    else:
        entering, leaving = (zeros, s), (zeros, early, late)
        rate_in, rate_out = (zeros, ones), (zeros, 1 - late_share, late_share)
        bend_in, bend_out = (zeros, zeros), (zeros, zeros, zeros)

    def row(start, enters, leaves):
        numbers = [-number / width for number in leaves] + [number / width for number in enters]
        return jnp.stack([start, *(number + zeros for number in numbers)])

    return row(ones, entering, leaving), row(zeros, rate_in, rate_out), row(zeros, bend_in, bend_out)


def read_leaving_commands(
    ring: Float[Array, "samples *batch"],
    tick: Int[Array, ""],
    split: SplitWindow,
    state: SimulatorState,
    before_run: UniformCommand | None = None,
) -> SimulatorState:
    """Read the three commands that leave the averaging window; return the state with these commands.

    Args:
        ring: Delay line of the drive commands at the end of each interval [m], including this interval.
        tick: Number of the current tick.
        split: Averaging window, divided into periods.
        state: State of the motion simulator (a moving average).
        before_run: Commands before the start of the run; None if the delay line contains them.
    """
    commands = []
    for extra in (2, 1, 0):
        back = split.intervals + extra
        if before_run is None:
            commands.append(look_back(ring, tick, back))
            continue
        last, stride, age = before_run
        uniform = last + (age - back + 1).astype(last.dtype) * stride
        commands.append(look_back(ring, tick, back, age >= back, uniform))
    return (state[0], *commands)


def _steady_velocity(split, width, hold):
    """Return a moving average's steady state under a command that increases by 1 in each control period."""
    count = split.intervals.astype(width.dtype)
    if hold == "linear":
        return jnp.stack([-width / 2, -1 - count, -count, 1 - count])
    mean = (count * (count + 1) / 2 + split.fraction * (count + 1)) / width
    return jnp.stack([-mean, -2 - count, -1 - count, -count])
