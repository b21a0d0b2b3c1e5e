"""Cells: subdivision of a sampling interval, with the motion in each cell as a power series.

A sampling interval has two parts: before and after the instant at which the force is sampled. Each part is
divided into cells. The length of a cell times the motion simulator's fastest pole is at most one radian.
Within a cell, a Taylor series of the motion simulator's response is therefore accurate to rounding.

If the lag of the force sensor is much shorter than a control period, a reading depends only on the force in a
short window before the sample. This window has separate cells, whose lengths are at most one time constant of
the lag.

The number of cells is static. The positions of the cells differ between the lanes of a batch.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxhil.simulation.motion_simulator import SimulatorState, generator_rows, matrix_exponential
from jaxhil.simulation.moving_average import DEGREE, motion_rows, split_window

# rad per control period; for faster poles of the motion simulator, the matrix exponential loses accuracy.
MAX_POLE = 64.0
# Degree of the power series for each maximum of cell length times fastest pole [rad]. The truncation error is
# below 1e-13.
SERIES_DEGREES = {0.0: 1, 0.12: 8, 1.0: 16}
CELL_LENGTH_TOLERANCE = 1e-3  # relative amount by which a cell may exceed its maximum length [1]
LAG_WINDOW = 40.0  # time constants; older forces change a reading by exp(-40), which is below rounding
MIN_LAG = 1e-12  # lag below which a force sensor counts as a sensor without lag [control periods]


class CellCounts(NamedTuple):
    """Number of cells before the force sample, equal to that after it, and degree of the power series."""

    plain: int  # number of cells before the window of a force sensor with lag
    window: int  # number of cells in the sensor's window; 0 for a sensor without lag
    degree: int  # degree of the power series of the motion in a cell

    @property
    def part(self) -> int:
        """Return the number of cells before the force sample, which is also the number after it."""
        return self.plain + self.window


NO_CELLS = CellCounts(0, 0, 0)


class Cells(NamedTuple):
    """Positions of the cells (short parts) of a sampling interval, and matrices for the motion in them.

    Cells are in chronological order.
    """

    begin: Float[Array, "cells *batch"]  # start of a cell in the sampling interval [periods]
    length: Float[Array, "cells *batch"]  # length of a cell [periods]
    remaining: Float[Array, "cells *batch"]  # time from a cell's end to the end of its part [periods]
    # Matrix from (state, command at the interval's start, command at its end) to the state at a cell's start.
    states: Float[Array, "order cells columns *batch"]
    # Matrix from (state, command, increase of the command in a period) at a cell's start to the coefficients
    # of tau^j, where tau is the time since the cell's start [periods].
    series: Float[Array, "powers columns *batch"]


class IntervalInputs(NamedTuple):
    """Inputs that determine the motion within a sampling interval."""

    state: SimulatorState  # state of the motion simulator at the interval's start
    start: Float[Array, "*batch"]  # position command at the interval's start [m]
    end: Float[Array, "*batch"]  # position command at the interval's end [m]
    # position of the mechanism's surface [m]; None in a delay line whose readings have jitter
    surface: Float[Array, "*batch"] | None


def count_cells(fastest: float, lags: Any) -> CellCounts:
    """Return the numbers of cells (short parts) into which a mechanism's sampling interval is divided.

    The numbers are powers of two, so that similar mechanisms share a compiled program.

    Args:
        fastest: Magnitude of the motion simulator's fastest pole [rad per period].
        lags: Time constants of the force sensor in each lane [periods].
    """
    lags = np.asarray(lags)
    plain, window = _power_of_two(fastest), 0
    if np.any(lags > 0):
        shortest = float(np.min(lags))
        # If the lag is long, the sensor's window covers each part of the sampling interval completely.
        if shortest * LAG_WINDOW >= 1:
            plain, window = 0, max(plain, _power_of_two(1 / shortest))
        else:
            longest = min(1.0, LAG_WINDOW * float(np.max(lags)))
            window = max(_power_of_two(LAG_WINDOW), _power_of_two(fastest * longest))
    longest = fastest / (plain or window)
    return CellCounts(
        plain, window, next(degree for limit, degree in SERIES_DEGREES.items() if longest <= 1.001 * limit)
    )


def merge_cell_counts(counts: Sequence[CellCounts]) -> CellCounts:
    """Return the numbers of cells of a common program, large enough for each of its mechanisms."""
    used = [count for count in counts if count.part]
    if not used:
        return NO_CELLS
    plain, window, degree = (max(numbers) for numbers in zip(*used, strict=True))
    if window and any(count.plain or not count.window for count in counts):
        # In the common program, all mechanisms have a window of full length and cells before this window,
        # including mechanisms whose own window covered the whole part.
        plain = max(count.plain or count.window for count in used)
        window = max(window, _power_of_two(LAG_WINDOW))
    return CellCounts(plain, window, degree)


def fastest_pole(denominator: Any) -> np.ndarray:
    """Return the magnitude [rad/s] of the fastest pole of each lane's motion simulator.

    `denominator` has the shape (order + 1, lanes), with descending powers of s.
    """
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
    # Division by the poles' geometric mean gives all coefficients similar magnitudes.
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
    window: Float[Array, "*batch"] | None = None,
    hold: str = "linear",
) -> Cells:
    """Compute positions and matrices of the cells of a sampling interval.

    Args:
        counts: Numbers of cells, from `count_cells`.
        numerator: Numerator of the motion simulator's transfer function, descending powers of s.
        denominator: Denominator of this transfer function.
        control_period: Control period [s].
        fraction: Time from the interval's start to the force sample [periods].
        time_constant: Lag of the force sensor [s].
        window: Window of a moving average [s]; None for a transfer function.
        hold: Hold of the position command; only a moving average needs it.
    """
    lag = bound_time_constant(time_constant, control_period) / control_period
    first, second = _divide_part(counts, fraction, lag), _divide_part(counts, 1 - fraction, lag)
    if window is not None:
        kink = split_window(window, control_period).fraction
        first, second = _divide_at(first, fraction - kink), _divide_at(second, 1 - kink)
    begin = jnp.concatenate([fraction - first.before[:-1], 1 - second.before[:-1]])
    length = jnp.concatenate([first.length, second.length])
    rest = jnp.concatenate([first.before[1:], second.before[1:]])
    if window is not None:
        states, series = _moving_average(begin, length, window, control_period, hold)
        return Cells(begin, length, rest, states, series)
    order = denominator.shape[0] - 1
    if order == 0:
        states = jnp.zeros((0, len(begin), 2, *control_period.shape), control_period.dtype)
        return Cells(begin, length, rest, states, _line_series(control_period, counts.degree))
    generator, output = generator_rows(numerator, denominator, control_period)
    rows = matrix_exponential(generator[:, :, None] * begin[None, None], begin)
    rows = rows.at[:, order].add(-rows[:, order + 1])
    return Cells(
        begin, length, rest, jnp.moveaxis(rows[:order], 2, 1), _series(generator, output, counts.degree)
    )


def build_series(
    numerator: Float[Array, "order *batch"],
    denominator: Float[Array, "order_plus_1 *batch"],
    control_period: Float[Array, "*batch"],
    degree: int,
) -> Float[Array, "powers columns *batch"]:
    """Return the matrix that gives the position over time as a power series.

    The matrix maps (state, command, increase of the command in a period) to the series' coefficients. The
    series gives the position [m] as a function of the time since the state's instant [periods].
    """
    if denominator.shape[0] > 1:
        return _series(*generator_rows(numerator, denominator, control_period), degree)
    return _line_series(control_period, degree)


def horner_series(
    series: Float[Array, "powers columns *batch"], drive: tuple[Array, ...], s: Float[Array, "*batch"]
) -> tuple[Array, Array, Array]:
    """Evaluate a series of `build_series` at the time `s` [periods].

    Return position [m] and its first two time derivatives; time is in periods. `drive` contains the state,
    the command, and the increase of the command in a period.
    """
    coefficients = [sum(row[i] * value for i, value in enumerate(drive)) for row in series]
    position = rate = half_bend = 0 * s
    for power in range(len(coefficients) - 1, -1, -1):
        half_bend = rate + s * half_bend
        rate = position + s * rate
        position = coefficients[power] + s * position
    return position, rate, 2 * half_bend


@jax.numpy_rank_promotion("allow")
def power_series(cells: Cells, inputs: IntervalInputs) -> Float[Array, "powers cells *batch"]:
    """Return the mechanism's position relative to the surface [m] as a power series in each cell.

    The series' variable is the time since the cell's start [periods].
    """
    growth = inputs.end - inputs.start
    state = [
        sum(
            (row[:, i] * component for i, component in enumerate(inputs.state)),
            row[:, -2] * inputs.start + row[:, -1] * inputs.end,
        )
        for row in cells.states
    ]
    drive = inputs.start + growth * cells.begin
    position = cells.series[:, None, -2] * drive + cells.series[:, None, -1] * growth
    for i, component in enumerate(state):
        position = position + cells.series[:, None, i] * component
    assert inputs.surface is not None
    return position.at[0].add(-inputs.surface)


def bound_time_constant(time_constant: Array, control_period: Array) -> Array:
    """Return the time constant [s], raised to at least `MIN_LAG` control periods."""
    shortest = MIN_LAG * control_period
    return jnp.where(time_constant > shortest, time_constant, shortest)


class _CellEdges(NamedTuple):
    """Positions of the cells in one part of a sampling interval: before or after the force sample."""

    # time from each edge of a cell to the end of the part [periods], in the order of time
    before: Float[Array, "edges *batch"]
    length: Float[Array, "cells *batch"]  # length of each cell [periods]


def _divide_part(counts, whole, lag):
    """Divide a part of a sampling interval into cells; its length `whole` and the `lag` are in periods."""
    window = jnp.minimum(whole, LAG_WINDOW * lag) if counts.plain else whole
    window = window if counts.window else jnp.zeros_like(whole)
    before_window = [(whole - window) * (i / counts.plain) for i in range(counts.plain, 0, -1)]
    inside = [window * (i / max(counts.window, 1)) for i in range(counts.window, -1, -1)]
    before = jnp.stack([window + time for time in before_window] + inside)
    lengths = [(whole - window) / max(counts.plain, 1)] * counts.plain
    return _CellEdges(before, jnp.stack(lengths + [window / max(counts.window, 1)] * counts.window))


def _divide_at(edges, before):
    """Divide a cell of a part at the time `before` [periods] before the part's end, clipped to the part."""
    kink = jnp.clip(before, edges.before[-1], edges.before[0])
    edges = -jnp.sort(-jnp.concatenate([edges.before, kink[None]]), axis=0)
    return _CellEdges(edges, edges[:-1] - edges[1:])


def _moving_average(begin, length, window, control_period, hold):
    """Return the matrices `states` and `series` of `Cells` for a motion simulator with a moving average.

    The motion in each cell is a parabola. The state at a cell's start consists of the parabola's three
    coefficients.
    """
    # Rounding may place the start of a cell on either side of the kink, but not its middle.
    is_before = begin + length / 2 < split_window(window, control_period).fraction
    position, rate, bend = motion_rows(window, control_period, begin, is_before, hold)
    states = jnp.moveaxis(jnp.stack([position, rate, bend / 2]), 1, 2)
    series = jnp.eye(DEGREE + 1, DEGREE + 3, dtype=begin.dtype)
    series = series.reshape(*series.shape, *[1] * control_period.ndim)
    return states, jnp.broadcast_to(series, (*series.shape[:2], *control_period.shape))


def _line_series(control_period, degree):
    """Return the result of `_series` for an ideal motion simulator: its position is the command."""
    ones, zeros = jnp.ones_like(control_period), jnp.zeros_like(control_period)
    lines = [jnp.stack([ones, zeros]), jnp.stack([zeros, ones])]
    return jnp.stack(lines + [jnp.zeros_like(lines[0])] * (degree - 1))


def _series(generator, output, degree):
    """Return row vectors that give the power series of y = C w, where w' = A w.

    C is `output`, A is `generator`, and w = (state, command, increase of the command in a period). Row j,
    multiplied by w, gives y^(j)/j!. The result has the shape (degree + 1, columns, *batch).
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
    """Return the smallest power of two >= `number` / (1 + `CELL_LENGTH_TOLERANCE`), but at least 1."""
    return 1 << max(0, math.ceil(math.log2(max(number, 1.0) / (1 + CELL_LENGTH_TOLERANCE))))
