"""Chaser against target: relative pose and twist, wrenches, and the relative mass.

The interface frames are T on the target and C on the chaser; z of T is the docking axis and points from the
target to the chaser. All that is relative is in T axes (notebooks/guide/six_axes.md, section 1).
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
    """An interface frame in the world."""

    position: Vector  # of its origin, in world axes [m]
    attitude: Quaternion  # from its axes to world axes
    velocity: Vector  # of its origin, in world axes [m/s]
    angular_velocity: Vector  # in world axes [rad/s]


class Pose(NamedTuple):
    """Where C is against T."""

    position: Vector  # p, of C's origin, in T axes [m]
    attitude: Quaternion  # from C axes to T axes


class Twist(NamedTuple):
    """Motion of C against T, as seen from T."""

    linear: Vector  # v, of C's origin, in T axes [m/s]
    angular: Vector  # w, in T axes [rad/s]


class Coordinates(NamedTuple):
    """Six numbers of a pose, or their rates."""

    position: Vector  # p [m], or its rate [m/s]
    rotation: Vector  # rotation vector theta from T axes [rad], or its rate [rad/s]


class Wrench(NamedTuple):
    """What the target exerts on the chaser, in T axes."""

    force: Vector  # f [N]
    moment: Vector  # m, about T's origin unless said otherwise [N m]


class Pair(NamedTuple):
    """Of the two bodies one thing each."""

    target: Body
    chaser: Body


class States(NamedTuple):
    """Motion of the two bodies."""

    target: State
    chaser: State


@jax.jit
def interface_frame(body: Body, state: State) -> Frame:
    """A body's interface frame."""
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
    """Pose and twist of the frame C against the frame T."""
    apart = chaser.position - target.position
    velocity = chaser.velocity - target.velocity - cross(target.angular_velocity, apart)
    pose = Pose(rotate_back(target.attitude, apart), compose(reverse(target.attitude), chaser.attitude))
    angular = chaser.angular_velocity - target.angular_velocity
    return pose, Twist(rotate_back(target.attitude, velocity), rotate_back(target.attitude, angular))


@jax.jit
def relative(bodies: Pair, states: States) -> tuple[Pose, Twist]:
    """Pose and twist of C against T."""
    target, chaser = (interface_frame(*one) for one in zip(bodies, states, strict=True))
    return relative_motion(target, chaser)


def coordinates(pose: Pose, twist: Twist) -> tuple[Coordinates, Coordinates]:
    """Coordinates (p, theta) of a pose, |theta| < pi, and their rates."""
    theta = logarithm(pose.attitude)
    return (
        Coordinates(pose.position, theta),
        Coordinates(twist.linear, inverse_left_jacobian(theta, twist.angular)),
    )


def motion_of(at: Coordinates, rates: Coordinates) -> tuple[Pose, Twist]:
    """Pose and twist that have these coordinates and rates."""
    return (
        Pose(at.position, exponential(at.rotation)),
        Twist(rates.position, left_jacobian(at.rotation, rates.rotation)),
    )


def wrench_at_chaser(wrench: Wrench, pose: Pose) -> Wrench:
    """The wrench moved from T's origin to C's: its power is that of the relative motion."""
    return Wrench(wrench.force, wrench.moment - cross(pose.position, wrench.force))


def power(wrench_at_chaser: Wrench, twist: Twist) -> Float[Array, "..."]:
    """Power [W] of a wrench about C's origin on the relative motion."""
    return dot(wrench_at_chaser.force, twist.linear) + dot(wrench_at_chaser.moment, twist.angular)


def loads(wrench: Wrench, target: Frame, states: States) -> tuple[Load, Load]:
    """What a wrench does to target and chaser: equal and opposite, and at one point."""
    force, moment = (rotate(target.attitude, part) for part in wrench)

    def about(state: State) -> Vector:
        return moment + cross(target.position - state.position, force)

    return Load(-force, -about(states.target)), Load(force, about(states.chaser))


def advance(
    bodies: Pair, states: States, wrench: Wrench, period: Float[Array, "..."], share: Array | float
) -> States:
    """The two bodies of the numerical model after a control `period` [s] under a wrench.

    Linear momentum is conserved for any wrench, and angular momentum where `share` is 1: else it changes by
    (1 - share) T^2 (v_chaser - v_target) x f in a period.
    """
    target, chaser = loads(wrench, interface_frame(bodies.target, states.target), states)
    return States(
        kick_drift(bodies.target, states.target, target, period, share),
        kick_drift(bodies.chaser, states.chaser, chaser, period, share),
    )


def acceleration(bodies: Pair, states: States, wrench_at_chaser: Wrench) -> Twist:
    """M^-1 W_C: how fast the relative twist of bodies at rest changes under a wrench about C's origin.

    M is the relative mass matrix. Each body adds to its inverse what the wrench makes of it alone.
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
    """Relative mass matrix M at the pose: M V' = W_C for bodies at rest, in kg, kg m and kg m^2."""
    like = states.target.position.x
    unit = jnp.eye(6, dtype=like.dtype).reshape(6, 6, *[1] * like.ndim)
    unit = jnp.broadcast_to(unit, (6, 6, *like.shape))
    # All six unit wrenches at once, along an axis before the batch.
    bodies, states = jax.tree.map(lambda leaf: leaf[None], (bodies, states))
    twist = acceleration(bodies, states, Wrench(vector(unit[:3]), vector(unit[3:])))
    inverse = jnp.stack(jax.tree.leaves(twist))
    return solve(inverse, unit)


def effective_mass(bodies: Pair, states: States, point: Vector, normal: Vector) -> Float[Array, "..."]:
    """Mass [kg] that a frictionless contact at `point` [m] meets along its unit `normal` (both in T axes):
    1/m_n = sum 1/m_i + (a_i . J_i^-1 a_i), a_i = (point - r_i) x normal."""
    target = interface_frame(bodies.target, states.target)
    total = jnp.zeros_like(normal.x)
    for body, state in zip(bodies, states, strict=True):
        centre = rotate_back(target.attitude, state.position - target.position)
        arm = cross(point - centre, normal)
        total = total + 1 / body.mass + dot(arm, _turning(body, state, target, arm))
    return 1 / total


def _turning(body: Body, state: State, target: Frame, torque: Vector) -> Vector:
    """J^-1 torque, both in T axes."""
    own = rotate_back(state.attitude, rotate(target.attitude, torque))
    return rotate_back(target.attitude, rotate(state.attitude, body.inverse_inertia @ own))
