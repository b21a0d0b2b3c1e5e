"""Distribution-free confidence intervals of quantiles of |error|, in constant memory.

Among n independent values, the number below the quantile of order q has a binomial distribution. Bounds of
this number are the ranks of two order statistics, which enclose the quantile for any distribution of the
values. The values need not be stored: `count_in_bins` counts them in bins whose edges increase by 1 %. The
counts of several batches can be added. They determine the order statistics to within one bin, rounded
outward. `replicate_quantile` computes the interval for scramblings of a Sobol sequence, whose points are not
independent.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from tuning.statistics.intervals import BETA_PRIOR, CONFIDENCE_LEVEL, IntervalEstimate, replicate_interval

BIN_RESOLUTION = 0.01  # relative distance between successive edges of bins [1]
_DECADES = -9, 3  # the first edge is 1e-9, and the last edge is about 1e3
# Two more bins extend from 0 to the first edge, and from the last edge to infinity.
BIN_EDGES = 10.0 ** _DECADES[0] * (1.0 + BIN_RESOLUTION) ** np.arange(
    int(np.ceil((_DECADES[1] - _DECADES[0]) * np.log(10.0) / np.log1p(BIN_RESOLUTION))) + 1
)
BIN_COUNT = len(BIN_EDGES) + 1


def compute_order_ranks(
    number: int, order: float, level: float = CONFIDENCE_LEVEL, sequential: bool = False
) -> tuple[int, int]:
    """Return the ranks of two order statistics between which a quantile lies with the confidence `level`.

    The smallest value has rank 1. A lower rank of 0 or an upper rank of `number` + 1 means that there
    is no such bound. The interval includes both order statistics, and is valid even if some values are equal
    (David and Nagaraja 2003, section 7.1).

    Let n = `number` and q = `order`, and consider the lower rank, and the upper rank minus 1. If n is fixed
    in advance, they are the quantiles of order (1 - level) / 2 and (1 + level) / 2 of the binomial
    distribution with n trials of probability q. If `sequential` is true, they are the smallest and the
    largest count for which the martingale of `tuning.statistics.intervals.confidence_sequence` at p = q is
    below 1 / (1 - level). The interval is then valid for every stopping rule (Howard and Ramdas 2022,
    "Sequential estimation of quantiles").

    Args:
        number: number of independent values.
        order: order q of the quantile, between 0 and 1.
        level: confidence level, between 0 and 1.
        sequential: whether a stopping rule determines the number from the values.

    Returns:
        The lower and the upper rank.

    Raises:
        ValueError: If an argument is out of its range.
    """
    if number < 0 or not (0 < order < 1 and 0 < level < 1):
        raise ValueError(
            f"number, order, level: found {number}, {order}, {level}, expected number >= 0, order and level "
            "between 0 and 1"
        )
    if number == 0:
        return 0, 1
    if not sequential:
        # Only this branch needs the import, which takes most of a second.
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
    """Count the magnitudes of values in each bin, (`BIN_COUNT`,) of int64.

    Bin 0 is [0, `BIN_EDGES[0]`), bin i is [`BIN_EDGES[i - 1]`, `BIN_EDGES[i]`), and the last bin extends from
    the last edge to infinity. Values that are not finite are counted in the last bin. The counts of several
    batches can be added.
    """
    magnitudes = np.abs(np.asarray(values, float)).ravel()
    magnitudes = np.sort(np.where(np.isfinite(magnitudes), magnitudes, np.inf))
    # There are more values than edges, so that it is faster to search for the edges among the sorted values.
    return np.diff(np.searchsorted(magnitudes, BIN_EDGES), prepend=0, append=len(magnitudes)).astype(np.int64)


def binned_quantile(
    counted: np.ndarray, order: float, level: float = CONFIDENCE_LEVEL, sequential: bool = False
) -> IntervalEstimate:
    """Estimate a quantile of |values| and its interval from `counted`, the counts of `count_in_bins`.

    The bounds are the order statistics of `compute_order_ranks`, rounded outward to the edges of their bins.
    Between the first and the last edge, this changes a bound by less than 1 % (`BIN_RESOLUTION`). Without an
    order statistic, the lower bound is 0, and the upper bound is infinity. The estimate is the geometric mean
    of the edges of the bin that contains rank ceil(order n) of n values; in the first bin it is 0, and in the
    last bin infinity. The arguments after `counted` are those of `compute_order_ranks`. Raise ValueError if
    an argument is out of its range.
    """
    number = int(np.sum(counted))
    below = np.cumsum(counted)
    bounds = np.concatenate([[0.0], BIN_EDGES, [np.inf]])
    low, high = compute_order_ranks(number, order, level, sequential)
    lower = bounds[np.searchsorted(below, low)] if low > 0 else 0.0
    upper = bounds[np.searchsorted(below, high) + 1] if high <= number else np.inf
    return IntervalEstimate(binned_estimate(counted, order), np.asarray(lower), np.asarray(upper))


def binned_estimate(counted: np.ndarray, order: float) -> np.ndarray:
    """Return only the estimate of `binned_quantile`, not its interval; NaN if there are no values.

    The last axis of `counted` contains counts of `count_in_bins`; the result has one estimate for each index
    of the other axes.
    """
    below = np.cumsum(counted, axis=-1)
    number = below[..., -1]
    index = np.argmax(below >= _compute_rank(number, order)[..., None], axis=-1)
    middles = np.concatenate([[0.0], np.sqrt(BIN_EDGES[:-1] * BIN_EDGES[1:]), [np.inf]])
    return np.where(number > 0, middles[index], np.nan)


def replicate_quantile(
    counted: np.ndarray, order: float, level: float = CONFIDENCE_LEVEL
) -> IntervalEstimate:
    """Return a quantile with its interval from independent scramblings of a Sobol sequence.

    For each edge of a bin, `tuning.statistics.intervals.replicate_interval` yields an interval of the
    fraction of values below this edge. Find the first edge whose fraction has an upper bound of at least
    `order`: the edge before it is the lower bound of the quantile. Find the last edge whose fraction has a
    lower bound of at most `order`: the edge after it is the upper bound of the quantile. The interval misses
    the quantile only if the interval of the fraction fails at one of the two edges next to the quantile.

    Args:
        counted: counts of `count_in_bins` for each replicate, (replicates, `BIN_COUNT`).
        order: order of the quantile, between 0 and 1.
        level: confidence level, between 0 and 1.

    Raises:
        ValueError: If the replicates have different numbers of points, or if an argument is out of its range.
    """
    counted = np.asarray(counted)
    numbers = np.sum(counted, axis=-1)
    if np.any(numbers != numbers[0]):
        raise ValueError(f"counted: found {numbers.tolist()} values per replicate, expected equal numbers")
    estimate = binned_estimate(np.sum(counted, axis=0), order)
    bounds = np.concatenate([[0.0], BIN_EDGES, [np.inf]])
    # The upper edge of bin i is bounds[i + 1].
    _, low, high = replicate_interval(np.cumsum(counted, axis=-1).T, int(numbers[0]), level)
    first = int(np.argmax(high >= order))
    last = int(np.max(np.nonzero(low[:-1] <= order)[0], initial=-1))
    return IntervalEstimate(estimate, bounds[first], bounds[last + 2])


def _compute_rank(number: ArrayLike, order: float) -> np.ndarray:
    """Return the rank of the order statistic that estimates the quantile: ceil(order n), from 1 to n."""
    # Without this factor, a rounding error could increase an integer product to the next rank.
    rank = np.ceil(order * np.asarray(number) * (1.0 - 1e-14))
    return np.clip(rank, 1, np.maximum(number, 1)).astype(np.int64)


def _bisect_last(inside, within: int, beyond: int) -> int:
    """Find by bisection the last integer from `within` towards `beyond` for which `inside` is true."""
    while abs(beyond - within) > 1:
        middle = (within + beyond) // 2
        within, beyond = (middle, beyond) if inside(middle) else (within, middle)
    return within
