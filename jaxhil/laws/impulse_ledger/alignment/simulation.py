"""Alignment of the measured position with the force: position and velocity as old as the force reading."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.laws.simulation_base import Signals


class Aligned(NamedTuple):
    """Measured positions of the last tick."""

    middle: Float[Array, "*batch"]  # delayed by tau on this tick [m]
    last: Float[Array, "*batch"]  # delayed by tau + T on this tick [m]


def align(
    old: Aligned, newest: Array, share: Array, signals: Signals, period: Array
) -> tuple[Array, Array, Aligned]:
    """Return measured position [m] and velocity [m/s], as old as the force, and the state.

    `newest` is the position [m] measured one tick less than the delay ago.
    """
    begins = signals.age == 0
    stride = period * signals.velocity_desired
    middle = jnp.where(begins, newest - stride, old.middle)
    last = jnp.where(begins, newest - 2 * stride, old.last)
    position = newest + share * (middle - newest)
    return position, (newest - last) / (2 * period), Aligned(newest, middle)
