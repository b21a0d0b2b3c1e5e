"""What is known of a sweep while it runs: outcomes counted, errors sorted into bins, the worst scenarios, and
the intervals that follow.

A tally is made of parts in any order, and is the same for the same parts; only one that is looked at again
and again, to stop when enough is known, needs them by index. It takes as much memory for a million parts as
for one.

The replicates of Sobol sampling are compared at equal numbers of points: where the sweep's scenarios are no
multiple of them, the last few, fewer than there are replicates, count as outcomes and among the worst, but
neither in the probability nor in the quantiles.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tuning.statistics.intervals import Running, binomial_interval, replicate_interval, updated
from tuning.statistics.quantiles import BINS, binned_estimate, binned_quantile, counts, replicate_quantile
from tuning.sweeps import MOST
from tuning.sweeps.columns import BEYOND, GOOD, OUTCOMES, SATURATED

WORST = 10
ORDERS = (0.5, 0.95, 0.99, 0.999)


class Tally(NamedTuple):
    """What is known of the scenarios so far."""

    outcomes: tuple[int, ...]  # scenarios of each of `OUTCOMES`
    whole: int  # number of scenarios, counted from 0, that make whole replicates
    replicates: tuple[tuple[int, int], ...]  # scenarios and failures of each, of whole replicates
    errors: tuple[tuple[int, ...], ...]  # bins of the errors of each (`tuning.statistics.quantiles.counts`)
    worst: tuple[tuple[int, float, int], ...]  # the worst first: how bad the outcome is, |error|, index
    looks: Running | None = None  # those taken, if it is looked at part by part

    @property
    def scenarios(self) -> int:
        return sum(self.outcomes)

    @property
    def failed(self) -> int:
        return self.scenarios - self.outcomes[OUTCOMES.index(GOOD)]

    @property
    def left_out(self) -> int:
        """Scenarios that are in no whole replicate."""
        return self.scenarios - sum(number for number, _ in self.replicates)


class Probability(NamedTuple):
    """An estimate with an interval of 95 %."""

    value: float  # the estimate [1]
    low: float  # end of the interval
    high: float  # end of the interval
    method: str  # how the interval was made


class Quantile(NamedTuple):
    """The |error| that a share `order` of the scenarios does not exceed, with an interval of 95 %."""

    order: float  # share of the scenarios [1]
    value: float  # the estimate [1]
    low: float  # end of the interval
    high: float  # end of the interval


def empty_tally(replicates: int, scenarios: int = MOST, looked_at: bool = False) -> Tally:
    """Before any of the `scenarios` that there are to be; `looked_at`: `add_rows` gets them by index, and the
    interval holds whenever one stops."""
    return Tally(
        (0,) * len(OUTCOMES),
        scenarios // replicates * replicates,
        ((0, 0),) * replicates,
        ((0,) * BINS,) * replicates,
        (),
        Running() if looked_at else None,
    )


def add_rows(tally: Tally, rows: Mapping[str, np.ndarray]) -> Tally:
    """The tally with some more rows; they need `index`, `outcome`, `failed` and `worst_error`."""
    index, outcome, failed = rows["index"], rows["outcome"], rows["failed"]
    outcomes = np.bincount(outcome, minlength=len(OUTCOMES))
    replicates, errors = _replicates(tally, rows)
    # Within the limit or beyond it, the error itself says how bad it is.
    badness = np.where(outcome <= OUTCOMES.index(BEYOND), 0, outcome)
    error = np.nan_to_num(np.abs(rows["worst_error"].astype(float)), nan=-1.0, posinf=np.inf)
    # Only those are sorted that may be among the worst.
    size = np.where(badness > 0, np.inf, error)
    few = np.flatnonzero(size >= np.partition(size, -WORST)[-WORST] if len(size) > WORST else size >= -1)
    first = few[np.lexsort((index[few], -error[few], -badness[few].astype(int)))[:WORST]]
    found = [(int(badness[i]), float(error[i]), int(index[i])) for i in first]
    looks = tally.looks
    return Tally(
        tuple(a + int(b) for a, b in zip(tally.outcomes, outcomes, strict=True)),
        tally.whole,
        replicates,
        errors,
        tuple(sorted([*tally.worst, *found], key=lambda one: (-one[0], -one[1], one[2]))[:WORST]),
        None if looks is None else updated(looks, int(np.sum(failed)), len(failed)),
    )


def error_sizes(rows: Mapping[str, np.ndarray]) -> np.ndarray:
    """The worst |error| of every scenario; infinite where not every contact ended."""
    size = np.abs(rows["worst_error"].astype(float))
    return np.where((rows["outcome"] > OUTCOMES.index(SATURATED)) | np.isnan(size), np.inf, size)


def failure_probability(tally: Tally) -> Probability:
    """The probability that a scenario fails: `binomial_interval` of independent draws, `replicate_interval`
    of Sobol replicates, `confidence_sequence` where the tally was looked at; see
    `tuning.statistics.intervals`.

    While replicates are of unequal size, the interval is 0 to 1.
    """
    numbers, failures = (np.array(each) for each in zip(*tally.replicates, strict=True))
    number = int(np.sum(numbers))
    value = float(np.sum(failures)) / number if number else float("nan")
    if tally.looks is not None:
        low, high = tally.looks.low, tally.looks.high
        return Probability(value, low, high, "confidence sequence, valid under repeated looks")
    if len(numbers) == 1:
        _, low, high = binomial_interval(failures[0], number)
        return Probability(value, float(low), float(high), "binomial, exact")
    method = f"{len(numbers)} scrambled Sobol replicates"
    if not _equal(numbers):
        return Probability(value, 0.0, 1.0, f"{method}, of unequal size yet")
    _, low, high = replicate_interval(failures, int(numbers[0]))
    return Probability(value, float(low), float(high), method)


def error_quantiles(tally: Tally) -> list[Quantile]:
    """Quantiles of the worst |error|, of `ORDERS`; by the same sampling's rules as `failure_probability`."""
    errors = np.array(tally.errors)
    found = []
    for order in ORDERS:
        if len(errors) == 1:
            interval = binned_quantile(errors[0], order, sequential=tally.looks is not None)
        elif _equal(np.sum(errors, axis=1)):
            interval = replicate_quantile(errors, order)
        else:
            interval = binned_estimate(np.sum(errors, axis=0), order), 0.0, np.inf
        found.append(Quantile(order, *(float(number) for number in interval)))
    return found


def _replicates(tally: Tally, rows: Mapping[str, np.ndarray]):
    """Scenarios and failures, and bins of the errors, of every replicate with the rows added."""
    kept = rows["index"] < tally.whole
    of = len(tally.replicates)
    replicate, sizes, failed = rows["index"][kept] % of, error_sizes(rows)[kept], rows["failed"][kept]
    replicates, errors = [], []
    for number, ((n, k), bins) in enumerate(zip(tally.replicates, tally.errors, strict=True)):
        own = replicate == number
        replicates.append((n + int(np.sum(own)), k + int(np.sum(failed[own]))))
        errors.append(tuple((np.array(bins) + counts(sizes[own])).tolist()))
    return tuple(replicates), tuple(errors)


def _equal(numbers: np.ndarray) -> bool:
    return bool(numbers[0] > 0 and np.all(numbers == numbers[0]))
