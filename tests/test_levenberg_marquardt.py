"""Bounded least squares: minima inside and on the bounds, and a status per start."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import QUICK
from scipy.optimize import lsq_linear

from tuning.optimisation.levenberg_marquardt import _with_jacobian, solve_least_squares
from tuning.optimisation.solution import SOLVER_STATUSES
from tuning.optimisation.unit_box import GainBounds, to_coordinates, to_gains

BOUNDS = GainBounds(np.array([0.0, 1e-3]), np.array([2.0, 10.0]), np.array([0.0, 1.0]))


def distance(static, gains, arguments):
    return static * jnp.stack([gains[:, 0] - arguments[:, 0], jnp.log(gains[:, 1] / arguments[:, 1])], axis=1)


def blows_up(static, gains, arguments):
    return jnp.where(gains[:, :1] > 1.5, jnp.nan, 1.0) * distance(static, gains, arguments)


def solved(residuals, targets, starts, steps):
    bounds = GainBounds(*(np.tile(leaf, (len(starts), 1)) for leaf in BOUNDS))
    coordinates = to_coordinates(np.array(starts), bounds)
    return solve_least_squares(
        residuals, 10.0, np.array(targets), bounds, coordinates, np.array(steps), longest=64, tile=2
    )


def test_least_squares_finds_minimum_of_every_problem():
    targets = [[0.7, 0.2], [0.7, 0.2], [1.2, 3.0]]
    solution = solved(distance, targets, [[0.1, 0.01], [1.9, 5.0], [1.0, 1.0]], 60)
    np.testing.assert_allclose(to_gains(np.asarray(solution.coordinates), BOUNDS), targets, rtol=1e-4)
    assert [SOLVER_STATUSES[i] for i in solution.status] == ["converged"] * 3
    history = np.asarray(solution.history)
    assert (np.diff(history, axis=1) <= 0).all()
    np.testing.assert_allclose(history[:, -1], solution.loss)


def test_gain_with_equal_bounds_stays_fixed():
    bounds = GainBounds(np.array([[0.4, 1e-3]] * 2), np.array([[0.4, 10.0]] * 2), np.array([[1.0, 1.0]] * 2))
    arguments, starts = np.array([[0.7, 0.2]] * 2), np.array([[0.4, 1.0], [0.4, 5.0]])
    coordinates = to_coordinates(starts, bounds)
    solution = solve_least_squares(distance, 10.0, arguments, bounds, coordinates, np.array(30))
    np.testing.assert_allclose(
        to_gains(np.asarray(solution.coordinates), bounds), [[0.4, 0.2]] * 2, rtol=1e-4
    )


def tilted(static, gains, arguments):
    """Return linear residuals whose unconstrained minimum lies far outside the box, along a narrow valley."""
    matrix = jnp.array([[1.0, 0.9], [0.9, 1.0], [0.1, -0.1]])
    return (gains - arguments) @ matrix.T


def test_minimum_on_bounds_equals_bounded_linear_least_squares_solution():
    bounds = GainBounds(*(np.full((4, 2), leaf) for leaf in (0.0, 1.0, 0.0)))
    targets = np.array([[2.0, -0.3], [0.5, 3.0], [-1.0, -2.0], [0.2, 0.6]])
    starts = np.array([[0.5, 0.5], [0.0, 0.0], [1.0, 1.0], [1.0, 0.0]])
    solution = solve_least_squares(tilted, None, targets, bounds, starts, np.array(30))
    matrix = np.array([[1.0, 0.9], [0.9, 1.0], [0.1, -0.1]])
    for target, result, curvature in zip(targets, solution.coordinates, solution.curvature, strict=True):
        best = lsq_linear(matrix, matrix @ target, bounds=(0, 1), tol=1e-12).x
        np.testing.assert_allclose(result, best, atol=2e-5)
        np.testing.assert_allclose(curvature, matrix.T @ matrix)


def test_gain_without_influence_keeps_its_starting_value():
    def blind(static, gains, arguments):
        return gains[:, :1] - arguments

    bounds = GainBounds(*(jnp.array([[leaf] * 2]) for leaf in (0.0, 1.0, 0.0)))
    solution = solve_least_squares(
        blind, None, jnp.array([[0.7]]), bounds, jnp.array([[0.1, 0.3]]), jnp.array(30)
    )
    np.testing.assert_allclose(solution.coordinates, [[0.7, 0.3]], rtol=1e-6)
    assert [SOLVER_STATUSES[i] for i in solution.status] == ["converged"]


def test_least_squares_without_further_progress_reports_convergence():
    """Use a ripple finer than any step, so that the loss stops falling before the residuals do."""

    def rippled(static, gains, arguments):
        return jnp.concatenate([gains - 2.0, 1e-3 * jnp.sin(1e6 * gains)], axis=1)

    bounds = GainBounds(*(jnp.array([[leaf]]) for leaf in (0.0, 1.0, 0.0)))
    solution = solve_least_squares(
        rippled, None, jnp.zeros((1, 1)), bounds, jnp.array([[0.5]]), jnp.array(30)
    )
    assert [SOLVER_STATUSES[i] for i in solution.status] == ["converged"]
    assert solution.steps[0] < 20


def test_least_squares_reports_step_limit_and_nonfinite_starting_point():
    solution = solved(blows_up, [[0.7, 0.2]] * 2, [[0.1, 0.01], [1.9, 5.0]], 2)
    assert [SOLVER_STATUSES[i] for i in solution.status] == ["step limit", "not finite"]


@pytest.mark.parametrize("number", [1, 2, 3])
def test_least_squares_gradient_equals_gradient_of_residuals(number):
    free = jnp.asarray(np.linspace(0.1, 0.9, 2 * number).reshape(number, 2))
    factors = jnp.asarray(np.linspace(2.0, 5.0, 2 * number).reshape(number, 2))
    tangent = jnp.asarray([1.0, -0.5])
    function = _with_jacobian(lambda free, factors: jnp.sin(free) * factors, free, factors)

    def along(free, factors):
        return jax.jvp(lambda x: function(x, factors), (free,), (tangent,))

    (value, loss), (slope, _) = jax.jit(jax.vmap(along), compiler_options=QUICK)(free, factors)
    np.testing.assert_allclose(value, np.sin(free) * factors)
    np.testing.assert_allclose(loss, np.sum(np.asarray(value) ** 2, axis=1) / 2)
    np.testing.assert_allclose(slope, np.cos(free) * factors * tangent[None])
    # The function gives the same value for a single problem.
    np.testing.assert_allclose(function(free[0], factors[0])[0], np.asarray(value)[0])
