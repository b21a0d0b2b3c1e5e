"""Contact candidates: pairs of shapes that may touch, with their penetration.

The pairs are known at compile time, so that no collision search is necessary. Arrays have a leading axis for
all candidates of one kind, (candidates, *batch), so that the compile time does not grow with their number.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.sixdof.relative import Pose, Twist
from jaxhil.sixdof.rotations import rotate, rotate_back
from jaxhil.sixdof.shapes import Capsule, Shape
from jaxhil.sixdof.vectors import Vector, cross, direction, dot, norm

# Regularisation, divided by the squared length of a segment [1]. For parallel segments, whose nearest points
# are not unique, the regularisation selects points near the middles of both segments.
PARALLEL_WEIGHT = 1e-9


class Touch(NamedTuple):
    """Geometry of contact candidates (pairs of shapes that may touch) at a pose, in target frame T."""

    depth: Float[Array, "candidates *batch"]  # penetration d [m]; minus the distance if the shapes are apart
    normal: Vector  # normal n of the target's surface, outward
    # point P where the force acts [m]: on the shape that the sphere touches, or on the target's capsule
    point: Vector


class Candidates(eqx.Module):
    """Interface of the kinds of contact candidates (pairs of shapes that may touch)."""

    @abc.abstractmethod
    def touch(self, pose: Pose) -> Touch:
        """Return penetration, normal and contact point of every pair at a `pose` with arrays (1, *batch)."""

    @property
    @abc.abstractmethod
    def size(self) -> Float[Array, "candidates *batch"]:
        """Return the penetration [m] at which one shape has passed through the other; may be infinite."""


class ChaserSpheres(Candidates):
    """Pairs of a sphere of the chaser and a shape of the target; a sphere of radius 0 is a point."""

    centre: Vector  # centre of the sphere, in chaser frame C [m]
    radius: Float[Array, "candidates *batch"]  # radius of the sphere [m]
    shape: Shape  # shape of the target, in target frame T

    @property
    def size(self):
        return self.radius + self.shape.thickness

    def touch(self, pose):
        centre = pose.position + rotate(pose.attitude, self.centre)
        distance, normal = self.shape.surface(centre)
        return Touch(self.radius - distance, normal, centre - distance * normal)


class TargetSpheres(Candidates):
    """Pairs of a sphere of the target and a shape of the chaser; a sphere of radius 0 is a point."""

    centre: Vector  # centre of the sphere, in target frame T [m]
    radius: Float[Array, "candidates *batch"]  # radius of the sphere [m]
    shape: Shape  # shape of the chaser, in chaser frame C

    @property
    def size(self):
        return self.radius + self.shape.thickness

    def touch(self, pose):
        centre = rotate_back(pose.attitude, self.centre - pose.position)
        distance, normal = self.shape.surface(centre)
        outward = -rotate(pose.attitude, normal)
        return Touch(self.radius - distance, outward, self.centre + distance * outward)


class Capsules(Candidates):
    """Pairs of a capsule of the chaser and a capsule of the target."""

    chaser: Capsule  # in chaser frame C
    target: Capsule  # in target frame T

    @property
    def size(self):
        return self.chaser.radius + self.target.radius

    def touch(self, pose):
        start, end = (
            pose.position + rotate(pose.attitude, end) for end in (self.chaser.start, self.chaser.end)
        )
        chaser = Capsule(start, end, self.chaser.radius)
        s, t = _nearest(chaser, self.target)
        on_target = self.target.at(t)
        apart = chaser.at(s) - on_target
        normal = direction(apart)
        depth = self.chaser.radius + self.target.radius - norm(apart)
        return Touch(depth, normal, on_target + self.target.radius * normal)


def motion_at(touch: Touch, pose: Pose, twist: Twist) -> tuple[Float[Array, "candidates *batch"], Vector]:
    """Return the penetration rate [m/s], and the chaser's velocity along the target's surface [m/s]."""
    velocity = twist.linear + cross(twist.angular, touch.point - pose.position)
    rate = -dot(touch.normal, velocity)
    return rate, velocity + rate * touch.normal


def _nearest(first: Capsule, second: Capsule) -> tuple[Array, Array]:
    """Return the nearest points of two capsules' segments, as fractions of the segments' lengths.

    If the nearest points are not unique, the result is near the middles of the segments. A linear equation
    with a slight regularisation gives both fractions. Then each point is projected on the other segment.
    """
    u, v, apart = first.end - first.start, second.end - second.start, first.start - second.start
    uu, vv, uv = dot(u, u) * (1 + PARALLEL_WEIGHT), dot(v, v) * (1 + PARALLEL_WEIGHT), dot(u, v)
    shift_u, shift_v = (PARALLEL_WEIGHT / 2 * dot(w, w) for w in (u, v))
    determinant = uu * vv - uv**2
    towards = vv * (shift_u - dot(u, apart)) + uv * (shift_v + dot(v, apart))
    s = towards / jnp.where(determinant > 0, determinant, 1)
    t = second.nearest(first.at(jnp.clip(s, 0, 1)))
    return first.nearest(second.at(t)), t
