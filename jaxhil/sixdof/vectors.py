"""Vectors and matrices in three dimensions, with a separate array for each component.

Each component has the batch shape. A single array with an axis for the components would have to be split and
joined at every tick.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.lanes import safe_sqrt


class Vector(eqx.Module):
    """Vector with three components, which supports `+`, `-` and `number * vector`."""

    x: Float[Array, "..."]
    y: Float[Array, "..."]
    z: Float[Array, "..."]

    # For `number * vector`, this makes NumPy numbers call `__rmul__` of this class.
    __array_ufunc__ = None

    def __add__(self, other: "Vector") -> "Vector":
        return Vector(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Vector") -> "Vector":
        return Vector(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> "Vector":
        return Vector(-self.x, -self.y, -self.z)

    def __rmul__(self, number: Array | float | int) -> "Vector":
        return Vector(number * self.x, number * self.y, number * self.z)


class Matrix(eqx.Module):
    """Matrix with three rows, which supports `matrix @ vector`."""

    x: Vector
    y: Vector
    z: Vector

    def __matmul__(self, vector: Vector) -> Vector:
        return Vector(dot(self.x, vector), dot(self.y, vector), dot(self.z, vector))


def vector(components: Float[Array, "3 *batch"]) -> Vector:
    """Convert an array with the components along the leading axis to a `Vector`."""
    return Vector(components[0], components[1], components[2])


def components(vector: Vector) -> Float[Array, "3 *batch"]:
    """Stack the components of a vector along a leading axis."""
    return jnp.stack([vector.x, vector.y, vector.z])


def assembled(parts: Any) -> Float[Array, "components *batch"]:
    """Stack the leaves of `parts` along a leading axis.

    The leaves are written one after the other, because the compiler would fuse `jnp.stack` with the
    computation of its inputs.
    """
    leaves = jax.tree.leaves(parts)
    whole = jnp.zeros((len(leaves), *leaves[0].shape), leaves[0].dtype)
    for index, leaf in enumerate(leaves):
        whole = lax.dynamic_update_index_in_dim(whole, leaf, index, 0)
    return whole


def matrix(entries: Float[Array, "3 3 *batch"]) -> Matrix:
    """Convert an array (rows, columns, *batch) to a `Matrix`."""
    return Matrix(vector(entries[0]), vector(entries[1]), vector(entries[2]))


def dot(a: Vector, b: Vector) -> Float[Array, "..."]:
    """Return the scalar product of two vectors."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product a x b."""
    return Vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def norm(a: Vector) -> Float[Array, "..."]:
    """Return the length of a vector. At the zero vector, the derivative is 0."""
    return safe_sqrt(dot(a, a))


def direction(a: Vector) -> Vector:
    """Return the unit vector along `a`, or the zero vector if `a` is 0."""
    length = norm(a)
    return (1 / jnp.where(length > 0, length, 1)) * a


@jax.jit
def inverse(a: Matrix) -> Matrix:
    """Return the inverse of an invertible matrix, computed from the cofactors."""
    columns = cross(a.y, a.z), cross(a.z, a.x), cross(a.x, a.y)
    factor = 1 / dot(a.x, columns[0])
    i, j, k = (factor * column for column in columns)
    return Matrix(Vector(i.x, j.x, k.x), Vector(i.y, j.y, k.y), Vector(i.z, j.z, k.z))
