"""Noise and bias of a force sensor at rest, if its dead zone replaces most readings by 0.

The force with bias b and noise of standard deviation s is n. A sensor with a continuous dead zone D reads
sign(n) max(|n| - D, 0); one with a cut dead zone reads n if |n| > D, and otherwise 0. The readings other than
0 and the number of zeros determine b and s, and also D if the zone is continuous. The estimates maximise the
likelihood; its curvature gives their covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

MIN_READINGS_BEYOND_DEAD_ZONE = 20  # minimum number of nonzero readings for an estimate
# Maximum ratio of smallest to mean magnitude of nonzero readings with a dead zone that is subtracted.
MAX_LEAST_TO_MEAN_RATIO = 0.3
BLOCK_ROWS = 50  # number of successive readings whose mean shows the correlation of the noise
DIFFERENCE_STEP = 0.01  # step of finite differences, divided by the standard deviation of the noise


@dataclass(frozen=True)
class HiddenNoise:
    """Estimate of the bias and the noise that a dead zone hides, and of the zone if it was unknown."""

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


def estimate_hidden_noise(readings: np.ndarray) -> HiddenNoise | None:
    """Estimate the noise, bias and continuous dead zone of a sensor from readings without contact.

    Returns:
        The estimate; or None if too few readings differ from 0, if a gap around 0 shows that the sensor does
        not subtract the dead zone, or if the readings do not determine the three values.
    """
    size = np.abs(readings[readings != 0.0])
    if len(size) < MIN_READINGS_BEYOND_DEAD_ZONE or size.min() > MAX_LEAST_TO_MEAN_RATIO * size.mean():
        return None
    start = np.array([0.0, np.log(2.0 * size.mean()), np.log(size.mean())])
    optimum, covariance = _maximise(lambda values: _compute_cost(readings, values, True), start)
    bias, std, zone = optimum[0], *np.exp(optimum[1:])
    if covariance is None:
        return None
    scale = np.array([1.0, zone]) * np.sqrt(_count_correlated_rows(readings))
    block = covariance[np.ix_([0, 2], [0, 2])] * np.outer(scale, scale)
    return HiddenNoise(float(std), float(bias), float(zone), block)


def estimate_hidden_bias(
    readings: np.ndarray, zone: float, is_subtracted: bool
) -> tuple[float, float] | None:
    """Estimate the bias [N] and its standard deviation for a known dead zone [N].

    The result is None if too few readings differ from 0.
    """
    size = np.abs(readings[readings != 0.0])
    if len(size) < MIN_READINGS_BEYOND_DEAD_ZONE:
        return None
    start = np.array([0.0, np.log(0.5 * float(size.mean() + zone * is_subtracted))])
    optimum, covariance = _maximise(
        lambda values: _compute_cost(readings, np.append(values, np.log(zone)), is_subtracted), start
    )
    if covariance is None:
        return None
    return float(optimum[0]), float(np.sqrt(covariance[0, 0] * _count_correlated_rows(readings)))


def compute_log_probability_of_zero(force, std: float, zone: float):
    """Return the log probability that a force [N] with noise lies inside the dead zone and so reads 0."""
    force = np.abs(force)
    high, low = special.log_ndtr((zone - force) / std), special.log_ndtr((-zone - force) / std)
    return high + np.log1p(-np.exp(np.minimum(low - high, -1e-15)))


def _count_correlated_rows(readings: np.ndarray) -> float:
    """Return how many readings have as much information as one independent reading: 1 for white noise."""
    blocks = np.array_split(readings, max(len(readings) // BLOCK_ROWS, 2))
    variance = float(np.var([block.mean() for block in blocks]) * len(readings) / len(blocks))
    return max(variance / max(float(np.var(readings)), 1e-300), 1.0)


def _compute_cost(readings: np.ndarray, parameters: np.ndarray, is_subtracted: bool) -> float:
    """Return the negative log likelihood of bias, and of the logarithms of noise and zone."""
    bias, (std, zone) = parameters[0], np.exp(parameters[1:])
    values = readings[readings != 0.0]
    forces = values + zone * np.sign(values) if is_subtracted else values
    inside = compute_log_probability_of_zero(bias, std, zone)
    left = 0.5 * np.sum(((forces - bias) / std) ** 2) + len(values) * parameters[1]
    return float(left - (len(readings) - len(values)) * inside)


def _maximise(cost, start: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the parameters with the smallest cost, and their covariance from the cost's curvature.

    The first parameter has the scale of the noise, whose logarithm is the second parameter. The covariance is
    None if the cost has no minimum.
    """
    options = {"xatol": 1e-7, "fatol": 1e-9, "maxiter": 2000, "maxfev": 2000}
    # Restarts prevent that the simplex collapses before it reaches the minimum.
    for _ in range(2):
        start = optimize.minimize(cost, start, method="Nelder-Mead", options=options).x
    steps = DIFFERENCE_STEP * np.diag([np.exp(start[1]), *np.ones(len(start) - 1)])
    curvature = np.empty((len(start), len(start)))
    for i, along in enumerate(steps):
        for j, across in enumerate(steps):
            signs = ((1, 1), (-1, -1), (1, -1), (-1, 1))
            plus, minus, up, down = (cost(start + a * along + b * across) for a, b in signs)
            curvature[i, j] = (plus + minus - up - down) / (4.0 * along[i] * across[j])
    if np.linalg.eigvalsh(curvature * np.outer(np.diag(steps), np.diag(steps)))[0] <= 0.0:
        return start, None
    return start, np.linalg.inv(curvature)
