"""Bounded least squares: the bijection, known minima, a status per start."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuning.optimiser import STATUSES, Bounds, _with_jacobian, solve, to_free, to_gains

BOUNDS = Bounds(jnp.array([0.0, 1e-3]), jnp.array([2.0, 10.0]), jnp.array([0.0, 1.0]))


@given(st.floats(0.01, 0.99), st.floats(0.01, 0.99))
def test_bounds_map_one_to_one(linear, logarithmic):
    gains = jnp.array([2 * linear, 1e-3 * 1e4**logarithmic])
    np.testing.assert_allclose(to_gains(to_free(gains, BOUNDS), BOUNDS), gains, rtol=1e-9)


@pytest.mark.parametrize("free", [-1e3, -5.0, 0.0, 5.0, 1e3])
def test_gains_stay_within_bounds(free):
    gains = np.asarray(to_gains(jnp.full(2, free), BOUNDS))
    assert (gains >= np.asarray(BOUNDS.lower) * (1 - 1e-12)).all()
    assert (gains <= np.asarray(BOUNDS.upper) * (1 + 1e-12)).all()


def distance(static, gains, arguments):
    return static * jnp.stack([gains[:, 0] - arguments[:, 0], jnp.log(gains[:, 1] / arguments[:, 1])], axis=1)


def blows_up(static, gains, arguments):
    return jnp.where(gains[:, :1] > 1.5, jnp.nan, 1.0) * distance(static, gains, arguments)


def solved(residuals, targets, starts, steps):
    bounds = Bounds(*(jnp.tile(leaf, (len(starts), 1)) for leaf in BOUNDS))
    return solve(
        residuals, 10.0, jnp.array(targets), bounds, jnp.array(starts), jnp.array(steps), longest=64, tile=2
    )


def test_every_problem_finds_its_own_minimum():
    targets = [[0.7, 0.2], [0.7, 0.2], [1.2, 3.0]]
    solution = solved(distance, targets, [[0.1, 0.01], [1.9, 5.0], [1.0, 1.0]], 60)
    np.testing.assert_allclose(solution.gains, targets, rtol=1e-4)
    assert [STATUSES[i] for i in solution.status] == ["converged"] * 3
    history = np.asarray(solution.history)
    assert (np.diff(history, axis=1) <= 0).all()
    np.testing.assert_allclose(history[:, -1], solution.loss)


def test_equal_bounds_hold_a_gain():
    bounds = Bounds(jnp.array([[0.4, 1e-3]] * 2), jnp.array([[0.4, 10.0]] * 2), jnp.array([[1.0, 1.0]] * 2))
    arguments, starts = jnp.array([[0.7, 0.2]] * 2), jnp.array([[0.4, 1.0], [0.4, 5.0]])
    solution = solve(distance, 10.0, arguments, bounds, starts, jnp.array(30))
    np.testing.assert_allclose(solution.gains, [[0.4, 0.2]] * 2, rtol=1e-4)


def test_too_few_steps_and_a_start_that_is_not_finite_are_named():
    solution = solved(blows_up, [[0.7, 0.2]] * 2, [[0.1, 0.01], [1.9, 5.0]], 2)
    assert [STATUSES[i] for i in solution.status] == ["step limit", "not finite"]


@pytest.mark.parametrize("number", [1, 2, 3])
def test_derivative_is_that_of_the_residuals(number):
    free = jnp.linspace(0.1, 0.9, 2 * number).reshape(number, 2)
    factors = jnp.linspace(2.0, 5.0, 2 * number).reshape(number, 2)
    tangent = jnp.array([1.0, -0.5])
    function = _with_jacobian(lambda free, factors: jnp.sin(free) * factors, free, factors)

    def along(free, factors):
        return jax.jvp(lambda x: function(x, factors), (free,), (tangent,))

    (value, loss), (slope, _) = jax.vmap(along)(free, factors)
    np.testing.assert_allclose(value, np.sin(free) * factors)
    np.testing.assert_allclose(loss, np.sum(np.asarray(value) ** 2, axis=1) / 2)
    np.testing.assert_allclose(slope, np.cos(free) * factors * tangent[None])
    # Alone, it is the same function.
    np.testing.assert_allclose(function(free[0], factors[0])[0], np.asarray(value)[0])
