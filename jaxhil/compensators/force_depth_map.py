"""A force-depth map of unknown contact, identified while it is met: slopes between knots, and damping.

    f(x, v) = sum_j slope_j clip(x - kappa_j, 0, kappa_{j+1} - kappa_j) + damping v      at x > 0, else 0

Everything is scaled by the approach speed v0 and the mass M: depth x / v0 [s], speed v / v0 [1],
force F / (M v0) [1/s], slope k / M [1/s^2], damping b / M [1/s]. Parameters theta (slopes, then damping) come
first, the batch trails. They start from a Gaussian prior whose slopes wander with depth, and are identified
by recursive least squares (Kalman's update for constant parameters).
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Depth over approach speed [s] at which a segment begins; the last goes on.
KNOTS = np.array([0, 2, 5, 10, 16, 24, 32, 40, 50, 62, 76, 92]) * 1e-3
SEGMENTS = len(KNOTS)
PARAMETERS = SEGMENTS + 1
WIDTHS = np.append(np.diff(KNOTS), np.inf)
WANDERING = 0.03  # s of depth over which a slope wanders by its spread
SHALLOWEST = 0.01  # s of depth by which it is judged how much has been learnt
OUTLYING = 4.0  # times the noise's variance: a force that hardly is noise


class Prior(NamedTuple):
    """Mean (13, *batch) and covariance (13, 13, *batch) of theta; variances [1/s^4, 1/s^4, 1/s^2] of the
    slopes' common value, of their wandering and of the damping."""

    mean: Float[Array, "parameters *batch"]
    covariance: Float[Array, "parameters parameters *batch"]
    common: Float[Array, "*batch"]
    wandering: Float[Array, "*batch"]
    damping: Float[Array, "*batch"]


class Map(NamedTuple):
    """Mean and covariance of theta."""

    mean: Float[Array, "parameters *batch"]
    covariance: Float[Array, "parameters parameters *batch"]


def prior(
    stiffness: Array, common_spread: Array, wandering_spread: Array, damping: Array, damping_spread: Array
) -> Prior:
    """Slopes N(K0, (s_K K0)^2 + (s_S K0)^2 min(kappa_i, kappa_j)/30 ms), damping N(B0, s_B^2).

    stiffness K0 [1/s^2], its spreads s_K, s_S [1], damping B0 and its spread s_B [1/s], of one shape.
    """
    common, wandering = (common_spread * stiffness) ** 2, (wandering_spread * stiffness) ** 2
    shared = _column(np.minimum.outer(KNOTS, KNOTS) / WANDERING, stiffness)
    slopes = common[None, None] + wandering[None, None] * shared
    zeros = jnp.zeros_like(slopes[0])
    covariance = jnp.concatenate(
        [
            jnp.concatenate([slopes, zeros[:, None]], axis=1),
            jnp.concatenate([zeros, zeros[:1] + damping_spread[None] ** 2], axis=0)[None],
        ]
    )
    mean = jnp.concatenate([zeros + stiffness[None], zeros[:1] + damping[None]])
    return Prior(mean, covariance, common, wandering, damping_spread**2)


def ramps(depth: Float[Array, "*batch"]) -> Float[Array, "segments *batch"]:
    """How far [s] each segment is pressed in."""
    beyond = depth[None] - _column(KNOTS, depth)
    return jnp.where(beyond > 0, jnp.minimum(beyond, _column(WIDTHS, depth)), 0)


def features(depth: Array, speed: Array) -> Float[Array, "parameters *batch"]:
    """phi, of which the force is phi.theta."""
    return jnp.concatenate([ramps(depth), speed[None]])


def elastic(slopes: Float[Array, "segments *batch"], depth: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Force [1/s] without damping, 0 out of contact."""
    return jnp.sum(slopes * ramps(depth), axis=0)


def update(old: Map, phi: Array, force: Array, variance: Array, enabled: Array) -> Map:
    """One reading of `force` [1/s] with noise of a `variance` [1/s^2], where `enabled` and either the map or
    the reading itself tells of contact: g = P phi, s = variance + phi.g, theta += g (f - phi.theta)/s,
    P -= g g'/s."""
    expected = jnp.sum(phi * old.mean, axis=0)
    used = enabled & ((expected > 0) | (force**2 > OUTLYING * variance))
    g = jnp.sum(old.covariance * phi[None], axis=1)
    s = variance + jnp.sum(phi * g, axis=0)
    used = used & (s > 0)
    share = jnp.where(used, 1 / jnp.where(used, s, 1), 0)
    scaled = share[None] * g
    return Map(old.mean + scaled * (force - expected)[None], old.covariance - scaled[:, None] * g[None])


def positive_damping(old: Map) -> Float[Array, "*batch"]:
    """Mean [1/s] of the damping, given that it is not negative.

    Of N(m, s^2) truncated at 0: s (t + phi(t)/Phi(t)), t = m/s, phi and Phi the normal density and
    distribution, with Boyd's bound of Mills' ratio, (1 - Phi(u))/phi(u) = pi/((pi - 1) u + sqrt(u^2 + 2 pi)),
    which is exact at 0 and far out, and (1 + u^2/512)^-256 for the density's exponential: algebraic, the same
    on every machine.
    """
    mean, variance = old.mean[-1], old.covariance[-1, -1]
    spread = jnp.sqrt(jnp.where(variance > 0, variance, 1))
    ratio = mean / spread
    root = jnp.sqrt(ratio**2 + 2 * math.pi)
    below = (ratio + root) / math.pi
    positive = jnp.where(ratio > 0, ratio, 0)
    mills = math.pi / ((math.pi - 1) * positive + root)
    # The power of what is at most 1: the other way round it overflows, and so does its derivative.
    density = (1 / (1 + positive**2 / 512)) ** 256 / math.sqrt(2 * math.pi)
    above = positive + density / (1 - density * mills)
    return jnp.where(variance > 0, spread * jnp.where(ratio > 0, above, below), jnp.where(mean > 0, mean, 0))


def learnt(old: Map, prior: Prior, depth: Array, speed: Array) -> Float[Array, "*batch"]:
    """By which share [1] the variance of the force at a depth, 10 ms or deeper, is less than the prior's."""
    phi = features(jnp.where(depth > SHALLOWEST, depth, SHALLOWEST), speed)
    left = jnp.sum(phi * jnp.sum(old.covariance * phi[None], axis=1), axis=0)
    beyond = jnp.where(depth > SHALLOWEST, depth, SHALLOWEST)[None] - _column(KNOTS, depth)
    beyond = jnp.where(beyond > 0, beyond, 0)
    steps = _column(np.append(0, np.diff(KNOTS)) / WANDERING, depth)
    before = (
        prior.common * beyond[0] ** 2
        + prior.wandering * jnp.sum(steps * beyond**2, axis=0)
        + prior.damping * speed**2
    )
    return jnp.where(before > 0, 1 - left / jnp.where(before > 0, before, 1), 0)


def _column(values: np.ndarray, like: Array) -> Array:
    """Constants along leading axes, of the type and with the trailing axes of `like`."""
    return jnp.asarray(values.reshape(*values.shape, *[1] * like.ndim), like.dtype)
