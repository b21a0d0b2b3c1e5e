"""Bounded least squares: the bijection, known minima, a status per start."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuning.optimiser import STATUSES, Bounds, solve, to_free, to_gains

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


def distance(static, gains, arguments, lane_axis):
    return static * jnp.stack([gains[0] - arguments[0], jnp.log(gains[1] / arguments[1])])


def blows_up(static, gains, arguments, lane_axis):
    return jnp.where(gains[0] > 1.5, jnp.nan, 1.0) * distance(static, gains, arguments, lane_axis)


def test_every_start_finds_the_minimum():
    starts = jnp.array([[0.1, 0.01], [1.9, 5.0], [1.0, 1.0]])
    solution = solve(distance, 10.0, jnp.array([0.7, 0.2]), BOUNDS, starts, max_steps=60)
    np.testing.assert_allclose(solution.gains, np.tile([0.7, 0.2], (3, 1)), rtol=1e-4)
    assert [STATUSES[i] for i in solution.status] == ["converged"] * 3
    history = np.asarray(solution.history)
    assert (np.diff(history, axis=1) <= 0).all()
    np.testing.assert_allclose(history[:, -1], solution.loss)


def test_too_few_steps_and_a_start_that_is_not_finite_are_named():
    starts = jnp.array([[0.1, 0.01], [1.9, 5.0]])
    solution = solve(blows_up, 10.0, jnp.array([0.7, 0.2]), BOUNDS, starts, max_steps=2)
    assert [STATUSES[i] for i in solution.status] == ["step limit", "not finite"]


def test_derivative_is_that_of_the_residuals():
    from tuning.optimiser import _with_jacobian

    free, arguments = jnp.array([0.3, 0.9]), jnp.array([2.0, 5.0])
    function = _with_jacobian(lambda free, arguments: jnp.sin(free) * arguments, 1, free, arguments)
    (value, loss), (slope, _) = jax.jvp(lambda x: function(x, arguments), (free,), (jnp.array([1.0, 0.0]),))
    np.testing.assert_allclose(value, np.sin(free) * arguments)
    np.testing.assert_allclose(loss, np.sum(np.asarray(value) ** 2) / 2)
    np.testing.assert_allclose(slope, [2 * np.cos(0.3), 0.0], atol=1e-15)
