"""Motion simulator x_a = G(s) e^{-s tau_p} x_d, discretised exactly from tick to tick.

A transport delay commutes with a linear system. G is therefore driven by the undelayed command, whose corners
are at the ticks. x_a at time t is its response at t - tau_p, and a sensor with delay tau_f reads the response
at t - tau_p - tau_f. Every delay is thus the age of the response that is read. In sampling interval k, from
t_k to t_{k+1}, the command is a straight line. The response at the fraction s of an interval is a constant
row times (state, command at the interval's start, command at its end), from the matrix exponential of the
system augmented by its input. There is no interpolation and no rounding to ticks.

Time is in control periods here. States are w, w', ..., w^(n-1) with den(p) w = u, y = num(p) w.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

EXPONENTIAL_SQUARINGS, EXPONENTIAL_TERMS = 6, 13  # of the matrix exponential

# One array of the batch shape per component: a stacked state would have to be split at every tick.
SimulatorState = tuple[Array, ...]


class SplitDelay(NamedTuple):
    """Delay of r control periods, as whole sampling intervals to look back and a position within one."""

    intervals: Int[Array, "*batch"]  # to look back from the newest one, which is interval n - 1 at tick n
    # position in (0, 1] within it: a reading at a tick has the value just before the tick
    fraction: Float[Array, "*batch"]


class Propagation(NamedTuple):
    """Exact discrete motion simulator; rows act on (state, command at start, command at end)."""

    transition: Float[Array, "order columns *batch"]  # rows of the state one period later
    position: Float[Array, "columns *batch"]  # row at the force sensor's sampling instant [m]
    velocity: Float[Array, "columns *batch"]  # row there [m/s]
    # row at the position sensor's sampling instant [m]; None if unused
    measured_position: Float[Array, "columns *batch"] | None
    # rows of position and velocity at the interval's start (right limit); None unless requested
    start: tuple[Array, Array] | None
    end: tuple[Array, Array] | None  # rows at its end (left limit); None unless requested
    steady_command: Float[Array, "order *batch"]  # steady state per unit of the command
    steady_velocity: Float[Array, "order *batch"]  # steady state per growth of the command in a period


def split_delay(delay: Float[Array, "*batch"], control_period: Float[Array, "*batch"]) -> SplitDelay:
    """Return whole intervals and fraction of `delay` [s]; multiples of the period are recognised to 1e-9."""
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
    """Discretise num(s)/den(s) exactly (descending powers, strictly proper; order 0 is ideal).

    With z' = A z + B u in periods, z(s) = E(s) (z, u(0), u(1) - u(0)), where E(s) is the exponential of s
    [[A, B, 0], [0, 0, 1], [0, 0, 0]] (Van Loan 1978). Derivatives pass to every parameter. `ends` requests
    the rows at the interval's start and end.
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
    # This changes columns for (z, u(0), u(1) - u(0)) into columns for (z, u(0), u(1)).
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
    """Return the rows of (A, B, 0), with time in periods, and the output weights of the state.

    The position is the sum of weights times states; the order is at least 1.
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
    """Return the first order + 1 rows of the matrix exponential of [[A, B, 0], [0, 0, r], [0, 0, 0]].

    `upper` are its first rows (A, B, 0), and `ramp` is r. Scaling, Taylor series and squaring give rounding
    accuracy for norms up to 64. The last rows, (0, 1, r) and (0, 0, 1), are not computed. Matrix axes come
    first, so that every product is a few vector operations over the batch; a library call per lane costs more
    than the whole contact.
    """
    order, size = upper.shape[:2]
    units = jnp.eye(size, dtype=upper.dtype).reshape(size, size, *[1] * ramp.ndim)
    scaled = upper / 2**EXPONENTIAL_SQUARINGS

    def ramp_row(ramp):
        """Return the row (0, 1, r)."""
        return units[order] + units[order + 1] * ramp[None]

    def product(left, right, ramp):
        """Return the upper rows of a product of two such matrices, or of their powers."""
        total = _matrix_product(left[:, :order], right)
        driven = left[:, order, None] * ramp_row(ramp)[None]
        return total + driven + left[:, order + 1, None] * units[None, order + 1]

    # The loops are not unrolled: the compiler would fuse the products and compute them repeatedly.
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
    """Return the state one period later."""
    return tuple(apply_row(transition[i], state, start, end) for i in range(len(state)))


def apply_row(row: Array, state: SimulatorState, start: Array, end: Array) -> Array:
    """Return a row times (state, command at the interval's start, command at its end)."""
    total = row[-2] * start + row[-1] * end
    for i, component in enumerate(state):
        total = total + row[i] * component
    return total


def read_measured_position(
    plant: Propagation, state: SimulatorState, start: Array, end: Array
) -> Array | None:
    """Return the position [m] at its sensor's sampling instant; None if unused."""
    return None if plant.measured_position is None else apply_row(plant.measured_position, state, start, end)


def rate_row(
    row: Float[Array, "columns *batch"],
    denominator: Float[Array, "order_plus_1 *batch"],
    control_period: Float[Array, "*batch"],
) -> Float[Array, "columns *batch"]:
    """Return the row of the time derivative [1/s] of a row's result within the sampling interval.

    It uses d/ds E(s) = E(s) G, where G is the generator of `discretise`.
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
    """Return the state in uniform motion: drive input `command`, which grows by `step` per period."""
    order = plant.steady_command.shape[0]
    return tuple(plant.steady_command[i] * command + plant.steady_velocity[i] * step for i in range(order))


def _ideal_propagation(control_period, force_fraction, position_fraction, hold, ends):
    """Return the propagation of an ideal motion simulator, which follows its command exactly."""

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
    """Return rows of A (the last has the coefficients) and output weights, with time in periods."""
    order = denominator.shape[0] - 1
    powers = [control_period**i for i in range(order + 1)]
    zeros, ones = jnp.zeros_like(control_period), jnp.ones_like(control_period)
    system = [[ones if j == i + 1 else zeros for j in range(order)] for i in range(order - 1)]
    system.append(_last_row(denominator, control_period))
    output = [numerator[order - 1 - i] * powers[order - i] / denominator[0] for i in range(order)]
    return system, output


def _last_row(denominator, control_period):
    """Return the last row of A."""
    order = denominator.shape[0] - 1
    return [-denominator[order - i] * control_period ** (order - i) / denominator[0] for i in range(order)]


def _steady_velocity(system, transition, steady_command, hold):
    """Return the steady state per growth of the command in a period."""
    order = steady_command.shape[0]
    if hold == "linear":
        # The ramp response is w = u/a_n - a_{n-1} u'/a_n^2 and w' = u'/a_n.
        constant = -system[order - 1][0]
        linear = -system[order - 1][1] if order > 1 else jnp.ones_like(constant)
        steady = jnp.zeros_like(steady_command).at[0].set(-linear / constant**2)
        return steady.at[1].set(1 / constant) if order > 1 else steady
    # For a staircase, z(k+1) = Ad z(k) + Bd u(k+1) with z(k) = alpha u(k+1) + beta step.
    identity = jnp.eye(order, dtype=steady_command.dtype)
    batch_first = jnp.moveaxis(transition[:, :order], (0, 1), (-2, -1))
    right = jnp.moveaxis(steady_command, 0, -1)[..., None]
    solved = jnp.linalg.solve(
        identity.reshape(*[1] * (batch_first.ndim - 2), order, order) - batch_first, right
    )
    return -jnp.moveaxis(solved[..., 0], -1, 0)


def _weighted_sum(weights, rows):
    """Return sum_i weights_i rows_i; rows are (columns, *batch)."""
    total = weights[0][None] * rows[0]
    for weight, row in zip(weights[1:], rows[1:], strict=True):
        total = total + weight[None] * row
    return total


def _matrix_product(left, right):
    """Return the matrix product."""
    total = left[:, 0, None] * right[None, 0]
    for k in range(1, left.shape[0]):
        total = total + left[:, k, None] * right[None, k]
    return total
