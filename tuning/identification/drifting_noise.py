"""Noise of a force sensor at rest whose bias drifts: white noise plus a random walk of the bias.

The differences of successive readings are a moving average e(n) - p e(n-1) of white noise e, with a pole p
between 0 and 1. The steps of the bias have the standard deviation (1 - p) std(e), and the white noise has the
variance p var(e). The filter (1 - z^-1)/(1 - p z^-1) whitens the readings; it subtracts the exponentially
weighted mean of earlier readings. Without its response to old readings, it has finite length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import optimize
from scipy.signal import lfilter

from tuning.identification.noise import NoiseEstimate, detect_quantum, estimate_noise

DRIFT_TIME = 1.0  # time in which a random walk exceeds the noise, if it is not stated [s]
MIN_LIKELIHOOD_GAIN = 10.0  # smallest gain of the log-likelihood from a random walk that is not stated
STATED_LOG_STD = 1.0  # standard deviation of the logarithm of the drift that the mechanism states
FORGOTTEN_SHARE = 0.005  # weight of the readings that the whitening filter leaves out
MAX_FILTER_LENGTH = 200  # largest number of coefficients of the whitening filter
# Number of coefficients above which a whitening filter is one of this module; autoregressions are shorter.
LONG_FILTER = 16
LOG_GAIN_RANGE = -9.0, -0.01  # range of log(1 - p)


def estimate_force_noise(readings: np.ndarray, period: float, stated: float) -> NoiseEstimate:
    """Estimate the noise at rest, with a random walk of the bias if the mechanism states one.

    If the mechanism states none, the bias has a random walk if two conditions are met: within `DRIFT_TIME`,
    the walk exceeds the noise, and it explains the readings better than a linear drift and an autoregression.
    """
    if stated:
        return estimate_drifting_noise(readings, period, stated)
    steady = estimate_noise(readings)
    if steady.silent or steady.std == 0.0 or len(readings) < 2 * MAX_FILTER_LENGTH:
        return steady
    rate = float(np.std(readings)) / math.sqrt(period * len(readings))
    drifting, (walk, _) = _fit_random_walk(readings, period, rate)
    if walk * math.sqrt(DRIFT_TIME) < drifting.std:
        return steady
    line = steady.mean + steady.drift * np.linspace(-0.5, 0.5, len(readings))
    with_walk, without = (
        float(np.std(lfilter(noise.filter, [1.0], readings - bias)[MAX_FILTER_LENGTH:]))
        for noise, bias in ((drifting, drifting.mean), (steady, line))
    )
    # Both are 0 if the readings change only at the beginning.
    is_better = without > with_walk * math.exp(MIN_LIKELIHOOD_GAIN / len(readings))
    return drifting if is_better else steady


def estimate_drifting_noise(readings: np.ndarray, period: float, stated: float) -> NoiseEstimate:
    """Estimate white noise and random walk of the bias from readings at rest at successive ticks.

    Args:
        readings: At least 20 finite readings.
        period: Time between readings [s].
        stated: Random walk that the mechanism states, above 0, in units of the readings per sqrt(s).

    Returns:
        The noise, with the random walk; without it if a dead zone hides the noise, or if there is no noise.
        The mean is the bias at the first reading.
    """
    steady = estimate_noise(readings)
    if steady.silent or steady.std == 0.0:
        return steady
    return _fit_random_walk(readings, period, stated)[0]


def whiten(values: np.ndarray, whitening: Sequence[float], lost: np.ndarray) -> np.ndarray:
    """Apply a whitening filter of any length along the last axis; see `subtract_weighted_mean` for `lost`."""
    if len(whitening) > LONG_FILTER:
        return subtract_weighted_mean(values, whitening, lost)
    filtered = values.copy() if len(whitening) > 1 else values
    for lag, weight in enumerate(whitening[1:], 1):
        filtered[..., lag:] += weight * values[..., :-lag]
    return filtered


def subtract_weighted_mean(
    values: np.ndarray, whitening: Sequence[float], lost: np.ndarray | None = None
) -> np.ndarray:
    """Apply a whitening filter of this module along the last axis, as fast as a filter of first order.

    Args:
        values: Values, shape (..., rows) or (..., lanes, rows).
        whitening: Coefficients of the filter.
        lost: Flags of the lost readings, shape (rows,) or (lanes, rows), or None. The filter skips them, and
            their result is 0. The mean then covers a slightly longer time, in which the bias hardly drifts.
    """
    if lost is not None and lost.any():
        result = np.zeros_like(values)
        for lane, flags in enumerate(np.atleast_2d(lost)):
            part = values if lost.ndim == 1 else values[..., lane, :]
            filtered = subtract_weighted_mean(part[..., ~flags], whitening)
            (result if lost.ndim == 1 else result[..., lane, :])[..., ~flags] = filtered
        return result
    length, gain, pole = len(whitening), -whitening[1], whitening[2] / whitening[1]
    total: Any = lfilter([gain], [1.0, -pole], values)
    result = values.copy()
    result[..., 1:] -= total[..., :-1]
    result[..., length:] += pole ** (length - 1) * total[..., :-length]
    return result


def _fit_random_walk(
    readings: np.ndarray, period: float, stated: float
) -> tuple[NoiseEstimate, tuple[float, float]]:
    """Return the noise of readings that are not constant, and its random walk with the standard error."""
    steps, number, root = np.diff(readings), len(readings), math.sqrt(period)

    def innovations(log_gain: float) -> float:
        """Return the standard deviation of e for a given log(1 - p)."""
        pole = -math.expm1(log_gain)
        return float(np.std(lfilter([1.0], [1.0, -pole], steps)[1:]))

    def cost(log_gain: float) -> float:
        std = innovations(log_gain)
        surprise = (log_gain + math.log(std / root / stated)) / STATED_LOG_STD
        return number * math.log(std) + 0.5 * surprise**2

    optimum: Any = optimize.minimize_scalar(
        cost, bounds=LOG_GAIN_RANGE, method="bounded", options={"xatol": 1e-4}
    )
    best = float(optimum.x)
    step = 0.3
    curvature = (cost(best + step) - 2.0 * cost(best) + cost(best - step)) / step**2
    log_std = 1.0 / math.sqrt(max(curvature, 1.0 / STATED_LOG_STD**2))
    gain, std = math.exp(best), innovations(best)
    pole, quantum = 1.0 - gain, detect_quantum(readings)
    # Rounding adds to the white noise.
    white = math.sqrt(max(pole * std**2 - quantum**2 / 12.0, 0.01 * pole * std**2))
    weights = gain * pole ** np.arange(number)
    length = min(math.ceil(math.log(FORGOTTEN_SHARE) / math.log(pole)) + 1, MAX_FILTER_LENGTH)
    walk = gain * std / root, gain * std / root * log_std
    noise = NoiseEstimate(
        mean=float(weights @ readings / weights.sum()),
        std=white,
        mean_std=white * math.sqrt(gain),
        std_std=white / math.sqrt(2.0 * number),
        quantum=quantum,
        silent=False,
        filter=(1.0, *(-weights[: length - 1]).tolist()),
        number=number,
        walk=walk,
        bias_step=gain * std,
    )
    return noise, walk
