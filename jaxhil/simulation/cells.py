"""Cells: short parts of a sampling interval, on each of which the mechanism's exact motion is a power series.

A sampling interval has two parts: up to the instant at which the force is sampled, and the rest. Each part is
cut into cells of at most one radian of the motion simulator's fastest pole, on which a Taylor series of the
exact response is exact to rounding. A force sensor that lags by much less than a
control period forgets all but a short window before its sample: that window has cells of its own, each at
most one time constant long. How many cells there are is static; where they lie depends on the lane.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxhil.simulation.motion_simulator import State, exponential, generator_rows

FASTEST_POLE = 64.0  # rad per control period, of the motion simulator: so far its exponential is exact
# Powers of a series by the longest cell [rad of the fastest pole]: what is left out is below 1e-13.
DEGREES = {0.0: 1, 0.12: 8, 1.0: 16}
SLACK = 1e-3  # by which a cell may be longer than stated
WINDOW = 40.0  # time constants; exp(-40) is below rounding


INSTANT = 1e-12  # control periods; a lag that is shorter is none


class CellCounts(NamedTuple):
    """How many cells each of the two parts of a sampling interval has; static."""

    plain: int  # in the part, or in what is left of it before the window of a lagging force sensor
    window: int  # in the window of a lagging force sensor; 0 without one
    degree: int  # of the series of the motion in a cell

    @property
    def part(self) -> int:
        """Number of cells of a part."""
        return self.plain + self.window


NO_CELLS = CellCounts(0, 0, 0)


class Cells(NamedTuple):
    """Tables of a lane's cells, those of the first part before those of the second."""

    begin: Float[Array, "cells *batch"]  # start of a cell in the sampling interval [periods]
    length: Float[Array, "cells *batch"]  # of a cell [periods]
    rest: Float[Array, "cells *batch"]  # from a cell's end to the end of its part [periods]
    states: Float[
        Array, "order cells columns *batch"
    ]  # rows of the motion simulator's state at a cell's start
    # rows of the coefficients of tau^j, tau the time since the cell's start [periods], for (state, command,
    # growth of the command in a period)
    series: Float[Array, "powers columns *batch"]


class Course(NamedTuple):
    """What the motion within a sampling interval follows from."""

    state: State  # of the motion simulator at the interval's start
    start: Float[Array, "*batch"]  # command at the interval's start [m]
    end: Float[Array, "*batch"]  # command at its end [m]
    surface: Float[Array, "*batch"]  # position of the mechanism's surface [m]


def count_cells(fastest: float, lags: Any) -> CellCounts:
    """Return the number of cells for poles up to `fastest` [rad per period] and force sensors' time constants
    `lags` [periods]. Counts are powers of two, so that mechanisms share compiled programs."""
    lags = np.asarray(lags)
    plain, window = _power_of_two(fastest), 0
    if np.any(lags > 0):
        shortest = float(np.min(lags))
        # The window may be the whole part.
        if shortest * WINDOW >= 1:
            plain, window = 0, max(plain, _power_of_two(1 / shortest))
        else:
            longest = min(1.0, WINDOW * float(np.max(lags)))
            window = max(_power_of_two(WINDOW), _power_of_two(fastest * longest))
    longest = fastest / (plain or window)
    return CellCounts(
        plain, window, next(degree for most, degree in DEGREES.items() if longest <= 1.001 * most)
    )


def join_counts(counts: Sequence[CellCounts]) -> CellCounts:
    """Return the number of cells that serves mechanisms with these."""
    every = [one for one in counts if one.part]
    if not every:
        return NO_CELLS
    plain, window, degree = (max(numbers) for numbers in zip(*every, strict=True))
    if window and any(one.plain or not one.window for one in counts):
        # Lanes whose window is the whole part have one beside it now, and the others need theirs.
        plain = max(one.plain or one.window for one in every)
        window = max(window, _power_of_two(WINDOW))
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
    # In units of the poles' mean magnitude, in which coefficients are of like size.
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
    """Compute the tables of all cells; `fraction` [periods] is that of the interval at which the force is
    sampled."""
    lag = not_instant(time_constant, control_period) / control_period
    first, second = _edges(counts, fraction, lag), _edges(counts, 1 - fraction, lag)
    begin = jnp.concatenate([fraction - first.before[:-1], 1 - second.before[:-1]])
    length = jnp.concatenate([first.length, second.length])
    rest = jnp.concatenate([first.before[1:], second.before[1:]])
    order = denominator.shape[0] - 1
    if order == 0:
        states = jnp.zeros((0, len(begin), 2, *control_period.shape), control_period.dtype)
        one, zero = jnp.ones_like(control_period), jnp.zeros_like(control_period)
        lines = [jnp.stack([one, zero]), jnp.stack([zero, one])]
        lines += [jnp.zeros_like(lines[0])] * (counts.degree - 1)
        return Cells(begin, length, rest, states, jnp.stack(lines))
    generator, output = generator_rows(numerator, denominator, control_period)
    rows = exponential(generator[:, :, None] * begin[None, None], begin)
    rows = rows.at[:, order].add(-rows[:, order + 1])
    return Cells(
        begin, length, rest, jnp.moveaxis(rows[:order], 2, 1), _series(generator, output, counts.degree)
    )


@jax.numpy_rank_promotion("allow")
def power_series(cells: Cells, course: Course) -> Float[Array, "powers cells *batch"]:
    """Coefficients of the position [m], from the surface, in powers of the time since a cell's start
    [periods]."""
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


def not_instant(time_constant: Array, control_period: Array) -> Array:
    """Return a time constant [s], or `INSTANT` of the control period where it is shorter."""
    least = INSTANT * control_period
    return jnp.where(time_constant > least, time_constant, least)


class _Edges(NamedTuple):
    before: Float[Array, "edges *batch"]  # from a cell's edges to the end of its part [periods]
    length: Float[Array, "cells *batch"]  # of the cells [periods]


def _edges(counts, whole, lag):
    """Edges of a part's cells, which is `whole` periods long."""
    window = jnp.minimum(whole, WINDOW * lag) if counts.plain else whole
    window = window if counts.window else jnp.zeros_like(whole)
    left = [(whole - window) * (i / counts.plain) for i in range(counts.plain, 0, -1)]
    inside = [window * (i / max(counts.window, 1)) for i in range(counts.window, -1, -1)]
    before = jnp.stack([window + one for one in left] + inside)
    lengths = [(whole - window) / max(counts.plain, 1)] * counts.plain
    return _Edges(before, jnp.stack(lengths + [window / max(counts.window, 1)] * counts.window))


def _series(generator, output, degree):
    """Rows of y^(j)/j! for y = output w, w' = generator w, w = (state, command, growth)."""
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
    """The least power of two that is not below a number, to `SLACK`."""
    return 1 << max(0, math.ceil(math.log2(max(number, 1.0) / (1 + SLACK))))
