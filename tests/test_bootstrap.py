"""Bootstrap intervals hold what they say: coverage, resampling by hand, seeds."""

import numpy as np
import pytest
from scipy.stats import binom

from tuning.statistics.bootstrap import error_intervals


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
        found = error_intervals(errors, np.ones(errors.shape, bool), resamples=299).rms
        hits += found.low <= truth <= found.high
    # Of a true 95 %, fewer than this one time in a thousand.
    assert hits >= binom.ppf(0.001, repeats, 0.95)
    assert hits < repeats


def test_contacts_of_a_scenario_count_as_one_draw():
    errors = np.repeat(np.random.default_rng(2).standard_normal((1, 300)), 5, axis=0)
    once = error_intervals(errors[:1], np.ones((1, 300), bool))
    five = error_intervals(errors, np.ones((5, 300), bool))
    np.testing.assert_allclose(five.rms, once.rms, rtol=1e-12)
    # Five times as many contacts move the 99th percentile between its neighbours only.
    np.testing.assert_allclose(five.p99, once.p99, rtol=0.06)


def test_intervals_match_plain_resampling():
    generator = np.random.default_rng(3)
    errors = heavy_tailed(generator, 200)
    good = generator.random(errors.shape) < 0.9
    found = error_intervals(errors, good, resamples=4000)
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
    assert error_intervals(errors, good) == error_intervals(errors, good)
    assert error_intervals(errors, good) != error_intervals(errors, good, seed=1)


@pytest.mark.parametrize("scenarios", [2, 511, 5000])
def test_an_interval_holds_its_own_figure(scenarios):
    errors = heavy_tailed(np.random.default_rng(5), scenarios)
    found = error_intervals(errors, np.ones(errors.shape, bool), resamples=299)
    assert found.rms.low < np.sqrt(np.mean(errors**2)) < found.rms.high
    assert found.p99.low <= np.percentile(np.abs(errors), 99) <= found.p99.high


def test_failed_contacts_do_not_count_and_nothing_left_is_not_a_number():
    errors = heavy_tailed(np.random.default_rng(6), 50)
    good = np.arange(50) < np.array([[30], [50], [0]])
    wild = np.where(good, errors, np.nan)
    assert error_intervals(wild, good) == error_intervals(np.where(good, errors, 7), good)
    assert np.isnan(error_intervals(wild, np.zeros_like(good))).all()
    # A scenario alone says nothing of the others.
    assert np.isnan(error_intervals(wild, good & (np.arange(50) == 3))).all()


def test_scenarios_all_alike_leave_no_doubt():
    assert error_intervals(np.full((2, 30), -0.5), np.ones((2, 30), bool)).rms == (0.5, 0.5)
