"""Derivative-free search on known minima: curved valleys, kinks, many basins, bounds."""

import numpy as np
import pytest

from tuning.optimisation.derivative_free import polish, reflect_into_box, search_globally


def rosenbrock(points):
    """Return Rosenbrock's function, 0 at 0.75 of each gain's range, at the end of a curved valley."""
    x = 4 * points - 2
    return np.sum(100 * (x[..., 1:] - x[..., :-1] ** 2) ** 2 + (1 - x[..., :-1]) ** 2, axis=-1)


def kinked(points):
    """Return a function with kinks and curvature, 0 at 0.3, 0.4, ...; gain weights differ 1000-fold."""
    gains = points.shape[-1]
    away = points - np.linspace(0.3, 0.7, gains)
    return np.sum(np.geomspace(1, 1e-3, gains) * (np.abs(away) + 10 * away**2), axis=-1)


def rippled(points):
    """Return Rastrigin's function, 0 at 0.6: a bowl with 5^gains basins."""
    x = 5 * (points - 0.6)
    return np.sum(x**2 + 10 * (1 - np.cos(2 * np.pi * x)), axis=-1)


@pytest.mark.parametrize("gains", [2, 6, 12])
def test_polishing_search_converges_along_a_curved_valley(gains):
    start = np.full(gains, 0.6)
    result = polish(rosenbrock, start, 1200 * gains, reach=0.05)
    assert result.loss < 1e-3 * rosenbrock(start)
    longer = polish(rosenbrock, start, 3000 * gains, reach=0.05)
    np.testing.assert_allclose(longer.point, 0.75, atol=1e-4)


@pytest.mark.parametrize("gains", [2, 6, 12])
def test_polishing_search_converges_at_a_kink(gains):
    start = np.full(gains, 0.52)
    result = polish(kinked, start, 400 * gains, reach=0.05)
    assert result.loss < 1e-3 * kinked(start)


def test_polishing_search_converges_faster_with_known_covariance():
    generator = np.random.default_rng(0)
    turned, _ = np.linalg.qr(generator.standard_normal((10, 10)))
    hessian = (turned * np.geomspace(1, 1e6, 10)) @ turned.T

    def losses(points):
        away = points - 0.5
        return np.einsum("...i,ij,...j->...", away, hessian, away)

    start = np.full(10, 0.5) + 0.05 * turned[:, 0] + 1e-4 * turned[:, 9]
    blind = polish(losses, start, 640, reach=0.02)
    shaped = polish(losses, start, 640, reach=0.02, covariance=np.linalg.inv(hessian))
    assert shaped.loss < 0.1 * blind.loss


def test_polishing_search_is_never_worse_than_its_starting_point():
    # Start at the minimum with so wide a search that no candidate is better.
    start = np.array([0.3, 0.7])
    result = polish(kinked, start, 64, reach=0.4)
    assert result.loss == kinked(start) == 0
    np.testing.assert_array_equal(result.point, start)


def test_polishing_searches_of_a_batch_are_independent():
    starts = np.random.default_rng(1).random((3, 4))
    together = polish(rosenbrock, starts, 320)
    for start, free, loss in zip(starts, together.point, together.loss, strict=True):
        alone = polish(rosenbrock, start, 320)
        np.testing.assert_allclose(alone.point, free, rtol=1e-9)
        assert alone.loss == pytest.approx(loss, rel=1e-9)
    assert together.evaluations == 320


def test_polishing_search_is_reproducible_and_uses_constant_batch_shape():
    shapes = []

    def losses(points):
        shapes.append(points.shape)
        assert (points >= 0).all() and (points <= 1).all()
        return rippled(points)

    first, second = (polish(losses, np.full(3, 0.99), 200, candidates=16, reach=0.3) for _ in range(2))
    np.testing.assert_array_equal(first.point, second.point)
    assert set(shapes) == {(16, 3)}
    # Evaluations are whole generations within the budget.
    assert first.evaluations == 192 and len(shapes) == 2 * 12


def test_polishing_search_finds_minimum_on_the_bound():
    target = np.array([0.0, 0.4, 1.0])
    result = polish(lambda points: np.sum(np.abs(points - target), axis=-1), np.full(3, 0.5), 1500, reach=0.1)
    np.testing.assert_allclose(result.point, target, atol=1e-3)


def test_polishing_search_treats_nan_as_the_worst_loss():
    def losses(points):
        return np.where(points[..., 0] > 0.55, np.nan, rosenbrock(points))

    result = polish(losses, np.full(2, 0.5), 1000, reach=0.1)
    # The valley decreases to (1 - x)^2 at x = 0.2, at the bound.
    assert result.loss == pytest.approx(0.64, rel=1e-3)
    assert result.point[0] <= 0.55
    nowhere = polish(lambda points: np.full(len(points), np.nan), np.full(2, 0.5), 64)
    np.testing.assert_array_equal(nowhere.point, 0.5)


@pytest.mark.parametrize("gains", [2, 5, 10])
def test_global_search_finds_the_best_of_many_basins(gains):
    result = search_globally(rippled, gains, 10_000 * gains)
    np.testing.assert_allclose(result.point, 0.6, atol=1e-3)
    assert result.loss < 1e-3


def test_global_search_finds_minimum_that_local_search_misses():
    def losses(points):
        """Return the minimum of a wide basin at 0.2 and a narrow, deeper basin at 0.8."""
        wide = np.sum((points - 0.2) ** 2, axis=-1)
        narrow = 20 * np.sum((points - 0.8) ** 2, axis=-1) - 0.5
        return np.minimum(wide, narrow)

    local = polish(losses, np.full(4, 0.3), 4000)
    assert local.loss == pytest.approx(0, abs=1e-6)
    result = search_globally(losses, 4, 20_000)
    assert result.loss == pytest.approx(-0.5, abs=1e-6)
    assert result.loss == losses(result.point)


def test_global_search_keeps_evaluation_budget_and_constant_batch_shape():
    shapes = []

    def losses(points):
        shapes.append(points.shape)
        return kinked(points)

    result = search_globally(losses, 3, 3000, candidates=8, basins=4)
    assert set(shapes) == {(32, 3)}
    assert result.evaluations == 32 * len(shapes) <= 3000
    assert result.evaluations > 3000 - 64
    assert result.loss == kinked(result.point)


def test_reflection_at_bounds_maps_points_into_unit_box():
    np.testing.assert_allclose(
        reflect_into_box(np.array([-0.2, 0.3, 1.2, 2.1, -1.4])), [0.2, 0.3, 0.8, 0.1, 0.6]
    )
