"""What is known of a sweep while it runs: outcomes counted, the worst scenarios, an interval.

A tally is made of parts in any order, and is the same for the same parts. It takes as much memory for a
million parts as for one.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tuning.sweeps.columns import GOOD, OUTCOMES
from tuning.verdict import LEVEL as CONFIDENCE
from tuning.verdict import Interval, binomial_interval, replicate_interval

WORST = 10


class Tally(NamedTuple):
    """Scenarios of each of `OUTCOMES`; per replicate scenarios and failures; the worst scenarios, the worst
    first: how bad the outcome is, |error|, index."""

    outcomes: tuple[int, ...]
    replicates: tuple[tuple[int, int], ...]
    worst: tuple[tuple[int, float, int], ...]

    @property
    def scenarios(self) -> int:
        return sum(self.outcomes)

    @property
    def failed(self) -> int:
        return self.scenarios - self.outcomes[OUTCOMES.index(GOOD)]


class Probability(NamedTuple):
    """An estimate with an interval of `CONFIDENCE`, and how that was made."""

    value: float
    low: float
    high: float
    method: str


def empty_tally(replicates: int) -> Tally:
    """Before any scenario."""
    return Tally((0,) * len(OUTCOMES), ((0, 0),) * replicates, ())


def add_rows(tally: Tally, rows: Mapping[str, np.ndarray]) -> Tally:
    """The tally with some more rows; they need `index`, `outcome` and `worst_error`."""
    index, outcome = rows["index"], rows["outcome"]
    counts = np.bincount(outcome, minlength=len(OUTCOMES))
    of = len(tally.replicates)
    replicate = index % of
    seen = np.bincount(replicate, minlength=of)
    failed = np.bincount(replicate[rows["failed"]], minlength=of)
    # Within the limit or beyond it, the error itself says how bad it is.
    badness = np.where(outcome <= OUTCOMES.index(GOOD) + 1, 0, outcome)
    error = np.nan_to_num(np.abs(rows["worst_error"].astype(float)), nan=-1.0, posinf=np.inf)
    first = np.lexsort((index, -error, -badness.astype(int)))[:WORST]
    found = [(int(badness[i]), float(error[i]), int(index[i])) for i in first]
    return Tally(
        tuple(a + int(b) for a, b in zip(tally.outcomes, counts, strict=True)),
        tuple(
            (n + int(more), k + int(bad))
            for (n, k), more, bad in zip(tally.replicates, seen, failed, strict=True)
        ),
        tuple(sorted([*tally.worst, *found], key=lambda one: (-one[0], -one[1], one[2]))[:WORST]),
    )


def failure_probability(tally: Tally) -> Probability:
    """Of independent draws with the exact binomial interval; of Sobol replicates, which must be of one size,
    with the interval over the replicates (`tuning.verdict`)."""
    if len(tally.replicates) == 1:
        found = binomial_interval(tally.failed, tally.scenarios, CONFIDENCE)
        return _probability(found, "binomial, exact")
    (each,) = {number for number, _ in tally.replicates}
    failures = [failed for _, failed in tally.replicates]
    found = replicate_interval(failures, each, CONFIDENCE)
    return _probability(found, f"{len(failures)} scrambled Sobol replicates")


def _probability(found: Interval, method: str) -> Probability:
    return Probability(float(found.estimate), float(found.low), float(found.high), method)
