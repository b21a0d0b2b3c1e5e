"""Real contact in one sampling interval, from the exact motion: sensor lag, work, peak force, duration.

Each cell (`jaxhil.simulation.cells`) is divided into sections of monotone motion, at the instants at which
the motion reverses. Each section is divided into spans at the surface, at each change of the contact law's
slope, and at each zero of the force. In each span the force is a smooth function, which Gauss-Legendre
quadrature integrates. All cells are computed in parallel. Only the state of a contact law with memory is
passed from cell to cell.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxhil.contact.laws import ContactLaw, ContactParameters, compute_two_sided_force
from jaxhil.mechanism.sensor_filter import FilterModes
from jaxhil.simulation.cells import Cells, bound_time_constant
from jaxhil.simulation.monotone_sections import (
    SHORT_CELL_DEGREE,
    build_cell_motion,
    horner,
    position_at,
    split_at,
    split_at_reversals,
    velocity_at,
)
from jaxhil.simulation.roots import find_positive_part, find_sign_change


class QuadratureRule(NamedTuple):
    """Gauss-Legendre quadrature on (0, 1)."""

    nodes: np.ndarray  # arguments in (0, 1)
    weights: np.ndarray  # weights of the function values at the nodes

    def nodes_and_ends(self, dtype: Any) -> np.ndarray:
        """Return the nodes, with an additional point just above 0 and one just below 1.

        If a force jumps at 0 or 1, its values at these two points are its limits from inside the interval.
        """
        inside = np.finfo(dtype).eps ** 0.5
        return np.concatenate([[inside], self.nodes, [1 - inside]]).astype(dtype)


def _build_quadrature(number: int) -> QuadratureRule:
    """Return a rule with `number` nodes, accurate also for fractional powers of x and 1 - x on (0, 1)."""
    nodes, weights = np.polynomial.legendre.leggauss(number)
    unit = (nodes + 1) / 2
    # Near the ends, the force may be any power of the penetration. The substitution p -> 3 p^2 - 2 p^3, whose
    # slope is 0 at both ends, converts these powers to smooth functions.
    return QuadratureRule(unit**2 * (3 - 2 * unit), weights * 3 * unit * (1 - unit))


# Key: whether the cells are short, with a series of low degree.
QUADRATURE_RULES = {True: _build_quadrature(12), False: _build_quadrature(16)}
_RESULT_COUNT = 7  # number of results that `_sum_surfaces` returns
_SUMMED_AXES = (0, 1, 2, 3)  # array axes: nodes of a span, spans of a section, sections of a cell, cells


class CellContact(NamedTuple):
    """Real contact in a sampling interval: sensor lag, work, peak force, duration, state of the law."""

    reading: Float[Array, "*batch"]  # output of the force sensor's lag at the sampling instant [N]
    lagged: Array  # state of the force sensor's lag or filter at the interval's end [N]
    work: tuple[Array, Array]  # work done on the mechanism and work returned by it [J]
    peak: Float[Array, "*batch"]  # largest |force| [N]
    contact_time: tuple[Array, Array]  # duration of contact, before and after the sampling instant [periods]
    at_sample: tuple[Any, ...]  # state of the contact law at the sampling instant
    at_end: tuple[Any, ...]  # state of the contact law at the interval's end


class ContactSurfaces(NamedTuple):
    """Contact law and its parameters at one surface or two opposite surfaces."""

    law: ContactLaw  # contact law
    parameters: ContactParameters  # parameters of the contact law
    clearance: Array | None  # distance between two surfaces [m]; None for one surface


# Arrays with one value per lane are broadcast against arrays with a value per cell, node and span.
@jax.numpy_rank_promotion("allow")
def contact_in_cells(
    touch: ContactSurfaces,
    state: tuple[Any, ...],
    cells: Cells,
    series: Float[Array, "powers cells *batch"],
    period: Float[Array, "*batch"],
    lagged: Array,
    time_constant: Float[Array, "*batch"] | None,
    sensor_filter: tuple[FilterModes, Array] | None = None,
) -> CellContact:
    """Compute the real contact in a sampling interval.

    Args:
        touch: Contact law and surfaces.
        state: State of the contact law at the interval's start.
        cells: Cells of the interval, from `build_cells`.
        series: Power series of the position [m] in each cell, from `power_series`.
        period: Control period [s].
        lagged: State of the force sensor's lag or filter at the interval's start [N].
        time_constant: Time constant of the force sensor's lag [s]; None for a sensor without lag.
        sensor_filter: Modes and cutoff frequency [rad/s] of the force sensor's filter; None without a filter.
    """
    rates = _sensor_rates(cells, period, time_constant, sensor_filter)

    # Each branch returns distinct arrays: without optimisation, XLA confuses results that share an array.
    def touches(state):
        """Compute the contact, and the law's states at the sampling instant and at the interval's end."""
        sections = split_at_reversals(build_cell_motion(series, cells.length))
        states, at_sample, at_end = _compute_law_states(touch, state, sections, period)
        parts = [
            _compute_side_contact(touch, states, sections, side, period, rates) for side in _sides(touch)
        ]
        return _sum_surfaces(parts), jax.tree.map(lambda *leaves: jnp.stack(leaves), at_sample, at_end)

    def free(state):
        """Return what `touches` returns without contact: zeros, and the contact law's initial states."""
        fresh = touch.law.init(jnp.zeros_like(period))
        count = _RESULT_COUNT if sensor_filter is None else _RESULT_COUNT - 2 + 2 * len(lagged)
        numbers = jnp.zeros((count, *period.shape), lagged.dtype)
        return numbers, jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), fresh)

    # In most intervals no lane is in contact, so that the computation can be skipped.
    numbers, states = lax.cond(_may_touch(touch, cells, series), touches, free, state)
    *readings, done, returned, before, after, peak = numbers
    sample, end = _decay_reading(lagged, rates, readings)
    at_sample, at_end = (jax.tree.map(lambda leaf, i=i: leaf[i], states) for i in (0, 1))
    return CellContact(sample, end, (done, returned), peak, (before, after), at_sample, at_end)


@jax.numpy_rank_promotion("allow")
def compute_jump_work(
    touch: ContactSurfaces,
    state: tuple[Any, ...],
    before: Float[Array, "*batch"],
    now: Float[Array, "*batch"],
) -> tuple[Array, Array]:
    """Return the work done on the mechanism and the work returned by it in a jump of the position [J].

    `before` and `now` are the positions before and after the jump [m].
    """
    ones = jnp.ones_like(before)
    path = build_cell_motion(jnp.stack([before, now - before])[:, None], ones[None])
    sections = split_at(path, jnp.stack([0 * ones, ones])[:, None])
    states = jax.tree.map(lambda leaf: leaf[None, None], state)
    parts = [
        _compute_side_contact(touch, states, sections, side, ones, None, still=True) for side in _sides(touch)
    ]
    done, returned = (sum((part.work[i] for part in parts), 0 * ones) for i in (0, 1))
    return done, returned


class _SurfaceContribution(NamedTuple):
    """Results of the contact at one surface in a sampling interval."""

    # contribution to the lag's output, or to each component of the filter's state, at the sampling instant
    # and at the interval's end [N]
    readings: tuple[Array, ...]
    work: tuple[Array, Array]  # work done on the mechanism and work returned by it [J]
    peak: Array  # largest |force| [N]
    contact_time: tuple[Array, Array]  # duration of contact, before and after the sampling instant [periods]


def _sum_surfaces(parts: list[_SurfaceContribution]) -> Array:
    """Combine the contributions of all surfaces into one array of the shape (results, *batch).

    The last result is the largest peak force; all others are sums.
    """
    sums = [jnp.stack([*part.readings, *part.work, *part.contact_time]) for part in parts]
    peak = functools.reduce(jnp.maximum, [part.peak for part in parts])
    return jnp.concatenate([functools.reduce(jnp.add, sums), peak[None]])


def _sides(touch):
    return (1,) if touch.clearance is None else (1, -1)


def _compute_law_states(touch, state, sections, period):
    """Return the contact law's states at the sections' starts, the sampling instant and the interval's end.

    In a section of a cell, the motion has one direction. The states at the starts of the sections have the
    shape (sections of a cell, cells, *batch).
    """
    cells = sections.path.length.shape[0]
    if not touch.law.has_memory:
        return state, state, state
    position = position_at(sections.path, sections.high)
    speed = velocity_at(sections.path, sections.high) / period

    def through(state, motion):
        before = []
        for position, speed in zip(*motion, strict=True):
            before.append(state)
            _, state = compute_two_sided_force(
                touch.law, touch.parameters, state, position, speed, touch.clearance
            )
        return state, jax.tree.map(lambda *leaves: jnp.stack(leaves), *before)

    at_end, states = lax.scan(through, state, (jnp.moveaxis(position, 1, 0), jnp.moveaxis(speed, 1, 0)))
    at_sample = jax.tree.map(lambda leaf: leaf[cells // 2, 0], states)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), states), at_sample, at_end


class _SensorRates(NamedTuple):
    """Rate and durations of the decay of the force sensor's lag or filter in a sampling interval."""

    # durations of the parts before and after the sampling instant [time constants of the lag]
    part_durations: tuple[Array, Array]
    rate: Array  # control period, divided by the lag's time constant [1]
    remaining: Array  # time from a cell's end to the end of its part [periods]
    modes: FilterModes | None  # modes of a filter, whose rates are relative to `rate`; None for a lag


def _sensor_rates(cells, period, time_constant, sensor_filter=None) -> _SensorRates | None:
    """Return the `_SensorRates` of the force sensor's lag or filter; None for a sensor without either."""
    if time_constant is None:
        return None
    modes = None
    if sensor_filter is None:
        rate = period / bound_time_constant(time_constant, period)
    else:
        modes, cutoff = sensor_filter
        rate = cutoff * period
    half = cells.length.shape[0] // 2
    first = cells.remaining[0] + cells.length[0]
    second = cells.remaining[half] + cells.length[half]
    return _SensorRates((first * rate, second * rate), rate, cells.remaining, modes)


def _decay_reading(lagged, rates, readings):
    """Return the sensor's output at the sampling instant, and its state at the interval's end [N]."""
    if rates is None:
        return lagged, lagged
    if rates.modes is not None:
        return _decay_modes(lagged, rates, readings)
    sample = lagged * jnp.exp(-rates.part_durations[0]) + readings[0]
    return sample, sample * jnp.exp(-rates.part_durations[1]) + readings[1]


def _decay_modes(state, rates, readings):
    """Return the filter's output at the sampling instant, and its state at the interval's end [N]."""
    half, states = len(readings) // 2, []
    for duration, added in zip(rates.part_durations, (readings[:half], readings[half:]), strict=True):
        decayed = []
        for rate, real, imaginary in zip(rates.modes.rates, state[::2], state[1::2], strict=True):
            c, s = _decay_factors(rate, duration)
            decayed += [real * c - imaginary * s, real * s + imaginary * c]
        state = [old + new for old, new in zip(decayed, added, strict=True)]
        states.append(state)
    sample, end = states
    terms = [
        weight.real * real - weight.imag * imaginary
        for weight, real, imaginary in zip(rates.modes.weights, sample[::2], sample[1::2], strict=True)
    ]
    return sum(terms[1:], terms[0]), jnp.stack(end)


def _decay_factors(rate: complex, duration: Array) -> tuple[Array, Array]:
    """Return real and imaginary part of exp(-rate duration)."""
    decay = jnp.exp(-rate.real * duration)
    return decay * jnp.cos(rate.imag * duration), -decay * jnp.sin(rate.imag * duration)


def _may_touch(touch, cells, series):
    """Return whether contact is possible in any lane of the batch, from position bounds in each cell."""
    reach = horner(jnp.abs(series.at[0].set(0)), cells.length)
    may = series[0] + reach > 0
    if touch.clearance is not None:
        may = may | (series[0] - reach < -touch.clearance)
    return jnp.any(may | ~jnp.isfinite(reach))


def _compute_side_contact(touch, states, sections, side, period, rates, still=False) -> _SurfaceContribution:
    """Compute the contact at the surface on one side; if `still`, pass zero velocity to the contact law."""
    law, parameters, path = touch.law, touch.parameters, sections.path
    inward = side * sections.direction
    surface = 0.0 if side > 0 else touch.clearance

    def depth(path, s):
        return side * position_at(path, s) - surface

    def rate(path, s):
        if still:
            return jnp.zeros_like(s)
        speed = side * velocity_at(path, s) / period
        if not law.has_reversal_jump:
            return speed
        # The force jumps with the sign of the velocity. Near a reversal, rounding can change this sign, so
        # the sign of the section is used.
        return jnp.where(speed * inward > 0, speed, inward * jnp.finfo(speed.dtype).tiny)

    def height(data, s):
        return depth(data[0], s) - data[1]

    def separation(data, s):
        path, parameters, states = data
        return law.separation_function(parameters, states, depth(path, s), rate(path, s))

    def force(s):
        return law.step(parameters, states, depth(path, s), rate(path, s))[0]

    breakpoints = [
        jnp.broadcast_to(breakpoint, sections.low.shape) for breakpoint in law.breakpoints(parameters, states)
    ]
    levels = jnp.sort(jnp.stack([jnp.zeros_like(sections.low), *breakpoints]), axis=0)
    low, high = (jnp.broadcast_to(onset_force, levels.shape) for onset_force in (sections.low, sections.high))
    inner, outer = jnp.where(inward > 0, low, high), jnp.where(inward > 0, high, low)
    at_level = find_sign_change(height, (path, levels), low, high, inner, outer)
    beyond = jnp.concatenate([at_level[1:], outer[:1]])
    spans = jnp.minimum(at_level, beyond), jnp.maximum(at_level, beyond)
    begin, end = find_positive_part(separation, (path, parameters, states), *spans)
    width = end - begin

    shape = (-1, *[1] * width.ndim)
    rule = QUADRATURE_RULES[len(path.position) <= SHORT_CELL_DEGREE + 1]
    ends_and_nodes = rule.nodes_and_ends(width.dtype)
    arguments = begin + width * ends_and_nodes.reshape(shape)
    forces = force(arguments)
    inside, nodes = forces[1:-1], arguments[1:-1]
    impulses = inside * rule.weights.reshape(shape).astype(width.dtype) * (width * path.length)
    work = side * impulses * velocity_at(path, nodes)
    peak = jnp.where(width > 0, _find_largest_force(force, ends_and_nodes, begin, width, jnp.abs(forces)), 0)
    return _SurfaceContribution(
        readings=_lag_contributions(rates, path, side * impulses, nodes),
        work=(
            jnp.sum(jnp.where(inward > 0, work, 0), axis=_SUMMED_AXES),
            -jnp.sum(jnp.where(inward > 0, 0, work), axis=_SUMMED_AXES),
        ),
        peak=jnp.max(peak, axis=_SUMMED_AXES[:-1]),
        contact_time=_sum_by_part(jnp.sum(width * path.length, axis=(0, 1))),
    )


def _lag_contributions(rates, path, impulses, arguments):
    """Return the response [N] of the force sensor's lag or filter to the force's impulses [N periods].

    The results are the responses at the sampling instant, then at the interval's end.
    """
    if rates is None:
        zeros = jnp.zeros(path.length.shape[1:], path.length.dtype)
        return zeros, zeros
    age = rates.remaining + (1 - arguments) * path.length
    if rates.modes is not None:
        return _mode_contributions(rates, impulses, age * rates.rate)
    remaining = jnp.sum(impulses * jnp.exp(-age * rates.rate) * rates.rate, axis=(0, 1, 2))
    return _sum_by_part(remaining)


def _mode_contributions(rates, impulses, age):
    """Return the response [N] of each mode of the sensor's filter to the force's impulses [N periods].

    `age` is the time since each impulse, multiplied by the filter's cutoff frequency [rad]. The results are
    real and imaginary part of each mode at the sampling instant, then at the interval's end.
    """
    parts = []
    for rate in rates.modes.rates:
        c, s = _decay_factors(rate, age)
        for factor in (rate.real * c - rate.imag * s, rate.real * s + rate.imag * c):
            parts.append(_sum_by_part(jnp.sum(impulses * factor * rates.rate, axis=(0, 1, 2))))
    return (*(before for before, _ in parts), *(after for _, after in parts))


def _sum_by_part(values):
    """Return two sums: of the values in the cells before the sampling instant, and in those after it."""
    half = len(values) // 2
    return jnp.sum(values[:half], axis=0), jnp.sum(values[half:], axis=0)


def _find_largest_force(force, arguments, begin, width, magnitudes):
    """Return the largest |force| [N] in a span, a part of a cell; `magnitudes` are |force| at its nodes.

    The largest force may lie between nodes. Therefore, also compute |force| at the vertex of the parabola
    through the largest magnitude and its two neighbours.
    """
    middle = jnp.clip(jnp.argmax(magnitudes, axis=0), 1, len(arguments) - 2)[None]

    def at(offset):
        return jnp.take_along_axis(magnitudes, middle + offset, axis=0)[0], jnp.asarray(
            arguments, magnitudes.dtype
        )[middle[0] + offset]

    (low, a), (peak, b), (high, c) = at(-1), at(0), at(1)
    slope = (peak - low) / (b - a)
    bend = ((high - peak) / (c - b) - slope) / (c - a)
    vertex = jnp.clip((a + b) / 2 - slope / (2 * jnp.where(bend < 0, bend, -1)), a, c)
    top = jnp.abs(force(begin + width * vertex))
    largest = jnp.max(magnitudes, axis=0)
    return jnp.where((bend < 0) & (top > largest), top, largest)
