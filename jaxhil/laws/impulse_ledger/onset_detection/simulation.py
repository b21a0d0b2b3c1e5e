"""Onset of contact in JAX: the cumulative sum of `rig.py` beside it, for batches."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.laws.impulse_ledger.onset_detection.rig import DRIFT, FEW, LONGEST_MEAN


class FreeFlight(NamedTuple):
    """Statistics of readings in free flight, and the cumulative sum."""

    count: Float[Array, "*batch"]  # readings that the bias is averaged over
    differences: Float[Array, "*batch"]  # differences that the noise is averaged over
    square: Float[Array, "*batch"]  # mean of half their squares [N^2]
    before: Float[Array, "*batch"]  # the reading before [N]
    bias: Float[Array, "*batch"]  # mean of the readings [N]
    total: Float[Array, "*batch"]  # the cumulative sum S


def variance(flight: FreeFlight, noise: Array) -> Float[Array, "*batch"]:
    """Return the variance of a force reading [N^2]: as specified, or as shown in free flight."""
    known = noise**2
    shown = (flight.differences > FEW) & (flight.square > known)
    return jnp.where(shown, flight.square, known)


def watch(flight: FreeFlight, deviation: Array, settled: Bool[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the cumulative sum with one reading more; `deviation` is its pushing force over sigma."""
    total = flight.total + deviation - DRIFT
    return jnp.where(settled & (total > 0), total, 0)


def learn(flight: FreeFlight, force: Array, free: Bool[Array, "*batch"]) -> FreeFlight:
    """Average bias and noise over one more reading [N], where it is `free`."""
    compared = free & (flight.count > 0)
    differences = flight.differences + jnp.where(compared, 1, 0)
    step = force - flight.before
    change = (0.5 * (step * step) - flight.square) / jnp.where(differences > 0, differences, 1)
    count = flight.count + jnp.where(free, 1, 0)
    number = jnp.where(count > 0, jnp.where(count < LONGEST_MEAN, count, LONGEST_MEAN), 1)
    return FreeFlight(
        count,
        differences,
        flight.square + jnp.where(compared, change, 0),
        jnp.where(free, force, flight.before),
        flight.bias + jnp.where(free, (force - flight.bias) / number, 0),
        flight.total,
    )
