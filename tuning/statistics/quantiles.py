"""Distribution-free confidence intervals of quantiles of |error|, in constant memory.

The number of n independent values below the quantile of order q has a binomial distribution. The order
statistics at bounds of this number therefore enclose the quantile, for any distribution. The values need not
be stored: `count_in_bins` counts them in bins whose edges increase by 1 %. Counts of several batches add up,
    and
give the order statistics to within a bin, rounded outward. `replicate_quantile` does the same for scramblings
of a Sobol sequence, for whose points no binomial distribution applies.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from tuning.statistics.intervals import BETA_PRIOR, CONFIDENCE_LEVEL, Estimate, replicate_interval

BIN_RESOLUTION = 0.01  # relative distance of neighbouring edges
_DECADES = -9, 3  # powers of 10 of the first edge and about the last one
# Two further bins reach from 0 to the first edge, and from the last edge to infinity.
BIN_EDGES = 10.0 ** _DECADES[0] * (1.0 + BIN_RESOLUTION) ** np.arange(
    int(np.ceil((_DECADES[1] - _DECADES[0]) * np.log(10.0) / np.log1p(BIN_RESOLUTION))) + 1
)
BIN_COUNT = len(BIN_EDGES) + 1


def compute_order_ranks(
    number: int, order: float, level: float = CONFIDENCE_LEVEL, sequential: bool = False
) -> tuple[int, int]:
    """Return the ranks of the order statistics that enclose a quantile.

    Rank 1 is the least value; 0 and `number` + 1 mean no bound. The quantile of order q lies between X_(low)
    and X_(high), ends included, with at least probability `level`, also with ties (David and Nagaraja 2003,
    section 7.1). For a fixed number, low and high - 1 are the quantiles (1 -+ level) / 2 of the binomial
    distribution of n and q. If `sequential`, they are the extreme counts k for which the martingale of
    `tuning.statistics.intervals.confidence_sequence` at p = q is below 1 / (1 - level), so that the interval
    covers at any stopping rule (Howard and Ramdas 2022, "Sequential estimation of quantiles"). Raise
    ValueError unless number >= 0, 0 < order < 1 and 0 < level < 1.
    """
    if number < 0 or not (0 < order < 1 and 0 < level < 1):
        raise ValueError(
            f"number, order, level: found {number}, {order}, {level}, expected 0 or more, 0 to 1, 0 to 1"
        )
    if number == 0:
        return 0, 1
    if not sequential:
        # The import takes most of a second, and only this branch needs it.
        from scipy import stats

        tail = (1.0 - level) / 2.0
        low, high = stats.binom.ppf([tail, 1.0 - tail], number, order)
        return int(low), int(high) + 1

    def inside(count: int) -> bool:
        likelihood = special.xlogy(count, order) + special.xlog1py(number - count, -order)
        mixture = special.betaln(BETA_PRIOR + count, BETA_PRIOR + number - count) - special.betaln(
            BETA_PRIOR, BETA_PRIOR
        )
        return mixture - likelihood < -np.log1p(-level)

    middle = round(order * number)
    return _bisect_last(inside, middle, -1), _bisect_last(inside, middle, number + 1) + 1


def count_in_bins(values: ArrayLike) -> np.ndarray:
    """Count |values| in each bin, (BINS,) of int64; counts of several batches may be added.

    Bin 0 is [0, EDGES[0]), bin i is [EDGES[i - 1], EDGES[i]), and the last one reaches from EDGES[-1] to
    infinity. Values that are not finite count in the last bin.
    """
    size = np.abs(np.asarray(values, float)).ravel()
    size = np.sort(np.where(np.isfinite(size), size, np.inf))
    # Searching the edges among the values is faster than the reverse, since there are more values.
    return np.diff(np.searchsorted(size, BIN_EDGES), prepend=0, append=len(size)).astype(np.int64)


def binned_quantile(
    counted: np.ndarray, order: float, level: float = CONFIDENCE_LEVEL, sequential: bool = False
) -> Estimate:
    """Return the quantile of order `order` of |values| with its interval, from their `count_in_bins`.

    The interval's ends are the order statistics of `compute_order_ranks`, or 0 and infinity without a bound.
    Each is rounded outward to the edge of its bin, with a relative error below `BIN_RESOLUTION` between the
    first and the last edge. The estimate, the order statistic of rank ceil(order n), is the geometric middle
    of its bin, with half that error; it is 0 in the first bin and infinite in the last. Raise ValueError as
    `compute_order_ranks` does.
    """
    number = int(np.sum(counted))
    below = np.cumsum(counted)
    bounds = np.concatenate([[0.0], BIN_EDGES, [np.inf]])
    low, high = compute_order_ranks(number, order, level, sequential)
    lower = bounds[np.searchsorted(below, low)] if low > 0 else 0.0
    upper = bounds[np.searchsorted(below, high) + 1] if high <= number else np.inf
    return Estimate(binned_estimate(counted, order), np.asarray(lower), np.asarray(upper))


def binned_estimate(counted: np.ndarray, order: float) -> np.ndarray:
    """Return the estimate (...) of `binned_quantile` from `count_in_bins` (..., BINS); nan without values."""
    below = np.cumsum(counted, axis=-1)
    number = below[..., -1]
    index = np.argmax(below >= _compute_rank(number, order)[..., None], axis=-1)
    middles = np.concatenate([[0.0], np.sqrt(BIN_EDGES[:-1] * BIN_EDGES[1:]), [np.inf]])
    return np.where(number > 0, middles[index], np.nan)


def replicate_quantile(counted: np.ndarray, order: float, level: float = CONFIDENCE_LEVEL) -> Estimate:
    """Return the quantile with its interval from independent scramblings of a Sobol sequence.

    `counted` holds the `count_in_bins` (replicates, BINS), with an equal number of points in each replicate.
    The share of |values| below an edge has the interval of `tuning.statistics.intervals.replicate_interval`.
    The quantile's interval begins at the edge before the first one where this interval's upper end reaches
    `order`, and ends at the edge after the last one where its lower end is at most `order`. It misses the
    quantile only if the share's interval fails at one of the two edges around the quantile. Raise ValueError
    as `compute_order_ranks` and `replicate_interval` do, and for unequal numbers of points.
    """
    counted = np.asarray(counted)
    numbers = np.sum(counted, axis=-1)
    if np.any(numbers != numbers[0]):
        raise ValueError(f"counted: found {numbers.tolist()} values per replicate, expected equal numbers")
    estimate = binned_estimate(np.sum(counted, axis=0), order)
    bounds = np.concatenate([[0.0], BIN_EDGES, [np.inf]])
    # Bin i ends at bounds[i + 1].
    _, low, high = replicate_interval(np.cumsum(counted, axis=-1).T, int(numbers[0]), level)
    first = int(np.argmax(high >= order))
    last = int(np.max(np.nonzero(low[:-1] <= order)[0], initial=-1))
    return Estimate(estimate, bounds[first], bounds[last + 2])


def _compute_rank(number: ArrayLike, order: float) -> np.ndarray:
    """Return the rank ceil(order n), at least 1 and at most n."""
    # The factor prevents that rounding lifts an exact product to the next rank.
    rank = np.ceil(order * np.asarray(number) * (1.0 - 1e-14))
    return np.clip(rank, 1, np.maximum(number, 1)).astype(np.int64)


def _bisect_last(inside, within: int, beyond: int) -> int:
    """Return by bisection the last integer from `within` towards `beyond` for which `inside` holds."""
    while abs(beyond - within) > 1:
        middle = (within + beyond) // 2
        within, beyond = (middle, beyond) if inside(middle) else (within, middle)
    return within
