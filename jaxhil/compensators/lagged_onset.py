"""Where a surface was met if the force sensor lags.

Since the surface was met, s ago, contact pushes with B + K s; through a sensor that lags by l that is read as
B g + K (s - l g), g = 1 - exp(-s/l), and looks as if it were met later. Of each lag, PLACES places from
l + BEFORE ticks before where it was met by the readings alone until AFTER ticks behind that are tried, with
B ~ N(0, 1) and K as the onset has it: the likelihood of the readings has a closed form in five sums over
them. Depths in s, forces in 1/s.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxhil.compensators.onset import SQUARINGS, STIFFNESS, STIFFNESS_VARIANCE, exponential

WINDOW = 40  # newest readings that count
PLACES = 8
BEFORE, AFTER = 3.0, 1.0  # ticks
DAMPING_VARIANCE = 1.0  # of B [1/s^2]


class Window(NamedTuple):
    """The newest readings."""

    depth: Float[Array, "readings *batch"]  # beyond where the surface was met by them alone [s]
    force: Float[Array, "readings *batch"]  # [1/s]
    shown: Bool[Array, "readings *batch"]  # whether the sensor showed it
    variance: Float[Array, "*batch"]  # of the forces [1/s^2]


def lagged_onsets(
    lags: Float[Array, "lags *batch"], window: Window, tick: Array
) -> tuple[Float[Array, "lags *batch"], Float[Array, "lags *batch"]]:
    """Of each lag [s] the mean [s] and the variance [s^2] of the place; a tick [s]."""
    first = lags + BEFORE * tick[None]
    width = first + AFTER * tick[None]
    steps = jnp.asarray(np.linspace(0, 1, PLACES).reshape(1, -1, *[1] * tick.ndim), lags.dtype)
    places = width[:, None] * steps - first[:, None]
    lag, noise = lags[None, :, None], window.variance[None, None, None]
    s = window.depth[:, None, None] - places[None]
    beyond = (s > 0) & window.shown[:, None, None]
    s = jnp.where(beyond, s, 0)
    force = jnp.where(beyond, window.force[:, None, None], 0)
    g = 1 - exponential(s / lag, SQUARINGS)
    q = s - lag * g
    a = 1 / DAMPING_VARIANCE + jnp.sum(g * g / noise, axis=0)
    b = jnp.sum(g * q / noise, axis=0)
    c = 1 / STIFFNESS_VARIANCE + jnp.sum(q * q / noise, axis=0)
    y = jnp.sum(g * force / noise, axis=0)
    z = STIFFNESS / STIFFNESS_VARIANCE + jnp.sum(q * force / noise, axis=0)
    determinant = a * c - b * b
    explained = 0.5 * (c * y * y - 2 * b * y * z + a * z * z) / determinant
    most = jnp.max(explained, axis=1, keepdims=True)
    likely = exponential(most - explained, SQUARINGS) / jnp.sqrt(determinant)
    total = jnp.sum(likely, axis=1)
    mean = jnp.sum(likely * places, axis=1) / total
    square = jnp.sum(likely * places**2, axis=1) / total
    return mean, square - mean**2 + (width / (PLACES - 1)) ** 2 / 12
