"""Latches, each of which catches a point of the chaser that is deep, aligned and slow enough.

A latch holds the caught point by a six-axis spring and damper. The spring is relaxed at the pose at which the
point was caught, so that its force begins at 0. A latch belongs to the hardware and never releases in a run.
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
    """Parameters of all latches of one [latch] table in the mechanism file."""

    point: Vector  # point of the chaser that the latch catches, in chaser frame C [m]
    depth: Float[Array, "latches *batch"]  # minimum depth of the point below T's plane z = 0 [m]
    angle: Float[Array, "latches *batch"]  # maximum angle between frames of chaser and target [rad]
    speed: Float[Array, "latches *batch"]  # maximum velocity of the point along T's z [m/s]; may be infinite
    # stiffness matrix in target frame T: from displacement and rotation to force and moment about the point
    stiffness: Float[Array, "6 6 latches *batch"]  # [N/m, N, N m]
    # damping matrix in target frame T: from velocity and angular velocity to force and moment about the point
    damping: Float[Array, "6 6 latches *batch"]  # [N s/m, N s, N m s]
    from_start: Bool[Array, "latches *batch"]  # whether the latch holds the chaser at the start of the run


class LatchState(NamedTuple):
    """State of the latches: whether they have caught, and the pose at which they caught."""

    caught: Bool[Array, "latches *batch"]
    point: Vector  # position of the point at the catch, in target frame T [m]
    attitude: Quaternion  # rotation from chaser frame C to target frame T at the catch


def init_latch(latch: Latch, pose: Pose) -> LatchState:
    """Return the latches' state at the start of a run; `pose` is the chaser's pose at the start."""
    zero = jnp.zeros_like(latch.depth)
    attitude: Quaternion = jax.tree.map(lambda part: part[None] + zero, pose.attitude)
    return LatchState(latch.from_start, latch_points(latch, pose), attitude)


def latch_wrench(latch: Latch, memory: LatchState, pose: Pose, twist: Twist) -> tuple[Wrench, LatchState]:
    """Return the wrench of all latches on the chaser [N, N m], and the next state of the latches.

    The wrench is about the origin of target frame T.
    """
    point = latch_points(latch, pose)
    (position, attitude), (linear, angular) = jax.tree.map(lambda part: part[None], (pose, twist))
    velocity = linear + cross(angular, point - position)
    tilt = 2 * jnp.arctan2(_sine(attitude), jnp.abs(attitude.w))
    fires = (-point.z > latch.depth) & (tilt < latch.angle) & (velocity.z <= latch.speed)
    first = fires & ~memory.caught
    now = LatchState(memory.caught | fires, point, attitude)
    memory = LatchState(
        now.caught, *(select_lanes(first, new, old) for new, old in zip(now[1:], memory[1:], strict=True))
    )

    displaced = point - memory.point
    rotation = logarithm(compose(attitude, reverse(memory.attitude)))
    spring = _product(latch.stiffness, displaced, rotation)
    damper = _product(latch.damping, velocity, angular)
    pull = memory.caught.astype(point.x.dtype)
    force = (-pull) * (spring[0] + damper[0])
    # The spring's moment is the gradient of its energy with respect to the rotation, hence the Jacobian.
    moment = (-pull) * (inverse_left_jacobian(-rotation, spring[1]) + damper[1]) + cross(point, force)
    total = jax.tree.map(lambda part: part.sum(axis=0), Wrench(force, moment))
    return total, memory


def latch_points(latch: Latch, pose: Pose) -> Vector:
    """Return the positions of the latches' points at a pose, in target frame T [m]."""
    position, attitude = jax.tree.map(lambda part: part[None], (pose.position, pose.attitude))
    return position + rotate(attitude, latch.point)


def _sine(attitude: Quaternion) -> Array:
    """Return the sine of half the rotation's angle, as a constant: its derivatives are 0."""
    v = attitude.v
    return jax.lax.stop_gradient(jnp.sqrt(v.x**2 + v.y**2 + v.z**2))


def _product(matrix: Array, linear: Vector, angular: Vector) -> tuple[Vector, Vector]:
    """Multiply each latch's 6 x 6 matrix by a 6-vector; return the linear and the angular part."""
    # The angular velocity is the same for all latches: its leading axis has length 1.
    parts = jnp.stack(jnp.broadcast_arrays(*jax.tree.leaves((linear, angular))))
    result = jnp.sum(matrix * parts[None], axis=1)
    return vector(result[:3]), vector(result[3:])
