"""Onset detection in JAX: the batched cumulative sum of `rig.py` in this folder."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.laws.impulse_ledger.onset_detection.rig import DRIFT, FEW, LONGEST_MEAN


class FreeFlight(NamedTuple):
    """Statistics of readings in free flight, and the cumulative sum."""

    count: Float[Array, "*batch"]  # number of readings in the bias
    differences: Float[Array, "*batch"]  # number of differences of readings in the noise
    square: Float[Array, "*batch"]  # mean of half the squared differences [N^2]
    before: Float[Array, "*batch"]  # last reading [N]
    bias: Float[Array, "*batch"]  # mean of the readings [N]
    total: Float[Array, "*batch"]  # cumulative sum S [1]


def variance(flight: FreeFlight, noise: Array) -> Float[Array, "*batch"]:
    """Return the variance of a force reading [N^2]: as specified, or larger as seen in free flight."""
    specified = noise**2
    is_larger = (flight.differences > FEW) & (flight.square > specified)
    return jnp.where(is_larger, flight.square, specified)


def watch(flight: FreeFlight, deviation: Array, settled: Bool[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the cumulative sum after a reading whose pushing force over sigma is `deviation`."""
    total = flight.total + deviation - DRIFT
    return jnp.where(settled & (total > 0), total, 0)


def learn(flight: FreeFlight, force: Array, free: Bool[Array, "*batch"]) -> FreeFlight:
    """Update bias and noise with one reading [N], where it is `free`."""
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
