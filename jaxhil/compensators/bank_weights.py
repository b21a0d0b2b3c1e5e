"""What the hypotheses of a `delay_bank` weigh, and the mean of their maps by these weights."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.compensators.entry import DENSITY_SQUARINGS, cumulative
from jaxhil.compensators.force_depth_map import KNOTS, PLACES, PRELOAD, SEGMENTS, Curve, Map, positive_mean
from jaxhil.compensators.hypotheses import DELAYS, FIRST_LAG
from jaxhil.compensators.onset import exponential

ELASTIC = 0.35  # probability that a contact has no damping
NOTHING = 1e-300  # a smaller product is none: some machines keep such numbers, some do not


def weighed(carried: Array, evidence: Array) -> Float[Array, "hypotheses *batch"]:
    """What is carried, by this contact's evidence. Whether it is a lag only maps whose slopes wander decide,
    as those of lags do: the sum over delays is what it would be if all were such."""
    weights = carried * evidence
    wandering, steady = carried[:DELAYS], carried[DELAYS:FIRST_LAG]
    delayed, as_lags = weights[:FIRST_LAG], (wandering + steady) * evidence[:DELAYS]
    # Next to a lag all of them may be next to nothing, whose square is none.
    most = lax.stop_gradient(jnp.max(delayed, axis=0, keepdims=True))
    ratio = jnp.sum(as_lags / most, axis=0) / jnp.sum(delayed / most, axis=0)
    return jnp.concatenate([delayed * ratio[None], weights[FIRST_LAG:]])


def plausibility(mean: Array, variance: Array, prior: Array) -> Float[Array, "*batch"]:
    """How much better a damping N(mean, variance) [1/s] goes with one that is 0 or not negative than one
    N(0, prior) does; Phi as in `positive_mean`."""
    spread = jnp.sqrt(variance)
    ratio = mean / spread
    density = exponential(0.5 * ratio**2, DENSITY_SQUARINGS)
    prior = jnp.where(prior > 0, prior, 1)
    return ELASTIC * (jnp.sqrt(prior) / spread) * density + (1 - ELASTIC) * (2 * cumulative(ratio))


def average(maps: Map, weights: Float[Array, "hypotheses *batch"], knots: Array) -> Curve:
    """What counts of the maps, by their weights; of the force at the usual knots."""
    own, preload = maps.mean[:SEGMENTS], maps.mean[PRELOAD]
    usual = jnp.asarray(KNOTS.reshape(-1, *[1] * weights.ndim), weights.dtype)
    reached = jnp.concatenate([preload[None], own[:-1] * jnp.diff(knots, axis=0)])
    past = usual - knots
    there = jnp.where(past < 0, jnp.concatenate([own[:1], own[:-1]]), own)
    at_knots = jnp.sum(weights[None] * (jnp.cumsum(reached, axis=0) + past * there), axis=1)
    slopes = jnp.diff(at_knots, axis=0) / jnp.diff(usual[:, 0], axis=0)
    slopes = jnp.concatenate([slopes, jnp.sum(weights * own[-1], axis=0)[None]])
    lost = (
        jnp.sum(positive_mean(maps.mean[i], maps.covariance[i, i]) * weights, axis=0) for i in PLACES[:-1]
    )
    return Curve(slopes, *lost, preload=at_knots[0])


def floored_shares(values: Array, least: float) -> Array:
    """Of their sum, at least so much."""
    values = jnp.where(values < NOTHING, 0, values)
    shares = values / jnp.sum(values, axis=0, keepdims=True)
    return jnp.where(shares > least, shares, least)
