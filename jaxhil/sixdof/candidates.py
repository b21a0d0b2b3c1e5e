"""Contact candidates: pairs of shapes that may touch, and their penetration.

The pairs are known at compile time: the program does not search, count or sort. All candidates of one kind
are along one leading array axis, (candidates, *batch), so that the compile time does not grow with their
number.
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

# Relative to a segment's squared length; regularisation that draws the nearest points of parallel segments to
# their middles.
PARALLEL = 1e-9


class Touch(NamedTuple):
    """Two shapes at a pose; all values are in T axes."""

    depth: Float[Array, "candidates *batch"]  # d [m], negative apart
    normal: Vector  # n, outward from the target's surface
    point: Vector  # P, where the force acts: on the sphere's counterpart, or on the target's capsule [m]


class Candidates(eqx.Module):
    """Interface of all kinds of pairs."""

    @abc.abstractmethod
    def touch(self, pose: Pose) -> Touch:
        """Return the contacts at a pose, whose leaves have a leading axis of length 1."""

    @property
    @abc.abstractmethod
    def size(self) -> Float[Array, "candidates *batch"]:
        """Penetration [m] at which a shape has passed through the other; infinite if it cannot."""


class ChaserSpheres(Candidates):
    """Spheres of the chaser against one kind of the target's shapes; a sphere of radius 0 is a point."""

    centre: Vector  # in C axes [m]
    radius: Float[Array, "candidates *batch"]  # [m]
    shape: Shape  # in T axes

    @property
    def size(self):
        return self.radius + self.shape.thickness

    def touch(self, pose):
        centre = pose.position + rotate(pose.attitude, self.centre)
        distance, normal = self.shape.surface(centre)
        return Touch(self.radius - distance, normal, centre - distance * normal)


class TargetSpheres(Candidates):
    """Spheres of the target against one kind of the chaser's shapes; a sphere of radius 0 is a point."""

    centre: Vector  # in T axes [m]
    radius: Float[Array, "candidates *batch"]  # [m]
    shape: Shape  # in C axes

    @property
    def size(self):
        return self.radius + self.shape.thickness

    def touch(self, pose):
        centre = rotate_back(pose.attitude, self.centre - pose.position)
        distance, normal = self.shape.surface(centre)
        outward = -rotate(pose.attitude, normal)
        return Touch(self.radius - distance, outward, self.centre + distance * outward)


class Capsules(Candidates):
    """Capsules of the chaser, in C axes, against capsules of the target, in T axes."""

    chaser: Capsule
    target: Capsule

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
    """Return the penetration rate d' [m/s] and the slip [m/s].

    The slip is the chaser's velocity along the target's surface.
    """
    velocity = twist.linear + cross(twist.angular, touch.point - pose.position)
    rate = -dot(touch.normal, velocity)
    return rate, velocity + rate * touch.normal


def _nearest(first: Capsule, second: Capsule) -> tuple[Array, Array]:
    """Return the fractions of two segments at which they are nearest; near their middles if not unique.

    Both are first found together with a slight regularisation, then each is the nearest to the other, within
    its segment.
    """
    u, v, apart = first.end - first.start, second.end - second.start, first.start - second.start
    uu, vv, uv = dot(u, u) * (1 + PARALLEL), dot(v, v) * (1 + PARALLEL), dot(u, v)
    shift_u, shift_v = (PARALLEL / 2 * dot(w, w) for w in (u, v))
    determinant = uu * vv - uv**2
    towards = vv * (shift_u - dot(u, apart)) + uv * (shift_v + dot(v, apart))
    s = towards / jnp.where(determinant > 0, determinant, 1)
    t = second.nearest(first.at(jnp.clip(s, 0, 1)))
    return first.nearest(second.at(t)), t
