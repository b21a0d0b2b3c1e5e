"""Motion in the cells of a sampling interval, and its monotone pieces.

The relative time s in a cell is from 0 to 1. Arrays have the axes (pieces of a cell, cells, *batch).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxhil.simulation.roots import find_sign_change

SHORT_CELL_DEGREE = 8  # degree of a series on a short cell, in which the motion reverses at most once


class CellMotion(NamedTuple):
    """Motion in each cell; the relative time s in a cell is from 0 to 1."""

    position: Array  # series of the position [m], (powers, cells, *batch)
    rate: Array  # series of the velocity [m per period]
    length: Array  # length of the cells [periods], (cells, *batch)


class MonotonePieces(NamedTuple):
    """Cells divided where the motion reverses, (pieces of a cell, cells, *batch)."""

    path: CellMotion
    low: Array  # s at which a piece begins
    high: Array  # s at which it ends
    way: Array  # 1 if the position increases, else -1


def build_cell_motion(series: Array, length: Array) -> CellMotion:
    """Return the motion with this series in powers of the time since a cell's start [periods]."""
    return CellMotion(series, _derivative(series), length)


def split_at_reversals(path: CellMotion) -> MonotonePieces:
    """Return the pieces of cells in which the motion reverses at most twice, in short ones at most once."""
    low, high = jnp.zeros_like(path.length), jnp.ones_like(path.length)
    if len(path.position) == 2:
        return split_at(path, jnp.stack([low, high]))
    if len(path.position) <= SHORT_CELL_DEGREE + 1:
        return split_at(path, jnp.stack([low, find_sign_change(velocity_at, path, low, high, high), high]))
    bend = find_sign_change(velocity_at, path._replace(rate=_derivative(path.rate)), low, high, high)
    begin, end = jnp.stack([low, bend]), jnp.stack([bend, high])
    early, late = find_sign_change(velocity_at, path, begin, end, end)
    # The velocity is monotone on each piece too, so that the force of a damper vanishes at most once.
    return split_at(path, jnp.stack([low, early, bend, late, high]))


def split_at(path: CellMotion, edges: Array) -> MonotonePieces:
    """Return the pieces between relative times, (edges, cells, *batch)."""
    moved = position_at(path, edges[1:]) - position_at(path, edges[:-1])
    return MonotonePieces(path, edges[:-1], edges[1:], jnp.where(moved < 0, -1, 1).astype(moved.dtype))


def position_at(path: CellMotion, s: Array) -> Array:
    """Return the position [m] at the relative time s."""
    return horner(path.position, s * path.length)


def velocity_at(path: CellMotion, s: Array) -> Array:
    """Return the velocity [m per period] at the relative time s."""
    return horner(path.rate, s * path.length)


def horner(series: Array, tau: Array) -> Array:
    """Return the sum of `series[j] tau^j`."""
    total = jnp.broadcast_to(series[-1], jnp.broadcast_shapes(series.shape[1:], tau.shape))
    for power in range(len(series) - 2, -1, -1):
        total = series[power] + tau * total
    return total


def _derivative(series):
    """Return the series of the derivative."""
    orders = np.arange(1, len(series)).reshape(-1, *[1] * (series.ndim - 1))
    return series[1:] * orders.astype(series.dtype)
