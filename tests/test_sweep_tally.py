"""Tally of a sweep: independent of the order, and intervals with known closed forms."""

import numpy as np
import pytest
from exact_quantile import quantile

from tuning.statistics.intervals import (
    SequentialState,
    confidence_sequence,
    replicate_interval,
    update_sequence,
)
from tuning.sweeps.columns import GOOD, SATURATED, SCENARIO_OUTCOMES
from tuning.sweeps.tally import (
    MAX_WORST_SCENARIOS,
    QUANTILE_ORDERS,
    add_to_tally,
    build_empty_tally,
    compute_error_sizes,
    estimate_error_quantiles,
    estimate_failure_probability,
)


def fake_rows(number, seed=0, share=0.3):
    generator = np.random.default_rng(seed)
    outcome = np.where(
        generator.random(number) < share, generator.integers(1, len(SCENARIO_OUTCOMES), number), 0
    )
    error = generator.normal(size=number)
    error[outcome > SCENARIO_OUTCOMES.index("not reached")] = np.nan
    return {
        "index": np.arange(number),
        "outcome": outcome.astype(np.int8),
        "failed": outcome > 0,
        "worst_error": error,
    }


def piece(rows, part):
    return {name: values[part] for name, values in rows.items()}


def test_sweep_tally_does_not_depend_on_order_of_chunks():
    rows = fake_rows(1000)
    cuts = np.split(np.arange(1000), [10, 500, 501])
    whole = add_to_tally(build_empty_tally(16), rows)
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        tally = build_empty_tally(16)
        for number in order:
            tally = add_to_tally(tally, piece(rows, cuts[number]))
        assert tally == whole
    assert whole.scenarios == 1000 and whole.failed == np.sum(rows["failed"])
    assert sum(k for _, k in whole.replicates) == whole.failed


def test_sweep_tally_lists_the_worst_scenarios_first():
    rows = fake_rows(1000)
    tally = add_to_tally(build_empty_tally(1), rows)
    assert len(tally.worst) == MAX_WORST_SCENARIOS
    outcomes = [SCENARIO_OUTCOMES[rows["outcome"][index]] for _, _, index in tally.worst]
    assert set(outcomes) == {"non-finite"}
    mild = piece(rows, rows["outcome"] <= 1)
    tally = add_to_tally(build_empty_tally(1), mild)
    largest = np.sort(np.abs(mild["worst_error"]))[::-1][:MAX_WORST_SCENARIOS]
    np.testing.assert_array_equal([error for _, error, _ in tally.worst], largest)


def test_sweep_tally_interval_without_failures_matches_closed_form():
    rows = fake_rows(500, share=0.0)
    result = estimate_failure_probability(add_to_tally(build_empty_tally(1), rows))
    assert SCENARIO_OUTCOMES[0] == GOOD and result.value == 0 and result.low == 0
    assert result.high == pytest.approx(1 - 0.025 ** (1 / 500), rel=1e-12)


def test_sweep_tally_interval_of_replicates_is_students_t_interval():
    rows = fake_rows(16 * 64)
    result = estimate_failure_probability(add_to_tally(build_empty_tally(16), rows))
    means = rows["failed"].reshape(64, 16).mean(axis=0)
    half = 2.131449545559323 * np.std(means, ddof=1) / 4
    assert result.value == pytest.approx(np.mean(means))
    assert (result.low, result.high) == pytest.approx((result.value - half, result.value + half))


def test_incomplete_last_block_of_sweep_tally_is_in_no_replicate():
    rows = fake_rows(16 * 64 + 5)
    tally = add_to_tally(build_empty_tally(16, 16 * 64 + 5), rows)
    assert tally.scenarios == 16 * 64 + 5 and tally.left_out == 5
    whole = piece(rows, slice(16 * 64))
    expected = replicate_interval(whole["failed"].reshape(64, 16).sum(axis=0), 64)
    result = estimate_failure_probability(tally)
    assert (result.value, result.low, result.high) == pytest.approx(tuple(map(float, expected)))
    assert result == estimate_failure_probability(add_to_tally(build_empty_tally(16, 16 * 64), whole))
    assert estimate_error_quantiles(tally) == estimate_error_quantiles(
        add_to_tally(build_empty_tally(16, 16 * 64), whole)
    )


def test_sweep_tally_has_no_interval_for_replicates_of_unequal_size():
    tally = add_to_tally(build_empty_tally(16, 1600), fake_rows(100))
    result = estimate_failure_probability(tally)
    assert (result.low, result.high) == (0, 1) and 0 < result.value < 1 and "yet" in result.method
    assert all((one.low, one.high) == (0, np.inf) for one in estimate_error_quantiles(tally))
    assert estimate_failure_probability(add_to_tally(build_empty_tally(16, 10), fake_rows(10))).high == 1


def test_sweep_tally_interval_for_repeated_looks_is_confidence_sequence():
    rows = fake_rows(1000)
    tally, running = build_empty_tally(1, 10**6, looked_at=True), SequentialState()
    for part in np.split(np.arange(1000), 10):
        tally = add_to_tally(tally, piece(rows, part))
        running = update_sequence(running, int(np.sum(rows["failed"][part])), 100)
    assert tally.looks == running
    result, (_, low, high) = estimate_failure_probability(tally), confidence_sequence(tally.failed, 1000)
    assert low <= result.low < result.value < result.high <= high
    assert "repeated looks" in result.method
    fixed = add_to_tally(build_empty_tally(1), rows)
    assert (
        result.high - result.low
        > estimate_failure_probability(fixed).high - estimate_failure_probability(fixed).low
    )
    for one, other in zip(estimate_error_quantiles(tally), estimate_error_quantiles(fixed), strict=True):
        assert one.low <= other.low and other.high <= one.high
    assert estimate_error_quantiles(tally)[0] != estimate_error_quantiles(fixed)[0]


@pytest.mark.parametrize("replicates", [1, 16])
def test_sweep_tally_quantiles_equal_quantiles_of_errors(replicates):
    rows = fake_rows(1600, share=0.01)
    sizes = compute_error_sizes(rows)
    assert np.array_equal(np.isinf(sizes), rows["outcome"] > SCENARIO_OUTCOMES.index(SATURATED)) and np.any(
        np.isinf(sizes)
    )
    result = estimate_error_quantiles(add_to_tally(build_empty_tally(replicates, 1600), rows))
    assert [one.order for one in result] == list(QUANTILE_ORDERS)
    for one in result[:3]:
        exact = quantile(sizes, one.order)
        assert one.value == pytest.approx(float(exact.value), rel=0.01)
        assert one.low == pytest.approx(float(exact.low), rel=0.05)
        assert one.high == pytest.approx(float(exact.high), rel=0.2)
        assert one.low < one.value < one.high
    # Six runs in a thousand have no result.
    assert result[3].value == result[3].high == np.inf
