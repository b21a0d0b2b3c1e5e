"""Conversion between gains and unit coordinates, which are 0 at the lower and 1 at the upper bound."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class GainBounds(NamedTuple):
    """Bounds of each gain, and whether its scale is logarithmic."""

    lower: Float[Array | np.ndarray, "*problems gains"]  # lower bound
    upper: Float[Array | np.ndarray, "*problems gains"]  # upper bound
    logarithmic: Float[Array | np.ndarray, "*problems gains"]  # 1 for a logarithmic scale, else 0


def to_gains(coordinates: Float[Any, "*points gains"], bounds: GainBounds) -> Float[Any, "*points gains"]:
    """Convert unit coordinates to gains; NumPy arrays give NumPy arrays, JAX arrays give JAX arrays.

    A coordinate outside [0, 1] is clipped; its derivative is the same as without clipping.
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
    """Convert gains to unit coordinates, clipped to [0, 1]; a gain with equal bounds has coordinate 0."""
    lower, upper = np.asarray(bounds.lower), np.asarray(bounds.upper)
    curved = (np.asarray(bounds.logarithmic) > 0) & (upper > lower)
    span = np.where(upper > lower, upper - lower, 1)
    share = (gains - lower) / span
    low, high = np.log(np.where(curved, lower, 1)), np.log(np.where(curved, upper, 2))
    positive = np.where(curved, np.maximum(gains, lower), 1)
    share = np.where(curved, (np.log(positive) - low) / (high - low), share)
    return np.clip(np.where(upper > lower, share, 0), 0, 1)
