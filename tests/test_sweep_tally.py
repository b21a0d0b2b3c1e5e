"""The tally: the same whatever the order, and an interval that is known."""

import numpy as np
import pytest

from tuning.sweeps.columns import GOOD, OUTCOMES
from tuning.sweeps.tally import WORST, add_rows, empty_tally, failure_probability
from tuning.verdict import replicate_interval


def made_up(number, seed=0, share=0.3):
    generator = np.random.default_rng(seed)
    outcome = np.where(generator.random(number) < share, generator.integers(1, 7, number), 0)
    error = generator.normal(size=number)
    error[outcome > 3] = np.nan
    return {
        "index": np.arange(number),
        "outcome": outcome.astype(np.int8),
        "failed": outcome > 0,
        "worst_error": error,
    }


def piece(rows, part):
    return {name: values[part] for name, values in rows.items()}


def test_parts_in_any_order_make_the_same_tally():
    rows = made_up(1000)
    cuts = np.split(np.arange(1000), [10, 500, 501])
    whole = add_rows(empty_tally(16), rows)
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        tally = empty_tally(16)
        for number in order:
            tally = add_rows(tally, piece(rows, cuts[number]))
        assert tally == whole
    assert whole.scenarios == 1000 and whole.failed == np.sum(rows["failed"])
    assert sum(k for _, k in whole.replicates) == whole.failed


def test_the_worst_come_first():
    rows = made_up(1000)
    tally = add_rows(empty_tally(1), rows)
    assert len(tally.worst) == WORST
    outcomes = [OUTCOMES[rows["outcome"][index]] for _, _, index in tally.worst]
    assert set(outcomes) == {"non-finite"}
    mild = piece(rows, rows["outcome"] <= 1)
    tally = add_rows(empty_tally(1), mild)
    largest = np.sort(np.abs(mild["worst_error"]))[::-1][:WORST]
    np.testing.assert_array_equal([error for _, error, _ in tally.worst], largest)


def test_interval_without_failures_is_known_in_closed_form():
    rows = made_up(500, share=0.0)
    found = failure_probability(add_rows(empty_tally(1), rows))
    assert OUTCOMES[0] == GOOD and found.value == 0 and found.low == 0
    assert found.high == pytest.approx(1 - 0.025 ** (1 / 500), rel=1e-12)


def test_interval_of_replicates_is_over_their_means():
    rows = made_up(16 * 64)
    found = failure_probability(add_rows(empty_tally(16), rows))
    counts = rows["failed"].reshape(64, 16).sum(axis=0)
    low, high = replicate_interval(counts, 64)[1:]
    assert found.value == pytest.approx(np.mean(rows["failed"]))
    assert (found.low, found.high) == (low, high)
