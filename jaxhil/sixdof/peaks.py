"""Peak value of a sampled signal, including peaks between samples."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Peak(NamedTuple):
    """Largest value so far, of samples and of parabolas through three samples that have a peak."""

    largest: Float[Array, "*batch"]
    before: tuple[Array, Array]  # the last two samples
    step: Float[Array, "*batch"]  # time between them [s]


def no_peak(zero: Float[Array, "*batch"]) -> Peak:
    """Return the state before the first sample."""
    return Peak(zero, (zero, zero), zero)


def higher(peak: Peak, now: Array, step: Array, anew: Bool[Array, "*batch"] | bool = False) -> Peak:
    """Update the peak with the sample `now`, a `step` [s] after the last one.

    `anew` means that the sample does not continue a smooth curve. A peak between samples requires that none
    of the three samples is 0.
    """
    first, middle = peak.before
    smooth = (first > 0) & (now > 0) & (middle >= first) & (middle >= now) & (step > 0) & ~jnp.asarray(anew)
    rises, falls = ((late - early) / jnp.where(smooth, length, 1)
                    for early, late, length in ((first, middle, peak.step), (middle, now, step)))  # fmt: skip
    both = peak.step + step
    bend = rises - falls
    has_peak = smooth & (bend > 0)
    slope = (rises * step + falls * peak.step) / jnp.where(has_peak, both, 1)
    vertex = middle + slope**2 * both / (4 * jnp.where(has_peak, bend, 1))
    largest = jnp.maximum(peak.largest, jnp.where(has_peak, vertex, now))
    return Peak(largest, (jnp.where(anew, 0, middle), now), step)
