"""What the figures of the next contact will be, from the file's uncertainty and the contacts so far.

Figures change in proportion to the numbers behind them, which are normal about the file's and the same in all
contacts: each contact tells a little more of them (Kalman 1960, of states that stand still). So long as
nothing changes, deviations over their predicted standard deviation are independent from contact to contact,
with mean 0 and variance 1, whatever the file was off from the beginning within what it states.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from tuning.identification.monitor.figures import BIAS, NAMES, NOISE

LOUDER = 0.1  # standard deviation of a day's noise about the file's, over it
COVERED = 0.99  # of what the file states to be possible


class Prediction:
    """Means and covariance of the numbers behind the figures: those of the file in standard deviations, then
    the sensor's bias [N] and the share by which its noise is larger."""

    def __init__(self, correlation: np.ndarray, noise_std: float):
        number = len(correlation)
        self.begun = np.zeros((number + 2, number + 2))
        self.begun[:number, :number] = correlation
        # A sensor that is tared each day is off by some of its noise.
        self.begun[number:, number:] = np.diag([noise_std**2, LOUDER**2])
        self.mean, self.covariance = np.zeros(number + 2), self.begun

    def deviation(
        self, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Figures less the predicted ones, and the predicted standard deviation. `slopes`: by the numbers of
        the file; `noise`: covariance of the figures, those given."""
        slopes = _with_sensor(slopes)
        spread = slopes @ self.covariance @ slopes.T + noise
        return value - slopes @ self.mean, np.sqrt(np.diag(spread))

    def learn(self, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray) -> None:
        """From one more contact."""
        known, slopes = np.isfinite(value), _with_sensor(slopes)
        slopes, noise = slopes[known], noise[np.ix_(known, known)]
        spread = slopes @ self.covariance @ slopes.T + noise
        gain = _solved(spread, slopes @ self.covariance).T
        self.mean = self.mean + gain @ (value[known] - slopes @ self.mean)
        kept = np.eye(len(self.mean)) - gain @ slopes
        self.covariance = kept @ self.covariance @ kept.T + gain @ noise @ gain.T

    def covers(self, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray) -> bool:
        """Whether figures are within the region of the file's numbers that holds nearly all of them."""
        known, slopes = np.isfinite(value), _with_sensor(slopes)
        slopes, noise = slopes[known], noise[np.ix_(known, known)]
        spread = slopes @ self.begun @ slopes.T + noise
        off = value[known]
        return bool(off @ _solved(spread, off) <= stats.chi2.ppf(COVERED, known.sum()))


def _with_sensor(slopes: np.ndarray) -> np.ndarray:
    """With columns for the sensor's bias and noise."""
    own = np.zeros((len(NAMES), 2))
    own[BIAS, 0] = own[NOISE, 1] = 1.0
    return np.concatenate([slopes, own], axis=1)


def _solved(spread: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Figures have units of very different sizes."""
    size = np.sqrt(np.diag(spread))
    scaled = right / (size[:, None] if right.ndim > 1 else size)
    found = np.linalg.solve(spread / np.outer(size, size), scaled)
    return found / (size[:, None] if right.ndim > 1 else size)
