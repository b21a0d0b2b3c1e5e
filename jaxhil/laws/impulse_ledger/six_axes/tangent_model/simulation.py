"""Tangent model in JAX: recursive least squares, and the bridge from the last reading to the present.

Along the contact's direction the force on a unit mass is F = k x + c x|x| + b x' + F_0, with the depth x
since the onset. The estimate is of F over the approach speed, so that its prior does not depend on the speed.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.laws.impulse_ledger.six_axes.constants import (
    BEND,
    BRIDGE_STEPS,
    FEATURES,
    LEAST_ERROR,
    MISFIT,
    MOST_GROWTH,
)
from jaxhil.laws.impulse_ledger.six_axes.simulation import dot


class Estimate(NamedTuple):
    """Estimate of the tangent model: stiffness [1/s^2], damping [1/s], force over speed [1/s], curvature."""

    mean: Float[Array, "features *batch"]
    covariance: Float[Array, "features features *batch"]


class Tangent(NamedTuple):
    """Tangent model at the depth of the last reading, per unit mass."""

    stiffness: Float[Array, "*batch"]  # [1/s^2]
    curvature: Float[Array, "*batch"]  # [1/s^3]
    damping: Float[Array, "*batch"]  # [1/s]
    path: Float[Array, "*batch"]  # depth over approach speed [s]
    speed: Float[Array, "*batch"]  # approach speed [m/s, over the direction's size]


def begin_estimate(spreads: tuple[Array, ...]) -> Estimate:
    """Return the estimate before contact, from the prior standard deviations."""
    zero = jnp.zeros_like(spreads[0])
    variances = jnp.stack([spread**2 for spread in spreads])
    identity = jnp.eye(FEATURES, dtype=zero.dtype).reshape(FEATURES, FEATURES, *[1] * zero.ndim)
    return Estimate(jnp.zeros_like(variances), identity * variances[None])


def learn(
    old: Estimate, prior: Estimate, path: Array, rate: Array, force: Array, variance: Array, growth: Array
) -> Estimate:
    """Update the estimate with a reading, by recursive least squares with forgetting.

    Args:
        old: estimate before the reading.
        prior: estimate before contact.
        path: depth over approach speed [s].
        rate: speed into the surface, over approach speed [1].
        force: force over approach speed [1/s].
        variance: variance of the force's noise, over the squared speed [1/s^2].
        growth: factor by which forgetting increases the covariance in a tick.
    """
    unit = jnp.ones_like(path)
    features = jnp.stack([path, rate, unit, path * jnp.abs(path) / BEND])
    column = jnp.sum(old.covariance * features[None], axis=1)
    error = variance + (MISFIT * force) ** 2 + LEAST_ERROR**2
    share = column / (error + dot(features, column))[None]
    mean = old.mean + share * (force - dot(old.mean, features))[None]
    covariance = old.covariance - share[:, None] * column[None]
    grown = sum(covariance[j, j] / prior.covariance[j, j] for j in range(3))
    return Estimate(mean, covariance * jnp.where(grown < MOST_GROWTH, growth, 1)[None, None])


def restoring(tangent: Tangent, change: Array) -> Float[Array, "*batch"]:
    """Return the change of the elastic force for a change of the depth [m]."""
    later = tangent.path + change / tangent.speed
    bend = later * jnp.abs(later) - tangent.path * jnp.abs(tangent.path)
    return tangent.stiffness * change + tangent.curvature * tangent.speed * bend


def bridge(
    tangent: Tangent, force: Array, least: Array, deeper: Array, velocity: Array, duration: Array
) -> tuple[Array, Array]:
    """Return impulse and last force of the reference from the last reading to the present.

    A unit mass moves against the tangent model.

    Args:
        tangent: model at the depth of the last reading.
        force: force on the reference at the last reading.
        least: least force, 0 or negative.
        deeper: depth of the hardware beyond that of the reference, at the last reading.
        velocity: speed of the reference into the surface.
        duration: time to bridge [s].
    """
    step = duration / BRIDGE_STEPS
    start = restoring(tangent, -deeper)

    def force_at(depth: Array, speed: Array) -> Array:
        elastic = restoring(tangent, depth - deeper) - start
        return jnp.maximum(force + elastic + tangent.damping * (speed - velocity), least)

    def advance(_, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        depth, speed, impulse = state
        push = force_at(depth + 0.5 * step * speed, speed) / (1 + 0.5 * step * tangent.damping)
        later = speed - push * step
        return depth + 0.5 * step * (speed + later), later, impulse + push * step

    zero = jnp.zeros_like(force)
    depth, speed, impulse = lax.fori_loop(0, BRIDGE_STEPS, advance, (zero, velocity, zero))
    return impulse, force_at(depth, speed)
