"""Statistics of a running sweep: counts of outcomes, histograms of errors, worst scenarios and intervals.

Unless the sweep can stop early, a tally does not depend on the order of the chunks. The memory that it needs
does not depend on their number.

The replicates of Sobol sampling must have equal numbers of scenarios. If the number of scenarios is not a
multiple of the number of replicates, the last few scenarios are counted in the outcomes and the worst
scenarios, but not in the failure probability and the quantiles.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tuning.statistics.intervals import (
    SequentialState,
    binomial_interval,
    replicate_interval,
    update_sequence,
)
from tuning.statistics.quantiles import (
    BIN_COUNT,
    binned_estimate,
    binned_quantile,
    count_in_bins,
    replicate_quantile,
)
from tuning.sweeps import MAX_SCENARIOS
from tuning.sweeps.columns import BEYOND_LIMIT, GOOD, SATURATED, SCENARIO_OUTCOMES

MAX_WORST_SCENARIOS = 10
QUANTILE_ORDERS = (0.5, 0.95, 0.99, 0.999)


class Tally(NamedTuple):
    """Statistics of the scenarios that a sweep has computed so far."""

    outcomes: tuple[int, ...]  # number of scenarios with each of `SCENARIO_OUTCOMES`
    whole: int  # largest multiple of the number of replicates that does not exceed the number of scenarios
    replicates: tuple[tuple[int, int], ...]  # number of scenarios and of failures in each replicate
    errors: tuple[tuple[int, ...], ...]  # histogram of |error| in each replicate (`count_in_bins`)
    worst: tuple[tuple[int, float, int], ...]  # (severity of the outcome, |error|, index), worst first
    looks: SequentialState | None = None  # confidence sequence; None if the sweep cannot stop early

    @property
    def scenarios(self) -> int:
        return sum(self.outcomes)

    @property
    def failed(self) -> int:
        return self.scenarios - self.outcomes[SCENARIO_OUTCOMES.index(GOOD)]

    @property
    def left_out(self) -> int:
        """Return the number of computed scenarios that belong to none of the replicates."""
        return self.scenarios - sum(number for number, _ in self.replicates)


class ProbabilityEstimate(NamedTuple):
    """Estimated probability with a 95 % interval."""

    value: float  # estimate [1]
    low: float  # low end of the interval [1]
    high: float  # high end of the interval [1]
    method: str  # name of the interval's method


class QuantileEstimate(NamedTuple):
    """Quantile of the |error| of all scenarios, with a 95 % interval."""

    order: float  # share of the scenarios that do not exceed the quantile [1]
    value: float  # estimate [1]
    low: float  # low end of the interval [1]
    high: float  # high end of the interval [1]


def build_empty_tally(replicates: int, scenarios: int = MAX_SCENARIOS, looked_at: bool = False) -> Tally:
    """Return a tally without rows, for a sweep of `scenarios` scenarios.

    `looked_at` states that the sweep may stop early. The confidence interval is then valid if the rows are
    added in the order of their index.
    """
    return Tally(
        (0,) * len(SCENARIO_OUTCOMES),
        scenarios // replicates * replicates,
        ((0, 0),) * replicates,
        ((0,) * BIN_COUNT,) * replicates,
        (),
        SequentialState() if looked_at else None,
    )


def add_to_tally(tally: Tally, rows: Mapping[str, np.ndarray]) -> Tally:
    """Add rows with the columns `index`, `outcome`, `failed` and `worst_error`; return the new tally."""
    index, outcome, failed = rows["index"], rows["outcome"], rows["failed"]
    outcomes = np.bincount(outcome, minlength=len(SCENARIO_OUTCOMES))
    replicates, errors = _add_to_replicates(tally, rows)
    # Among good scenarios and those whose error exceeds the limit, only the error determines the rank.
    severity = np.where(outcome <= SCENARIO_OUTCOMES.index(BEYOND_LIMIT), 0, outcome)
    error = np.nan_to_num(np.abs(rows["worst_error"].astype(float)), nan=-1.0, posinf=np.inf)
    # Only the scenarios that can be among the worst are sorted.
    size = np.where(severity > 0, np.inf, error)
    few = np.flatnonzero(
        size >= np.partition(size, -MAX_WORST_SCENARIOS)[-MAX_WORST_SCENARIOS]
        if len(size) > MAX_WORST_SCENARIOS
        else size >= -1
    )
    first = few[np.lexsort((index[few], -error[few], -severity[few].astype(int)))[:MAX_WORST_SCENARIOS]]
    worst = [(int(severity[i]), float(error[i]), int(index[i])) for i in first]
    looks = tally.looks
    return Tally(
        tuple(a + int(b) for a, b in zip(tally.outcomes, outcomes, strict=True)),
        tally.whole,
        replicates,
        errors,
        tuple(
            sorted([*tally.worst, *worst], key=lambda entry: (-entry[0], -entry[1], entry[2]))[
                :MAX_WORST_SCENARIOS
            ]
        ),
        None if looks is None else update_sequence(looks, int(np.sum(failed)), len(failed)),
    )


def compute_error_sizes(rows: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the worst |error| of every scenario; infinite if a contact did not end."""
    size = np.abs(rows["worst_error"].astype(float))
    return np.where((rows["outcome"] > SCENARIO_OUTCOMES.index(SATURATED)) | np.isnan(size), np.inf, size)


def estimate_failure_probability(tally: Tally) -> ProbabilityEstimate:
    """Estimate the probability that a scenario fails, with a 95 % interval.

    The method of the interval (`tuning.statistics.intervals`) is a confidence sequence if the sweep can stop
    early, `binomial_interval` for independent draws, and `replicate_interval` for Sobol replicates. While the
    Sobol replicates have unequal numbers of scenarios, the interval is 0 to 1.
    """
    numbers, failures = (np.array(column) for column in zip(*tally.replicates, strict=True))
    number = int(np.sum(numbers))
    value = float(np.sum(failures)) / number if number else float("nan")
    if tally.looks is not None:
        low, high = tally.looks.low, tally.looks.high
        return ProbabilityEstimate(value, low, high, "confidence sequence, valid under repeated looks")
    if len(numbers) == 1:
        _, low, high = binomial_interval(failures[0], number)
        return ProbabilityEstimate(value, float(low), float(high), "binomial, exact")
    method = f"{len(numbers)} scrambled Sobol replicates"
    if not _is_balanced(numbers):
        return ProbabilityEstimate(value, 0.0, 1.0, f"{method}, of unequal size yet")
    _, low, high = replicate_interval(failures, int(numbers[0]))
    return ProbabilityEstimate(value, float(low), float(high), method)


def estimate_error_quantiles(tally: Tally) -> list[QuantileEstimate]:
    """Estimate the quantiles `QUANTILE_ORDERS` of the worst |error|, with confidence intervals."""
    errors = np.array(tally.errors)
    quantiles = []
    for order in QUANTILE_ORDERS:
        if len(errors) == 1:
            interval = binned_quantile(errors[0], order, sequential=tally.looks is not None)
        elif _is_balanced(np.sum(errors, axis=1)):
            interval = replicate_quantile(errors, order)
        else:
            interval = binned_estimate(np.sum(errors, axis=0), order), 0.0, np.inf
        quantiles.append(QuantileEstimate(order, *(float(number) for number in interval)))
    return quantiles


def _add_to_replicates(tally: Tally, rows: Mapping[str, np.ndarray]):
    """Add rows to the replicates; return, by replicate, counts (scenarios, failures) and histograms."""
    used = rows["index"] < tally.whole
    replicate = rows["index"][used] % len(tally.replicates)
    sizes, failed = compute_error_sizes(rows)[used], rows["failed"][used]
    replicates, errors = [], []
    for number, ((n, k), bins) in enumerate(zip(tally.replicates, tally.errors, strict=True)):
        mask = replicate == number
        replicates.append((n + int(np.sum(mask)), k + int(np.sum(failed[mask]))))
        errors.append(tuple((np.array(bins) + count_in_bins(sizes[mask])).tolist()))
    return tuple(replicates), tuple(errors)


def _is_balanced(numbers: np.ndarray) -> bool:
    return bool(numbers[0] > 0 and np.all(numbers == numbers[0]))
