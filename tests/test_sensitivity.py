"""How far each gain may move before the objective rises, against closed forms."""

import numpy as np
import pytest

from tuning.optimisation.sensitivity import RISE, freedom, sensitivity

STIFF_ENOUGH = 0.05  # the box adds its square to the region, relatively


def quadratic():
    """J of two combinations of three gains: a stiff one, a weaker one; the third is free."""
    return np.array([[300.0, 300.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def test_gains_move_as_far_as_the_loss_allows():
    jacobian, loss = np.array([[50.0, 0.0], [0.0, 20.0]]), 0.5
    found = sensitivity(jacobian, loss)
    # d^2 J^2 / 2 = rise * loss, in a box of one.
    allowed = np.sqrt(2 * RISE * loss) / np.array([50.0, 20.0])
    np.testing.assert_allclose(found.alone, 1 / np.hypot(1 / allowed, 1), rtol=1e-12)
    np.testing.assert_allclose(found.together, found.alone, rtol=1e-12)
    np.testing.assert_allclose(found.correlation, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(found.stiff_share, 1)


def test_gains_that_make_up_for_each_other_are_correlated_and_free_together():
    found = sensitivity(quadratic(), 0.5)
    assert found.alone[0] == pytest.approx(found.alone[1], rel=1e-4)
    assert found.alone[0] < 1e-3
    assert found.together[0] > 30 * found.alone[0]
    assert found.correlation[0, 1] < -0.999
    assert found.correlation[0, 2] == pytest.approx(0, abs=1e-12)
    assert found.together[2] == found.alone[2] == 1
    assert found.stiff_share[2] == 0
    assert 0.4 < found.stiff_share[0] <= 1


def test_the_region_of_a_quadratic_is_the_region():
    generator = np.random.default_rng(7)
    jacobian, residuals = 40 * generator.standard_normal((9, 4)), generator.standard_normal(9)
    # At the optimum of a linear least-squares problem, the residuals are orthogonal to J.
    residuals -= jacobian @ np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
    loss = np.sum(residuals**2) / 2
    found = sensitivity(jacobian, loss)
    assert (found.radius < STIFF_ENOUGH).all()
    for direction, radius in zip(found.directions, found.radius, strict=True):
        moved = np.sum((residuals + jacobian @ (radius * direction)) ** 2) / 2
        assert moved == pytest.approx((1 + RISE) * loss, rel=RISE * STIFF_ENOUGH**2)
    np.testing.assert_allclose(np.sum(found.directions**2, axis=0), 1)


def test_fewer_residuals_than_gains_leave_the_rest_free():
    found = sensitivity(np.array([[3.0, 0.0, 4.0]]), 0.5)
    np.testing.assert_allclose(found.values, [5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found.radius[1:], 1)
    assert found.together[1] == pytest.approx(1)


def test_freedom_sees_kinks_bounds_and_walls():
    optimum = np.array([0.5, 0.2, 0.9, 0.5])

    def losses(points):
        away = points - optimum
        wall = np.where(points[:, 3] < 0.4, np.nan, 0)
        return 1 + np.abs(away[:, 0]) + 100 * away[:, 1] ** 2 + wall

    found = freedom(losses, optimum, steps=200)
    np.testing.assert_allclose(found[:, 0], RISE, rtol=0.05)
    np.testing.assert_allclose(found[:, 1], np.sqrt(RISE / 100), rtol=0.05)
    np.testing.assert_allclose(found[:, 2], [0.9, 0.1], rtol=1e-12)
    np.testing.assert_allclose(found[:, 3], [0.1, 0.5], rtol=0.05)


def test_freedom_is_one_call_and_zero_on_the_bound():
    calls = []

    def losses(points):
        calls.append(points.shape)
        assert (points >= 0).all() and (points <= 1).all()
        return 1 + np.sum(points, axis=1)

    found = freedom(losses, np.array([0.0, 0.5]), steps=8)
    assert calls == [(2 * 2 * 8 + 1, 2)]
    assert found[0].tolist() == [0.0, 0.5]
    assert 0 < found[1, 1] < 0.015
