"""Shapes that may touch, with the signed distance from a point to the surface and the outward normal.

The parameters of a shape are arrays (candidates, *batch), in the axes of the body's interface frame [m].
Distances are positive outside. The formulas follow Quilez, "3D signed distance functions".
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.lanes import safe_sqrt
from jaxhil.sixdof.rotations import Quaternion, rotate, rotate_back
from jaxhil.sixdof.vectors import Vector, direction, dot, norm

NEAR_AXIS = 1e-12  # distance from the axis below which the radial direction decreases smoothly to 0 [m]


class Surface(NamedTuple):
    """Signed distance from a point to a shape's surface, and the surface's outward normal."""

    distance: Float[Array, "..."]  # signed distance [m], positive if the point is outside the shape
    normal: Vector  # outward normal at the nearest point of the surface, unit vector


class Shape(eqx.Module):
    """Interface of all shapes."""

    @abc.abstractmethod
    def surface(self, point: Vector) -> Surface:
        """Return the signed distance from a point [m] to the surface, and the outward normal."""

    @property
    def thickness(self) -> Float[Array, "..."] | float:
        """Return the depth below the surface [m] at which a point has passed through the shape."""
        return jnp.inf


class Plane(Shape):
    """Half-space, bounded by a plane."""

    point: Vector  # point on the plane [m]
    normal: Vector  # outward normal, unit vector

    def surface(self, point):
        return Surface(dot(self.normal, point - self.point), self.normal)


class Ball(Shape):
    """Sphere that is touched from outside. At the centre, the normal is 0."""

    centre: Vector  # [m]
    radius: Float[Array, "..."]  # [m]

    def surface(self, point):
        apart = point - self.centre
        return Surface(norm(apart) - self.radius, direction(apart))

    @property
    def thickness(self):
        return self.radius


class Cavity(Shape):
    """Sphere that is touched from inside, such as the surface that the end of a tether cannot leave."""

    centre: Vector  # [m]
    radius: Float[Array, "..."]  # [m]

    def surface(self, point):
        apart = point - self.centre
        return Surface(self.radius - norm(apart), -direction(apart))


class Drogue(Shape):
    """Cone that opens along +z and is touched from inside; its bottom is a sphere tangent to the cone.

    A sphere that touches the drogue must be smaller than the bottom sphere: a larger sphere could touch the
    wall while its centre is on the axis, where the wall's normal is not defined.
    """

    half_angle: Float[Array, "..."]  # half angle of the cone [rad]
    bottom_radius: Float[Array, "..."]  # radius of the bottom sphere [m]
    bottom: Float[Array, "..."]  # z coordinate of the bottom sphere's centre [m]

    def surface(self, point):
        radius, outward = _radial(point)
        height = point.z - self.bottom
        sine, cosine = jnp.sin(self.half_angle), jnp.cos(self.half_angle)
        zero = jnp.zeros_like(height)
        centre = Vector(zero, zero, self.bottom + zero)
        bottom = Cavity(centre, self.bottom_radius).surface(point)
        wall = self.bottom_radius - (radius * cosine - height * sine)
        inward = -cosine * outward + sine * Vector(zero, zero, zero + 1)
        on_wall = radius * sine + height * cosine > 0
        return Surface(jnp.where(on_wall, wall, bottom.distance), _either(on_wall, inward, bottom.normal))


class Shell(Drogue):
    """Thin drogue of finite length, which can be touched from inside, from outside and at its edge.

    A sphere that touches the shell must have a radius greater than 0.
    """

    mouth_radius: Float[Array, "..."]  # radius of the wall's edge at the mouth [m]

    def surface(self, point):
        signed, inward = super().surface(point)
        side = jnp.where(signed < 0, -1, 1).astype(signed.dtype)
        sine, cosine = jnp.sin(self.half_angle), jnp.cos(self.half_angle)
        height = self.bottom + (self.mouth_radius * cosine - self.bottom_radius) / sine
        edge = Rim(self.mouth_radius, height, jnp.zeros_like(height)).surface(point)
        radius, _ = _radial(point)
        # If the nearest point of a wall without end lies beyond the mouth, the edge is the nearest part.
        on_wall = radius * sine + (point.z - self.bottom) * cosine > 0
        beyond = on_wall & (radius + signed * cosine > self.mouth_radius)
        distance = jnp.where(beyond, edge.distance, side * signed)
        return Surface(distance, _either(beyond, edge.normal, side * inward))

    @property
    def thickness(self):
        return 0.0


class Rim(Shape):
    """Torus about the z axis, such as the rim of a drogue's mouth."""

    ring_radius: Float[Array, "..."]  # major radius: radius of the centre circle [m]
    height: Float[Array, "..."]  # z coordinate of the centre circle [m]
    radius: Float[Array, "..."]  # minor radius: radius of the cross-section [m]

    def surface(self, point):
        radius, outward = _radial(point)
        across, along = radius - self.ring_radius, point.z - self.height
        apart = safe_sqrt(across**2 + along**2)
        scale = 1 / jnp.where(apart > 0, apart, 1)
        zero = jnp.zeros_like(along)
        normal = (scale * across) * outward + Vector(zero, zero, scale * along)
        return Surface(apart - self.radius, normal)

    @property
    def thickness(self):
        return self.radius


class Capsule(Shape):
    """Capsule: all points whose distance from a line segment is less than a radius."""

    start: Vector  # start of the segment [m]
    end: Vector  # end of the segment [m]
    radius: Float[Array, "..."]  # [m]

    def surface(self, point):
        apart = point - self.at(self.nearest(point))
        return Surface(norm(apart) - self.radius, direction(apart))

    def at(self, s: Float[Array, "..."]) -> Vector:
        """Return the point of the segment at the fraction `s` of its length: 0 at its start, 1 at its end."""
        return self.start + s * (self.end - self.start)

    def nearest(self, point: Vector) -> Float[Array, "..."]:
        """Return the place on the segment nearest to `point`, as a fraction of its length from the start."""
        along = self.end - self.start
        square = dot(along, along)
        return jnp.clip(dot(along, point - self.start) / jnp.where(square > 0, square, 1), 0, 1)

    @property
    def thickness(self):
        return self.radius


class Box(Shape):
    """Box with rounded edges."""

    centre: Vector  # [m]
    attitude: Quaternion  # rotation from the box's axes to the frame's axes
    half_lengths: Vector  # half lengths of the edges, including the rounding [m]
    rounding: Float[Array, "..."]  # radius of the edges [m], positive

    def surface(self, point):
        in_box = rotate_back(self.attitude, point - self.centre)
        sign = Vector(*(jnp.where(part < 0, -1, 1).astype(part.dtype) for part in _parts(in_box)))
        core = [half - self.rounding for half in _parts(self.half_lengths)]
        beyond = [s * part - half for s, part, half in zip(_parts(sign), _parts(in_box), core, strict=True)]
        outside = Vector(*(jnp.where(part > 0, part, 0) for part in beyond))
        apart = norm(outside)
        # Inside the core (the box without its rounding), the nearest face determines distance and normal.
        x, y, z = beyond
        first, second = (x >= y) & (x >= z), y >= z
        faces = first, ~first & second, ~first & ~second
        unit = Vector(*(face.astype(x.dtype) for face in faces))
        inside = apart == 0
        normal = _either(inside, unit, direction(outside))
        signed = Vector(sign.x * normal.x, sign.y * normal.y, sign.z * normal.z)
        depth = jnp.where(first, x, jnp.where(second, y, z))
        return Surface(jnp.where(inside, depth, apart) - self.rounding, rotate(self.attitude, signed))

    @property
    def thickness(self):
        return jnp.minimum(jnp.minimum(*_parts(self.half_lengths)[:2]), self.half_lengths.z)


def _parts(vector: Vector) -> tuple[Array, Array, Array]:
    return vector.x, vector.y, vector.z


def _either(condition: Array, a: Vector, b: Vector) -> Vector:
    """Select the vector `a` where the condition holds, else the vector `b`."""
    return Vector(*(jnp.where(condition, u, v) for u, v in zip(_parts(a), _parts(b), strict=True)))


def _radial(point: Vector) -> tuple[Array, Vector]:
    """Return the distance from the z axis [m], and the radial direction, which is 0 on the axis."""
    radius = jnp.sqrt(point.x**2 + point.y**2 + NEAR_AXIS**2)
    return radius, Vector(point.x / radius, point.y / radius, jnp.zeros_like(radius))
