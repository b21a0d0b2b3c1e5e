"""What the drives of a motion simulator move: from coordinates to axes, and from axes to the pose.

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
    """Motion of C against T on the hardware."""

    pose: Pose
    twist: Twist
    acceleration: Twist | None  # rate of the twist, where it is followed


class Kinematics(eqx.Module):
    """Interface of all motion simulators."""

    @property
    def is_linear(self) -> bool:
        """Whether a straight line of coordinates is one of the axes."""
        return True

    def reaches(self, axes: Float[Array, "axes *batch"]) -> Bool[Array, "*batch"]:
        """Whether the axes can be there."""
        return jnp.ones(axes.shape[1:], bool)

    @abc.abstractmethod
    def command(self, coordinates: Float[Array, "6 *batch"]) -> Float[Array, "axes *batch"]:
        """Positions of the axes that have the pose with these coordinates."""

    @abc.abstractmethod
    def coordinates(self, motion: Motion, near: Float[Array, "6 *batch"]) -> Motion:
        """Coordinates of the pose to which the axes move, with rates and accelerations; `near` them."""


class TaskSpace(Kinematics):
    """An axis each coordinate."""

    def command(self, coordinates):
        return coordinates

    def coordinates(self, motion, near):
        return motion


class TwoRobots(Kinematics):
    """One robot carries the chaser's mechanism, another the target's: twelve axes, the chaser's first.

    The pose is the difference of both, of which the target's robot makes a share.
    """

    share: Float[Array, "6 *batch"]  # of each coordinate that the target's robot moves [1]

    def command(self, coordinates):
        return jnp.concatenate([(1 - self.share) * coordinates, -self.share * coordinates])

    def coordinates(self, motion, near):
        difference: Motion = jax.tree.map(lambda leaf: leaf[:6] - leaf[6:], motion)
        return difference


def moving(motion: Motion) -> Moving:
    """Pose, twist and acceleration of coordinates, their rates and accelerations."""

    def place(at, rates):
        return motion_of(*(Coordinates(vector(part[:3]), vector(part[3:])) for part in (at, rates)))

    if motion.acceleration is None:
        return Moving(*place(motion.position, motion.rate), None)
    (pose, twist), (_, acceleration) = jax.jvp(
        place, (motion.position, motion.rate), (motion.rate, motion.acceleration)
    )
    return Moving(pose, twist, Twist(*acceleration))
