"""Quantiles of |error|: intervals with stated coverage for any distribution, from values or from bins."""

import numpy as np
import pytest
from exact_quantile import quantile
from scipy import stats

from tuning.statistics.quantiles import (
    BIN_COUNT,
    BIN_EDGES,
    BIN_RESOLUTION,
    binned_quantile,
    compute_order_ranks,
    count_in_bins,
    replicate_quantile,
)


@pytest.mark.parametrize("number", (1, 20, 300, 5000))
@pytest.mark.parametrize("order", (0.05, 0.5, 0.95, 0.999))
def test_quantile_interval_ranks_have_stated_coverage(number, order):
    """P(X_(low) <= quantile <= X_(high)) = P(low <= B < high) for a binomial B."""
    low, high = compute_order_ranks(number, order)
    law = stats.binom(number, order)
    below, above = law.cdf(low - 1), law.sf(high - 1)
    assert below <= 0.025 and above <= 0.025
    # The next smaller interval would not have the coverage.
    assert law.cdf(low) >= 0.025 and law.sf(high - 2) >= 0.025
    wider = compute_order_ranks(number, order, sequential=True)
    assert wider[0] <= low and wider[1] >= high


def test_sequential_quantile_ranks_have_coverage_at_all_sample_sizes_together():
    rng = np.random.default_rng(0)
    numbers = np.arange(50, 5001, 50)
    for order in (0.5, 0.95):
        below = np.cumsum(rng.binomial(50, order, (1000, len(numbers))), axis=1)
        low, high = np.array([compute_order_ranks(int(n), order, sequential=True) for n in numbers]).T
        assert np.mean(np.all((low <= below) & (below < high), axis=1)) >= 0.95
        low, high = np.array([compute_order_ranks(int(n), order) for n in numbers]).T
        assert np.mean(np.all((low <= below) & (below < high), axis=1)) < 0.85


@pytest.mark.parametrize("order", (0.5, 0.95, 0.99))
def test_quantile_intervals_have_stated_coverage_over_repeated_sweeps(order, capsys):
    truth = stats.halfnorm.ppf(order)
    rng = np.random.default_rng(1)
    exact, binned, widths = [], [], []
    for _ in range(1000):
        values = rng.standard_normal(500)
        interval = quantile(values, order)
        parts = count_in_bins(values[:200]) + count_in_bins(values[200:])
        wider = binned_quantile(parts, order)
        assert interval.low / (1 + BIN_RESOLUTION) < wider.low <= interval.low
        assert interval.high <= wider.high <= interval.high * (1 + BIN_RESOLUTION)
        assert wider.value == pytest.approx(interval.value, rel=BIN_RESOLUTION / 2)
        exact.append(interval.low <= truth <= interval.high)
        binned.append(wider.low <= truth <= wider.high)
        widths.append(wider.high - wider.low)
    with capsys.disabled():
        print(
            f"\nquantile {order}: coverage {np.mean(exact):.3f}, of bins {np.mean(binned):.3f}, median "
            f"width of bins {np.median(widths):.4f}",
            end="",
        )
    assert np.mean(exact) >= 0.935 and np.mean(binned) >= np.mean(exact)


@pytest.mark.parametrize("order", (0.5, pytest.param(0.99, marks=pytest.mark.slow)))
@pytest.mark.parametrize("sampling", ("independent", "sobol"))
def test_quantile_intervals_of_replicates_have_stated_coverage(order, sampling, capsys):
    """Draw |u_1 + u_2 - 1| for 16 replicates of 64 points.

    The distribution is triangular on 0..1, with the quantile 1 - sqrt(1 - q).
    """
    truth, rng = 1 - np.sqrt(1 - order), np.random.default_rng(4)
    inside, widths = [], []
    for _ in range(200):
        if sampling == "sobol":
            points = np.stack([stats.qmc.Sobol(2, rng=rng).random(64) for _ in range(16)])
        else:
            points = rng.random((16, 64, 2))
        counted = np.stack([count_in_bins(values) for values in np.sum(points, axis=-1) - 1])
        interval = replicate_quantile(counted, order)
        assert interval.low < interval.value < interval.high
        inside.append(interval.low <= truth <= interval.high)
        widths.append(interval.width)
    with capsys.disabled():
        print(
            f"\nquantile {order}, {sampling} replicates: coverage {np.mean(inside):.3f}, median width "
            f"{np.median(widths):.4f}",
            end="",
        )
    assert np.mean(inside) >= 0.935
    if sampling == "sobol" and order == 0.5:
        _, low, high = binned_quantile(np.sum(counted, axis=0), order)
        assert np.median(widths) < 0.6 * (high - low)


def test_quantile_of_replicates_without_results_has_no_bound():
    none = np.stack([count_in_bins([np.nan] * 10)] * 4)
    interval = replicate_quantile(none, 0.5)
    assert interval.value == np.inf and interval.high == np.inf and interval.low >= BIN_EDGES[-2]
    zero = np.stack([count_in_bins([0.0] * 10)] * 4)
    assert replicate_quantile(zero, 0.5) == (0.0, 0.0, BIN_EDGES[0])
    with pytest.raises(ValueError, match="expected equal numbers"):
        replicate_quantile(np.stack([count_in_bins([1.0]), count_in_bins([1.0, 2.0])]), 0.5)


def test_quantile_intervals_have_stated_coverage_for_tied_values():
    rng = np.random.default_rng(2)
    inside = []
    for _ in range(500):
        interval = quantile(rng.choice([1.0, 2.0, 5.0], 200, p=[0.3, 0.4, 0.3]), 0.7)
        inside.append(interval.low <= 2.0 <= interval.high)
    assert np.mean(inside) >= 0.95


def test_merged_quantile_bins_contain_every_error():
    assert BIN_EDGES[0] == 1e-9 and BIN_EDGES[-1] >= 1e3 and BIN_COUNT == len(BIN_EDGES) + 1 < 3000
    assert np.max(BIN_EDGES[1:] / BIN_EDGES[:-1]) <= 1 + BIN_RESOLUTION + 1e-12
    rng = np.random.default_rng(3)
    values = np.concatenate(
        [10 ** rng.uniform(-12, 6, 1000), [0.0, np.nan, np.inf, -np.inf], BIN_EDGES, -BIN_EDGES]
    )
    whole = count_in_bins(values)
    assert whole.dtype == np.int64 and whole.shape == (BIN_COUNT,) and np.sum(whole) == len(values)
    split = rng.permutation(values)
    np.testing.assert_array_equal(sum(count_in_bins(part) for part in np.split(split, [10, 999])), whole)
    assert whole[-1] == np.sum(~(np.abs(values) < BIN_EDGES[-1]))
    assert whole[0] == np.sum(np.abs(values) < BIN_EDGES[0])
    np.testing.assert_array_equal(count_in_bins(BIN_EDGES)[1:], 1)
    np.testing.assert_array_equal(count_in_bins(np.float32([0.5])), count_in_bins([0.5]))


def test_quantiles_count_failed_runs_as_the_largest_errors():
    values = [1.0] * 90 + [np.nan] * 10
    for interval in (quantile(values, 0.95), binned_quantile(count_in_bins(values), 0.95)):
        assert np.isinf(interval.value) and np.isinf(interval.high)
    assert quantile(values, 0.5) == (1.0, 1.0, 1.0)
    small = binned_quantile(count_in_bins(np.zeros(50)), 0.5)
    assert (small.value, small.low, small.high) == (0.0, 0.0, BIN_EDGES[0])


@pytest.mark.parametrize("interval", (quantile([], 0.5), binned_quantile(count_in_bins([]), 0.5)))
def test_quantile_of_no_values_is_unknown(interval):
    assert np.isnan(interval.value) and interval.low == 0.0 and np.isinf(interval.high)


def test_extreme_quantile_of_few_values_has_no_upper_bound():
    values = np.arange(1.0, 11.0)
    assert np.isinf(quantile(values, 0.99).high) and quantile(values, 0.01).low == 0.0
    # 100 n q is a whole number: the rank is not rounded up.
    assert quantile(np.arange(1.0, 101.0), 0.07).value == 7.0


@pytest.mark.parametrize(
    "number, order, level", ((-1, 0.5, 0.9), (5, 0.0, 0.9), (5, 1.0, 0.9), (5, 0.5, 1.0))
)
def test_quantile_function_rejects_impossible_orders(number, order, level):
    with pytest.raises(ValueError, match="number, order, level: found"):
        compute_order_ranks(number, order, level)
