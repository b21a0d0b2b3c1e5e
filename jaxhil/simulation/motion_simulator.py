"""The motion simulator: x_a = G(s) e^{-s tau_p} x_d, propagated exactly from tick to tick.

A transport delay commutes with a linear system. So G is driven by the *undelayed* command, whose corners
are the ticks themselves; x_a at any time t is its response at t - tau_p, and a sensor with delay tau_f sees
the response at t - tau_p - tau_f. Every delay becomes one number: how long ago the response is read. Between
ticks (sampling interval k spans t_k to t_{k+1}) the command is a straight line, and the response at the
fraction s of a interval is a fixed row of numbers times (state, command at the interval's start, command at
its end): the matrix exponential of the system augmented by its input. Nothing is interpolated and nothing is
rounded to ticks.

Time inside is in control periods. States are w, w', ..., w^(n-1) with den(p) w = u, y = num(p) w.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

SQUARINGS, TERMS = 6, 13

# One array of the batch shape per component: a stacked state would be taken apart at every tick.
State = tuple[Array, ...]


class Delay(NamedTuple):
    """A delay of r control periods, as whole sampling intervals to look back and a place within one."""

    intervals: Int[Array, "*batch"]  # to look back from the newest one, which is interval n - 1 at tick n
    # place in (0, 1] within it: a reading at a tick takes the value just before the tick acts
    fraction: Float[Array, "*batch"]


class Propagation(NamedTuple):
    """Exact discrete motion simulator; rows act on (state, command at start, command at end)."""

    transition: Float[Array, "order columns *batch"]  # rows of the state one period later
    position: Float[Array, "columns *batch"]  # row at the force sensor's place in the sampling interval [m]
    velocity: Float[Array, "columns *batch"]  # row there [m/s]
    # row at the position sensor's place [m]; None where nobody reads it
    measured_position: Float[Array, "columns *batch"] | None
    # rows of position and velocity at the interval's start, from within, where asked for
    start: tuple[Array, Array] | None
    end: tuple[Array, Array] | None  # at its end, likewise
    steady_command: Float[Array, "order *batch"]  # state of a uniform motion, per command now
    steady_velocity: Float[Array, "order *batch"]  # state of a uniform motion, per its growth in a period


def split_delay(delay: Float[Array, "*batch"], control_period: Float[Array, "*batch"]) -> Delay:
    """Whole intervals and fraction of `delay` [s]; whole multiples of the period are met to 1e-9."""
    periods = delay / control_period
    whole = jax.lax.stop_gradient(jnp.floor(periods + 1e-9))
    return Delay(whole.astype(jnp.int32), 1 - (periods - whole))


def propagation(
    numerator: Float[Array, "order *batch"],
    denominator: Float[Array, "order_plus_1 *batch"],
    control_period: Float[Array, "*batch"],
    force_fraction: Float[Array, "*batch"],
    position_fraction: Float[Array, "*batch"] | None,
    hold: str,
    ends: bool = False,
) -> Propagation:
    """Exact discretisation of num(s)/den(s) (descending powers, strictly proper; order 0 is ideal).

    With z' = A z + B u in periods, z(s) = E(s) (z, u(0), u(1) - u(0)) where E(s) is the exponential of
    s [[A, B, 0], [0, 0, 1], [0, 0, 0]] (Van Loan 1978). Gradients pass to every parameter.
    """
    order = denominator.shape[0] - 1
    if order == 0:
        return _ideal(control_period, force_fraction, position_fraction, hold, ends)
    system, output = _companion(numerator, denominator, control_period)
    zero, one = jnp.zeros_like(control_period), jnp.ones_like(control_period)
    generator, _ = generator_rows(numerator, denominator, control_period)
    places = [one, force_fraction]
    if ends:
        places.append(zero)
    if position_fraction is not None:
        places.append(position_fraction)
    fractions = jnp.stack(places)
    # Axes: row, column, place in the interval, batch.
    rows = exponential(generator[:, :, None] * fractions[None, None], fractions)
    # Columns for (z, u(0), u(1)) instead of (z, u(0), u(1) - u(0)).
    rows = rows.at[:, order].add(-rows[:, order + 1])
    state = rows[:order]

    def motion(place):
        place = rows[:, :, place]
        rates = [*place[1:order], _combine(system[order - 1], place[:order]) + place[order]]
        return _combine(output, place[:order]), _combine(output, rates) / control_period[None]

    position, velocity = motion(1)
    steady_command = jnp.stack([-1 / system[order - 1][0]] + [zero] * (order - 1))
    return Propagation(
        transition=state[:, :, 0],
        position=position,
        velocity=velocity,
        measured_position=None if position_fraction is None else _combine(output, state[:, :, -1]),
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
    """Return the rows of (A, B, 0), with time in periods, and the weights with which the position is made of
    the state; the order is at least 1."""
    order = denominator.shape[0] - 1
    system, output = _companion(numerator, denominator, control_period)
    zero, one = jnp.zeros_like(control_period), jnp.ones_like(control_period)
    generator = [[*row, zero, zero] for row in system]
    generator[order - 1][order] = one
    return jnp.stack([jnp.stack(row) for row in generator]), output


def exponential(
    upper: Float[Array, "order order_plus_2 *batch"], ramp: Float[Array, "*batch"]
) -> Float[Array, "order_plus_1 order_plus_2 *batch"]:
    """First order + 1 rows of the matrix exponential of [[A, B, 0], [0, 0, r], [0, 0, 0]], whose first rows
    are `upper` and whose r is `ramp`: by scaling, Taylor and squaring, to rounding for norms up to 64.

    Its last rows are (0, 1, r) and (0, 0, 1): they are not worked out. Matrix axes come first, so that every
    product is a few vector operations over the batch; a library call per lane costs more than the whole
    contact.
    """
    order, size = upper.shape[:2]
    units = jnp.eye(size, dtype=upper.dtype).reshape(size, size, *[1] * ramp.ndim)
    scaled = upper / 2**SQUARINGS

    def ramp_row(ramp):
        return units[order] + units[order + 1] * ramp[None]

    def product(left, right, ramp):
        """Upper rows of a product of two such matrices, or their powers."""
        total = _product(left[:, :order], right)
        driven = left[:, order, None] * ramp_row(ramp)[None]
        return total + driven + left[:, order + 1, None] * units[None, order + 1]

    # Loops, not unrolled: fused into one another the products would be computed over and over.
    def horner(step, carry):
        terms = jnp.asarray(TERMS - step, ramp.dtype)
        return units[:order] + product(scaled, *carry) / terms, ramp / 2**SQUARINGS / terms

    def square(_, carry):
        total, ramp = carry
        return product(total, total, ramp), 2 * ramp

    carry = jnp.broadcast_to(units[:order], upper.shape), jnp.zeros_like(ramp)
    carry = jax.lax.fori_loop(0, TERMS, horner, carry)
    total, ramp = jax.lax.fori_loop(0, SQUARINGS, square, carry)
    return jnp.concatenate([total, ramp_row(ramp)[None]])


def advance(transition: Array, state: State, start: Array, end: Array) -> State:
    """The state one period later."""
    return tuple(read(transition[i], state, start, end) for i in range(len(state)))


def read(row: Array, state: State, start: Array, end: Array) -> Array:
    """One row times (state, command at the interval's start, command at its end)."""
    total = row[-2] * start + row[-1] * end
    for i, component in enumerate(state):
        total = total + row[i] * component
    return total


def read_measured(plant: Propagation, state: State, start: Array, end: Array) -> Array | None:
    """Position [m] at its sensor's place in the sampling interval; None where nobody reads it."""
    return None if plant.measured_position is None else read(plant.measured_position, state, start, end)


def rate_row(
    row: Float[Array, "columns *batch"],
    denominator: Float[Array, "order_plus_1 *batch"],
    control_period: Float[Array, "*batch"],
) -> Float[Array, "columns *batch"]:
    """The row of the rate [1/s] of what a row gives at a place within the sampling interval.

    There d/ds E(s) = E(s) G, G the generator of `propagation`.
    """
    *state, start, end = row
    zero = jnp.zeros_like(start)
    level = start + end
    if state:
        system = _last_row(denominator, control_period)
        rates = [below + state[-1] * a for below, a in zip([zero, *state[:-1]], system, strict=True)]
        driven = state[-1]
    else:
        rates, driven = [], zero
    return jnp.stack([*rates, driven - level, level]) / control_period[None]


def steady_state(plant: Propagation, command: Array, step: Array) -> State:
    """State at a tick of a uniform motion: drive input `command` now, growing by `step` per period."""
    order = plant.steady_command.shape[0]
    return tuple(plant.steady_command[i] * command + plant.steady_velocity[i] * step for i in range(order))


def _ideal(control_period, force_fraction, position_fraction, hold, ends):
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
    """Rows of A (the last carries the coefficients) and output weights, time in periods."""
    order = denominator.shape[0] - 1
    powers = [control_period**i for i in range(order + 1)]
    zero, one = jnp.zeros_like(control_period), jnp.ones_like(control_period)
    system = [[one if j == i + 1 else zero for j in range(order)] for i in range(order - 1)]
    system.append(_last_row(denominator, control_period))
    output = [numerator[order - 1 - i] * powers[order - i] / denominator[0] for i in range(order)]
    return system, output


def _last_row(denominator, control_period):
    order = denominator.shape[0] - 1
    return [-denominator[order - i] * control_period ** (order - i) / denominator[0] for i in range(order)]


def _steady_velocity(system, transition, steady_command, hold):
    order = steady_command.shape[0]
    if hold == "linear":
        # Ramp response: w = u/a_n - a_{n-1} u'/a_n^2 and w' = u'/a_n.
        constant = -system[order - 1][0]
        linear = -system[order - 1][1] if order > 1 else jnp.ones_like(constant)
        steady = jnp.zeros_like(steady_command).at[0].set(-linear / constant**2)
        return steady.at[1].set(1 / constant) if order > 1 else steady
    # Staircase: z(k+1) = Ad z(k) + Bd u(k+1) with z(k) = alpha u(k+1) + beta step.
    identity = jnp.eye(order, dtype=steady_command.dtype)
    batch_first = jnp.moveaxis(transition[:, :order], (0, 1), (-2, -1))
    right = jnp.moveaxis(steady_command, 0, -1)[..., None]
    solved = jnp.linalg.solve(
        identity.reshape(*[1] * (batch_first.ndim - 2), order, order) - batch_first, right
    )
    return -jnp.moveaxis(solved[..., 0], -1, 0)


def _combine(weights, rows):
    """sum_i weights_i rows_i, rows (columns, *batch)."""
    total = weights[0][None] * rows[0]
    for weight, row in zip(weights[1:], rows[1:], strict=True):
        total = total + weight[None] * row
    return total


def _product(left, right):
    total = left[:, 0, None] * right[None, 0]
    for k in range(1, left.shape[0]):
        total = total + left[:, k, None] * right[None, k]
    return total
