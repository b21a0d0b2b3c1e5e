"""Bootstrap intervals: coverage, comparison with plain resampling, reproducibility."""

import numpy as np
import pytest
from scipy.stats import binom

from tuning.statistics.bootstrap import compute_error_intervals


def heavy_tailed(generator, scenarios):
    """Return errors of three contacts per scenario that share a random scale."""
    scale = np.exp(0.6 * generator.standard_normal(scenarios))
    return 0.01 * scale * generator.standard_normal((3, scenarios))


def test_bootstrap_rms_interval_has_stated_coverage():
    generator = np.random.default_rng(1)
    truth = 0.01 * np.exp(0.6**2)
    repeats, hits = 150, 0
    for _ in range(repeats):
        errors = heavy_tailed(generator, 300)
        result = compute_error_intervals(errors, np.ones(errors.shape, bool), resamples=299).rms
        hits += result.low <= truth <= result.high
    # At a true coverage of 95 %, fewer hits have a probability of 0.001.
    assert hits >= binom.ppf(0.001, repeats, 0.95)
    assert hits < repeats


def test_bootstrap_resamples_whole_scenarios():
    errors = np.repeat(np.random.default_rng(2).standard_normal((1, 300)), 5, axis=0)
    once = compute_error_intervals(errors[:1], np.ones((1, 300), bool))
    five = compute_error_intervals(errors, np.ones((5, 300), bool))
    np.testing.assert_allclose(five.rms, once.rms, rtol=1e-12)
    # Five copies of every contact move the 99th percentile only between neighbouring values.
    np.testing.assert_allclose(five.p99, once.p99, rtol=0.06)


def test_bootstrap_intervals_match_plain_resampling():
    generator = np.random.default_rng(3)
    errors = heavy_tailed(generator, 200)
    good = generator.random(errors.shape) < 0.9
    result = compute_error_intervals(errors, good, resamples=4000)
    plain = []
    for _ in range(4000):
        drawn = generator.integers(0, 200, 200)
        size = np.abs(errors[:, drawn][good[:, drawn]])
        plain.append([np.sqrt(np.mean(size**2)), np.percentile(size, 99)])
    expected = np.quantile(plain, [0.025, 0.975], axis=0)
    np.testing.assert_allclose(result.p99, expected[:, 1], rtol=0.04)
    # The correction moves both ends towards the long tail, by a fraction of the width.
    width = np.ptp(expected[:, 0])
    assert expected[0, 0] < result.rms.low < expected[0, 0] + width / 4
    assert expected[1, 0] < result.rms.high < expected[1, 0] + width / 2


def test_bootstrap_interval_is_reproducible_from_seed():
    errors = heavy_tailed(np.random.default_rng(4), 100)
    good = np.ones(errors.shape, bool)
    assert compute_error_intervals(errors, good) == compute_error_intervals(errors, good)
    assert compute_error_intervals(errors, good) != compute_error_intervals(errors, good, seed=1)


@pytest.mark.parametrize("scenarios", [2, 511, 5000])
def test_bootstrap_interval_contains_point_estimate(scenarios):
    errors = heavy_tailed(np.random.default_rng(5), scenarios)
    result = compute_error_intervals(errors, np.ones(errors.shape, bool), resamples=299)
    assert result.rms.low < np.sqrt(np.mean(errors**2)) < result.rms.high
    assert result.p99.low <= np.percentile(np.abs(errors), 99) <= result.p99.high


def test_bootstrap_ignores_failed_contacts_and_returns_nan_without_data():
    errors = heavy_tailed(np.random.default_rng(6), 50)
    good = np.arange(50) < np.array([[30], [50], [0]])
    wild = np.where(good, errors, np.nan)
    assert compute_error_intervals(wild, good) == compute_error_intervals(np.where(good, errors, 7), good)
    assert np.isnan(compute_error_intervals(wild, np.zeros_like(good))).all()
    # A single scenario has no variation to resample.
    assert np.isnan(compute_error_intervals(wild, good & (np.arange(50) == 3))).all()


def test_bootstrap_interval_has_zero_width_for_equal_errors():
    assert compute_error_intervals(np.full((2, 30), -0.5), np.ones((2, 30), bool)).rms == (0.5, 0.5)
