"""Rotations as unit quaternions, and rotation vectors: exponential, logarithm and left Jacobian.

Quaternions q = (w, v) are Hamilton's; q and -q are the same rotation. A rotation vector theta is the axis
times the angle t = |theta| [rad]. What depends on t is a power series in t^2, and near t = 0 that series is
summed: values and derivatives of any order are right there too.
"""

from collections.abc import Callable
from math import factorial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.sixdof.vectors import Vector, cross, dot

NEAR = 0.25  # of t^2, up to where series are summed: eight terms are exact to rounding


class Quaternion(NamedTuple):
    """A rotation w + v, of norm 1; from axes A to axes B it takes components in A to components in B."""

    w: Float[Array, "..."]  # cos(t/2)
    v: Vector  # sin(t/2) times the axis


def identity(like: Float[Array, "*batch"]) -> Quaternion:
    """No rotation, for a batch shaped like `like`."""
    zero = jnp.zeros_like(like)
    return Quaternion(zero + 1, Vector(zero, zero, zero))


@jax.jit
def compose(second: Quaternion, first: Quaternion) -> Quaternion:
    """The rotation `first`, then the rotation `second`: their product."""
    (a, u), (b, v) = second, first
    return Quaternion(a * b - dot(u, v), a * v + b * u + cross(u, v))


def reverse(rotation: Quaternion) -> Quaternion:
    """The rotation back."""
    return Quaternion(rotation.w, -rotation.v)


@jax.jit
def rotate(rotation: Quaternion, vector: Vector) -> Vector:
    """R vector."""
    along = 2 * cross(rotation.v, vector)
    return vector + rotation.w * along + cross(rotation.v, along)


def rotate_back(rotation: Quaternion, vector: Vector) -> Vector:
    """R^T vector."""
    return rotate(reverse(rotation), vector)


@jax.jit
def normalise(rotation: Quaternion) -> Quaternion:
    """The same rotation, of norm 1 to rounding."""
    share = 1 / jnp.sqrt(rotation.w**2 + dot(rotation.v, rotation.v))
    return Quaternion(share * rotation.w, share * rotation.v)


@jax.jit
def exponential(theta: Vector) -> Quaternion:
    """The rotation whose rotation vector is theta [rad]."""
    square = dot(theta, theta) / 4
    return Quaternion(_cosine(square), (_sine(square) / 2) * theta)


@jax.jit
def logarithm(rotation: Quaternion) -> Vector:
    """Rotation vector [rad] of at most pi; of a half turn, either of its two."""
    sign = jnp.where(rotation.w < 0, -1, 1).astype(rotation.w.dtype)
    w, v = sign * rotation.w, sign * rotation.v
    sine_square = dot(v, v)
    # t/2 = atan(sin/cos) is a series in tan^2 near 0, and atan2 beyond.
    near = sine_square < _TANGENT_NEAR * w**2
    tangent_square = jnp.where(near, sine_square, 0) / jnp.where(near, w, 1) ** 2
    sine = jnp.sqrt(jnp.where(near, 1, sine_square))
    half = jnp.where(
        near, _sum(_ARCTANGENT, tangent_square) / jnp.where(near, w, 1), jnp.arctan2(sine, w) / sine
    )
    return (2 * half) * v


@jax.jit
def left_jacobian(theta: Vector, rate: Vector) -> Vector:
    """Jl(theta) rate: the angular velocity [rad/s], in the axes to which exp(theta) leads, of a rotation
    vector that changes at `rate` [rad/s]."""
    square = dot(theta, theta)
    once = cross(theta, rate)
    return rate + _versine(square) * once + _cubic(square) * cross(theta, once)


@jax.jit
def inverse_left_jacobian(theta: Vector, angular_velocity: Vector) -> Vector:
    """Jl(theta)^-1 w: the rate [rad/s] of the rotation vector at the angular velocity w [rad/s]; |theta| is
    less than a whole turn."""
    once = cross(theta, angular_velocity)
    return angular_velocity - 0.5 * once + _cotangent(dot(theta, theta)) * cross(theta, once)


def _sum(coefficients, x):
    total = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = coefficient + x * total
    return total


def _alternating(first: int) -> tuple[float, ...]:
    """(-1)^k / (2k + first)!"""
    return tuple((-1) ** k / factorial(2 * k + first) for k in range(8))


def _function(series: tuple[float, ...], closed: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """A function of t^2: its series near 0, and beyond what `closed` makes of t."""

    def function(square):
        near = square < NEAR
        angle = jnp.sqrt(jnp.where(near, 1, square))
        return jnp.where(near, _sum(series, jnp.where(near, square, 0)), closed(angle))

    return function


_TANGENT_NEAR = 0.01  # of tan^2(t/2)
_ARCTANGENT = tuple((-1) ** k / (2 * k + 1) for k in range(8))
# Bernoulli's numbers |B_2k| / (2k)!
_BERNOULLI = (
    1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160,
    691 / 1307674368000, 1 / 74724249600, 3617 / 10670622842880000,
)  # fmt: skip

_cosine = _function(_alternating(0), jnp.cos)
_sine = _function(_alternating(1), lambda t: jnp.sin(t) / t)
_versine = _function(_alternating(2), lambda t: (1 - jnp.cos(t)) / t**2)
_cubic = _function(_alternating(3), lambda t: (t - jnp.sin(t)) / t**3)
_cotangent = _function(_BERNOULLI, lambda t: (1 - t / 2 / jnp.tan(t / 2)) / t**2)
