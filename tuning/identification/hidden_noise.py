"""Noise and bias of a force sensor at rest, if its dead zone replaces most readings by 0.

The force with bias b and noise of standard deviation s is n. A sensor with a continuous dead zone D reads
sign(n) max(|n| - D, 0); one with a cut dead zone reads n if |n| > D, and otherwise 0. The readings other than
0 and the number of zeros determine b and s, and also D if the zone is continuous. The estimates maximise the
likelihood; its curvature gives their covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

MIN_READINGS_BEYOND_DEAD_ZONE = 20  # minimum number of nonzero readings for an estimate
# Maximum ratio of smallest to mean magnitude of nonzero readings with a dead zone that is subtracted.
MAX_LEAST_TO_MEAN_RATIO = 0.3
MIN_READINGS_PER_SIGN = 5  # minimum number of positive and of negative readings; one sign is not enough
# Means of blocks of readings show the correlation of the noise.
MIN_BLOCK_ROWS, MAX_BLOCKS = 50, 40
DIFFERENCE_STEP = 0.01  # step of finite differences, divided by the standard deviation of the noise


@dataclass(frozen=True)
class HiddenNoise:
    """Estimate of noise, bias and continuous dead zone from readings without contact."""

    std: float  # standard deviation of the noise [N]
    bias: float  # N
    zone: float  # size of the dead zone [N]
    covariance: np.ndarray  # (2, 2), covariance of bias and zone [N^2]

    @property
    def missing_force(self) -> tuple[float, float]:
        """Return the force that a reading in contact lacks, zone - bias, and its standard deviation [N]."""
        direction = np.array([-1.0, 1.0])
        return self.zone - self.bias, float(np.sqrt(direction @ self.covariance @ direction))

    def draw_zone(self, missing_force: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Draw the size of the zone [N] for given values of zone - bias [N], from standard normal numbers."""
        expected, std = self.missing_force
        shared = float(self.covariance[1, 1] - self.covariance[0, 1])
        slope = shared / max(std**2, 1e-300)
        left = np.sqrt(max(self.covariance[1, 1] - slope * shared, 0.0))
        return np.maximum(self.zone + slope * (missing_force - expected) + left * normal, 0.0)


def estimate_hidden_noise(readings: np.ndarray, quantum: float = 0.0) -> HiddenNoise | None:
    """Estimate the noise, bias and continuous dead zone of a sensor from readings without contact.

    Args:
        readings: Readings [N].
        quantum: Step of rounded readings [N], or 0.

    Returns:
        The estimate; or None if too few readings of either sign differ from 0, if a gap around 0 shows that
        the sensor does not subtract the dead zone, or if the readings do not determine the three values.
    """
    size = np.abs(readings[readings != 0.0])
    fewest = min(np.sum(readings > 0.0), np.sum(readings < 0.0))
    if len(size) < MIN_READINGS_BEYOND_DEAD_ZONE or fewest < MIN_READINGS_PER_SIGN:
        return None
    if size.min() > MAX_LEAST_TO_MEAN_RATIO * size.mean():
        return None
    compute_cost = _make_cost(readings, True, quantum)
    start = np.array([0.0, np.log(2.0 * size.mean()), np.log(size.mean())])
    optimum, covariance = _minimise(compute_cost, start)
    bias, std, zone = optimum[0], *np.exp(optimum[1:])
    if covariance is None:
        return None
    scale = np.array([1.0, zone]) * np.sqrt(_compute_variance_inflation(readings))
    block = covariance[np.ix_([0, 2], [0, 2])] * np.outer(scale, scale)
    return HiddenNoise(float(std), float(bias), float(zone), block)


def estimate_hidden_bias(
    readings: np.ndarray, zone: float, is_subtracted: bool, quantum: float = 0.0
) -> tuple[float, float] | None:
    """Estimate the bias [N] and its standard deviation for a known dead zone [N].

    The result is None if too few readings differ from 0.
    """
    size = np.abs(readings[readings != 0.0])
    if len(size) < MIN_READINGS_BEYOND_DEAD_ZONE:
        return None
    compute_cost = _make_cost(readings, is_subtracted, quantum)
    start = np.array([0.0, np.log(0.5 * float(size.mean() + zone * is_subtracted))])
    optimum, covariance = _minimise(lambda values: compute_cost(np.append(values, np.log(zone))), start)
    if covariance is None:
        return None
    return float(optimum[0]), float(np.sqrt(covariance[0, 0] * _compute_variance_inflation(readings)))


def compute_log_probability_of_zero(force, std: float, zone: float):
    """Return the log probability that a force [N] with noise lies inside the dead zone and so reads 0."""
    force = np.abs(force)
    high, low = special.log_ndtr((zone - force) / std), special.log_ndtr((-zone - force) / std)
    return high + np.log1p(-np.exp(np.minimum(low - high, -1e-15)))


def _compute_variance_inflation(readings: np.ndarray) -> float:
    """Return the variance of the mean of correlated readings, divided by that of white noise; at least 1."""
    count = int(np.clip(len(readings) // MIN_BLOCK_ROWS, 2, MAX_BLOCKS))
    means = [block.mean() for block in np.array_split(readings, count)]
    variance = float(np.var(means, ddof=1)) * len(readings) / count
    return max(variance / max(float(np.var(readings)), 1e-300), 1.0)


def _make_cost(readings: np.ndarray, is_subtracted: bool, quantum: float) -> Callable[[np.ndarray], float]:
    """Return the negative log likelihood, up to a constant, as a function of bias, log noise and log zone.

    All readings enter by their number, sum and sum of squares, for each sign.
    """
    values = readings[readings != 0.0]
    number, zeros, signs = len(values), len(readings) - len(values), float(np.sum(np.sign(values)))
    total, size, square = float(values.sum()), float(np.abs(values).sum()), float(values @ values)
    # A reading is rounded to 0 if it is less than half a step below the smallest other reading.
    margin = float(np.abs(values).min()) - 0.5 * quantum if quantum and is_subtracted else 0.0

    def compute_cost(parameters: np.ndarray) -> float:
        bias, (std, zone) = parameters[0], np.exp(parameters[1:])
        shift = zone if is_subtracted else 0.0
        squares = square + 2.0 * shift * size - 2.0 * bias * (total + shift * signs)
        squares += number * (shift**2 + bias**2)
        inside = compute_log_probability_of_zero(bias, std, zone + margin)
        return float(0.5 * squares / std**2 + number * parameters[1] - zeros * inside)

    return compute_cost


def _minimise(
    compute_cost: Callable[[np.ndarray], float], start: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the parameters with the smallest cost, and their covariance from the cost's curvature.

    The first parameter has the scale of the noise, whose logarithm is the second parameter. The covariance is
    None if the curvature is not positive definite.
    """
    options = {"xatol": 1e-7, "fatol": 1e-9, "maxiter": 2000, "maxfev": 2000}
    # The second search continues if the simplex collapsed before the minimum.
    for _ in range(2):
        start = optimize.minimize(compute_cost, start, method="Nelder-Mead", options=options).x
    steps = DIFFERENCE_STEP * np.diag([np.exp(start[1]), *np.ones(len(start) - 1)])
    curvature = np.empty((len(start), len(start)))
    for i, along in enumerate(steps):
        for j, across in enumerate(steps):
            signs = ((1, 1), (-1, -1), (1, -1), (-1, 1))
            plus, minus, up, down = (compute_cost(start + a * along + b * across) for a, b in signs)
            curvature[i, j] = (plus + minus - up - down) / (4.0 * along[i] * across[j])
    if np.linalg.eigvalsh(curvature * np.outer(np.diag(steps), np.diag(steps)))[0] <= 0.0:
        return start, None
    return start, np.linalg.inv(curvature)
