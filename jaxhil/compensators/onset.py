"""Where the hardware's surface is: the tick from which on the force tells of contact.

While the numerical model flies freely, the hardware may have met the surface in any tick. Since then the
force would be y = b + B + K s, s the time since the middle of that tick, K ~ N(K0, s_K^2), B ~ N(0, s_B^2);
before, y = b, the sensor's bias. Its evidence against free flight throughout has a closed form in sums over
the readings; the surface is found when the evidence of the best tick, with how likely a surface is there,
exceeds e^CERTAIN. The surface is expected at a place with a spread s: of a distance d s from there its
density is 1/(pi s (1 + d^2)). The farther back, the fewer ticks are tried; beside the best of them all are,
by ever smaller steps. Scaled by approach speed and mass: forces in 1/s, K in 1/s^2.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.compensators.history import SLOTS

# Ticks since the surface was met that are tried first, what bounds them, and the steps from the best of them.
AGES = np.array([1, 2, 3, 4, 5, 6, 8, 11, 16, 24, 36, 56, 88, 140, 224], np.int32)
BOUNDS = np.array([0, *AGES, 225], np.int32)
STEPS = (32, 16, 8, 4, 2, 1)
STIFFNESS = 300.0  # K0 [1/s^2]
STIFFNESS_VARIANCE = 160000.0  # s_K^2 [1/s^4]
JUMP_VARIANCE = 36.0  # s_B^2 [1/s^2]
CERTAIN = 9.0
WAIT = 0.004  # s, and a tick, since the surface was met: then its stiffness shows
LONGEST_FLIGHT = 65536  # ticks of a flight up to which the sums are exact enough; then they begin anew
BESIDE = 8  # steps to both sides of what was found, together its age
SQUARINGS = 10


class Onset(NamedTuple):
    """The readings of a flight that the sensor showed."""

    watched: Int[Array, "*batch"]  # ticks of the flight
    sums: Float[Array, "5 *batch"]  # of 1, the tick m, m^2, y [1/s] and m y
    ring: Float[Array, "slots 5 *batch"]  # of the sums


class Found(NamedTuple):
    """A surface."""

    detected: Bool[Array, "*batch"]  # whether it is
    age: Int[Array, "*batch"]  # ticks since it was met
    bias: Float[Array, "*batch"]  # of the force [1/s]
    stiffness: Float[Array, "*batch"]  # the most that it may be, by three standard deviations [1/s^2]
    earlier: Float[Array, "*batch"]  # ticks by which it was met before the middle of that tick, in the mean
    variance: Float[Array, "*batch"]  # of that, where the surface is not expected anywhere


def no_onset(like: Float[Array, "*batch"]) -> Onset:
    """Before the first tick."""
    zeros = jnp.zeros((5, *like.shape), like.dtype)
    return Onset(jnp.zeros(like.shape, jnp.int32), zeros, jnp.zeros((SLOTS, *zeros.shape), like.dtype))


def watch(
    old: Onset, tick: Int[Array, ""], flies: Bool[Array, "*batch"], force: Array, shown: Array
) -> Onset:
    """A reading [1/s] more where the model `flies` to a surface; elsewhere the next flight is to begin."""
    starts = old.watched == LONGEST_FLIGHT
    watched = jnp.where(flies, jnp.where(starts, 0, old.watched) + 1, 0)
    m = watched.astype(force.dtype)
    terms = jnp.stack([jnp.ones_like(force), m, m * m, force, m * force])
    sums = jnp.where((starts | ~flies)[None], 0, old.sums)
    sums = sums + jnp.where((shown & flies)[None], terms, 0)
    return Onset(watched, sums, lax.dynamic_update_index_in_dim(old.ring, sums, tick & (SLOTS - 1), 0))


def find(
    onset: Onset,
    tick: Int[Array, ""],
    period: Array,
    noise: Array,
    unknown: Array,
    rarity: Callable[[Array], Array],
) -> Found:
    """The surface, by the variances of a reading (`noise`) and of the bias (`unknown`) [1/s^2]; one met so
    many ticks ago as `rarity` is given (ages, *batch) is one over that as likely as none."""
    scales = period[None], noise[None], unknown[None]

    def evidence(ages):
        before = _sums_before(onset, tick, ages)
        # What is compared alone moves nothing that is differentiated.
        return _suppose(*lax.stop_gradient((onset, before, ages, *scales, rarity(ages))))[0]

    ages = jnp.asarray(AGES.reshape(-1, *[1] * period.ndim))
    tried = jnp.where(ages < onset.watched[None], evidence(ages), -CERTAIN)
    best = jnp.argmax(tried, axis=0)
    first = jnp.asarray(AGES)[best], jnp.take_along_axis(tried, best[None], axis=0)[0]
    certain = (first[0] < onset.watched) & (first[1] > CERTAIN)
    below, above = jnp.asarray(BOUNDS)[best], jnp.asarray(BOUNDS)[best + 2]

    def nearer(reached, step):
        age, most = reached
        others = jnp.stack([age - step, age + step])
        within = (others > below[None]) & (others < above[None]) & (others < onset.watched[None])
        tried = certain[None] & within
        found = jnp.where(tried, evidence(jnp.where(tried, others, age[None])), most[None])
        for other, one in zip(others, found, strict=True):
            age, most = jnp.where(one > most, other, age), jnp.maximum(one, most)
        return (age, most), None

    def beside():
        # A loop that is not written out: what each step compares hangs on all steps before.
        return lax.scan(nearer, first, jnp.asarray(STEPS, jnp.int32))[0]

    age = lax.cond(jnp.any(certain), beside, lambda: first)[0]
    _, bias, stiffness = _suppose(onset, _sums_before(onset, tick, age[None]), age[None], *scales, 1.0)
    waited = (age > 1) & (age.astype(period.dtype) * period >= WAIT * (1 - 1e-9))
    detected = certain & waited

    def around():
        return _spread(onset, tick, age, lax.stop_gradient(scales))

    zeros = jnp.zeros_like(period)
    earlier, variance = lax.cond(jnp.any(detected), around, lambda: (zeros, zeros))
    return Found(detected, age, bias[0], stiffness[0], earlier, variance)


def nothing_found(like: Float[Array, "*batch"]) -> Found:
    """No surface."""
    zeros = jnp.zeros_like(like)
    return Found(zeros > 0, zeros.astype(jnp.int32) + 1, *[zeros] * 4)


def rarity(away: Array, spread: Array, width: Array) -> Array:
    """One over the probability of a surface in a stretch of this width, so far `away` from where it is
    expected."""
    distance = away / spread
    return math.pi * spread * (1 + distance * distance) / width


def logarithm(z: Array) -> Array:
    """ln z, of a positive number that is not extreme; by square roots alone, the same on every machine."""
    for _ in range(10):
        z = jnp.sqrt(z)
    return 2048 * (z - 1) / (z + 1)


def exponential(u: Array, squarings: int) -> Array:
    """(1 + u/n)^-n, n = 2^squarings: exp(-u), and less steep far out."""
    value = 1 / (1 + u / 2**squarings)
    for _ in range(squarings):
        value = value * value
    return value


def _spread(onset: Onset, tick: Array, age: Array, scales: tuple[Array, Array, Array]):
    """How much earlier than found the surface was met, in the mean, and the variance of that, by the ticks
    beside it [ticks]."""
    beside = (
        jnp.arange(-BESIDE, BESIDE + 1, dtype=jnp.int32).reshape(-1, *[1] * age.ndim)
        * (1 + age // (2 * BESIDE))[None]
    )
    ages = age[None] + beside
    counts = (beside != 0) & (ages >= 1) & (ages < onset.watched[None]) & (ages <= AGES[-1])
    ages = jnp.where(counts, ages, age[None])
    evidence = _suppose(onset, _sums_before(onset, tick, ages), ages, *scales, 1.0)[0]
    most = evidence[BESIDE]
    weights = jnp.where(counts & (evidence > -CERTAIN), exponential(most[None] - evidence, SQUARINGS), 0)
    earlier = beside.astype(evidence.dtype)
    total = 1 + jnp.sum(weights, axis=0)  # with that of what was found
    mean = jnp.sum(weights * earlier, axis=0) / total
    return lax.stop_gradient((mean, jnp.sum(weights * earlier**2, axis=0) / total - mean * mean))


def _sums_before(onset, tick, ages):
    """The sums (5, ages, *batch) so many ticks ago."""
    slots = ((tick - ages) & (SLOTS - 1))[:, None]
    return jnp.moveaxis(jnp.take_along_axis(onset.ring, slots, axis=0, mode="promise_in_bounds"), 1, 0)


def _suppose(onset, before, ages, period, noise, unknown, rarity):
    """ln of the evidence for a surface met `ages` ticks ago against none, the bias [1/s] by it, and the most
    that its stiffness may be [1/s^2]; the sums as they were `before` (5, ages, *batch)."""
    number_before, ticks_before, squares_before, forces_before, moments_before = before
    number, all_ticks, all_squares, forces, moments = onset.sums[:, None]
    middle = (onset.watched[None] - ages).astype(period.dtype) + 0.5
    known = number_before * unknown + noise
    bias = forces_before * unknown / known
    left = unknown * noise / known
    n = number - number_before
    ticks = (all_ticks - ticks_before) - middle * n
    squares = (all_squares - squares_before) - middle * (2 * (all_ticks - ticks_before) - middle * n)
    force = forces - forces_before
    moment = (moments - moments_before) - middle * force
    s = period * ticks
    y = force - bias * n
    p = noise / STIFFNESS_VARIANCE + period * period * squares
    jump = JUMP_VARIANCE + left
    r = noise / jump + n
    f = noise * (STIFFNESS / STIFFNESS_VARIANCE) + (period * moment - bias * s)
    determinant = p * r - s * s
    explained = (r * f * f - 2 * (s * f * y) + p * y * y) / determinant
    silence = noise + n * left
    occam = determinant * (STIFFNESS_VARIANCE * jump) / (noise * silence)
    prior = STIFFNESS * STIFFNESS / STIFFNESS_VARIANCE
    silent = y * y * left / (noise * silence)
    evidence = 0.5 * (explained / noise - prior - silent - logarithm(occam * rarity * rarity))
    stiffness = ((r * f - s * y) + 3 * jnp.sqrt(r * noise * determinant)) / determinant
    return jnp.where((y > 0) & (determinant > 0), evidence, -CERTAIN), bias, stiffness
