"""Rotations compared with SciPy, also near zero and near half a turn; derivatives of any order at 0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxhil.sixdof.rotations import (
    Quaternion,
    compose,
    exponential,
    inverse_left_jacobian,
    left_jacobian,
    logarithm,
    normalise,
    rotate,
    rotate_back,
)
from jaxhil.sixdof.vectors import Vector, components, inverse, matrix, vector

SEEDED = np.random.default_rng(5)
AXES = SEEDED.normal(size=(3, 40))
AXES /= np.linalg.norm(AXES, axis=0)
# Both sides of the limit of the series, and the smallest distances to 0 and to half a turn.
ANGLES = np.r_[0.0, 1e-300, 1e-160, 1e-20, 1e-9, 1e-4, np.linspace(1e-3, 0.6, 17), np.linspace(0.7, 3.1, 15),
               np.pi - 1e-9, np.pi]  # fmt: skip
THETA = AXES * ANGLES
MATRIX = np.array([[3.0, -1.0, 0.5], [0.2, 2.0, 0.7], [-0.4, 0.3, 1.5]])
RATE = SEEDED.normal(size=THETA.shape)


@jax.jit
def everything(theta, rate):
    theta, rate = vector(theta), vector(rate)
    turn, other, product = exponential(theta), exponential(rate), matrix(jnp.asarray(MATRIX))
    return (
        jnp.stack([turn.w, *components(turn.v)]),
        components(rotate(turn, rate)),
        components(logarithm(turn)),
        components(left_jacobian(theta, rate)),
        components(inverse_left_jacobian(theta, left_jacobian(theta, rate))),
        components(rotate_back(turn, rotate(turn, rate))),
        components(rotate(compose(turn, other), rate)),
        components(logarithm(normalise(Quaternion(-3 * turn.w, -3 * turn.v)))),
        components(inverse(product) @ (product @ rate)),
    )


@pytest.fixture(scope="module")
def results():
    return [np.asarray(part) for part in everything(jnp.asarray(THETA), jnp.asarray(RATE))]


def test_rotation_exponential_map_agrees_with_scipy(results):
    turns = Rotation.from_rotvec(THETA.T)
    sign = np.sign(np.sum(np.roll(turns.as_quat(), 1, axis=1).T * results[0], axis=0))
    np.testing.assert_allclose(results[0], sign * np.roll(turns.as_quat(), 1, axis=1).T, atol=4e-16)
    np.testing.assert_allclose(results[1], turns.apply(RATE.T).T, atol=2e-15)
    both = turns * Rotation.from_rotvec(RATE.T)
    np.testing.assert_allclose(results[6], both.apply(RATE.T).T, atol=4e-15)
    np.testing.assert_allclose(results[5], RATE, atol=2e-15)
    np.testing.assert_allclose(results[8], RATE, rtol=1e-12, atol=1e-13)


def test_rotation_logarithm_inverts_the_exponential_map(results):
    np.testing.assert_allclose(results[2][:, :-1], THETA[:, :-1], rtol=1e-14, atol=5e-16)
    np.testing.assert_allclose(results[7][:, :-1], THETA[:, :-1], rtol=1e-14, atol=5e-16)
    # Half a turn in either direction is the same rotation.
    np.testing.assert_allclose(np.linalg.norm(results[2][:, -1]), np.pi, rtol=1e-15)
    np.testing.assert_allclose(np.abs(results[2][:, -1] @ AXES[:, -1]), np.pi, rtol=1e-15)


def test_rotation_left_jacobian_equals_mean_of_intermediate_rotations(results):
    """Compute the mean of exp(s theta) over s in [0, 1] as a block of a matrix exponential."""
    for column in range(THETA.shape[1]):
        x, y, z = THETA[:, column]
        hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        block = expm(np.block([[hat, np.eye(3)], [np.zeros((3, 6))]]))[:3, 3:]
        np.testing.assert_allclose(results[3][:, column], block @ RATE[:, column], rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(results[4], RATE, rtol=1e-12, atol=1e-13)


def test_rotations_of_many_radians_agree_with_scipy():
    angles = np.r_[np.pi * np.arange(1, 9) + 1e-7, np.pi * np.arange(1, 9) - 1e-7, np.linspace(3, 400, 24)]
    results = [np.asarray(part) for part in everything(jnp.asarray(AXES * angles), jnp.asarray(RATE))]
    turns = Rotation.from_rotvec((AXES * angles).T)
    sign = np.sign(np.sum(np.roll(turns.as_quat(), 1, axis=1).T * results[0], axis=0))
    np.testing.assert_allclose(sign * results[0], np.roll(turns.as_quat(), 1, axis=1).T, atol=5e-14)
    crossed = np.cross(AXES.T, RATE.T).T
    along = AXES * np.sum(AXES * RATE, axis=0)
    mean = along + np.sin(angles) / angles * (RATE - along) + (1 - np.cos(angles)) / angles * crossed
    np.testing.assert_allclose(results[3], mean, atol=1e-13)


@pytest.mark.slow
def test_rotation_derivatives_at_zero_match_power_series():
    rate = Vector(*jnp.asarray([0.3, -0.2, 0.5]))

    def there_and_back(theta):
        turned = rotate(exponential(vector(theta)), rate)
        return jnp.stack([
            components(turned),
            components(logarithm(exponential(vector(theta)))),
            components(left_jacobian(vector(theta), rate)),
            components(inverse_left_jacobian(vector(theta), rate)),
        ])  # fmt: skip

    zero = jnp.zeros(3)
    slopes = jax.jit(jax.jacfwd(there_and_back))(zero)
    # Column i is the change of the vector with theta_i.
    crossed = -np.cross(np.asarray(components(rate)), np.eye(3)).T
    expected = [crossed, np.eye(3), crossed / 2, -crossed / 2]
    np.testing.assert_allclose(slopes, expected, atol=1e-16)


@pytest.mark.slow
def test_rotation_derivatives_up_to_third_order_match_finite_differences_along_a_ray():
    angles = jnp.asarray([0.0, 1e-8, 0.1, 0.19, 0.2, 0.21, 0.49, 0.5, 0.51, 1.5, 3.0])
    axis, rate = (vector(jnp.asarray(part)[:, :11]) for part in (AXES, RATE))

    def along(angles):
        theta, turn = angles * axis, exponential(angles * axis)
        results = (
            rotate(turn, rate),
            logarithm(turn),
            left_jacobian(theta, rate),
            inverse_left_jacobian(theta, rate),
        )
        return jnp.stack([components(part) for part in results])

    def slope(function):
        return lambda angles: jax.jvp(function, (angles,), (jnp.ones_like(angles),))[1]

    function = along
    for _ in range(3):
        below, above = (jax.jit(function)(angles + step) for step in (-1e-5, 1e-5))
        function = slope(function)
        np.testing.assert_allclose(jax.jit(function)(angles), (above - below) / 2e-5, atol=2e-8)
