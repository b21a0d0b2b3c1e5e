"""Prediction of the next contact's metrics, from the file's uncertainty and the contacts so far.

The metrics depend linearly on the underlying parameters, which are normal about the file's values and
constant over all contacts. Each contact reduces their uncertainty (Kalman 1960, with constant states). As
long as nothing changes, the deviations over their predicted standard deviation are independent with mean 0
and variance 1, even if the file is wrong within its stated uncertainty.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from tuning.identification.monitor.metrics import BIAS_INDEX, METRIC_NAMES, NOISE_INDEX

NOISE_LEVEL_STD = 0.1  # relative standard deviation of the noise level from day to day
COVERAGE_PROBABILITY = 0.99  # probability of the region that the file's uncertainty covers


class MetricFilter:
    """Kalman filter of the parameters behind the metrics.

    The state holds the file's parameters in standard deviations, the sensor's bias [N], and the relative
    increase of its noise.
    """

    def __init__(self, correlation: np.ndarray, noise_std: float):
        number = len(correlation)
        self.begun = np.zeros((number + 2, number + 2))
        self.begun[:number, :number] = correlation
        # Taring leaves a bias of the size of the noise.
        self.begun[number:, number:] = np.diag([noise_std**2, NOISE_LEVEL_STD**2])
        self.mean, self.covariance = np.zeros(number + 2), self.begun

    def deviation(
        self, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the metrics minus the predicted ones, and the predicted standard deviation.

        `slopes` are the derivatives by the file's parameters; `noise` is the covariance of the metrics for
        given parameters.
        """
        slopes = _append_sensor_columns(slopes)
        spread = slopes @ self.covariance @ slopes.T + noise
        return value - slopes @ self.mean, np.sqrt(np.diag(spread))

    def learn(self, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray) -> None:
        """Update the state with one contact."""
        finite, slopes = np.isfinite(value), _append_sensor_columns(slopes)
        slopes, noise = slopes[finite], noise[np.ix_(finite, finite)]
        spread = slopes @ self.covariance @ slopes.T + noise
        gain = _solve_normalised(spread, slopes @ self.covariance).T
        self.mean = self.mean + gain @ (value[finite] - slopes @ self.mean)
        remainder = np.eye(len(self.mean)) - gain @ slopes
        self.covariance = remainder @ self.covariance @ remainder.T + gain @ noise @ gain.T

    def covers(self, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray) -> bool:
        """Return whether the metrics are compatible with the file's uncertainty."""
        finite, slopes = np.isfinite(value), _append_sensor_columns(slopes)
        slopes, noise = slopes[finite], noise[np.ix_(finite, finite)]
        spread = slopes @ self.begun @ slopes.T + noise
        deviation = value[finite]
        return bool(
            deviation @ _solve_normalised(spread, deviation)
            <= stats.chi2.ppf(COVERAGE_PROBABILITY, finite.sum())
        )


def _append_sensor_columns(slopes: np.ndarray) -> np.ndarray:
    """Return the slopes with two more columns, for the sensor's bias and noise."""
    sensor_columns = np.zeros((len(METRIC_NAMES), 2))
    sensor_columns[BIAS_INDEX, 0] = sensor_columns[NOISE_INDEX, 1] = 1.0
    return np.concatenate([slopes, sensor_columns], axis=1)


def _solve_normalised(spread: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve the linear system in normalized units, because the metrics have very different magnitudes."""
    size = np.sqrt(np.diag(spread))
    scaled = right / (size[:, None] if right.ndim > 1 else size)
    solution = np.linalg.solve(spread / np.outer(size, size), scaled)
    return solution / (size[:, None] if right.ndim > 1 else size)
