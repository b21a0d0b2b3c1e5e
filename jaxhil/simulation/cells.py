"""Cells: short parts of a sampling interval, in each of which the motion is computed as a power series.

A sampling interval has two parts: before and after the instant at which the force is sampled. Each part is
divided into cells of at most one radian of the motion simulator's fastest pole. In a cell a Taylor series of
the exact response is exact to rounding. A force sensor whose lag is much shorter than a control period
depends only on a short window before its sample. This window has its own cells, each at most one time
constant long. The number of cells is static; their positions depend on the lane.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxhil.simulation.motion_simulator import SimulatorState, generator_rows, matrix_exponential

MAX_POLE = 64.0  # rad per control period; up to it the motion simulator's matrix exponential is exact
# Degree of the series by the longest cell [rad of the fastest pole]; the error is below 1e-13.
SERIES_DEGREES = {0.0: 1, 0.12: 8, 1.0: 16}
CELL_LENGTH_TOLERANCE = 1e-3  # relative excess of a cell over its greatest length
LAG_WINDOW = 40.0  # time constants; exp(-40) is below rounding
MIN_LAG = 1e-12  # control periods; a shorter lag counts as no lag


class CellCounts(NamedTuple):
    """Number of cells in each of the two parts of a sampling interval; static."""

    plain: int  # in the part, or in its rest before the window of a lagging force sensor
    window: int  # in the window of a lagging force sensor; 0 without one
    degree: int  # degree of the power series of the motion in a cell

    @property
    def part(self) -> int:
        """Return the number of cells of a part."""
        return self.plain + self.window


NO_CELLS = CellCounts(0, 0, 0)


class Cells(NamedTuple):
    """Tables of a lane's cells; those of the first part come before those of the second."""

    begin: Float[Array, "cells *batch"]  # start of a cell in the sampling interval [periods]
    length: Float[Array, "cells *batch"]  # length of a cell [periods]
    rest: Float[Array, "cells *batch"]  # from a cell's end to the end of its part [periods]
    # rows that give the motion simulator's state at a cell's start
    states: Float[Array, "order cells columns *batch"]
    # rows that give the coefficients of tau^j, with tau the time since the cell's start [periods], from
    # (state, command, growth of the command in a period)
    series: Float[Array, "powers columns *batch"]


class IntervalInputs(NamedTuple):
    """Inputs that determine the motion within a sampling interval."""

    state: SimulatorState  # of the motion simulator at the interval's start
    start: Float[Array, "*batch"]  # command at the interval's start [m]
    end: Float[Array, "*batch"]  # command at its end [m]
    surface: Float[Array, "*batch"]  # position of the mechanism's surface [m]


def count_cells(fastest: float, lags: Any) -> CellCounts:
    """Return the number of cells; counts are powers of two, so that mechanisms share compiled programs.

    Args:
        fastest: Fastest pole [rad per period].
        lags: Time constants of the force sensors [periods].
    """
    lags = np.asarray(lags)
    plain, window = _power_of_two(fastest), 0
    if np.any(lags > 0):
        shortest = float(np.min(lags))
        # The window may be the whole part.
        if shortest * LAG_WINDOW >= 1:
            plain, window = 0, max(plain, _power_of_two(1 / shortest))
        else:
            longest = min(1.0, LAG_WINDOW * float(np.max(lags)))
            window = max(_power_of_two(LAG_WINDOW), _power_of_two(fastest * longest))
    longest = fastest / (plain or window)
    return CellCounts(
        plain, window, next(degree for most, degree in SERIES_DEGREES.items() if longest <= 1.001 * most)
    )


def merge_cell_counts(counts: Sequence[CellCounts]) -> CellCounts:
    """Return the number of cells that suffices for all mechanisms with these counts."""
    used = [count for count in counts if count.part]
    if not used:
        return NO_CELLS
    plain, window, degree = (max(numbers) for numbers in zip(*used, strict=True))
    if window and any(count.plain or not count.window for count in counts):
        # Lanes whose window was the whole part now have plain cells too; the others keep their window.
        plain = max(count.plain or count.window for count in used)
        window = max(window, _power_of_two(LAG_WINDOW))
    return CellCounts(plain, window, degree)


def fastest_pole(denominator: Any) -> np.ndarray:
    """Return the magnitude of the fastest pole [rad/s] of each lane; `denominator` is (order + 1, lanes)."""
    coefficients = np.asarray(denominator, float)
    order = len(coefficients) - 1
    if order == 0:
        return np.zeros(coefficients.shape[1:])
    lower = coefficients[1:] / coefficients[0]
    if order == 1:
        return np.abs(lower[0])
    if order == 2:
        half, constant = lower[0] / 2, lower[1]
        real = np.abs(half) + np.sqrt(np.maximum(half**2 - constant, 0))
        return np.where(half**2 < constant, np.sqrt(np.abs(constant)), real)
    # Dividing by the poles' mean magnitude gives coefficients of similar size.
    unit = np.abs(lower[-1]) ** (1 / order)
    scaled = lower / unit ** np.arange(1, order + 1)[:, None]
    companion = np.zeros((scaled.shape[1], order, order))
    companion[:, 1:, :-1] = np.eye(order - 1)
    companion[:, 0] = -scaled.T
    return unit * np.max(np.abs(np.linalg.eigvals(companion)), axis=1)


@jax.numpy_rank_promotion("allow")
def build_cells(
    counts: CellCounts,
    numerator: Float[Array, "order *batch"],
    denominator: Float[Array, "order_plus_1 *batch"],
    control_period: Float[Array, "*batch"],
    fraction: Float[Array, "*batch"],
    time_constant: Float[Array, "*batch"],
) -> Cells:
    """Compute the tables of all cells; the force is sampled at `fraction` [periods] of the interval."""
    lag = bound_time_constant(time_constant, control_period) / control_period
    first, second = _edges(counts, fraction, lag), _edges(counts, 1 - fraction, lag)
    begin = jnp.concatenate([fraction - first.before[:-1], 1 - second.before[:-1]])
    length = jnp.concatenate([first.length, second.length])
    rest = jnp.concatenate([first.before[1:], second.before[1:]])
    order = denominator.shape[0] - 1
    if order == 0:
        states = jnp.zeros((0, len(begin), 2, *control_period.shape), control_period.dtype)
        ones, zeros = jnp.ones_like(control_period), jnp.zeros_like(control_period)
        lines = [jnp.stack([ones, zeros]), jnp.stack([zeros, ones])]
        lines += [jnp.zeros_like(lines[0])] * (counts.degree - 1)
        return Cells(begin, length, rest, states, jnp.stack(lines))
    generator, output = generator_rows(numerator, denominator, control_period)
    rows = matrix_exponential(generator[:, :, None] * begin[None, None], begin)
    rows = rows.at[:, order].add(-rows[:, order + 1])
    return Cells(
        begin, length, rest, jnp.moveaxis(rows[:order], 2, 1), _series(generator, output, counts.degree)
    )


@jax.numpy_rank_promotion("allow")
def power_series(cells: Cells, course: IntervalInputs) -> Float[Array, "powers cells *batch"]:
    """Return the coefficients of the position [m], relative to the surface.

    They belong to powers of the time since a cell's start [periods].
    """
    growth = course.end - course.start
    state = [
        sum(
            (row[:, i] * component for i, component in enumerate(course.state)),
            row[:, -2] * course.start + row[:, -1] * course.end,
        )
        for row in cells.states
    ]
    drive = course.start + growth * cells.begin
    position = cells.series[:, None, -2] * drive + cells.series[:, None, -1] * growth
    for i, component in enumerate(state):
        position = position + cells.series[:, None, i] * component
    return position.at[0].add(-course.surface)


def bound_time_constant(time_constant: Array, control_period: Array) -> Array:
    """Return a time constant [s], or `MIN_LAG` control periods if it is shorter."""
    least = MIN_LAG * control_period
    return jnp.where(time_constant > least, time_constant, least)


class _Edges(NamedTuple):
    """Edges of a part's cells."""

    before: Float[Array, "edges *batch"]  # from a cell's edges to the end of its part [periods]
    length: Float[Array, "cells *batch"]  # length of the cells [periods]


def _edges(counts, whole, lag):
    """Return the edges of the cells of a part that is `whole` periods long."""
    window = jnp.minimum(whole, LAG_WINDOW * lag) if counts.plain else whole
    window = window if counts.window else jnp.zeros_like(whole)
    left = [(whole - window) * (i / counts.plain) for i in range(counts.plain, 0, -1)]
    inside = [window * (i / max(counts.window, 1)) for i in range(counts.window, -1, -1)]
    before = jnp.stack([window + before_window for before_window in left] + inside)
    lengths = [(whole - window) / max(counts.plain, 1)] * counts.plain
    return _Edges(before, jnp.stack(lengths + [window / max(counts.window, 1)] * counts.window))


def _series(generator, output, degree):
    """Return the rows of y^(j)/j!, (degree + 1, columns, *batch), for y = output w and w' = generator w.

    The vector w is (state, command, growth of the command in a period).
    """
    order, columns = generator.shape[:2]
    zero = jnp.zeros_like(output[0])
    row = [*output, zero, zero]
    rows = [jnp.stack(row)]
    for power in range(1, degree + 1):
        after = []
        for column in range(columns):
            total = sum((row[i] * generator[i, column] for i in range(order)), zero)
            after.append((total + row[order] if column == columns - 1 else total) / power)
        row = after
        rows.append(jnp.stack(row))
    return jnp.stack(rows)


def _power_of_two(number: float) -> int:
    """Return the least power of two not below a number, within the relative `CELL_LENGTH_TOLERANCE`."""
    return 1 << max(0, math.ceil(math.log2(max(number, 1.0) / (1 + CELL_LENGTH_TOLERANCE))))
