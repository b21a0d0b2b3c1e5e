"""Conversion between gains and unit coordinates, which are shares of a linear or logarithmic range."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class GainBounds(NamedTuple):
    """Range of each gain."""

    lower: Float[Array | np.ndarray, "*problems gains"]  # lower bound
    upper: Float[Array | np.ndarray, "*problems gains"]  # upper bound
    logarithmic: Float[Array | np.ndarray, "*problems gains"]  # 1 for a logarithmic scale, else 0


def to_gains(coordinates: Float[Any, "*points gains"], bounds: GainBounds) -> Float[Any, "*points gains"]:
    """Return the gains at unit `coordinates`, as NumPy or JAX arrays like the input.

    A coordinate outside [0, 1] is clipped, but keeps the derivative of one inside.
    """
    xp = jnp if isinstance(coordinates, jax.Array) else np
    inside = xp.clip(coordinates, 0, 1)
    if xp is jnp:
        inside = coordinates + jax.lax.stop_gradient(inside - coordinates)
    curved = bounds.logarithmic > 0
    straight = bounds.lower + (bounds.upper - bounds.lower) * inside
    low, high = (xp.log(xp.where(curved, bound, 1)) for bound in (bounds.lower, bounds.upper))
    return xp.where(curved, xp.exp(xp.where(curved, low + (high - low) * inside, 0)), straight)


def to_coordinates(
    gains: Float[np.ndarray, "*points gains"], bounds: GainBounds
) -> Float[np.ndarray, "*points gains"]:
    """Return the unit coordinates of gains, clipped to [0, 1]; 0 if both bounds are equal."""
    lower, upper = np.asarray(bounds.lower), np.asarray(bounds.upper)
    curved = (np.asarray(bounds.logarithmic) > 0) & (upper > lower)
    span = np.where(upper > lower, upper - lower, 1)
    share = (gains - lower) / span
    low, high = np.log(np.where(curved, lower, 1)), np.log(np.where(curved, upper, 2))
    positive = np.where(curved, np.maximum(gains, lower), 1)
    share = np.where(curved, (np.log(positive) - low) / (high - low), share)
    return np.clip(np.where(upper > lower, share, 0), 0, 1)
