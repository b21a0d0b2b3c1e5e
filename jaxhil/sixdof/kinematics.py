"""Kinematics of motion simulators: from coordinates to axes, and from axes to the pose.

Coordinates are (p, theta), six numbers along a leading axis, (6, *batch).
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.sixdof.axes import Motion
from jaxhil.sixdof.relative import Coordinates, Pose, Twist, motion_of
from jaxhil.sixdof.vectors import vector


class Moving(NamedTuple):
    """Motion of C relative to T on the hardware."""

    pose: Pose
    twist: Twist
    acceleration: Twist | None  # time derivative of the twist; None if unused


class Kinematics(eqx.Module):
    """Interface of all motion simulators."""

    @property
    def is_linear(self) -> bool:
        """Return whether the axes are linear functions of the coordinates."""
        return True

    def reaches(self, axes: Float[Array, "axes *batch"]) -> Bool[Array, "*batch"]:
        """Return whether the axes' positions are within their workspace."""
        return jnp.ones(axes.shape[1:], bool)

    @abc.abstractmethod
    def command(self, coordinates: Float[Array, "6 *batch"]) -> Float[Array, "axes *batch"]:
        """Return the positions of the axes for the pose with these coordinates."""

    @abc.abstractmethod
    def coordinates(self, motion: Motion, near: Float[Array, "6 *batch"]) -> Motion:
        """Return the coordinates of the axes' pose, with rates and accelerations.

        `near` are coordinates close to the result.
        """


class TaskSpace(Kinematics):
    """Motion simulator with one axis per coordinate."""

    def command(self, coordinates):
        return coordinates

    def coordinates(self, motion, near):
        return motion


class TwoRobots(Kinematics):
    """Motion simulator with a robot for the chaser's mechanism and another for the target's.

    There are twelve axes, the chaser's first. The pose is the difference of both robots' coordinates, of
    which the target's robot moves a share.
    """

    share: Float[Array, "6 *batch"]  # share of each coordinate that the target's robot moves [1]

    def command(self, coordinates):
        return jnp.concatenate([(1 - self.share) * coordinates, -self.share * coordinates])

    def coordinates(self, motion, near):
        difference: Motion = jax.tree.map(lambda leaf: leaf[:6] - leaf[6:], motion)
        return difference


def moving(motion: Motion) -> Moving:
    """Return pose, twist and acceleration from coordinates, their rates and accelerations."""

    def pose_and_twist(at, rates):
        return motion_of(*(Coordinates(vector(part[:3]), vector(part[3:])) for part in (at, rates)))

    if motion.acceleration is None:
        return Moving(*pose_and_twist(motion.position, motion.rate), None)
    (pose, twist), (_, acceleration) = jax.jvp(
        pose_and_twist, (motion.position, motion.rate), (motion.rate, motion.acceleration)
    )
    return Moving(pose, twist, Twist(*acceleration))
