"""Division of the motion in each cell into sections of monotone motion.

A cell (`jaxhil.simulation.cells`) is a short part of a sampling interval. The relative time s in a cell runs
from 0 to 1. Arrays have the axes (sections of a cell, cells, *batch).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxhil.simulation.roots import find_sign_change

SHORT_CELL_DEGREE = 8  # degree of the series in a short cell, in which the motion reverses at most once


class CellMotion(NamedTuple):
    """Motion in each cell (part of a sampling interval), as power series in the time since its start."""

    # variable of both power series: time since the cell's start [periods]
    position: Array  # coefficients of the position [m], (powers, cells, *batch)
    rate: Array  # coefficients of the velocity [m per period], (powers, cells, *batch)
    length: Array  # length of each cell [periods], (cells, *batch)


class MonotoneSections(NamedTuple):
    """Sections of monotone motion in each cell (part of an interval), (sections of a cell, cells, *batch)."""

    path: CellMotion  # motion in the cells
    low: Array  # relative time at which a section begins, 0 to 1
    high: Array  # relative time at which a section ends, 0 to 1
    direction: Array  # 1 if the position increases in the section, else -1


def build_cell_motion(series: Array, length: Array) -> CellMotion:
    """Return the motion in the cells of an interval, `length` [periods] long, from position `series` [m]."""
    return CellMotion(series, _derivative(series), length)


def split_at_reversals(path: CellMotion) -> MonotoneSections:
    """Divide the cells (parts of a sampling interval) at the instants at which the motion reverses.

    The motion is assumed to reverse at most twice in a cell. If the degree of the power series is at most
    `SHORT_CELL_DEGREE`, the motion is assumed to reverse at most once.
    """
    low, high = jnp.zeros_like(path.length), jnp.ones_like(path.length)
    if len(path.position) == 2:
        return split_at(path, jnp.stack([low, high]))
    if len(path.position) <= SHORT_CELL_DEGREE + 1:
        return split_at(path, jnp.stack([low, find_sign_change(velocity_at, path, low, high, high), high]))
    bend = find_sign_change(velocity_at, path._replace(rate=_derivative(path.rate)), low, high, high)
    begin, end = jnp.stack([low, bend]), jnp.stack([bend, high])
    early, late = find_sign_change(velocity_at, path, begin, end, end)
    # The cells are divided at `bend` too: the velocity is then monotone in each section, and the force of a
    # damper vanishes at most once.
    return split_at(path, jnp.stack([low, early, bend, late, high]))


def split_at(path: CellMotion, edges: Array) -> MonotoneSections:
    """Divide each cell into monotone sections at relative times `edges`, (edges, cells, *batch)."""
    step = position_at(path, edges[1:]) - position_at(path, edges[:-1])
    return MonotoneSections(path, edges[:-1], edges[1:], jnp.where(step < 0, -1, 1).astype(step.dtype))


def position_at(path: CellMotion, s: Array) -> Array:
    """Return the position [m] in each cell of an interval at the time `s` (0: cell's start, 1: its end)."""
    return horner(path.position, s * path.length)


def velocity_at(path: CellMotion, s: Array) -> Array:
    """Return each cell's velocity [m per period] at the fraction `s` of its duration (0: start, 1: end)."""
    return horner(path.rate, s * path.length)


def horner(series: Array, tau: Array) -> Array:
    """Evaluate the polynomial with the coefficients `series`, ascending powers, at `tau`."""
    total = jnp.broadcast_to(series[-1], jnp.broadcast_shapes(series.shape[1:], tau.shape))
    for power in range(len(series) - 2, -1, -1):
        total = series[power] + tau * total
    return total


def _derivative(series):
    orders = np.arange(1, len(series)).reshape(-1, *[1] * (series.ndim - 1))
    return series[1:] * orders.astype(series.dtype)
