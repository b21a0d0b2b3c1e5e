"""Alignment in JAX: delays the measured position and velocity by the delay of the force measurement."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.laws.simulation_base import Signals


class Aligned(NamedTuple):
    """State of the alignment: positions measured before the next tick, with the force delay tau."""

    middle: Float[Array, "*batch"]  # position measured tau before the next tick [m]
    last: Float[Array, "*batch"]  # position measured tau + T before the next tick [m]


def align(
    old: Aligned, newest: Array, share: Array, signals: Signals, period: Array
) -> tuple[Array, Array, Aligned]:
    """Return the measured position [m] and velocity [m/s], delayed like the force, and the next state.

    `newest` [m] is the measured position, delayed by one tick less than the force.
    """
    begins = signals.age == 0
    stride = period * signals.velocity_desired
    middle = jnp.where(begins, newest - stride, old.middle)
    last = jnp.where(begins, newest - 2 * stride, old.last)
    position = newest + share * (middle - newest)
    return position, (newest - last) / (2 * period), Aligned(newest, middle)
