"""Where a surface is expected: carried from contact to contact, as each finds it anew."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

PER_TICK = 0.25  # how uncertain the surface is, of the ticks until it was found
DRIFT = 1e-6  # m, from contact to contact
ELSEWHERE = 25.0  # times the variance of where the surface is expected


class Plane(NamedTuple):
    """Where surfaces are expected."""

    place: Float[Array, "*shape"]  # by how much they are deeper than told [m]
    spread: Float[Array, "*shape"]  # of that [m]


def found_variance(width: Array, age: Array) -> Float[Array, "*shape"]:
    """Of a surface [m^2] that was met so many ticks before that was found, each of this width [m]."""
    late = PER_TICK * age.astype(width.dtype)
    return width * width * (1 / 12 + late * late)


def learn_plane(old: Plane, low: Array, high: Array, found: Array) -> Plane:
    """Where a surface is expected that was met between two places [m], with the variance `found` [m^2]."""
    known = old.spread * old.spread
    middle = 0.5 * (low + high)
    away = middle - old.place
    elsewhere = away * away > ELSEWHERE * (known + found)
    share = known / (known + found)
    place = jnp.where(elsewhere, middle, old.place + away * share)
    variance = jnp.where(elsewhere, found, share * found)
    return Plane(place, jnp.sqrt(variance + DRIFT * DRIFT))
