"""The real contact along the exact motion of a sampling interval: lagging reading, work, peak, time in touch.

Each cell (`jaxhil.simulation.cells`) is cut where the motion turns, into pieces on which it goes one way; a
piece is cut at the surface, where the law's slope changes, and where the surfaces let go of each other. On
each span that is left the force is one smooth formula, integrated by Gauss's rule. All cells are computed
side by side; only a law's memory goes from one to the next.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxhil.contact.laws import ContactLaw, ContactParameters, two_sided
from jaxhil.simulation.cells import Cells, not_instant
from jaxhil.simulation.pieces import (
    SHORT,
    cut_at_turns,
    horner,
    path_of,
    pieces_between,
    position_at,
    rate_at,
)
from jaxhil.simulation.roots import crossing, positive_part


class Rule(NamedTuple):
    """Gauss's rule on (0, 1)."""

    nodes: np.ndarray
    weights: np.ndarray

    def places(self, dtype: Any) -> np.ndarray:
        """Return the nodes, and before and behind them the ends, where a limit from inside is read."""
        inside = np.finfo(dtype).eps ** 0.5
        return np.concatenate([[inside], self.nodes, [1 - inside]]).astype(dtype)


def _rule(number: int) -> Rule:
    nodes, weights = np.polynomial.legendre.leggauss(number)
    unit = (nodes + 1) / 2
    # p -> 3 p^2 - 2 p^3 is flat at both ends: a power of the depth is smooth there.
    return Rule(unit**2 * (3 - 2 * unit), weights * 3 * unit * (1 - unit))


RULES = {True: _rule(12), False: _rule(16)}  # for short cells, and for others
_NUMBERS = 7  # of a contact, see `_in_one`
_ALL = (0, 1, 2, 3)  # nodes, levels, pieces, cells


class CellContact(NamedTuple):
    """The contact in a sampling interval."""

    reading: Float[Array, "*batch"]  # of a lagging force sensor at the sample [N]
    lagged: Float[Array, "*batch"]  # its reading at the interval's end [N]
    works: tuple[Array, Array]  # done on the mechanism and returned by it [J]
    peak: Float[Array, "*batch"]  # largest |force| [N]
    touched: tuple[Array, Array]  # time with a force, up to the sample and after it [periods]
    at_sample: tuple[Any, ...]  # state of the contact law where the force is sampled
    at_end: tuple[Any, ...]  # state of the contact law at the interval's end


class Touch(NamedTuple):
    """A contact law at one surface or two."""

    law: ContactLaw
    parameters: ContactParameters
    clearance: Array | None  # between two surfaces [m]; None for one


# Numbers of a lane meet those of its cells, places and spans.
@jax.numpy_rank_promotion("allow")
def contact_in_cells(
    touch: Touch,
    state: tuple[Any, ...],
    cells: Cells,
    series: Float[Array, "powers cells *batch"],
    period: Float[Array, "*batch"],
    lagged: Float[Array, "*batch"],
    time_constant: Float[Array, "*batch"] | None,
) -> CellContact:
    """Compute the contact of a sampling interval.

    Args:
        touch: Contact law and surfaces.
        state: State of the law at the interval's start.
        cells: Cells of the interval.
        series: Motion in the cells, from `power_series`.
        period: Control period [s].
        lagged: Reading of the lagging sensor at the interval's start [N].
        time_constant: Lag of the force sensor [s]; None without lag.
    """
    rates = _sensor_rates(cells, period, time_constant)

    # Each branch returns arrays of its own: where one array is several of its results, the compiler without
    # optimisation mixes them up.
    def touches(state):
        pieces = cut_at_turns(path_of(series, cells.length))
        states, at_sample, at_end = _memory(touch, state, pieces, period)
        parts = [_along_side(touch, states, pieces, side, period, rates) for side in _sides(touch)]
        return _in_one(parts), jax.tree.map(lambda *leaves: jnp.stack(leaves), at_sample, at_end)

    def free(state):
        fresh = touch.law.init(jnp.zeros_like(lagged))
        numbers = jnp.zeros((_NUMBERS, *lagged.shape), lagged.dtype)
        return numbers, jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), fresh)

    # Most of the time no lane touches.
    numbers, states = lax.cond(_may_touch(touch, cells, series), touches, free, state)
    *readings, done, returned, before, after, peak = numbers
    sample, end = _fade(lagged, rates, readings)
    at_sample, at_end = (jax.tree.map(lambda leaf, i=i: leaf[i], states) for i in (0, 1))
    return CellContact(sample, end, (done, returned), peak, (before, after), at_sample, at_end)


@jax.numpy_rank_promotion("allow")
def work_of_jump(
    touch: Touch, state: tuple[Any, ...], before: Float[Array, "*batch"], now: Float[Array, "*batch"]
) -> tuple[Array, Array]:
    """Return the work [J] of a jump from one position to another: done on the mechanism, returned by it."""
    one = jnp.ones_like(before)
    path = path_of(jnp.stack([before, now - before])[:, None], one[None])
    pieces = pieces_between(path, jnp.stack([0 * one, one])[:, None])
    states = jax.tree.map(lambda leaf: leaf[None, None], state)
    parts = [_along_side(touch, states, pieces, side, one, None, still=True) for side in _sides(touch)]
    done, returned = (sum((part.works[i] for part in parts), 0 * one) for i in (0, 1))
    return done, returned


class _Part(NamedTuple):
    """What the contact at one surface adds, each summed over the cells but for the readings."""

    readings: tuple[Array, Array]  # what the force leaves in a lagging reading at either part's end [N]
    works: tuple[Array, Array]
    peak: Array
    touched: tuple[Array, Array]


def _in_one(parts: list[_Part]) -> Array:
    """Numbers of the contact at either surface together, (numbers, *batch); the peak comes last."""
    each = [jnp.stack([*part.readings, *part.works, *part.touched]) for part in parts]
    peak = functools.reduce(jnp.maximum, [part.peak for part in parts])
    return jnp.concatenate([functools.reduce(jnp.add, each), peak[None]])


def _sides(touch):
    return (1,) if touch.clearance is None else (1, -1)


def _memory(touch, state, pieces, period):
    """State of the law at the start of each piece, (3, cells, *batch), at the sample and at the end."""
    cells = pieces.path.length.shape[0]
    if not touch.law.remembers:
        return state, state, state
    position = position_at(pieces.path, pieces.high)
    speed = rate_at(pieces.path, pieces.high) / period

    def through(state, motion):
        before = []
        for position, speed in zip(*motion, strict=True):
            before.append(state)
            _, state = two_sided(touch.law, touch.parameters, state, position, speed, touch.clearance)
        return state, jax.tree.map(lambda *leaves: jnp.stack(leaves), *before)

    at_end, states = lax.scan(through, state, (jnp.moveaxis(position, 1, 0), jnp.moveaxis(speed, 1, 0)))
    at_sample = jax.tree.map(lambda leaf: leaf[cells // 2, 0], states)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), states), at_sample, at_end


class _Rates(NamedTuple):
    """A lagging sensor in a lane's cells."""

    fades: tuple[Array, Array]  # duration of either part [time constants]
    rate: Array  # time constants per period
    rest: Array  # from a cell's end to that of its part [periods]


def _sensor_rates(cells, period, time_constant) -> _Rates | None:
    if time_constant is None:
        return None
    rate = period / not_instant(time_constant, period)
    half = cells.length.shape[0] // 2
    first = cells.rest[0] + cells.length[0]
    second = cells.rest[half] + cells.length[half]
    return _Rates((first * rate, second * rate), rate, cells.rest)


def _fade(lagged, rates, readings):
    """The reading at the sample and at the interval's end [N]."""
    if rates is None:
        return lagged, lagged
    sample = lagged * jnp.exp(-rates.fades[0]) + readings[0]
    return sample, sample * jnp.exp(-rates.fades[1]) + readings[1]


def _may_touch(touch, cells, series):
    """Whether any lane may touch: by a bound on the series."""
    reach = horner(jnp.abs(series.at[0].set(0)), cells.length)
    may = series[0] + reach > 0
    if touch.clearance is not None:
        may = may | (series[0] - reach < -touch.clearance)
    return jnp.any(may | ~jnp.isfinite(reach))


def _along_side(touch, states, pieces, side, period, rates, still=False) -> _Part:
    """The contact at the surface of one side; a motion that is `still` has no velocity to the law."""
    law, parameters, path = touch.law, touch.parameters, pieces.path
    inward = side * pieces.way
    surface = 0.0 if side > 0 else touch.clearance

    def depth(path, s):
        return side * position_at(path, s) - surface

    def rate(path, s):
        if still:
            return jnp.zeros_like(s)
        speed = side * rate_at(path, s) / period
        if not law.jumps:
            return speed
        # By its sign a law tells the ways apart: at a turn rounding would decide.
        return jnp.where(speed * inward > 0, speed, inward * jnp.finfo(speed.dtype).tiny)

    def height(data, s):
        return depth(data[0], s) - data[1]

    def hold(data, s):
        path, parameters, states = data
        return law.hold(parameters, states, depth(path, s), rate(path, s))

    def force(s):
        return law.step(parameters, states, depth(path, s), rate(path, s))[0]

    corners = [jnp.broadcast_to(one, pieces.low.shape) for one in law.corners(parameters, states)]
    levels = jnp.sort(jnp.stack([jnp.zeros_like(pieces.low), *corners]), axis=0)
    low, high = (jnp.broadcast_to(one, levels.shape) for one in (pieces.low, pieces.high))
    inner, outer = jnp.where(inward > 0, low, high), jnp.where(inward > 0, high, low)
    at_level = crossing(height, (path, levels), low, high, inner, outer)
    beyond = jnp.concatenate([at_level[1:], outer[:1]])
    spans = jnp.minimum(at_level, beyond), jnp.maximum(at_level, beyond)
    begin, end = positive_part(hold, (path, parameters, states), *spans)
    width = end - begin

    shape = (-1, *[1] * width.ndim)
    rule = RULES[len(path.position) <= SHORT + 1]
    ends_and_nodes = rule.places(width.dtype)
    places = begin + width * ends_and_nodes.reshape(shape)
    forces = force(places)
    inside, nodes = forces[1:-1], places[1:-1]
    impulses = inside * rule.weights.reshape(shape).astype(width.dtype) * (width * path.length)
    work = side * impulses * rate_at(path, nodes)
    peak = jnp.where(width > 0, _largest(force, ends_and_nodes, begin, width, jnp.abs(forces)), 0)
    return _Part(
        readings=_lag_of(rates, path, side * impulses, nodes),
        works=(
            jnp.sum(jnp.where(inward > 0, work, 0), axis=_ALL),
            -jnp.sum(jnp.where(inward > 0, 0, work), axis=_ALL),
        ),
        peak=jnp.max(peak, axis=_ALL[:-1]),
        touched=_by_part(jnp.sum(width * path.length, axis=(0, 1))),
    )


def _lag_of(rates, path, impulses, places):
    """What impulses [N periods] leave in a lagging reading at the end of either part [N]."""
    if rates is None:
        zeros = jnp.zeros(path.length.shape[1:], path.length.dtype)
        return zeros, zeros
    ago = rates.rest + (1 - places) * path.length
    left = jnp.sum(impulses * jnp.exp(-ago * rates.rate) * rates.rate, axis=(0, 1, 2))
    return _by_part(left)


def _by_part(values):
    """Sums over the cells of either part."""
    half = len(values) // 2
    return jnp.sum(values[:half], axis=0), jnp.sum(values[half:], axis=0)


def _largest(force, places, begin, width, magnitudes):
    """Largest |force| [N] of a span: of those at the nodes, and at the vertex through the three largest."""
    middle = jnp.clip(jnp.argmax(magnitudes, axis=0), 1, len(places) - 2)[None]

    def at(offset):
        return jnp.take_along_axis(magnitudes, middle + offset, axis=0)[0], jnp.asarray(
            places, magnitudes.dtype
        )[middle[0] + offset]

    (low, a), (peak, b), (high, c) = at(-1), at(0), at(1)
    slope = (peak - low) / (b - a)
    bend = ((high - peak) / (c - b) - slope) / (c - a)
    vertex = jnp.clip((a + b) / 2 - slope / (2 * jnp.where(bend < 0, bend, -1)), a, c)
    top = jnp.abs(force(begin + width * vertex))
    largest = jnp.max(magnitudes, axis=0)
    return jnp.where((bend < 0) & (top > largest), top, largest)
