"""Kalman filter that predicts the metrics of a contact from the metrics of all earlier contacts.

The metrics are assumed to be linear in the parameters of the rig, which are assumed to be constant. Before
the first contact, the parameters are normally distributed with the values and uncertainties of the mechanism
file. Each contact reduces their uncertainty (Kalman 1960). As long as the rig does not change, the deviations
from the prediction, divided by their predicted standard deviation, are independent with mean 0 and variance
1. This holds even if the file's values are wrong within their uncertainty.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from tuning.identification.monitor.metrics import BIAS_INDEX, METRIC_NAMES, NOISE_INDEX

NOISE_LEVEL_STD = 0.1  # day-to-day variation of the force noise's level (relative standard deviation)
# probability that `covers` is true for metrics of a rig that agrees with the mechanism file
COVERAGE_PROBABILITY = 0.99


class MetricFilter:
    """Kalman filter that estimates the rig's parameters from the metrics of each contact.

    The state contains the deviations of the parameters from the mechanism file, divided by their standard
    deviations; the bias of the force sensor [N]; and the relative increase of the sensor's noise.
    """

    def __init__(self, correlation: np.ndarray, noise_std: float):
        number = len(correlation)
        self.initial_covariance = np.zeros((number + 2, number + 2))
        self.initial_covariance[:number, :number] = correlation
        # After taring, the bias is assumed to be about as large as the noise.
        self.initial_covariance[number:, number:] = np.diag([noise_std**2, NOISE_LEVEL_STD**2])
        self.mean, self.covariance = np.zeros(number + 2), self.initial_covariance

    def deviation(
        self, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the deviation of the metrics from their prediction, and its predicted standard deviation.

        Args:
            value: Metrics of the contact.
            slopes: Derivatives of the metrics with respect to the parameters.
            noise: Covariance of the metrics due to the noise of the readings.
        """
        slopes = _append_sensor_columns(slopes)
        spread = slopes @ self.covariance @ slopes.T + noise
        return value - slopes @ self.mean, np.sqrt(np.diag(spread))

    def learn(self, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray) -> None:
        """Update the state with the metrics of one contact."""
        finite, slopes = np.isfinite(value), _append_sensor_columns(slopes)
        slopes, noise = slopes[finite], noise[np.ix_(finite, finite)]
        spread = slopes @ self.covariance @ slopes.T + noise
        gain = _solve_normalised(spread, slopes @ self.covariance).T
        self.mean = self.mean + gain @ (value[finite] - slopes @ self.mean)
        remainder = np.eye(len(self.mean)) - gain @ slopes
        self.covariance = remainder @ self.covariance @ remainder.T + gain @ noise @ gain.T

    def covers(self, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray) -> bool:
        """Return whether the uncertainty of the mechanism file explains the metrics."""
        finite, slopes = np.isfinite(value), _append_sensor_columns(slopes)
        slopes, noise = slopes[finite], noise[np.ix_(finite, finite)]
        spread = slopes @ self.initial_covariance @ slopes.T + noise
        deviation = value[finite]
        return bool(
            deviation @ _solve_normalised(spread, deviation)
            <= stats.chi2.ppf(COVERAGE_PROBABILITY, finite.sum())
        )


def _append_sensor_columns(slopes: np.ndarray) -> np.ndarray:
    """Append columns to the metrics' derivatives: those with respect to the sensor's bias and noise."""
    sensor_columns = np.zeros((len(METRIC_NAMES), 2))
    sensor_columns[BIAS_INDEX, 0] = sensor_columns[NOISE_INDEX, 1] = 1.0
    return np.concatenate([slopes, sensor_columns], axis=1)


def _solve_normalised(spread: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve `spread` x = `right` for x; the covariance matrix is first scaled to a correlation matrix."""
    size = np.sqrt(np.diag(spread))
    scaled = right / (size[:, None] if right.ndim > 1 else size)
    solution = np.linalg.solve(spread / np.outer(size, size), scaled)
    return solution / (size[:, None] if right.ndim > 1 else size)
