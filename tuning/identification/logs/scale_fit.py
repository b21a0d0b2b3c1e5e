"""Robust fit of one signal as a multiple of another one, with the error of the factor."""

from __future__ import annotations

import numpy as np

FAR = 6.0  # times the median error, beyond which a row is left out
KEPT = 0.7  # share of rows that a fit must keep
ROUNDS = 4  # of leaving rows out


class Scale:
    """Fit of one signal as a multiple of another one."""

    def __init__(self, slope: float, left: float, rms: float, error: float, rows: float):
        self.slope = slope
        self.left = left  # rms of what it leaves, over the signal's own
        self.rms = rms  # of what it leaves
        self.error = error  # standard error of the slope
        self.rows = rows  # that were kept, less those that others tell by the correlation of errors


def scale(signal: np.ndarray, unit: np.ndarray, width: int = 1) -> Scale | None:
    """Fit signal = slope * unit, rows that are far off left out; None if one of them is 0 throughout.

    Errors of rows up to twice `width` apart may be correlated."""
    kept = np.ones(len(signal), bool)
    slope = 0.0
    for _ in range(ROUNDS):
        power = float(unit[kept] @ unit[kept])
        if power == 0.0 or not np.any(signal[kept]):
            return None
        slope = float(signal[kept] @ unit[kept]) / power
        error = np.abs(signal - slope * unit)
        again = error <= FAR * max(float(np.median(error)), 1e-300)
        if np.mean(again) < KEPT or np.array_equal(again, kept):
            break
        kept = again
    left = signal[kept] - slope * unit[kept]
    rms, own = (float(np.sqrt(np.mean(values**2))) for values in (left, signal[kept]))
    power, alike = float(unit[kept] @ unit[kept]), _correlated(left, 2 * width)
    error = rms * np.sqrt(alike / power) if power else np.inf
    return Scale(slope, rms / own if own else np.inf, rms, error, len(left) / alike)


def _correlated(values: np.ndarray, longest: int) -> float:
    """Return the number of values that say as much as one that is independent of the others."""
    power = float(values @ values)
    if power == 0.0:
        return 1.0
    lags = range(1, min(longest, len(values) - 1) + 1)
    return 1.0 + 2.0 * sum(max(0.0, float(values[lag:] @ values[:-lag]) / power) for lag in lags)
