"""Peak value of a sampled signal, with interpolation between the samples."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Peak(NamedTuple):
    """Largest value of a signal so far, and the last two samples."""

    largest: Float[Array, "*batch"]  # largest sample or vertex of a parabola through three samples
    before: tuple[Array, Array]  # last two samples
    step: Float[Array, "*batch"]  # time between the last two samples [s]


def zero_peak(zero: Float[Array, "*batch"]) -> Peak:
    """Return the initial `Peak`, whose value and samples are 0 in every lane."""
    return Peak(zero, (zero, zero), zero)


def update_peak(peak: Peak, now: Array, step: Array, anew: Bool[Array, "*batch"] | bool = False) -> Peak:
    """Update the peak with the sample `now`, taken a time `step` [s] after the last sample.

    A peak between samples is the vertex of a parabola through the last three samples, which must be greater
    than 0. `anew` marks the first sample after a jump or kink; no parabola is fitted across it.
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
