"""What the hypotheses of a `DelayBank` weigh."""

from math import pi, sqrt

import numpy as np

from .entry import DENSITY_SQUARINGS, cumulative
from .hypotheses import DELAYS, FIRST_LAG, HYPOTHESES
from .onset import exponential

ELASTIC = 0.35  # probability that a contact has no damping
NOTHING = 1e-300  # a smaller product is none: some machines keep such numbers, some do not
# Beside an array, a number takes longer than an array does.
_0, _1 = np.zeros(HYPOTHESES), np.ones(HYPOTHESES)


def plausibility(mean: np.ndarray, variance: np.ndarray, prior: float) -> np.ndarray:
    """How much better a damping N(mean, variance) goes with one that is 0 or not negative than one
    N(0, prior) does; Phi as in `force_depth_map.positive_mean`."""
    spread = np.sqrt(variance)
    ratio = mean / spread
    density = exponential(0.5 * (ratio * ratio), DENSITY_SQUARINGS)
    known = sqrt(prior if prior > 0.0 else 1.0)
    return ELASTIC * (known / spread) * density + (1.0 - ELASTIC) * (2.0 * cumulative(ratio))


def positive_mean(mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """`force_depth_map.positive_mean` of many."""
    known = variance > _0
    spread = np.sqrt(np.where(known, variance, _1))
    ratio = mean / spread
    root = np.sqrt(ratio * ratio + 2.0 * pi)
    below = 2.0 / (root - ratio)
    above_0 = ratio > _0
    positive = np.where(above_0, ratio, _0)
    mills = pi / ((pi - 1.0) * positive + root)
    tail = 1.0 / (1.0 + positive * positive / 512.0)
    for _ in range(8):
        tail *= tail
    density = tail / sqrt(2.0 * pi)
    above = positive + density / (1.0 - density * mills)
    return np.where(known, spread * np.where(above_0, above, below), np.fmax(mean, _0))


def weighed(carried: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """What is carried, by this contact's evidence. Whether it is a lag only maps whose slopes wander decide,
    as those of lags do: the sum over delays is what it would be if all were such."""
    weights = carried * evidence
    as_lags = (carried[:DELAYS] + carried[DELAYS:FIRST_LAG]) * evidence[:DELAYS]
    weights[:FIRST_LAG] *= sum_in_order(as_lags) / sum_in_order(weights[:FIRST_LAG])
    return weights


def floored_shares(values: np.ndarray, least: float) -> np.ndarray:
    """Of their sum, at least so much."""
    values = np.where(values < NOTHING, 0.0, values)
    shares = values / sum_in_order(values)
    return np.fmax(shares, least)


def sum_in_order(values: np.ndarray) -> float:
    """The sum, one term after another."""
    return np.add.accumulate(values)[-1]
