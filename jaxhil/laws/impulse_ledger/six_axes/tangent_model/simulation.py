"""Tangent model in JAX: scalar force model of the contact, fitted by recursive least squares.

Along the contact's direction, the force on a unit mass is F = k x + c x|x| + b x' + F_0, with the depth x
since the onset. The fit divides F and x by the approach speed, so that the prior does not depend on the
speed. `bridge` predicts the impulse from the last reading to the present.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.laws.impulse_ledger.six_axes.constants import (
    BEND,
    BRIDGE_STEPS,
    FEATURES,
    MAX_GROWTH,
    MAX_PUSH,
    MIN_ERROR,
    MISFIT,
)
from jaxhil.laws.impulse_ledger.six_axes.simulation import dot


class Estimate(NamedTuple):
    """Mean and covariance of the parameters of the force model F = k x + c x|x| + b x' + F_0 (depth x).

    The parameters are stiffness k [1/s^2], damping b [1/s], F_0/v_0 [1/s] and c v_0 `BEND` [1/s^2], where
    v_0 is the approach speed and F the force per unit mass.
    """

    mean: Float[Array, "features *batch"]
    covariance: Float[Array, "features features *batch"]


class Tangent(NamedTuple):
    """Contact force model, per unit mass, about the depth of the last reading."""

    stiffness: Float[Array, "*batch"]  # k [1/s^2]
    curvature: Float[Array, "*batch"]  # c times the approach speed [1/s^3]
    damping: Float[Array, "*batch"]  # b [1/s]
    path: Float[Array, "*batch"]  # depth divided by approach speed [s]
    speed: Float[Array, "*batch"]  # approach speed v_0 along the direction


def begin_estimate(spreads: tuple[Array, ...]) -> Estimate:
    """Return the prior estimate: all means 0, the standard deviations `spreads`, and no correlation."""
    zero = jnp.zeros_like(spreads[0])
    variances = jnp.stack([spread**2 for spread in spreads])
    identity = jnp.eye(FEATURES, dtype=zero.dtype).reshape(FEATURES, FEATURES, *[1] * zero.ndim)
    return Estimate(jnp.zeros_like(variances), identity * variances[None])


def turn(old: Estimate, prior: Estimate, path: Array, force: Array) -> Estimate:
    """Return the estimate after a turn of the contact's direction, which restarts the depth at 0.

    The means are now the slope at the last depth `path` [s], the old damping, `force` [1/s], and no
    curvature. The covariance is that of `prior`. Depth and force are divided by the approach speed.
    """
    slope = jnp.maximum(old.mean[0] + 2 * old.mean[3] * jnp.abs(path) / BEND, 0)
    mean = jnp.stack([slope, old.mean[1], force, jnp.zeros_like(force)])
    return Estimate(mean, prior.covariance)


def learn(
    old: Estimate, prior: Estimate, path: Array, rate: Array, force: Array, variance: Array, growth: Array
) -> Estimate:
    """Update the estimate with one reading by recursive least squares with forgetting.

    Args:
        old: estimate before the reading.
        prior: estimate before the contact.
        path: depth, divided by the approach speed [s].
        rate: speed into the surface, divided by the approach speed [1].
        force: force, divided by the approach speed [1/s].
        variance: noise variance of the force, divided by the squared approach speed [1/s^2].
        growth: factor by which forgetting increases the covariance on each tick.
    """
    unit = jnp.ones_like(path)
    features = jnp.stack([path, rate, unit, path * jnp.abs(path) / BEND])
    column = jnp.sum(old.covariance * features[None], axis=1)
    error = variance + (MISFIT * force) ** 2 + MIN_ERROR**2
    share = column / (error + dot(features, column))[None]
    mean = old.mean + share * (force - dot(old.mean, features))[None]
    covariance = old.covariance - share[:, None] * column[None]
    grown = sum(covariance[j, j] / prior.covariance[j, j] for j in range(3))
    return Estimate(mean, covariance * jnp.where(grown < MAX_GROWTH, growth, 1)[None, None])


def compute_force_change(tangent: Tangent, change: Array) -> Float[Array, "*batch"]:
    """Return the change of the tangent model's elastic force for a `change` of the depth.

    The result is 0 if force and depth would change with opposite signs, because a model with a negative
    curvature could otherwise push apart bodies that separate.
    """
    later = tangent.path + change / tangent.speed
    bend = later * jnp.abs(later) - tangent.path * jnp.abs(tangent.path)
    force = tangent.stiffness * change + tangent.curvature * tangent.speed * bend
    return jnp.where(change > 0, jnp.maximum(force, 0), jnp.minimum(force, 0))


def bridge(
    tangent: Tangent, force: Array, least: Array, deeper: Array, velocity: Array, duration: Array
) -> tuple[Array, Array]:
    """Predict a unit mass's motion under the tangent model's force, from the last reading to the present.

    Args:
        tangent: tangent model at the depth of the last reading.
        force: force per unit mass on the reference trajectory at the last reading [m/s^2].
        least: lower bound of the force, 0 or negative [m/s^2].
        deeper: depth of the hardware minus depth of the reference trajectory, at the last reading [m].
        velocity: speed of the reference trajectory into the surface at the last reading [m/s].
        duration: time from the last reading to the present [s].

    Returns:
        Impulse of the force in this time [m/s], and force at the end [m/s^2].
    """
    step = duration / BRIDGE_STEPS
    start = compute_force_change(tangent, -deeper)

    def force_at(depth: Array, speed: Array) -> Array:
        elastic = compute_force_change(tangent, depth - deeper) - start
        push = jnp.maximum(force + elastic + tangent.damping * (speed - velocity), least)
        return jnp.minimum(push, MAX_PUSH)

    def advance(_, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        depth, speed, impulse = state
        push = force_at(depth + 0.5 * step * speed, speed) / (1 + 0.5 * step * tangent.damping)
        later = speed - push * step
        return depth + 0.5 * step * (speed + later), later, impulse + push * step

    zero = jnp.zeros_like(force)
    depth, speed, impulse = lax.fori_loop(0, BRIDGE_STEPS, advance, (zero, velocity, zero))
    return impulse, force_at(depth, speed)
