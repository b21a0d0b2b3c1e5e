"""Quantiles of |error| from all values, as a reference for quantiles from bins."""

import numpy as np
from numpy.typing import ArrayLike

from tuning.statistics.intervals import IntervalEstimate
from tuning.statistics.quantiles import compute_order_ranks


def quantile(values: ArrayLike, order: float) -> IntervalEstimate:
    """Return the order statistic of rank ceil(order n) of |values|, and its interval.

    Non-finite values count as inf.
    """
    ordered = np.sort(np.nan_to_num(np.abs(np.asarray(values, float)).ravel(), nan=np.inf, posinf=np.inf))
    bounded = np.concatenate([[0.0], ordered, [np.inf]])
    low, high = compute_order_ranks(len(ordered), order)
    # Rounding must not increase the rank if the product is an exact integer.
    rank = max(1, int(np.ceil(order * len(ordered) * (1.0 - 1e-14))))
    estimate = bounded[rank] if len(ordered) else np.nan
    return IntervalEstimate(np.asarray(estimate), bounded[low], bounded[high])
