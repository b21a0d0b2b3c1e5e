"""Onset detection in JAX: batched version of `rig.py` in this folder."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.laws.impulse_ledger.onset_detection.rig import DRIFT, MAX_MEAN, MIN_FLIGHT_READINGS


class FreeFlight(NamedTuple):
    """Statistics of the force readings in free flight, and the cumulative sum of the onset detection."""

    count: Float[Array, "*batch"]  # number of readings in free flight
    square: Float[Array, "*batch"]  # noise variance, from half the squared differences of readings [N^2]
    before: Float[Array, "*batch"]  # last reading [N]
    bias: Float[Array, "*batch"]  # mean of the readings [N]
    total: Float[Array, "*batch"]  # cumulative sum S [1]
    velocity: Float[Array, "*batch"]  # approach velocity at the last reading [m/s]; 0 without an approach


def variance(flight: FreeFlight, noise: Array) -> Float[Array, "*batch"]:
    """Return the noise variance of a force reading [N^2]: the larger of specified and measured value."""
    return jnp.maximum(noise**2, jnp.where(flight.count > MIN_FLIGHT_READINGS, flight.square, 0))


def update(flight: FreeFlight, deviation: Array, settled: Bool[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the next cumulative sum; `deviation` is the reading minus the bias, divided by sigma."""
    total = flight.total + deviation - DRIFT
    return jnp.where(settled & (total > 0), total, 0)


def learn(old: FreeFlight, force: Array) -> FreeFlight:
    """Update the estimates of bias and noise with one force reading [N] of free flight."""
    step = force - old.before
    change = (0.5 * (step * step) - old.square) / jnp.maximum(old.count, 1)
    square = old.square + jnp.where(old.count > 0, change, 0)
    bias = old.bias + (force - old.bias) / jnp.minimum(old.count + 1, MAX_MEAN)
    return old._replace(count=old.count + 1, square=square, before=force, bias=bias)
