"""Onset detection in JAX: batched version of `rig.py` in this folder."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.laws.impulse_ledger.onset_detection.rig import DRIFT, EARLY_DRIFT, MAX_MEAN, MIN_FLIGHT_READINGS


class FreeFlight(NamedTuple):
    """Statistics of the force readings in free flight, and the cumulative sums of the onset detection."""

    count: Float[Array, "*batch"]  # number of readings in free flight
    square: Float[Array, "*batch"]  # noise variance, from half the squared differences of readings [N^2]
    before: Float[Array, "*batch"]  # last reading [N]
    bias: Float[Array, "*batch"]  # mean of the readings [N]
    total: Float[Array, "*batch"]  # cumulative sum S [1]
    early: Float[Array, "*batch"]  # cumulative sum S' [1]; 0 in front of the specified surface
    missed: Float[Array, "*batch"]  # sum of the readings without bias since the last reading with S' = 0 [N]
    start: Float[Array, "*batch"]  # position of the hardware at the last reading with S' = 0 [m]
    velocity: Float[Array, "*batch"]  # approach velocity at the last reading [m/s]; 0 without an approach


def variance(flight: FreeFlight, noise: Array) -> Float[Array, "*batch"]:
    """Return the noise variance of a force reading [N^2]: the larger of specified and measured value."""
    return jnp.maximum(noise**2, jnp.where(flight.count > MIN_FLIGHT_READINGS, flight.square, 0))


def update(
    old: FreeFlight,
    push: Array,
    sigma: Array,
    settled: Bool[Array, "*batch"],
    inside: Bool[Array, "*batch"],
    position: Array,
) -> FreeFlight:
    """Update the cumulative sums with one reading without bias, `push` [N]; `sigma` is its deviation [N]."""
    total = jnp.where(settled, jnp.maximum(old.total + push / sigma - DRIFT, 0), 0)
    early = jnp.where(settled & inside, jnp.maximum(old.early + push / sigma - EARLY_DRIFT, 0), 0)
    rises = early > 0
    missed, start = jnp.where(rises, old.missed + push, 0), jnp.where(rises, old.start, position)
    return old._replace(total=total, early=early, missed=missed, start=start)


def learn(old: FreeFlight, force: Array) -> FreeFlight:
    """Update the estimates of bias and noise with one force reading [N] of free flight."""
    step = force - old.before
    change = (0.5 * (step * step) - old.square) / jnp.maximum(old.count, 1)
    square = old.square + jnp.where(old.count > 0, change, 0)
    bias = old.bias + (force - old.bias) / jnp.minimum(old.count + 1, MAX_MEAN)
    return old._replace(count=old.count + 1, square=square, before=force, bias=bias)
