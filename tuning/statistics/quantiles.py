"""Quantiles of |error| with intervals that hold for any distribution, in constant memory if need be.

Below the quantile of order q lie, of n independent values, a binomial number of them: the order statistics of
ranks that this number does not leave enclose the quantile, whatever the distribution. The values themselves
need not be kept. `counts` sorts them into bins of fixed edges, each 1 % above the last: counts of parts add
up, and the same order statistics are then known to a bin, outward. `replicate_quantile` does it for
scramblings of a Sobol sequence, whose points no binomial law describes.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from tuning.statistics.intervals import LEVEL, PRIOR, Estimate, replicate_interval

RESOLUTION = 0.01  # of an edge, to the next one
_DECADES = -9, 3
# Below the first edge is a bin of its own, from 0; above the last one too, to infinity.
EDGES = 10.0 ** _DECADES[0] * (1.0 + RESOLUTION) ** np.arange(
    int(np.ceil((_DECADES[1] - _DECADES[0]) * np.log(10.0) / np.log1p(RESOLUTION))) + 1
)
BINS = len(EDGES) + 1


def ranks(number: int, order: float, level: float = LEVEL, sequential: bool = False) -> tuple[int, int]:
    """Ranks (1 the least, 0 and `number` + 1 beyond all) of the order statistics around a quantile.

    Between X_(low) and X_(high), ends included, is the quantile of order q with probability `level` or more
    (David and Nagaraja 2003, section 7.1, with ties too). Fixed number: low and high - 1 are the quantiles
    (1 -+ level) / 2 of the binomial distribution of n and q. Sequential: they are the counts k at which the
    martingale of `tuning.statistics.intervals.confidence_sequence` at p = q stays below 1 / (1 - level), so
    that the interval covers whenever one stops (Howard and Ramdas 2022, "Sequential estimation of
    quantiles"). Raises ValueError unless number >= 0, 0 < order < 1 and 0 < level < 1.
    """
    if number < 0 or not (0 < order < 1 and 0 < level < 1):
        raise ValueError(
            f"number, order, level: found {number}, {order}, {level}, allowed 0 or more, 0 to 1, 0 to 1"
        )
    if number == 0:
        return 0, 1
    if not sequential:
        # Takes most of a second to import, and only this branch needs it.
        from scipy import stats

        tail = (1.0 - level) / 2.0
        low, high = stats.binom.ppf([tail, 1.0 - tail], number, order)
        return int(low), int(high) + 1

    def inside(count: int) -> bool:
        likelihood = special.xlogy(count, order) + special.xlog1py(number - count, -order)
        mixture = special.betaln(PRIOR + count, PRIOR + number - count) - special.betaln(PRIOR, PRIOR)
        return mixture - likelihood < -np.log1p(-level)

    middle = round(order * number)
    return _last(inside, middle, -1), _last(inside, middle, number + 1) + 1


def counts(values: ArrayLike) -> np.ndarray:
    """How many of |values| lie in each bin, (BINS,) of int64: add those of parts. Non-finite: the last bin.

    Bin 0 is [0, EDGES[0]), bin i is [EDGES[i - 1], EDGES[i]), the last one from EDGES[-1] on.
    """
    size = np.abs(np.asarray(values, float)).ravel()
    size = np.sort(np.where(np.isfinite(size), size, np.inf))
    # Every edge is looked for among the values, which are more.
    return np.diff(np.searchsorted(size, EDGES), prepend=0, append=len(size)).astype(np.int64)


def binned_quantile(
    counted: np.ndarray, order: float, level: float = LEVEL, sequential: bool = False
) -> Estimate:
    """The quantile of order `order` of |values| and its interval, from their `counts`, in their unit.

    Its ends are the order statistics of `ranks`, 0 and infinity beyond the least and the greatest value, each
    moved outward, to the edge of its bin: off by less than `RESOLUTION` of itself (between the first edge and
    the last one). The estimate, the order statistic of rank ceil(order n), is the geometric middle of its
    bin, off by half of that; 0 in the first bin, infinite in the last one. Raises ValueError as `ranks` does.
    """
    number = int(np.sum(counted))
    below = np.cumsum(counted)
    bounds = np.concatenate([[0.0], EDGES, [np.inf]])
    low, high = ranks(number, order, level, sequential)
    lower = bounds[np.searchsorted(below, low)] if low > 0 else 0.0
    upper = bounds[np.searchsorted(below, high) + 1] if high <= number else np.inf
    return Estimate(binned_estimate(counted, order), np.asarray(lower), np.asarray(upper))


def binned_estimate(counted: np.ndarray, order: float) -> np.ndarray:
    """The estimate of `binned_quantile` alone, (...), from `counts` (..., BINS); nan without values."""
    below = np.cumsum(counted, axis=-1)
    number = below[..., -1]
    place = np.argmax(below >= _rank(number, order)[..., None], axis=-1)
    middles = np.concatenate([[0.0], np.sqrt(EDGES[:-1] * EDGES[1:]), [np.inf]])
    return np.where(number > 0, middles[place], np.nan)


def replicate_quantile(counted: np.ndarray, order: float, level: float = LEVEL) -> Estimate:
    """As `binned_quantile`, from the `counts` (replicates, BINS) of equally many points of each of several
    independent scramblings of a Sobol sequence.

    The share of |values| below an edge has the interval of `tuning.statistics.intervals.replicate_interval`.
    The quantile lies between the edge before the first one where that reaches up to `order`, and the edge
    after the last one where it reaches down to it: this fails only if the share's interval does at one of the
    two edges around the quantile, each to its side. Raises ValueError as `ranks` and `replicate_interval` do,
    and for unequal numbers.
    """
    counted = np.asarray(counted)
    numbers = np.sum(counted, axis=-1)
    if np.any(numbers != numbers[0]):
        raise ValueError(f"counted: found {numbers.tolist()} values per replicate, allowed equal numbers")
    estimate = binned_estimate(np.sum(counted, axis=0), order)
    bounds = np.concatenate([[0.0], EDGES, [np.inf]])
    # Bin i ends at bounds[i + 1].
    _, low, high = replicate_interval(np.cumsum(counted, axis=-1).T, int(numbers[0]), level)
    first = int(np.argmax(high >= order))
    last = int(np.max(np.nonzero(low[:-1] <= order)[0], initial=-1))
    return Estimate(estimate, bounds[first], bounds[last + 2])


def _rank(number: ArrayLike, order: float) -> np.ndarray:
    # Rounding must not lift an exact product to the next rank.
    rank = np.ceil(order * np.asarray(number) * (1.0 - 1e-14))
    return np.clip(rank, 1, np.maximum(number, 1)).astype(np.int64)


def _last(inside, within: int, beyond: int) -> int:
    """The last whole number for which `inside` holds, from `within`, where it does, towards `beyond`."""
    while abs(beyond - within) > 1:
        middle = (within + beyond) // 2
        within, beyond = (middle, beyond) if inside(middle) else (within, middle)
    return within
