"""Rotations as unit quaternions and rotation vectors: exponential, logarithm and left Jacobian.

Quaternions q = (w, v) follow Hamilton's convention; q and -q are the same rotation. A rotation vector theta
is the axis times the angle t = |theta| [rad]. Near t = 0, functions of t are computed as power series in t^2,
so that values and derivatives of any order are accurate there.
"""

from math import factorial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.sixdof.vectors import Vector, cross, dot

PI = 3.141592653589793, 1.2246467991473532e-16  # pi as a sum of two floats, which has twice the digits
# Maximum t^2 for the power series, whose eleven terms are accurate to rounding.
MAX_SERIES_SQUARE = (PI[0] / 2) ** 2


class Quaternion(NamedTuple):
    """Rotation as a unit quaternion (w, v).

    A rotation from axes A to axes B maps a vector's components in A to its components in B.
    """

    w: Float[Array, "..."]  # cos(t/2)
    v: Vector  # sin(t/2) times the axis


def identity(like: Float[Array, "*batch"]) -> Quaternion:
    """Return the identity rotation, for a batch with the shape of `like`."""
    zero = jnp.zeros_like(like)
    return Quaternion(zero + 1, Vector(zero, zero, zero))


@jax.jit
def compose(second: Quaternion, first: Quaternion) -> Quaternion:
    """Return the product of two rotations: `first`, followed by `second`."""
    (a, u), (b, v) = second, first
    return Quaternion(a * b - dot(u, v), a * v + b * u + cross(u, v))


def reverse(rotation: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    return Quaternion(rotation.w, -rotation.v)


@jax.jit
def rotate(rotation: Quaternion, vector: Vector) -> Vector:
    """Return the product R v, where R is the matrix of the rotation and v the `vector`."""
    along = 2 * cross(rotation.v, vector)
    return vector + rotation.w * along + cross(rotation.v, along)


def rotate_back(rotation: Quaternion, vector: Vector) -> Vector:
    """Return the product R^T v, where R is the matrix of the rotation and v the `vector`."""
    return rotate(reverse(rotation), vector)


@jax.jit
def normalise(rotation: Quaternion) -> Quaternion:
    """Scale a quaternion to norm 1, to correct rounding errors."""
    scale = 1 / jnp.sqrt(rotation.w**2 + dot(rotation.v, rotation.v))
    return Quaternion(scale * rotation.w, scale * rotation.v)


@jax.jit
def exponential(theta: Vector) -> Quaternion:
    """Convert a rotation vector [rad] to a quaternion."""
    square = dot(theta, theta) / 4
    return Quaternion(_cosine(square), (_sine(square) / 2) * theta)


@jax.jit
def logarithm(rotation: Quaternion) -> Vector:
    """Convert a rotation to its rotation vector [rad], with a norm of at most pi.

    For a rotation by pi, the result is one of the two possible vectors.
    """
    sign = jnp.where(rotation.w < 0, -1, 1).astype(rotation.w.dtype)
    w, v = sign * rotation.w, sign * rotation.v
    # tan(a/2) = tan(a)/(1 + sqrt(1 + tan(a)^2)) reduces tan(t/2) to tan(t/8), which is less than 1/2.
    square = dot(v, v)
    scale = 1 / (w + jnp.sqrt(w**2 + square))
    scale = scale / (1 + jnp.sqrt(1 + scale**2 * square))
    return (8 * scale * _sum(_ARCTANGENT, scale**2 * square)) * v


@jax.jit
def left_jacobian(theta: Vector, rate: Vector) -> Vector:
    """Return the angular velocity Jl(theta) rate [rad/s] for a rotation vector theta and its rate [rad/s].

    Jl is the left Jacobian. The angular velocity is in the axes to which the rotation maps.
    """
    square = dot(theta, theta)
    once = cross(theta, rate)
    return rate + _versine(square) * once + _cubic(square) * cross(theta, once)


@jax.jit
def inverse_left_jacobian(theta: Vector, angular_velocity: Vector) -> Vector:
    """Return the rate Jl(theta)^-1 w [rad/s] of a rotation vector theta for an angular velocity w [rad/s].

    Jl is the left Jacobian. The norm of theta must be less than 2 pi.
    """
    once = cross(theta, angular_velocity)
    return angular_velocity - 0.5 * once + _cotangent(dot(theta, theta)) * cross(theta, once)


def _sum(coefficients, x):
    """Return the value of a power series at x; `coefficients` begin with the lowest order."""
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = coefficient + x * total
    return total


def _alternating(first: int) -> tuple[float, ...]:
    """Return the eleven coefficients (-1)^k / (2k + first)! for k = 0 to 10."""
    return tuple((-1) ** k / factorial(2 * k + first) for k in range(11))


def _cosine(square: Array) -> Array:
    """Return cos t for the angle t = sqrt(square) [rad]."""
    _, turned, sign = _reduced(square)
    return sign * _sum(_COSINE, turned)


def _sine(square: Array) -> Array:
    """Return sin(t)/t for the angle t = sqrt(square) [rad]."""
    share, turned, sign = _reduced(square)
    return sign * share * _sum(_SINE, turned)


def _reduced(square: Array) -> tuple[Array, Array, Array]:
    """Reduce the angle t = sqrt(square) to t = r + k pi with |r| <= pi/2; return r/t, r^2 and (-1)^k.

    With the reduced angle, power series give sine and cosine faster than JAX's functions, which call a
    library function for each number.
    """
    near = square <= MAX_SERIES_SQUARE
    safe = jnp.where(near, 1, square)
    share = lax.rsqrt(safe)
    half_turns = lax.stop_gradient(jnp.round(safe * share / PI[0]))
    rest = safe * share - half_turns * PI[0] - half_turns * PI[1]
    odd = half_turns - 2 * jnp.floor(half_turns / 2)
    return (
        jnp.where(near, 1, rest * share),
        jnp.where(near, square, rest**2),
        jnp.where(near, 1, 1 - 2 * odd),
    )


def _versine(square: Array) -> Array:
    """Return (1 - cos t)/t^2 for the angle t = sqrt(square) [rad]."""
    return _sine(square / 4) ** 2 / 2


def _cubic(square: Array) -> Array:
    """Return (t - sin t)/t^3 for the angle t = sqrt(square) [rad]."""
    sine = _sine(square / 4) * _cosine(square / 4)
    return _near(_CUBIC, MAX_SERIES_SQUARE, square, 1 - sine)


def _cotangent(square: Array) -> Array:
    """Return (1 - (t/2) cot(t/2))/t^2 for the angle t = sqrt(square) [rad]."""
    return _near(_BERNOULLI, 0.25, square, 1 - _cosine(square / 4) / _sine(square / 4))


def _near(series: tuple[float, ...], limit: float, square: Array, beyond: Array) -> Array:
    """Return a power series in `square` if `square` is at most `limit`, and `beyond`/`square` otherwise."""
    near = square <= limit
    return jnp.where(near, _sum(series, jnp.where(near, square, 0)), beyond / jnp.where(near, 1, square))


_COSINE, _SINE, _CUBIC = _alternating(0), _alternating(1), _alternating(3)
_ARCTANGENT = tuple((-1) ** k / (2 * k + 1) for k in range(20))
# Coefficients |B_2k| / (2k)! with Bernoulli numbers B_2k.
_BERNOULLI = (
    1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160,
    691 / 1307674368000, 1 / 74724249600, 3617 / 10670622842880000,
)  # fmt: skip
