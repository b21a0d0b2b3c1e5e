"""Contact model in JAX: estimate, force and features of `jaxhil.runtime.laws.contact_model`, for batches.

The model, its equation and its sources stand there. Arrays have parameters first and the batch last.
"""

import math
from functools import reduce
from operator import add
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxhil.runtime.laws.contact_model import (
    BROAD,
    DAMPING,
    DEPTH_DAMPING,
    DISSIPATIVE,
    FRICTION,
    KNOTS,
    LEAST_VARIANCE,
    ODDS,
    PARAMETERS,
    PRELOAD,
    REACH,
    SLOW,
    UNLOADING,
    WANDER,
)


class Estimate(NamedTuple):
    """Estimate of theta."""

    mean: Float[Array, "parameters *batch"]  # posterior mean, dissipative parameters of either sign
    covariance: Float[Array, "parameters parameters *batch"]
    theta: Float[Array, "parameters *batch"]  # posterior mean, dissipative parameters zero or positive


def prior(stiffness: Array, spreads: tuple[Array, ...]) -> tuple[Array, Array]:
    """Return the prior mean and the prior variances of theta.

    `spreads` are the standard deviations of the slope at depth 0 [1/s^2], of its change over `WANDER`
    [1/s^2], of damping [1/s], depth damping [1/s], unloading [1/s^2], friction [1/s] and preload [1/s].
    """
    common, wander, *others = spreads
    changes = (np.diff(np.minimum(KNOTS, BROAD)) / WANDER).tolist()
    hinges = [common**2, *(wander**2 * change for change in changes)]
    zeros = jnp.zeros_like(stiffness)
    mean = jnp.stack([stiffness, *[zeros] * (PARAMETERS - 1)])
    return mean, jnp.stack([*hinges, *(spread**2 for spread in others)])


def restarted(
    old: Estimate, prior_mean: Array, prior_variances: Array, begins: Bool[Array, "*batch"]
) -> Estimate:
    """Return the prior where contact `begins`, else the old estimate."""
    identity = np.eye(PARAMETERS, dtype=bool).reshape(PARAMETERS, PARAMETERS, *[1] * begins.ndim)
    covariance = jnp.where(identity, prior_variances[:, None], 0)
    return Estimate(
        jnp.where(begins[None], prior_mean, old.mean),
        jnp.where(begins[None, None], covariance, old.covariance),
        jnp.where(begins[None], prior_mean, old.theta),
    )


def features(depth: Array, speed: Array, deepest: Array) -> Float[Array, "parameters *batch"]:
    """Return phi, with which the force is phi.theta; zeros out of contact."""
    beyond = depth[None] - _column(KNOTS, depth)
    hinges = jnp.where(beyond > 0, beyond, 0)
    back = depth - deepest
    others = [
        speed,
        depth * speed / REACH,
        jnp.where(back < 0, back, 0),
        speed / jnp.sqrt(speed * speed + SLOW * SLOW),
        jnp.ones_like(depth),
    ]
    return jnp.concatenate([hinges, jnp.where((depth > 0)[None], jnp.stack(others), 0)])


def force(theta: Array, depth: Array, speed: Array, deepest: Array) -> Float[Array, "*batch"]:
    """Return the force [1/s] of the parameters `theta`."""
    back = depth - deepest
    total = theta[PRELOAD]
    for hinge, knot in zip(theta, KNOTS, strict=False):
        total = total + hinge * jnp.where(depth > knot, depth - knot, 0)
    total = total + (theta[DAMPING] + theta[DEPTH_DAMPING] * depth / REACH) * speed
    total = total + theta[UNLOADING] * jnp.where(back < 0, back, 0)
    total = total + theta[FRICTION] * (speed / jnp.sqrt(speed * speed + SLOW * SLOW))
    return jnp.where(depth > 0, total, 0)


def slope(theta: Array, depth: Array) -> Float[Array, "*batch"]:
    """Return the slope [1/s^2] at a depth, at least 0."""
    hinges = (jnp.where(depth > knot, hinge, 0) for hinge, knot in zip(theta, KNOTS, strict=False))
    total = reduce(add, hinges)
    return jnp.where(total > 0, total, 0)


def learn(
    old: Estimate, phi: Array, force: Array, variance: Array, used: Bool[Array, "*batch"]
) -> tuple[Array, Array]:
    """Return mean and covariance with one reading of the force more, where it is `used`."""
    column = reduce(add, (old.covariance[j] * phi[j][None] for j in range(PARAMETERS)))
    total = variance + dot(phi, column)
    used = used & (total > 0)  # unless rounding has spoilt the covariance
    share = jnp.where(used, 1 / jnp.where(used, total, 1), 0)
    innovation = share * (force - dot(phi, old.mean))
    scaled = share[None] * column
    return old.mean + column * innovation[None], old.covariance - scaled[:, None] * column[None]


def conclude(mean: Array, covariance: Array, prior_variances: Array) -> Array:
    """Return theta: the mean, conditioned on the expected dissipative parameters."""
    columns = [covariance[j] for j in DISSIPATIVE]
    for index, j in enumerate(DISSIPATIVE):
        column = columns[index]
        uncertain = column[j] > LEAST_VARIANCE
        variance = jnp.where(uncertain, column[j], 1)
        expected = zero_or_positive(mean[j], variance, prior_variances[j])
        mean = mean + column * jnp.where(uncertain, (expected - mean[j]) / variance, 0)[None]
        for later in range(index + 1, len(DISSIPATIVE)):
            share = jnp.where(uncertain, columns[later][j] / variance, 0)
            columns[later] = columns[later] - share[None] * column
    signed = mean[DAMPING : FRICTION + 1]
    return jnp.concatenate([mean[:DAMPING], jnp.where(signed > 0, signed, 0), mean[PRELOAD:]])


def zero_or_positive(mean: Array, variance: Array, prior_variance: Array) -> Float[Array, "*batch"]:
    """Return the posterior mean of a parameter that is zero with `ZERO_PROBABILITY` or else positive.

    `mean` and `variance` are those of the posterior without this knowledge. The tail of the normal
    distribution is Boyd's bound of Mills' ratio, pi/((pi - 1) t + sqrt(t^2 + 2 pi)).
    """
    spread = jnp.sqrt(variance)
    ratio = mean / spread
    size = jnp.abs(ratio)
    mills = math.pi / ((math.pi - 1) * size + jnp.sqrt(size * size + 2 * math.pi))
    density = jnp.exp(-0.5 * (size * size)) / math.sqrt(2 * math.pi)
    hazard = jnp.where(ratio > 0, density / (1 - density * mills), 1 / mills)
    return spread * (ratio + hazard) / (1 + ODDS * jnp.sqrt(prior_variance / variance) * hazard)


def dot(left: Array, right: Array) -> Array:
    """Return the sum of products over the first axis, added term by term.

    The compiler keeps such a sum within the loop over lanes; a reduction it computes apart.
    """
    return reduce(add, (left[j] * right[j] for j in range(len(left))))


def _column(values: tuple[float, ...], like: Array) -> Array:
    """Return constants along the first axis, of the type and with the trailing axes of `like`."""
    return jnp.asarray(np.reshape(values, (-1, *[1] * like.ndim)), like.dtype)
