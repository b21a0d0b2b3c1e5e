"""Subset simulation compared with closed forms, down to a probability of 1e-6."""

import numpy as np
import pytest
from scipy import stats

from tuning.statistics.intervals import binomial_interval
from tuning.statistics.subset_simulation import convert_to_uniform, subset_simulation


def plane(inputs):
    return inputs, lambda u: np.sum(u, axis=1) / np.sqrt(inputs), stats.norm.isf


def sphere(inputs):
    return inputs, lambda u: np.sum(u**2, axis=1), lambda p: stats.chi2.isf(p, inputs)


# Inputs, performance, and the limit that it exceeds with a given probability.
LIMIT_STATES = {
    "plane of 2": plane(2),
    "plane of 5": plane(5),
    "plane of 20": plane(20),
    "sphere of 3": sphere(3),
    "sphere of 10": sphere(10),
    # Two failure regions: opposite half spaces, and perpendicular half spaces with 1 - (1 - q)^2 = p.
    "opposite": (2, lambda u: np.abs(u[:, 0] + u[:, 1]) / np.sqrt(2), lambda p: stats.norm.isf(p / 2)),
    "series": (
        5,
        lambda u: np.maximum(u[:, 0], (u[:, 1] - u[:, 2]) / np.sqrt(2)),
        lambda p: stats.norm.isf(-np.expm1(0.5 * np.log1p(-p))),
    ),
}


def repeated(name, probability, repeats):
    inputs, performance, limit = LIMIT_STATES[name]
    return [subset_simulation(performance, inputs, limit(probability), seed) for seed in range(repeats)]


# The levels down to 1e-6 include 1e-4.
@pytest.mark.parametrize("probability", (pytest.param(1e-4, marks=pytest.mark.slow), 1e-6))
@pytest.mark.parametrize("name", LIMIT_STATES)
def test_subset_simulation_interval_contains_the_probability(name, probability, capsys):
    results = repeated(name, probability, 20)
    inside = sum(result.low <= probability <= result.high for result in results)
    with capsys.disabled():
        width = np.mean([result.high - result.low for result in results]) / probability
        variation = np.mean([result.coefficient_of_variation for result in results])
        print(
            f"\n{name}, {probability}: {inside} of 20, mean width {width:.2f} p, coefficient of variation "
            f"{variation:.3f}, evaluations {np.mean([result.evaluations for result in results]):.0f}",
            end="",
        )
    assert inside >= 17
    # The estimate is right within a factor of two, and the interval is not excessively wide.
    assert all(0.5 < result.probability / probability < 2.0 for result in results)
    assert all(result.high / result.low < 5 for result in results)


@pytest.mark.slow
@pytest.mark.parametrize("probability", (1e-4, 1e-6))
@pytest.mark.parametrize("name", LIMIT_STATES)
def test_repeated_subset_simulation_intervals_contain_the_probability(name, probability, capsys):
    results = repeated(name, probability, 300)
    inside = np.mean([result.low <= probability <= result.high for result in results])
    bias = np.mean([result.probability for result in results]) / probability - 1
    with capsys.disabled():
        print(f"\n{name}, {probability}: coverage {inside:.3f}, bias {bias:+.3f}", end="")
    assert inside >= 0.935
    assert abs(bias) < 0.1


def test_subset_simulation_coefficient_of_variation_matches_repeats():
    """The estimate from the spread of the replicates is right; the published formula is too small."""
    results = repeated("plane of 5", 1e-4, 40)
    seen = np.std([result.estimates for result in results]) / 1e-4
    of_replicates = np.sqrt(np.mean([result.coefficient_of_variation**2 for result in results]) * 10)
    assert of_replicates == pytest.approx(seen, rel=0.15)
    of_formula = np.mean([result.formula_coefficients for result in results])
    assert 0.6 * seen < of_formula < 0.95 * seen
    combined = np.mean([result.formula_coefficient_of_variation for result in results])
    assert combined == pytest.approx(of_formula / np.sqrt(10), rel=0.1)


def test_subset_simulation_levels_match_closed_form():
    limit = float(stats.norm.isf(1e-4))
    result = subset_simulation(LIMIT_STATES["plane of 5"][1], 5, limit, seed=3, samples=4000)
    assert result.thresholds.shape[1] == 10
    expected = stats.norm.isf([[0.1], [0.01], [0.001]])
    np.testing.assert_allclose(result.thresholds[:3], expected * np.ones(10), atol=0.15)
    last = np.nanmax(result.thresholds, axis=0)
    np.testing.assert_array_equal(last, limit)
    levels = np.sum(np.isfinite(result.thresholds), axis=0)
    assert np.all((levels == 4) | (levels == 5))


def test_subset_simulation_batches_have_constant_size_and_are_all_counted():
    sizes = []

    def performance(u):
        sizes.append(u.shape)
        return np.sum(u, axis=1)

    result = subset_simulation(performance, 3, 6.0, seed=0, samples=200, replicates=4)
    assert set(sizes) == {(80, 3)} and result.evaluations == 80 * len(sizes)
    assert len(sizes) == 10 + 9 * (len(result.thresholds) - 1)


def test_subset_simulation_with_the_same_seed_gives_the_same_result():
    first, again, other = (
        subset_simulation(LIMIT_STATES["series"][1], 5, 3.5, seed, samples=200) for seed in (1, 1, 2)
    )
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, two)
    assert first.probability != other.probability


def test_subset_simulation_worst_scenarios_are_distinct_and_reproducible():
    performance = LIMIT_STATES["sphere of 3"][1]
    result = subset_simulation(performance, 3, 15.0, seed=4)
    assert result.worst_points.shape == (10, 3)
    assert len(np.unique(result.worst_values)) == 10 and np.all(np.diff(result.worst_values) < 0)
    np.testing.assert_array_equal(performance(result.worst_points), result.worst_values)
    assert result.worst_values[-1] > 15.0


@pytest.mark.parametrize("broken", (np.nan, np.inf, -np.inf))
def test_subset_simulation_counts_nonfinite_performance_as_failure(broken):
    def performance(u):
        return np.where(u[:, 0] > 3.5, broken, u[:, 0])

    truth = stats.norm.sf(3.5)
    results = [subset_simulation(performance, 2, 1e9, seed) for seed in range(20)]
    assert sum(result.low <= truth <= result.high for result in results) >= 17
    assert np.all(np.isinf(results[0].worst_values))
    # Among equally bad scenarios, the likeliest comes first.
    assert np.all(np.diff(np.sum(results[0].worst_points ** 2, axis=1)) >= 0)
    assert np.all(results[0].worst_points[:, 0] > 3.5) and np.all(results[0].worst_points[:, 0] < 3.7)


@pytest.mark.parametrize("quantum", (0.25, 1.0))
def test_subset_simulation_works_for_stepwise_performance_function(quantum):
    """Many scenarios have the same performance, often more than a tenth of all."""

    def performance(u):
        return quantum * np.floor(np.sum(u, axis=1) / np.sqrt(3) / quantum)

    truth = stats.norm.sf(4.0)
    results = [subset_simulation(performance, 3, 3.9, seed) for seed in range(20)]
    assert sum(result.low <= truth <= result.high for result in results) >= 17


@pytest.mark.parametrize("probability", (0.0, 0.02, 0.05, 0.3, 1.0))
def test_subset_simulation_of_frequent_failures_uses_binomial_interval(probability):
    limit = stats.norm.isf(probability)
    inside = 0
    for seed in range(40):
        result = subset_simulation(lambda u: np.where(u[:, 0] > limit, 1.0, 0.0), 2, 0.5, seed)
        assert result.evaluations == 10_000 and len(result.thresholds) == 1
        expected = binomial_interval(round(result.probability * 10_000), 10_000)
        np.testing.assert_allclose([result.low, result.high], [expected.low, expected.high], rtol=1e-12)
        assert (result.coefficient_of_variation == np.inf) == (probability == 0.0)
        inside += result.low <= probability <= result.high
    assert inside >= 36


def test_subset_simulation_upper_bound_covers_failures_beyond_a_plateau():
    """The performance rises to a plateau, and fails beyond."""

    def performance(u):
        return np.where(u[:, 0] > 5.5, 10.0, np.minimum(u[:, 0], 2.0))

    result = subset_simulation(performance, 1, 5.0, seed=6)
    assert result.probability == 0.0 == result.low
    assert stats.norm.sf(5.5) < stats.norm.sf(2.0) * 0.9 < result.high < 1.2 * stats.norm.sf(2.0)


def test_subset_simulation_limits_the_number_of_levels():
    result = subset_simulation(lambda u: u[:, 0], 1, 4.75, seed=7, levels=3)
    assert len(result.thresholds) == 3 and result.evaluations == 10_000 + 2 * 9_000
    assert result.low == 0.0 and 1e-6 < result.high < 0.02


def test_subset_simulation_uniform_numbers_stay_within_unit_interval():
    uniform = convert_to_uniform(np.array([-40.0, -1.0, 0.0, 1.0, 40.0]))
    assert np.all((uniform > 0) & (uniform < 1)) and np.all(np.diff(uniform) > 0)
    np.testing.assert_allclose(uniform[1:4], stats.norm.cdf([-1.0, 0.0, 1.0]), rtol=1e-14)


@pytest.mark.parametrize(
    "wrong",
    (
        {"inputs": 0},
        {"limit": np.inf},
        {"seed": -1},
        {"samples": 105},
        {"replicates": 1},
        {"level": 1.0},
        {"levels": 0},
    ),
)
def test_subset_simulation_rejects_impossible_settings(wrong):
    settings = {"inputs": 2, "limit": 3.0, "seed": 0} | wrong
    with pytest.raises(ValueError, match=f"^{next(iter(wrong))}: found"):
        subset_simulation(lambda u: u[:, 0], **settings)
