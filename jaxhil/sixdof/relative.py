"""Relative pose and twist of chaser and target, wrenches, and the relative mass.

The interface frames are T on the target and C on the chaser. z of T is the docking axis and points from the
target to the chaser. All relative quantities are in T axes (notebooks/guide/six_axes.md, section 1).
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
    """Interface frame in the world."""

    position: Vector  # of its origin, in world axes [m]
    attitude: Quaternion  # from its axes to world axes
    velocity: Vector  # of its origin, in world axes [m/s]
    angular_velocity: Vector  # in world axes [rad/s]


class Pose(NamedTuple):
    """Pose of C relative to T."""

    position: Vector  # p, of C's origin, in T axes [m]
    attitude: Quaternion  # from C axes to T axes


class Twist(NamedTuple):
    """Velocity of C relative to T, as seen from T."""

    linear: Vector  # v, of C's origin, in T axes [m/s]
    angular: Vector  # w, in T axes [rad/s]


class Coordinates(NamedTuple):
    """Six coordinates of a pose, or their rates."""

    position: Vector  # p [m], or its rate [m/s]
    rotation: Vector  # rotation vector theta from T axes [rad], or its rate [rad/s]


class Wrench(NamedTuple):
    """Force and moment of the target on the chaser, in T axes."""

    force: Vector  # f [N]
    moment: Vector  # m, about T's origin unless said otherwise [N m]


class Pair(NamedTuple):
    """Target and chaser."""

    target: Body
    chaser: Body


class States(NamedTuple):
    """Motion of the two bodies."""

    target: State
    chaser: State


@jax.jit
def interface_frame(body: Body, state: State) -> Frame:
    """Return a body's interface frame."""
    angular = rotate(state.attitude, angular_velocity(body, state))
    offset = rotate(state.attitude, body.interface)
    turned = body.interface_attitude
    return Frame(
        position=state.position + offset,
        attitude=state.attitude if turned is None else compose(state.attitude, turned),
        velocity=state.velocity + cross(angular, offset),
        angular_velocity=angular,
    )


def relative_motion(target: Frame, chaser: Frame) -> tuple[Pose, Twist]:
    """Return pose and twist of the frame C relative to the frame T."""
    apart = chaser.position - target.position
    velocity = chaser.velocity - target.velocity - cross(target.angular_velocity, apart)
    pose = Pose(rotate_back(target.attitude, apart), compose(reverse(target.attitude), chaser.attitude))
    angular = chaser.angular_velocity - target.angular_velocity
    return pose, Twist(rotate_back(target.attitude, velocity), rotate_back(target.attitude, angular))


@jax.jit
def relative(bodies: Pair, states: States) -> tuple[Pose, Twist]:
    """Return pose and twist of C relative to T."""
    target, chaser = (interface_frame(*item) for item in zip(bodies, states, strict=True))
    return relative_motion(target, chaser)


def coordinates(pose: Pose, twist: Twist) -> tuple[Coordinates, Coordinates]:
    """Return coordinates (p, theta) of a pose, with |theta| < pi, and their rates."""
    theta = logarithm(pose.attitude)
    return (
        Coordinates(pose.position, theta),
        Coordinates(twist.linear, inverse_left_jacobian(theta, twist.angular)),
    )


def motion_of(at: Coordinates, rates: Coordinates) -> tuple[Pose, Twist]:
    """Return pose and twist for coordinates and their rates."""
    return (
        Pose(at.position, exponential(at.rotation)),
        Twist(rates.position, left_jacobian(at.rotation, rates.rotation)),
    )


def wrench_at_chaser(wrench: Wrench, pose: Pose) -> Wrench:
    """Return the wrench about C's origin; its product with the relative twist is the power."""
    return Wrench(wrench.force, wrench.moment - cross(pose.position, wrench.force))


def power(wrench_at_chaser: Wrench, twist: Twist) -> Float[Array, "..."]:
    """Return the power [W] of a wrench about C's origin on the relative motion."""
    return dot(wrench_at_chaser.force, twist.linear) + dot(wrench_at_chaser.moment, twist.angular)


def loads(wrench: Wrench, target: Frame, states: States) -> tuple[Load, Load]:
    """Return the loads of a wrench on target and chaser: equal and opposite, at one point."""
    force, moment = (rotate(target.attitude, part) for part in wrench)

    def about(state: State) -> Vector:
        return moment + cross(target.position - state.position, force)

    return Load(-force, -about(states.target)), Load(force, about(states.chaser))


def advance(
    bodies: Pair, states: States, wrench: Wrench, period: Float[Array, "..."], share: Array | float
) -> States:
    """Return the bodies of the numerical model after a control `period` [s] under a wrench.

    Linear momentum is conserved for any wrench, angular momentum if `share` is 1. Otherwise the latter
    changes by (1 - share) T^2 (v_chaser - v_target) x f per period.
    """
    target, chaser = loads(wrench, interface_frame(bodies.target, states.target), states)
    return States(
        kick_drift(bodies.target, states.target, target, period, share),
        kick_drift(bodies.chaser, states.chaser, chaser, period, share),
    )


def acceleration(bodies: Pair, states: States, wrench_at_chaser: Wrench) -> Twist:
    """Return M^-1 W_C: the rate of the relative twist of bodies at rest under a wrench about C's origin.

    M is the relative mass matrix; M^-1 is the sum of the bodies' contributions.
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
    """Return the relative mass matrix M at the pose, in kg, kg m and kg m^2.

    It satisfies M V' = W_C for bodies at rest.
    """
    like = states.target.position.x
    unit = jnp.eye(6, dtype=like.dtype).reshape(6, 6, *[1] * like.ndim)
    unit = jnp.broadcast_to(unit, (6, 6, *like.shape))
    # All six unit wrenches are computed at once, along an axis before the batch.
    bodies, states = jax.tree.map(lambda leaf: leaf[None], (bodies, states))
    twist = acceleration(bodies, states, Wrench(vector(unit[:3]), vector(unit[3:])))
    inverse = jnp.stack(jax.tree.leaves(twist))
    return solve(inverse, unit)


def effective_mass(bodies: Pair, states: States, point: Vector, normal: Vector) -> Float[Array, "..."]:
    """Return the mass [kg] that is effective in a frictionless contact.

    It is 1/m_n = sum 1/m_i + (a_i . J_i^-1 a_i), a_i = (point - r_i) x normal, with `point` [m] and the unit
    `normal` in T axes.
    """
    target = interface_frame(bodies.target, states.target)
    total = jnp.zeros_like(normal.x)
    for body, state in zip(bodies, states, strict=True):
        centre = rotate_back(target.attitude, state.position - target.position)
        arm = cross(point - centre, normal)
        total = total + 1 / body.mass + dot(arm, _turning(body, state, target, arm))
    return 1 / total


def _turning(body: Body, state: State, target: Frame, torque: Vector) -> Vector:
    """Return J^-1 torque; both vectors are in T axes."""
    in_body = rotate_back(state.attitude, rotate(target.attitude, torque))
    return rotate_back(target.attitude, rotate(state.attitude, body.inverse_inertia @ in_body))
