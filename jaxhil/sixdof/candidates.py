"""Contact candidates: pairs of shapes that may touch, and how deep they do.

Which pairs there are is known when the program is compiled: nothing is searched for, counted or sorted. All
candidates of one kind lie along one leading array axis, (candidates, *batch), so that compile time does not
grow with them.
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

# Of a segment's squared length: what holds the nearest points of parallel segments to their middles.
PARALLEL = 1e-9


class Touch(NamedTuple):
    """Two shapes at a pose; all in T axes."""

    depth: Float[Array, "candidates *batch"]  # d [m], negative apart
    normal: Vector  # n, outward from the target's surface
    point: Vector  # P, on the shape that the sphere meets, else on the target's: there the force acts [m]


class Candidates(eqx.Module):
    """Interface of all kinds of pairs."""

    @abc.abstractmethod
    def touch(self, pose: Pose) -> Touch:
        """The pairs at a pose, whose leaves have a leading axis of length 1."""

    @property
    @abc.abstractmethod
    def size(self) -> Float[Array, "candidates *batch"]:
        """Depth [m] at which the shapes have gone through each other; infinite where they cannot."""


class ChaserSpheres(Candidates):
    """Spheres of the chaser, against one kind of the target's shapes. Radius 0 is a point."""

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
    """Spheres of the target, against one kind of the chaser's shapes. Radius 0 is a point."""

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
    """Rate d' of the depth [m/s], and slip [m/s]: the chaser's motion along the target's surface."""
    velocity = twist.linear + cross(twist.angular, touch.point - pose.position)
    rate = -dot(touch.normal, velocity)
    return rate, velocity + rate * touch.normal


def _nearest(one: Capsule, other: Capsule) -> tuple[Array, Array]:
    """The fractions of two segments that are nearest to each other; where many are, near their middles.

    Both at once, slightly held to the middles, then each to the other's, clamped to its ends.
    """
    u, v, apart = one.end - one.start, other.end - other.start, one.start - other.start
    uu, vv, uv = dot(u, u) * (1 + PARALLEL), dot(v, v) * (1 + PARALLEL), dot(u, v)
    held_u, held_v = (PARALLEL / 2 * dot(w, w) for w in (u, v))
    determinant = uu * vv - uv**2
    towards = vv * (held_u - dot(u, apart)) + uv * (held_v + dot(v, apart))
    s = towards / jnp.where(determinant > 0, determinant, 1)
    t = other.nearest(one.at(jnp.clip(s, 0, 1)))
    return one.nearest(other.at(t)), t
