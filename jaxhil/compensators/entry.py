"""How well the surface of each hypothesis goes with the readings about the tick in which it was met.

Near the entry a map expects f(x) = f_0 + K x at depth x, by its own surface, and has that surface where its
preload P is undone, at x = -P/K; of P, what is known of a true preload beforehand counts as one. Where a
surface was told, the place is the mean of both by how certain either is. Readings y_i at depths x_1 < x_2 <
.. about the tick: if the surface lies between x_(j-1) and x_j, those from j on are f(x_i), those before 0.
With L_j their likelihood, a hypothesis is as likely as sum_j L_j P(x_(j-1) < place < x_j). Where none of them
has its surface where the readings begin, as behind a lag, all are less likely, by the root of what the best
has of the greatest L_j: a root, as the likelihood of all other readings.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxhil.compensators.force_depth_map import DAMPING, FRICTION, PRELOAD, Map
from jaxhil.compensators.lagged_onset import Window
from jaxhil.compensators.meeting import Meeting
from jaxhil.compensators.onset import SQUARINGS, exponential

TICKS_BESIDE = 4  # on either side of where the surface was met, whose readings count
MOST_BESIDE = 10  # of these, the first
APART, TICKS_APART = 3.0, 1.5  # standard deviations, and ticks, that it is from there at most
USUAL = 0.5  # stiffness, of the most that it may be
GENTLEST = 1.0  # 1/s^2: what has less of a slope tells of no place
NOT_THERE = 9.0  # times the variance of where the surface is expected: it is not there
UNLIKELY = 0.1  # that it is not, at least
LEAST_AGREED = 1e-12  # of the likelihood of the best: what is ruled out can come back
DENSITY_SQUARINGS = 8  # n = 2^8 of a normal density


class Entry(NamedTuple):
    """Where a contact was entered; depths of `delays` by their own surfaces."""

    depths: Float[Array, "readings *batch"]  # of the readings beside it, beyond where it was met [s]
    forces: Float[Array, "readings *batch"]  # [1/s]
    counts: Bool[Array, "readings *batch"]  # which of these are some
    variance: Float[Array, "*batch"]  # of the forces [1/s^2]
    met: Float[Array, "*batch"]  # depth at which the surface was met, by the given delay [s]
    farthest: Float[Array, "*batch"]  # by how much it may lie elsewhere [s]
    deeper: Float[Array, "delays *batch"]  # depth at which it was met [s]
    told: Float[Array, "delays *batch"]  # depth at which it was told [s]
    known: Float[Array, "*batch"]  # variance of that [s^2]
    preload: Float[Array, "*batch"]  # spread of the preload by which a map finds its place [1/s]
    placed: Float[Array, "*batch"]  # share of the preload's variance that this makes
    true: Float[Array, "*batch"]  # variance of a true preload [1/s^2]
    between: Float[Array, "*batch"]  # variance of the delays that a hypothesis stands for [s^2]
    level: Float[Array, "*batch"]  # by how much the wider preload made the readings less likely


class Entered(NamedTuple):
    """By each hypothesis."""

    place: Float[Array, "delays *batch"]  # depth of the surface [s]
    likely: Float[Array, "delays *batch"]  # how likely it is


def no_entry(like: Float[Array, "*batch"], delays: int) -> Entry:
    """Before the first contact."""
    zeros = jnp.zeros((MOST_BESIDE, *like.shape), like.dtype)
    each, one, zero = jnp.zeros((delays, *like.shape), like.dtype), jnp.ones_like(like), jnp.zeros_like(like)
    return Entry(zeros, zeros, zeros > 0, one, zero, zero, each, each, one, zero, one, zero, zero, one)


def enter(
    meeting: Meeting,
    window: Window,
    length: Array,
    tick: Array,
    deeper: Float[Array, "delays *batch"],
    places: Float[Array, "delays *batch"],
    known: Array,
    true: Array,
    step: Array,
) -> Entry:
    """By hypotheses with their surfaces at these places, met so much deeper [m]; it is `known` so well where
    it was told [m^2], what a true preload may be [1/s^2], the step from delay to delay [s]. A second is
    `length` [m]; a tick [s]."""
    met = meeting.variance > 0
    spread = jnp.where(met, jnp.sqrt(jnp.where(met, meeting.variance, 1)), 0) / length
    ticks = spread / tick * (spread / tick) - 1 / 12
    wide = ticks > 0
    farthest = (APART * jnp.where(wide, jnp.sqrt(jnp.where(wide, ticks, 1)), 0) + TICKS_APART) * tick
    near = jnp.minimum(farthest, TICKS_BESIDE * tick)[None]
    chosen = window.shown & (window.depth > -near) & (window.depth < near)
    rank = jnp.cumsum(chosen, axis=0)
    slots = jnp.arange(1, MOST_BESIDE + 1).reshape(-1, *[1] * rank.ndim)
    picked = chosen[None] & (rank[None] == slots)
    depths, forces = (
        jnp.sum(jnp.where(picked, each[None], 0), axis=1) for each in (window.depth, window.force)
    )
    preload = meeting.stiffness * farthest
    square = preload * preload
    steep = square > 0
    return Entry(
        depths, forces, jnp.any(picked, axis=1), window.variance,
        (meeting.place - meeting.scales.plane) / length, farthest, deeper / length[None],
        -places / length[None], known / (length * length), preload,
        jnp.where(steep, square / jnp.where(steep, square + true, 1), 1), true, step * step / 12,
        jnp.where(met, farthest / (USUAL * jnp.where(met, spread, 1)), 1),
    )  # fmt: skip


def agree(entry: Entry, maps: Map) -> Entered:
    """By the maps of the delays."""
    slope, covariance = maps.mean[0], maps.covariance
    steep = slope > GENTLEST
    k = jnp.where(steep, slope, 1)
    known, placed, true = entry.known[None], entry.placed[None], entry.true[None]
    own = -(maps.mean[PRELOAD] / k)
    square = own * own * covariance[0, 0] + 2 * (own * covariance[0, PRELOAD]) + covariance[PRELOAD, PRELOAD]
    variance = (placed * placed * square + placed * true) / (k * k)
    variance = jnp.where(variance > 0, variance, 0)
    own = placed * own
    away = own - entry.told
    both = known + variance
    gone = away * away / both
    elsewhere = gone > NOT_THERE
    there = exponential(0.5 * gone, DENSITY_SQUARINGS) * jnp.sqrt(known / both)
    share = jnp.where(elsewhere, 0, variance / both)
    place = jnp.where(steep, own - share * away, 0)
    square = jnp.where(elsewhere, variance, variance * (known / both)) + entry.between[None]
    spread = jnp.sqrt(jnp.where(square > 0, square, 1))
    began = _began(entry, maps, place, spread)
    there = jnp.where(steep & (there > UNLIKELY), there, UNLIKELY)
    return Entered(
        jnp.clip(place, -entry.farthest[None], entry.farthest[None]), entry.level[None] * (began * there)
    )


def _began(entry: Entry, maps: Map, place: Array, spread: Array) -> Float[Array, "delays *batch"]:
    """sum_j L_j P(x_(j-1) < place < x_j), in terms of the greatest, times the root of that over the greatest
    L_j."""
    mean, covariance = maps
    jumps = mean[PRELOAD] + mean[DAMPING] + mean[FRICTION]
    of_jumps = covariance[PRELOAD, PRELOAD] + covariance[DAMPING, DAMPING] + 2 * covariance[DAMPING, PRELOAD]
    of_both = covariance[0, PRELOAD] + covariance[0, DAMPING]
    depths = entry.depths[:, None] + entry.deeper[None]
    uncertain = of_jumps[None] + depths * (2 * of_both[None] + depths * covariance[0, 0][None])
    noise = entry.variance[None, None]
    precision = 1 / (noise + jnp.where(uncertain > 0, uncertain, 0))
    forces, counts = entry.forces[:, None], entry.counts[:, None]
    missed = forces - (jumps[None] + mean[0][None] * depths)
    better = jnp.where(counts, 0.5 * (forces * forces / noise - missed * missed * precision), 0)
    known = jnp.where(counts, noise * precision, 1)
    below = jnp.where(counts, cumulative((depths - place[None]) / spread[None]), 1)
    none, one = jnp.zeros_like(depths[:1]), jnp.ones_like(depths[:1])
    since = jnp.concatenate([jnp.cumsum(better[::-1], axis=0)[::-1], none])
    sharpness = jnp.sqrt(jnp.concatenate([jnp.cumprod(known[::-1], axis=0)[::-1], one]))
    within = jnp.concatenate([below, one]) - jnp.concatenate([none, below])
    within = jnp.where(within > 0, within, 0)  # none where the hardware went back
    most = lax.stop_gradient(jnp.max(since, axis=(0, 1), keepdims=True))
    each = exponential(most - since, SQUARINGS) * sharpness
    likely = jnp.sum(each * within, axis=0)
    best = jnp.max(likely, axis=0, keepdims=True)
    agreed = best / jnp.max(each, axis=(0, 1), keepdims=True)[0]
    agreed = jnp.sqrt(jnp.where(agreed > LEAST_AGREED, agreed, LEAST_AGREED))
    likely = likely / jnp.where(best > 0, best, 1)
    return jnp.where(likely > LEAST_AGREED, likely, LEAST_AGREED) * agreed


def cumulative(ratio: Array) -> Float[Array, "*batch"]:
    """Phi, the normal distribution, with Mills' ratio as in `force_depth_map.positive_mean`."""
    density = exponential(0.5 * (ratio * ratio), DENSITY_SQUARINGS)
    size = jnp.where(ratio > 0, ratio, -ratio)
    mills = math.pi / ((math.pi - 1) * size + jnp.sqrt(size * size + 2 * math.pi))
    beyond = density * mills * (1 / math.sqrt(2 * math.pi))
    return jnp.where(ratio > 0, 1 - beyond, beyond)
