"""The readings of a tick as the retrospective laws use them: as old as one another, and how noisy."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.compensators.base import Gains, Signals
from jaxhil.compensators.history import History

SEEN = 8  # differences between readings that show how noisy the force is
OUTSTANDING = 32.0  # times the noise's variance: what hardly is noise


class Aligned(NamedTuple):
    """Measured positions of the tick before."""

    middle: Float[Array, "*batch"]  # delayed by tau [m]
    last: Float[Array, "*batch"]  # delayed by tau + T [m]


class Noise(NamedTuple):
    """Of the forces read out of contact."""

    squares: Float[Array, "*batch"]  # sum of half the squares of differences between successive ones [N^2]
    number: Float[Array, "*batch"]  # how many they are


def align(
    old: Aligned, newest: Array, share: Array, signals: Signals, period: Array
) -> tuple[Array, Array, Aligned]:
    """Measured position [m] and velocity [m/s] as old as the force that is read, `newest` being the position
    a tick less than the delay ago; what is kept."""
    begins = signals.age == 0
    stride = period * signals.velocity_desired
    middle = jnp.where(begins, newest - stride, old.middle)
    last = jnp.where(begins, newest - 2 * stride, old.last)
    position = newest + share * (middle - newest)
    return position, (newest - last) / (2 * period), Aligned(newest, middle)


def take_noise(gains: Gains, old: Noise, history: History, force: Array, shown: Array, free: Array) -> Noise:
    """A reading [N] after those of the history: where the hardware is `free`, the difference tells how noisy
    the force is."""
    before, shown_before = history.reading
    step = force - before
    stands = (old.number >= SEEN) & (step * step > OUTSTANDING * force_noise(gains, old))
    taken = free & shown & (shown_before > 0) & ~stands
    return Noise(old.squares + jnp.where(taken, 0.5 * (step * step), 0), old.number + jnp.where(taken, 1, 0))


def force_noise(gains: Gains, seen: Noise) -> Float[Array, "*batch"]:
    """The force's variance [N^2]: what the gains say, or what readings out of contact show if that is
    more."""
    known = gains["force_noise"] ** 2
    shown = seen.squares / jnp.where(seen.number > 0, seen.number, 1)
    return jnp.where(shown > known, shown, known)
