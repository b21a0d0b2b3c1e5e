"""Latches: points of the chaser that are caught when they are deep, aligned and slow enough.

From then on a spring and a damper in six axes hold the point, about the pose at which it was caught; the
spring force begins at 0. A latch belongs to the hardware and does not release during a run.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.lanes import select_lanes
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
    depth: Float[Array, "latches *batch"]  # least depth below T's plane z = 0 for catching [m]
    angle: Float[Array, "latches *batch"]  # greatest angle of C against T for catching [rad]
    speed: Float[Array, "latches *batch"]  # greatest receding speed for catching [m/s]; infinite for no limit
    # (force, moment about the point) per (displacement, rotation) of the point, in T axes [N/m, N, N m]
    stiffness: Float[Array, "6 6 latches *batch"]
    damping: Float[Array, "6 6 latches *batch"]  # likewise per twist of the point [N s/m, N s, N m s]
    from_start: Bool[Array, "latches *batch"]  # whether it holds from the start, about the start's pose


class Held(NamedTuple):
    """State of latches."""

    caught: Bool[Array, "latches *batch"]
    point: Vector  # position of the point when caught, in T axes [m]
    attitude: Quaternion  # attitude of C then, from C axes to T axes


def init_latch(latch: Latch, pose: Pose) -> Held:
    """Return the state at the start of a run, at a pose."""
    zero = jnp.zeros_like(latch.depth)
    attitude: Quaternion = jax.tree.map(lambda part: part[None] + zero, pose.attitude)
    return Held(latch.from_start, latch_points(latch, pose), attitude)


def latch_wrench(latch: Latch, memory: Held, pose: Pose, twist: Twist) -> tuple[Wrench, Held]:
    """Return the latches' wrench [N, N m] on the chaser, about T's origin, and their next state."""
    point = latch_points(latch, pose)
    (position, attitude), (linear, angular) = jax.tree.map(lambda part: part[None], (pose, twist))
    velocity = linear + cross(angular, point - position)
    tilt = 2 * jnp.arctan2(_sine(attitude), jnp.abs(attitude.w))
    fires = (-point.z > latch.depth) & (tilt < latch.angle) & (velocity.z <= latch.speed)
    first = fires & ~memory.caught
    now = Held(memory.caught | fires, point, attitude)
    memory = Held(
        now.caught, *(select_lanes(first, new, old) for new, old in zip(now[1:], memory[1:], strict=True))
    )

    displaced = point - memory.point
    turned = logarithm(compose(attitude, reverse(memory.attitude)))
    moved = _product(latch.stiffness, displaced, turned)
    damped = _product(latch.damping, velocity, angular)
    pull = memory.caught.astype(point.x.dtype)
    force = (-pull) * (moved[0] + damped[0])
    # The spring's moment is the energy's gradient with respect to the rotation, not to the rotation vector.
    moment = (-pull) * (inverse_left_jacobian(-turned, moved[1]) + damped[1]) + cross(point, force)
    total = jax.tree.map(lambda part: part.sum(axis=0), Wrench(force, moment))
    return total, memory


def latch_points(latch: Latch, pose: Pose) -> Vector:
    """Return the latches' points in T axes."""
    position, attitude = jax.tree.map(lambda part: part[None], (pose.position, pose.attitude))
    return position + rotate(attitude, latch.point)


def _sine(attitude: Quaternion) -> Array:
    """Return the sine of half the angle of a rotation, without derivative."""
    v = attitude.v
    return jax.lax.stop_gradient(jnp.sqrt(v.x**2 + v.y**2 + v.z**2))


def _product(matrix: Array, linear: Vector, angular: Vector) -> tuple[Vector, Vector]:
    """Return matrix times (linear, angular), for all latches."""
    # All latches have the same angular velocity, whose leading axis has length 1.
    parts = jnp.stack(jnp.broadcast_arrays(*jax.tree.leaves((linear, angular))))
    result = jnp.sum(matrix * parts[None], axis=1)
    return vector(result[:3]), vector(result[3:])
