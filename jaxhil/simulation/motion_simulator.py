"""Exact discretisation of the motion simulator: position x_a = G(s) e^{-s tau_p} x_d for the command x_d.

The order of a linear system and a transport delay can be exchanged. Here G receives the undelayed position
command. The position x_a at time t is the response of G at the time t - tau_p. A sensor with delay tau_f
reads the response at the time t - tau_p - tau_f.

In a sampling interval, from one tick to the next, the position command is a straight line. The response at
the fraction s of the interval is therefore a constant row vector times (state, command at the interval's
start, command at the interval's end). The row vectors follow from the matrix exponential of the system
augmented by its input. There is no interpolation and no rounding of delays to ticks.

Time is in control periods. The state of G = num/den is (w, w', ..., w^(n-1)), where den(p) w = u, y = num(p)
w, and p is the time derivative.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

# Number of squarings, and number of terms of the Taylor series, in the matrix exponential.
EXPONENTIAL_SQUARINGS, EXPONENTIAL_TERMS = 6, 13

# State of the motion simulator: one array of the batch shape per component. A single array would have to be
# split at every tick.
SimulatorState = tuple[Array, ...]


class SplitDelay(NamedTuple):
    """Delay, divided into a number of whole sampling intervals and a fraction of a sampling interval."""

    intervals: Int[Array, "*batch"]  # number of intervals to look back from the newest complete interval
    # Relative time in (0, 1] within this interval. At a tick, the relative time is 1, not 0: readings have
    # the value just before the tick.
    fraction: Float[Array, "*batch"]


class SplitWindow(NamedTuple):
    """Window of a moving average, divided into whole control periods and a fraction."""

    intervals: Int[Array, "*batch"]  # whole number of control periods in the window
    fraction: Float[Array, "*batch"]  # remaining fraction of a control period, in [0, 1)


class Propagation(NamedTuple):
    """Discretised motion simulator as row vectors.

    Each row is multiplied by (state, command at the interval's start, command at the interval's end) of a
    sampling interval. The fields `steady_command` and `steady_velocity` are states, not rows.
    """

    transition: Float[Array, "order columns *batch"]  # rows that give the state one period later
    position: Float[Array, "columns *batch"]  # row that gives the position at the force sample [m]
    velocity: Float[Array, "columns *batch"]  # row that gives the velocity at the force sample [m/s]
    # row that gives the position at the position sensor's sampling instant [m]; None if unused
    measured_position: Float[Array, "columns *batch"] | None
    # rows that give position and velocity at the interval's start (right limit); None unless requested
    start: tuple[Array, Array] | None
    # rows that give position and velocity at the interval's end (left limit); None unless requested
    end: tuple[Array, Array] | None
    steady_command: Float[Array, "order *batch"]  # steady state per unit of the command
    # steady state under a ramp command that increases by 1 in each control period
    steady_velocity: Float[Array, "order *batch"]
    window: SplitWindow | None = None  # window of a moving average; None for a transfer function


def split_delay(delay: Float[Array, "*batch"], control_period: Float[Array, "*batch"]) -> SplitDelay:
    """Divide a delay [s] into whole sampling intervals and a fraction.

    A delay within 1e-9 control periods of a multiple of the control period counts as this multiple.
    """
    periods = delay / control_period
    whole = jax.lax.stop_gradient(jnp.floor(periods + 1e-9))
    return SplitDelay(whole.astype(jnp.int32), 1 - (periods - whole))


def discretise(
    numerator: Float[Array, "order *batch"],
    denominator: Float[Array, "order_plus_1 *batch"],
    control_period: Float[Array, "*batch"],
    force_fraction: Float[Array, "*batch"],
    position_fraction: Float[Array, "*batch"] | None,
    hold: str,
    ends: bool = False,
) -> Propagation:
    """Discretise the transfer function num(s)/den(s) of the motion simulator exactly.

    With time in control periods, the state z follows z' = A z + B u for the position command u. At the time
    t in an interval, the state is z(t) = E(t) (z(0), u(0), u(1) - u(0)). Here E(t) consists of the first rows
    of the matrix exponential of t [[A, B, 0], [0, 0, 1], [0, 0, 0]] (Van Loan 1978). The result is
    differentiable with respect to every numeric argument.

    Args:
        numerator: Coefficients of num(s), descending powers; the transfer function is strictly proper.
        denominator: Coefficients of den(s), descending powers; of order 0 for an ideal motion simulator.
        control_period: Control period [s].
        force_fraction: Fraction of the interval at which the force is sampled.
        position_fraction: Fraction of the interval at which the position is sampled; None if unused.
        hold: Hold of the position command, "linear" or "zoh" (zero-order hold).
        ends: Whether to return the rows for the interval's start and end too.
    """
    order = denominator.shape[0] - 1
    if order == 0:
        return _ideal_propagation(control_period, force_fraction, position_fraction, hold, ends)
    system, output = _companion(numerator, denominator, control_period)
    zeros, ones = jnp.zeros_like(control_period), jnp.ones_like(control_period)
    generator, _ = generator_rows(numerator, denominator, control_period)
    instants = [ones, force_fraction]
    if ends:
        instants.append(zeros)
    if position_fraction is not None:
        instants.append(position_fraction)
    fractions = jnp.stack(instants)
    # The axes are row, column, instant in the interval, batch.
    rows = matrix_exponential(generator[:, :, None] * fractions[None, None], fractions)
    # Convert rows for (z, u(0), u(1) - u(0)) to rows for (z, u(0), u(1)).
    rows = rows.at[:, order].add(-rows[:, order + 1])
    state = rows[:order]

    def motion(instant):
        state_rows = rows[:, :, instant]
        rates = [
            *state_rows[1:order],
            _weighted_sum(system[order - 1], state_rows[:order]) + state_rows[order],
        ]
        return _weighted_sum(output, state_rows[:order]), _weighted_sum(output, rates) / control_period[None]

    position, velocity = motion(1)
    steady_command = jnp.stack([-1 / system[order - 1][0]] + [zeros] * (order - 1))
    return Propagation(
        transition=state[:, :, 0],
        position=position,
        velocity=velocity,
        measured_position=None if position_fraction is None else _weighted_sum(output, state[:, :, -1]),
        start=motion(2) if ends else None,
        end=motion(0) if ends else None,
        steady_command=steady_command,
        steady_velocity=_steady_velocity(system, state[:, :, 0], steady_command, hold),
    )


def generator_rows(
    numerator: Float[Array, "order *batch"],
    denominator: Float[Array, "order_plus_1 *batch"],
    control_period: Float[Array, "*batch"],
) -> tuple[Float[Array, "order order_plus_2 *batch"], list[Array]]:
    """Return the first rows (A, B, 0) of the matrix in `discretise`, and the weights of the output.

    The position is the sum of the state's components, each times its weight. The order must be at least 1.
    """
    order = denominator.shape[0] - 1
    system, output = _companion(numerator, denominator, control_period)
    zeros, ones = jnp.zeros_like(control_period), jnp.ones_like(control_period)
    generator = [[*row, zeros, zeros] for row in system]
    generator[order - 1][order] = ones
    return jnp.stack([jnp.stack(row) for row in generator]), output


def matrix_exponential(
    upper: Float[Array, "order order_plus_2 *batch"], ramp: Float[Array, "*batch"]
) -> Float[Array, "order_plus_1 order_plus_2 *batch"]:
    """Return the matrix exponential of [[A, B, 0], [0, 0, r], [0, 0, 0]], without its last row (0, 0, 1).

    The exponential is computed by scaling, Taylor series and squaring, and is accurate to rounding for norms
    up to 64. The matrix axes come first: every matrix product then takes a few vector operations for the
    whole batch. A library call for every lane would take longer than the simulation of a contact.

    Args:
        upper: First rows (A, B, 0) of the matrix.
        ramp: Element r of the matrix.
    """
    order, size = upper.shape[:2]
    units = jnp.eye(size, dtype=upper.dtype).reshape(size, size, *[1] * ramp.ndim)
    scaled = upper / 2**EXPONENTIAL_SQUARINGS

    def ramp_row(ramp):
        return units[order] + units[order + 1] * ramp[None]

    def product(left, right, ramp):
        """Return left @ right without its last rows; `right` lacks the rows (0, 1, `ramp`) and (0, 0, 1)."""
        total = _matrix_product(left[:, :order], right)
        driven = left[:, order, None] * ramp_row(ramp)[None]
        return total + driven + left[:, order + 1, None] * units[None, order + 1]

    # The loops are not unrolled, because XLA would fuse the products and compute each product repeatedly.
    def horner(step, carry):
        terms = jnp.asarray(EXPONENTIAL_TERMS - step, ramp.dtype)
        return units[:order] + product(scaled, *carry) / terms, ramp / 2**EXPONENTIAL_SQUARINGS / terms

    def square(_, carry):
        total, ramp = carry
        return product(total, total, ramp), 2 * ramp

    carry = jnp.broadcast_to(units[:order], upper.shape), jnp.zeros_like(ramp)
    carry = jax.lax.fori_loop(0, EXPONENTIAL_TERMS, horner, carry)
    total, ramp = jax.lax.fori_loop(0, EXPONENTIAL_SQUARINGS, square, carry)
    return jnp.concatenate([total, ramp_row(ramp)[None]])


def advance_state(transition: Array, state: SimulatorState, start: Array, end: Array) -> SimulatorState:
    """Return the motion simulator's state one control period later."""
    return tuple(apply_row(transition[i], state, start, end) for i in range(len(state)))


def apply_row(row: Array, state: SimulatorState, start: Array, end: Array) -> Array:
    """Multiply a row of `Propagation` by (state, command at the interval's start, command at its end)."""
    total = row[-2] * start + row[-1] * end
    for i, component in enumerate(state):
        total = total + row[i] * component
    return total


def read_measured_position(
    plant: Propagation, state: SimulatorState, start: Array, end: Array
) -> Array | None:
    """Return the position that the position sensor samples [m]; None if this sensor is not simulated."""
    return None if plant.measured_position is None else apply_row(plant.measured_position, state, start, end)


def rate_row(
    row: Float[Array, "columns *batch"],
    denominator: Float[Array, "order_plus_1 *batch"],
    control_period: Float[Array, "*batch"],
) -> Float[Array, "columns *batch"]:
    """Return the row of `Propagation` for the time derivative, per second, of the quantity of `row`.

    The formula follows from dE(s)/ds = E(s) G, where G = [[A, B, 0], [0, 0, 1], [0, 0, 0]] (`discretise`).
    """
    *state, start, end = row
    zero = jnp.zeros_like(start)
    growth = start + end
    if state:
        system = _last_row(denominator, control_period)
        rates = [below + state[-1] * a for below, a in zip([zero, *state[:-1]], system, strict=True)]
        driven = state[-1]
    else:
        rates, driven = [], zero
    return jnp.stack([*rates, driven - growth, growth]) / control_period[None]


def steady_state(plant: Propagation, command: Array, step: Array) -> SimulatorState:
    """Return the motion simulator's steady state if `command` [m] grows by `step` [m] in each period."""
    order = plant.steady_command.shape[0]
    return tuple(plant.steady_command[i] * command + plant.steady_velocity[i] * step for i in range(order))


def _ideal_propagation(control_period, force_fraction, position_fraction, hold, ends):
    """Return the `Propagation` of an ideal motion simulator, whose position equals its command."""

    def position(fraction):
        return jnp.stack([1 - fraction, fraction])

    slope = jnp.stack([-1 / control_period, 1 / control_period])
    velocity = slope if hold == "linear" else jnp.zeros_like(slope)
    zero = jnp.zeros_like(control_period)
    empty = jnp.zeros((0, *control_period.shape), control_period.dtype)
    return Propagation(
        transition=jnp.zeros((0, 2, *control_period.shape), control_period.dtype),
        position=position(force_fraction),
        velocity=velocity,
        measured_position=None if position_fraction is None else position(position_fraction),
        start=(position(zero), velocity) if ends else None,
        end=(position(zero + 1), velocity) if ends else None,
        steady_command=empty,
        steady_velocity=empty,
    )


def _companion(numerator, denominator, control_period):
    """Return the companion matrix A as a list of rows, and the output weights; time is in periods."""
    order = denominator.shape[0] - 1
    powers = [control_period**i for i in range(order + 1)]
    zeros, ones = jnp.zeros_like(control_period), jnp.ones_like(control_period)
    system = [[ones if j == i + 1 else zeros for j in range(order)] for i in range(order - 1)]
    system.append(_last_row(denominator, control_period))
    output = [numerator[order - 1 - i] * powers[order - i] / denominator[0] for i in range(order)]
    return system, output


def _last_row(denominator, control_period):
    """Return the last row of the companion matrix: negated denominator coefficients, with time in periods."""
    order = denominator.shape[0] - 1
    return [-denominator[order - i] * control_period ** (order - i) / denominator[0] for i in range(order)]


def _steady_velocity(system, transition, steady_command, hold):
    """Return a transfer function's steady state under a command that increases by 1 in each period."""
    order = steady_command.shape[0]
    if hold == "linear":
        # The steady response to a ramp u is w = u/a_n - a_{n-1} u'/a_n^2 and w' = u'/a_n.
        constant = -system[order - 1][0]
        linear = -system[order - 1][1] if order > 1 else jnp.ones_like(constant)
        steady = jnp.zeros_like(steady_command).at[0].set(-linear / constant**2)
        return steady.at[1].set(1 / constant) if order > 1 else steady
    # For a command with steps at the ticks, insert z(k) = alpha u(k+1) + beta step into
    # z(k+1) = Ad z(k) + Bd u(k+1) and solve for beta.
    identity = jnp.eye(order, dtype=steady_command.dtype)
    batch_first = jnp.moveaxis(transition[:, :order], (0, 1), (-2, -1))
    right = jnp.moveaxis(steady_command, 0, -1)[..., None]
    solved = jnp.linalg.solve(
        identity.reshape(*[1] * (batch_first.ndim - 2), order, order) - batch_first, right
    )
    return -jnp.moveaxis(solved[..., 0], -1, 0)


def _weighted_sum(weights, rows):
    """Return the sum of row vectors (columns, *batch), each multiplied by its weight."""
    total = weights[0][None] * rows[0]
    for weight, row in zip(weights[1:], rows[1:], strict=True):
        total = total + weight[None] * row
    return total


def _matrix_product(left, right):
    total = left[:, 0, None] * right[None, 0]
    for k in range(1, left.shape[0]):
        total = total + left[:, k, None] * right[None, k]
    return total
