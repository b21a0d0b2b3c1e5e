"""Motion in the cells of a sampling interval, and its monotone pieces.

The relative time s in a cell is from 0 to 1. Arrays have the axes (pieces of a cell, cells, *batch).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxhil.simulation.roots import crossing

SHORT = 8  # degree of a series on a short cell, in which the motion reverses at most once


class Path(NamedTuple):
    """Motion in each cell; the relative time s in a cell is from 0 to 1."""

    position: Array  # series of the position [m], (powers, cells, *batch)
    rate: Array  # series of the velocity [m per period]
    length: Array  # length of the cells [periods], (cells, *batch)


class Pieces(NamedTuple):
    """Cells divided where the motion reverses, (pieces of a cell, cells, *batch)."""

    path: Path
    low: Array  # s at which a piece begins
    high: Array  # s at which it ends
    way: Array  # 1 if the position increases, else -1


def path_of(series: Array, length: Array) -> Path:
    """Return the motion with this series in powers of the time since a cell's start [periods]."""
    return Path(series, _derivative(series), length)


def cut_at_turns(path: Path) -> Pieces:
    """Return the pieces of cells in which the motion reverses at most twice, in short ones at most once."""
    low, high = jnp.zeros_like(path.length), jnp.ones_like(path.length)
    if len(path.position) == 2:
        return pieces_between(path, jnp.stack([low, high]))
    if len(path.position) <= SHORT + 1:
        return pieces_between(path, jnp.stack([low, crossing(rate_at, path, low, high, high), high]))
    bend = crossing(rate_at, path._replace(rate=_derivative(path.rate)), low, high, high)
    begin, end = jnp.stack([low, bend]), jnp.stack([bend, high])
    early, late = crossing(rate_at, path, begin, end, end)
    # The velocity is monotone on each piece too, so that the force of a damper vanishes at most once.
    return pieces_between(path, jnp.stack([low, early, bend, late, high]))


def pieces_between(path: Path, edges: Array) -> Pieces:
    """Return the pieces between relative times, (edges, cells, *batch)."""
    moved = position_at(path, edges[1:]) - position_at(path, edges[:-1])
    return Pieces(path, edges[:-1], edges[1:], jnp.where(moved < 0, -1, 1).astype(moved.dtype))


def position_at(path: Path, s: Array) -> Array:
    """Return the position [m] at the relative time s."""
    return horner(path.position, s * path.length)


def rate_at(path: Path, s: Array) -> Array:
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
