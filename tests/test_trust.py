"""Intervals that hold what they say, and sensitivities against closed forms."""

import numpy as np
import pytest
from scipy.stats import binom

from tuning.optimisation.sensitivity import RISE, freedom, sensitivity
from tuning.statistics.bootstrap import interval

STIFF_ENOUGH = 0.05  # the box adds its square to the region, relatively


def heavy_tailed(generator, scenarios):
    """Errors of three contacts of each scenario, which share a scale: dependent, and far from normal."""
    scale = np.exp(0.6 * generator.standard_normal(scenarios))
    return 0.01 * scale * generator.standard_normal((3, scenarios))


def test_the_interval_of_the_rms_covers_the_truth_as_often_as_it_says():
    generator = np.random.default_rng(1)
    truth = 0.01 * np.exp(0.6**2)
    repeats, hits = 150, 0
    for _ in range(repeats):
        errors = heavy_tailed(generator, 300)
        found = interval(errors, np.ones(errors.shape, bool), resamples=299).rms
        hits += found.low <= truth <= found.high
    # Of a true 95 %, fewer than this one time in a thousand.
    assert hits >= binom.ppf(0.001, repeats, 0.95)
    assert hits < repeats


def test_contacts_of_a_scenario_count_as_one_draw():
    errors = np.repeat(np.random.default_rng(2).standard_normal((1, 300)), 5, axis=0)
    once = interval(errors[:1], np.ones((1, 300), bool))
    five = interval(errors, np.ones((5, 300), bool))
    np.testing.assert_allclose(five.rms, once.rms, rtol=1e-12)
    # Five times as many contacts move the 99th percentile between its neighbours only.
    np.testing.assert_allclose(five.p99, once.p99, rtol=0.06)


def test_intervals_match_plain_resampling():
    generator = np.random.default_rng(3)
    errors = heavy_tailed(generator, 200)
    good = generator.random(errors.shape) < 0.9
    found = interval(errors, good, resamples=4000)
    plain = []
    for _ in range(4000):
        drawn = generator.integers(0, 200, 200)
        size = np.abs(errors[:, drawn][good[:, drawn]])
        plain.append([np.sqrt(np.mean(size**2)), np.percentile(size, 99)])
    expected = np.quantile(plain, [0.025, 0.975], axis=0)
    np.testing.assert_allclose(found.p99, expected[:, 1], rtol=0.04)
    # The correction moves both ends towards the long tail, by a fraction of the width.
    width = np.ptp(expected[:, 0])
    assert expected[0, 0] < found.rms.low < expected[0, 0] + width / 4
    assert expected[1, 0] < found.rms.high < expected[1, 0] + width / 2


def test_the_same_seed_gives_the_same_interval():
    errors = heavy_tailed(np.random.default_rng(4), 100)
    good = np.ones(errors.shape, bool)
    assert interval(errors, good) == interval(errors, good)
    assert interval(errors, good) != interval(errors, good, seed=1)


@pytest.mark.parametrize("scenarios", [2, 511, 5000])
def test_an_interval_holds_its_own_figure(scenarios):
    errors = heavy_tailed(np.random.default_rng(5), scenarios)
    found = interval(errors, np.ones(errors.shape, bool), resamples=299)
    assert found.rms.low < np.sqrt(np.mean(errors**2)) < found.rms.high
    assert found.p99.low <= np.percentile(np.abs(errors), 99) <= found.p99.high


def test_failed_contacts_do_not_count_and_nothing_left_is_not_a_number():
    errors = heavy_tailed(np.random.default_rng(6), 50)
    good = np.arange(50) < np.array([[30], [50], [0]])
    wild = np.where(good, errors, np.nan)
    assert interval(wild, good) == interval(np.where(good, errors, 7), good)
    assert np.isnan(interval(wild, np.zeros_like(good))).all()
    # A scenario alone says nothing of the others.
    assert np.isnan(interval(wild, good & (np.arange(50) == 3))).all()


def test_scenarios_all_alike_leave_no_doubt():
    assert interval(np.full((2, 30), -0.5), np.ones((2, 30), bool)).rms == (0.5, 0.5)


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
