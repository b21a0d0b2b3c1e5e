"""Kinematics of motion simulators: conversion of coordinates to axis positions, and back to the pose.

The coordinates of a pose are its position p and its rotation vector theta, in arrays (6, *batch).
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.sixdof.axes import AxisMotion
from jaxhil.sixdof.relative import Coordinates, Pose, Twist, motion_of
from jaxhil.sixdof.vectors import vector


class RigidMotion(NamedTuple):
    """Motion of the hardware: pose, twist and acceleration of chaser frame C relative to target frame T."""

    pose: Pose
    twist: Twist
    acceleration: Twist | None  # time derivative of the twist; None if not needed


class Kinematics(eqx.Module):
    """Interface of the kinematics of all motion simulators."""

    @property
    def is_linear(self) -> bool:
        """Return whether the axis positions are linear functions of the coordinates."""
        return True

    def reaches(self, axes: Float[Array, "axes *batch"]) -> Bool[Array, "*batch"]:
        """Return whether all axis positions are within the workspace."""
        return jnp.ones(axes.shape[1:], bool)

    @abc.abstractmethod
    def command(self, coordinates: Float[Array, "6 *batch"]) -> Float[Array, "axes *batch"]:
        """Return the axis positions for the pose with these coordinates."""

    @abc.abstractmethod
    def coordinates(self, motion: AxisMotion, near: Float[Array, "6 *batch"]) -> AxisMotion:
        """Convert the motion of the simulator's axes to the motion of the pose coordinates of C in T.

        `near` contains coordinates near the result, from which an iteration can start.
        """


class TaskSpace(Kinematics):
    """Motion simulator with one axis for each coordinate of the pose."""

    def command(self, coordinates):
        return coordinates

    def coordinates(self, motion, near):
        return motion


class TwoRobots(Kinematics):
    """Motion simulator with one robot for the chaser's mechanism and one robot for the target's mechanism.

    Each robot has six axes; the six axes of the chaser's robot are the first. The relative pose is the
    difference between the coordinates of the two robots.
    """

    share: Float[Array, "6 *batch"]  # fraction of each coordinate that the target's robot moves [1]

    def command(self, coordinates):
        return jnp.concatenate([(1 - self.share) * coordinates, -self.share * coordinates])

    def coordinates(self, motion, near):
        difference: AxisMotion = jax.tree.map(lambda leaf: leaf[:6] - leaf[6:], motion)
        return difference


def to_rigid_motion(motion: AxisMotion) -> RigidMotion:
    """Convert the motion of the pose coordinates to pose, twist and acceleration."""

    def pose_and_twist(at, rates):
        return motion_of(*(Coordinates(vector(part[:3]), vector(part[3:])) for part in (at, rates)))

    if motion.acceleration is None:
        return RigidMotion(*pose_and_twist(motion.position, motion.rate), None)
    (pose, twist), (_, acceleration) = jax.jvp(
        pose_and_twist, (motion.position, motion.rate), (motion.rate, motion.acceleration)
    )
    return RigidMotion(pose, twist, Twist(*acceleration))
