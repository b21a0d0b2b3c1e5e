"""Relative pose and twist of chaser and target, wrenches, and the relative mass matrix.

The interface frames are T on the target and C on the chaser. The z axis of T is the docking axis and points
from the target to the chaser. Relative quantities are in frame T (notebooks/guide/six_axes.md, section 1).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.sixdof.bodies import Body, Load, State, angular_velocity, kick_drift
from jaxhil.sixdof.equations import solve
from jaxhil.sixdof.rotations import (
    Quaternion,
    compose,
    exponential,
    inverse_left_jacobian,
    left_jacobian,
    logarithm,
    reverse,
    rotate,
    rotate_back,
)
from jaxhil.sixdof.vectors import Vector, cross, dot, vector


class Frame(NamedTuple):
    """Position, attitude and velocity of an interface frame in the world."""

    position: Vector  # position of the frame's origin, in world axes [m]
    attitude: Quaternion  # rotation from the frame's axes to world axes
    velocity: Vector  # velocity of the frame's origin, in world axes [m/s]
    angular_velocity: Vector  # angular velocity of the frame, in world axes [rad/s]


class Pose(NamedTuple):
    """Pose of the chaser's frame C relative to the target's frame T."""

    position: Vector  # position p of the origin of chaser frame C, in target frame T [m]
    attitude: Quaternion  # rotation from chaser frame C to target frame T


class Twist(NamedTuple):
    """Velocity of the chaser's frame C relative to the target's frame T, observed from T."""

    linear: Vector  # velocity v of the origin of chaser frame C, in target frame T [m/s]
    angular: Vector  # angular velocity w, in target frame T [rad/s]


class Coordinates(NamedTuple):
    """Six coordinates of a pose, or the rates of these coordinates."""

    position: Vector  # position p [m], or its rate [m/s]
    rotation: Vector  # rotation vector theta of the chaser [rad], or its rate [rad/s]


class Wrench(NamedTuple):
    """Force and moment of the target on the chaser, in target frame T."""

    force: Vector  # force f [N]
    moment: Vector  # moment m about the origin of target frame T, if not stated otherwise [N m]


class Pair(NamedTuple):
    """Parameters of the two bodies."""

    target: Body
    chaser: Body


class States(NamedTuple):
    """States of the two bodies."""

    target: State
    chaser: State


@jax.jit
def interface_frame(body: Body, state: State) -> Frame:
    """Return position, attitude and velocities of a body's interface frame, in world axes."""
    angular = rotate(state.attitude, angular_velocity(body, state))
    offset = rotate(state.attitude, body.interface)
    rotation = body.interface_attitude
    return Frame(
        position=state.position + offset,
        attitude=state.attitude if rotation is None else compose(state.attitude, rotation),
        velocity=state.velocity + cross(angular, offset),
        angular_velocity=angular,
    )


def relative_motion(target: Frame, chaser: Frame) -> tuple[Pose, Twist]:
    """Return pose and twist of chaser frame C (`chaser`) relative to target frame T (`target`)."""
    apart = chaser.position - target.position
    velocity = chaser.velocity - target.velocity - cross(target.angular_velocity, apart)
    pose = Pose(rotate_back(target.attitude, apart), compose(reverse(target.attitude), chaser.attitude))
    angular = chaser.angular_velocity - target.angular_velocity
    return pose, Twist(rotate_back(target.attitude, velocity), rotate_back(target.attitude, angular))


@jax.jit
def relative(bodies: Pair, states: States) -> tuple[Pose, Twist]:
    """Return pose and twist of the chaser's frame C relative to the target's frame T."""
    target, chaser = (interface_frame(*item) for item in zip(bodies, states, strict=True))
    return relative_motion(target, chaser)


def coordinates(pose: Pose, twist: Twist) -> tuple[Coordinates, Coordinates]:
    """Convert pose and twist to the coordinates (p, theta), with |theta| <= pi, and their rates."""
    theta = logarithm(pose.attitude)
    return (
        Coordinates(pose.position, theta),
        Coordinates(twist.linear, inverse_left_jacobian(theta, twist.angular)),
    )


def motion_of(at: Coordinates, rates: Coordinates) -> tuple[Pose, Twist]:
    """Convert coordinates and their rates to pose and twist."""
    return (
        Pose(at.position, exponential(at.rotation)),
        Twist(rates.position, left_jacobian(at.rotation, rates.rotation)),
    )


def wrench_at_chaser(wrench: Wrench, pose: Pose) -> Wrench:
    """Convert a wrench about the origin of target frame T to a wrench about the origin of chaser frame C.

    The product of the result with the relative twist is the power of the wrench.
    """
    return Wrench(wrench.force, wrench.moment - cross(pose.position, wrench.force))


def power(wrench_at_chaser: Wrench, twist: Twist) -> Float[Array, "..."]:
    """Return the power [W] of a wrench about the origin of chaser frame C in a relative motion."""
    return dot(wrench_at_chaser.force, twist.linear) + dot(wrench_at_chaser.moment, twist.angular)


def loads(wrench: Wrench, target: Frame, states: States) -> tuple[Load, Load]:
    """Return the loads on target and chaser: `wrench` acts on the chaser, its reaction on the target.

    `wrench` is about the origin of target frame T. The loads are about the bodies' centres of mass.
    """
    force, moment = (rotate(target.attitude, part) for part in wrench)

    def about(state: State) -> Vector:
        return moment + cross(target.position - state.position, force)

    return Load(-force, -about(states.target)), Load(force, about(states.chaser))


def advance(
    bodies: Pair, states: States, wrench: Wrench, period: Float[Array, "..."], share: Array | float
) -> States:
    """Integrate the motion of both bodies for a control `period` [s] under a constant wrench.

    `share` selects the integrator (see `bodies.SHARES`). Linear momentum is conserved exactly. Angular
    momentum changes by (1 - share) period^2 (v_chaser - v_target) x f in a period, where f is the force on
    the chaser, and v_chaser and v_target are the initial velocities of the centres of mass.
    """
    target, chaser = loads(wrench, interface_frame(bodies.target, states.target), states)
    return States(
        kick_drift(bodies.target, states.target, target, period, share),
        kick_drift(bodies.chaser, states.chaser, chaser, period, share),
    )


def acceleration(bodies: Pair, states: States, wrench_at_chaser: Wrench) -> Twist:
    """Return the relative acceleration of bodies at rest due to a wrench about frame C's origin.

    The result is M^-1 W_C, where M is the relative mass matrix and W_C the wrench. The result is computed as
    the sum of the contributions of the two bodies.
    """
    target = interface_frame(bodies.target, states.target)
    chaser = interface_frame(bodies.chaser, states.chaser)
    linear, angular = [], []
    for body, state in zip(bodies, states, strict=True):
        arm = rotate_back(target.attitude, chaser.position - state.position)
        torque = wrench_at_chaser.moment + cross(arm, wrench_at_chaser.force)
        turning = _turning(body, state, target, torque)
        angular.append(turning)
        linear.append((1 / body.mass) * wrench_at_chaser.force + cross(turning, arm))
    return Twist(linear[0] + linear[1], angular[0] + angular[1])


def mass_matrix(bodies: Pair, states: States) -> Float[Array, "6 6 *batch"]:
    """Return the relative mass matrix M [kg, kg m, kg m^2].

    M relates the relative twist V to the wrench W_C about the origin of chaser frame C: M V' = W_C for bodies
    at rest.
    """
    like = states.target.position.x
    unit = jnp.eye(6, dtype=like.dtype).reshape(6, 6, *[1] * like.ndim)
    unit = jnp.broadcast_to(unit, (6, 6, *like.shape))
    # The accelerations for all six unit wrenches are computed at once, along an axis before the batch.
    bodies, states = jax.tree.map(lambda leaf: leaf[None], (bodies, states))
    twist = acceleration(bodies, states, Wrench(vector(unit[:3]), vector(unit[3:])))
    inverse = jnp.stack(jax.tree.leaves(twist))
    return solve(inverse, unit)


def effective_mass(bodies: Pair, states: States, point: Vector, normal: Vector) -> Float[Array, "..."]:
    """Return the effective mass m_n [kg] of the two bodies in a frictionless contact.

    1/m_n is the sum of 1/m_i + a_i . J_i^-1 a_i for both bodies i, where a_i = (point - r_i) x normal. Body
    i has the mass m_i, the inertia J_i and the centre of mass r_i. `point` [m] and `normal` (a unit vector)
    are in target frame T.
    """
    target = interface_frame(bodies.target, states.target)
    total = jnp.zeros_like(normal.x)
    for body, state in zip(bodies, states, strict=True):
        centre = rotate_back(target.attitude, state.position - target.position)
        arm = cross(point - centre, normal)
        total = total + 1 / body.mass + dot(arm, _turning(body, state, target, arm))
    return 1 / total


def _turning(body: Body, state: State, target: Frame, torque: Vector) -> Vector:
    """Return the angular acceleration J^-1 torque of a body; torque and result are in target frame T."""
    in_body = rotate_back(state.attitude, rotate(target.attitude, torque))
    return rotate_back(target.attitude, rotate(state.attitude, body.inverse_inertia @ in_body))
