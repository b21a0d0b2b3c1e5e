"""Latches: points of the chaser that are caught once they are deep, aligned and slow enough.

From then on a spring and a damper of six axes hold the point, about the pose at which it was caught: the
spring begins at 0. A latch belongs to the hardware and does not let go during a run.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.sixdof.relative import Pose, Twist, Wrench
from jaxhil.sixdof.rotations import (
    Quaternion,
    compose,
    inverse_left_jacobian,
    logarithm,
    reverse,
    rotate,
)
from jaxhil.sixdof.vectors import Vector, cross, vector


class Latch(NamedTuple):
    """Latches of one kind along a leading axis, (latches, *batch)."""

    point: Vector  # in C axes [m]
    depth: Float[Array, "latches *batch"]  # below T's plane z = 0 from which it is caught [m]
    angle: Float[Array, "latches *batch"]  # of C against T up to which it is caught [rad]
    speed: Float[Array, "latches *batch"]  # of receding up to which it is caught [m/s]; infinite for any
    # of the held point: (force, moment about it) per (displacement, rotation), in T axes [N/m, N, N m]
    stiffness: Float[Array, "6 6 latches *batch"]
    damping: Float[Array, "6 6 latches *batch"]  # per twist of the point [N s/m, N s, N m s]
    from_start: Bool[Array, "latches *batch"]  # whether it holds from the start on, about the start's pose


class Held(NamedTuple):
    """State of latches."""

    caught: Bool[Array, "latches *batch"]
    point: Vector  # where it was caught, in T axes [m]
    attitude: Quaternion  # of C then, from C axes to T axes


def init_latch(latch: Latch, pose: Pose) -> Held:
    """State at the start of a run, at a pose."""
    zero = jnp.zeros_like(latch.depth)
    attitude: Quaternion = jax.tree.map(lambda part: part[None] + zero, pose.attitude)
    return Held(latch.from_start, _point(latch, pose), attitude)


def latch_wrench(latch: Latch, held: Held, pose: Pose, twist: Twist) -> tuple[Wrench, Held]:
    """The wrench [N, N m] of the latches on the chaser, about T's origin, and their next state."""
    point = _point(latch, pose)
    (position, attitude), (linear, angular) = jax.tree.map(lambda part: part[None], (pose, twist))
    velocity = linear + cross(angular, point - position)
    tilt = 2 * jnp.arctan2(_sine(attitude), jnp.abs(attitude.w))
    fires = (-point.z > latch.depth) & (tilt < latch.angle) & (velocity.z <= latch.speed)
    first = fires & ~held.caught
    here = Held(held.caught | fires, point, attitude)
    held = Held(here.caught, *(_either(first, new, old) for new, old in zip(here[1:], held[1:], strict=True)))

    displaced = point - held.point
    turned = logarithm(compose(attitude, reverse(held.attitude)))
    moved = _product(latch.stiffness, displaced, turned)
    damped = _product(latch.damping, velocity, angular)
    pull = held.caught.astype(point.x.dtype)
    force = (-pull) * (moved[0] + damped[0])
    # The spring's moment is the gradient of its energy by the rotation, not by the rotation vector.
    moment = (-pull) * (inverse_left_jacobian(-turned, moved[1]) + damped[1]) + cross(point, force)
    total = jax.tree.map(lambda part: part.sum(axis=0), Wrench(force, moment))
    return total, held


def _point(latch: Latch, pose: Pose) -> Vector:
    """The latches' points in T axes."""
    position, attitude = jax.tree.map(lambda part: part[None], (pose.position, pose.attitude))
    return position + rotate(attitude, latch.point)


def _sine(attitude: Quaternion) -> Array:
    v = attitude.v
    return jax.lax.stop_gradient(jnp.sqrt(v.x**2 + v.y**2 + v.z**2))


def _either(condition: Array, one, other):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def _product(matrix: Array, linear: Vector, angular: Vector) -> tuple[Vector, Vector]:
    # All latches turn alike: the angular velocity has a leading axis of length 1.
    parts = jnp.stack(jnp.broadcast_arrays(*jax.tree.leaves((linear, angular))))
    result = jnp.sum(matrix * parts[None], axis=1)
    return vector(result[:3]), vector(result[3:])
