"""Reference trajectory in JAX: batched version of `rig.py` in this folder, which states the equations."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxhil.laws.impulse_ledger.contact_model.simulation import damping, dot, features, slope
from jaxhil.laws.impulse_ledger.reference_trajectory.rig import MAX_SCALED_DEPTH, MAX_SCALED_SPEED, STEPS


class ReferenceTrajectory(NamedTuple):
    """Reference trajectory at the time of the last reading, with its sensitivities to theta."""

    depth: Float[Array, "*batch"]  # x_r [s]
    speed: Float[Array, "*batch"]  # v_r [1]
    force: Float[Array, "*batch"]  # F_r [1/s]
    deepest: Float[Array, "*batch"]  # largest depth so far [s]
    released: Bool[Array, "*batch"]  # whether the trajectory has left the surface
    depths: Float[Array, "parameters *batch"]  # sensitivities s of the depth
    speeds: Float[Array, "parameters *batch"]  # sensitivities s' of the speed


def begin(depth: Array, speed: Array, like: Array) -> ReferenceTrajectory:
    """Return the trajectory at `depth` [s] and `speed` [1], both divided by the approach speed.

    The sensitivities are 0 and have the shape of `like`.
    """
    zeros, sensitivities = jnp.zeros_like(depth), jnp.zeros_like(like)
    return ReferenceTrajectory(depth, speed, zeros, depth, zeros > 0, sensitivities, sensitivities)


def correct(old: ReferenceTrajectory, changes: Array) -> ReferenceTrajectory:
    """Correct the trajectory to first order for the `changes` of the contact model's parameters."""
    moved = jnp.where(old.released, 0, dot(old.depths, changes))
    speed = jnp.clip(old.speed + dot(old.speeds, changes), -MAX_SCALED_SPEED, MAX_SCALED_SPEED)
    return old._replace(depth=jnp.clip(old.depth + moved, -MAX_SCALED_DEPTH, MAX_SCALED_DEPTH), speed=speed)


def advance(
    old: ReferenceTrajectory, theta: Array, period: Array, reading: Array, measured: Array
) -> ReferenceTrajectory:
    """Advance by one period to the next reading y (scaled, [1/s]); `measured` is the hardware's phi(X, V)."""
    depth = old.depth + period * old.speed - 0.5 * (period * period) * old.force
    speed = old.speed - period * old.force
    deepest = jnp.where(depth > old.deepest, depth, old.deepest)
    released = old.released | ((depth <= 0) & (speed < 0))
    undelayed = features(depth, speed, deepest, jnp.zeros_like(depth))
    least = jnp.where(reading < 0, reading, 0)
    push = dot(theta, undelayed) + (reading - dot(theta, measured))
    push = jnp.where(released, 0, jnp.where(push > least, push, least))
    # With larger stiffness or damping, the integration would be unstable.
    stiffness = jnp.minimum(slope(theta, depth), 1 / (period * period))
    resistance = jnp.minimum(damping(theta, depth), 1 / period)
    tick, moves = period[None], (push != 0)[None]
    ahead = old.depths + tick * old.speeds
    rates = undelayed - measured + stiffness[None] * ahead + resistance[None] * old.speeds
    speeds = old.speeds - jnp.where(moves, tick * rates, 0)
    depths = old.depths + jnp.where(moves, tick * speeds, 0)
    speed = jnp.clip(old.speed - 0.5 * period * (old.force + push), -MAX_SCALED_SPEED, MAX_SCALED_SPEED)
    return ReferenceTrajectory(depth, speed, push, deepest, released, depths, speeds)


def bridge(now: ReferenceTrajectory, theta: Array, duration: Array) -> tuple[Array, Array]:
    """Predict scaled force [1/s] and speed [1] at the time `duration` [s] after the last reading."""
    step = duration / STEPS

    def advanced(_, old):
        depth, speed, push, deepest, released = old
        depth = depth + (step * speed - 0.5 * (step * step) * push)
        ahead = speed - step * push
        deepest = jnp.where(depth > deepest, depth, deepest)
        later = dot(theta, features(depth, ahead, deepest, jnp.zeros_like(depth)))
        released = released | ((ahead < 0) & ((depth <= 0) | (later <= 0)))
        later = jnp.where(released | (later < 0), 0, later)
        return depth, speed - 0.5 * step * (push + later), later, deepest, released

    # XLA compiles the body of this loop only once.
    _, speed, push, _, _ = lax.fori_loop(0, STEPS, advanced, now[:5])
    return push, speed
