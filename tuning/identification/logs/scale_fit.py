"""Robust fit of one signal as a multiple of another signal, with the standard error of the factor."""

from __future__ import annotations

import numpy as np

OUTLIER_RATIO = 6.0  # maximum ratio of an error to the median error; other rows are excluded
MIN_USED_SHARE = 0.7  # minimum share of the rows that a fit must use
OUTLIER_ITERATIONS = 4  # maximum number of iterations that exclude rows


class ScaleFit:
    """Fit of one signal as a multiple of another: the factor (slope), its standard error, and residuals."""

    def __init__(self, slope: float, left: float, rms: float, error: float, rows: float):
        self.slope = slope
        self.left = left  # ratio of the residual's rms to the signal's rms
        self.rms = rms  # rms of the residual, in the unit of the signal
        self.error = error  # standard error of the slope
        self.rows = rows  # effective number of rows; correlated errors reduce it


def fit_scale(signal: np.ndarray, unit: np.ndarray, width: int = 1) -> ScaleFit | None:
    """Fit signal = slope * unit by least squares, excluding outliers.

    Args:
        signal: Signal to fit.
        unit: Signal that is multiplied by the slope.
        width: Errors in rows up to 2 * `width` apart may be correlated.

    Returns:
        The fit, or None if one of the signals is 0 in all rows.
    """
    used = np.ones(len(signal), bool)
    slope = 0.0
    for _ in range(OUTLIER_ITERATIONS):
        power = float(unit[used] @ unit[used])
        if power == 0.0 or not np.any(signal[used]):
            return None
        slope = float(signal[used] @ unit[used]) / power
        error = np.abs(signal - slope * unit)
        again = error <= OUTLIER_RATIO * max(float(np.median(error)), 1e-300)
        if np.mean(again) < MIN_USED_SHARE or np.array_equal(again, used):
            break
        used = again
    left = signal[used] - slope * unit[used]
    rms, signal_rms = (float(np.sqrt(np.mean(values**2))) for values in (left, signal[used]))
    power, alike = float(unit[used] @ unit[used]), _count_correlated(left, 2 * width)
    error = rms * np.sqrt(alike / power) if power else np.inf
    return ScaleFit(slope, rms / signal_rms if signal_rms else np.inf, rms, error, len(left) / alike)


def _count_correlated(values: np.ndarray, longest: int) -> float:
    """Return how many of the correlated values contain as much information as one independent value."""
    power = float(values @ values)
    if power == 0.0:
        return 1.0
    lags = range(1, min(longest, len(values) - 1) + 1)
    return 1.0 + 2.0 * sum(max(0.0, float(values[lag:] @ values[:-lag]) / power) for lag in lags)
