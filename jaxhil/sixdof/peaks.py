"""The largest size of something that is sampled, between its samples too."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Peak(NamedTuple):
    """Largest size so far: of samples, and of the parabola through three of them that has a crest."""

    largest: Float[Array, "*batch"]
    before: tuple[Array, Array]  # the last two samples
    step: Float[Array, "*batch"]  # from the one to the other [s]


def no_peak(zero: Float[Array, "*batch"]) -> Peak:
    """Before the first sample."""
    return Peak(zero, (zero, zero), zero)


def higher(peak: Peak, now: Array, step: Array, anew: Bool[Array, "*batch"] | bool = False) -> Peak:
    """After another sample, a `step` [s] later; `anew` says that it is none of a smooth curve with those
    before. A crest has three samples that are not 0."""
    first, middle = peak.before
    known = (first > 0) & (now > 0) & (middle >= first) & (middle >= now) & (step > 0) & ~jnp.asarray(anew)
    rises, falls = ((late - early) / jnp.where(known, length, 1)
                    for early, late, length in ((first, middle, peak.step), (middle, now, step)))  # fmt: skip
    both = peak.step + step
    bend = rises - falls
    crest = known & (bend > 0)
    slope = (rises * step + falls * peak.step) / jnp.where(crest, both, 1)
    vertex = middle + slope**2 * both / (4 * jnp.where(crest, bend, 1))
    largest = jnp.maximum(peak.largest, jnp.where(crest, vertex, now))
    return Peak(largest, (jnp.where(anew, 0, middle), now), step)
