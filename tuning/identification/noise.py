"""Noise statistics of a sensor at rest: mean, standard deviation, quantum, dead zone and autocorrelation.

A reading that is rounded to a quantum determines only an interval of the signal. The estimates of mean and
standard deviation therefore maximise the likelihood of the number of readings at each multiple of the
quantum. They are correct even if the noise is smaller than the quantum. Coloured noise is modelled as an
autoregression (Yule-Walker equations, order by the Bayesian information criterion); the inverse of the model
whitens the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, optimize, special
from scipy.signal import lfilter

from tuning.identification.hidden_noise import (
    MIN_READINGS_BEYOND_DEAD_ZONE,
    HiddenNoise,
    estimate_hidden_noise,
)

MAX_AUTOREGRESSION_ORDER = 8  # maximum order of the autoregression
MAX_DISTINCT_SHARE = 0.2  # maximum number of distinct values per reading in rounded readings
MIN_EXCESS_ZERO_SHARE = 0.02  # minimum share of exact zeros, beyond those from rounding, for a dead zone
# Maximum scatter of readings in contact that shows no noise, divided by the scatter from rounding, and by the
# largest reading.
MAX_ROUNDING_RATIO, MAX_SCATTER_SHARE = 2.0, 1e-4
MIN_LOUD_SHARE = 0.1  # share of the largest reading above which a reading is in contact
MIN_ZERO_SHARE = 0.5  # minimum share of exact zeros that indicates a dead zone without further tests


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise statistics of one sensor, estimated from readings at rest, in the unit of the readings."""

    mean: float  # mean of the readings; 0 if a dead zone hides it
    std: float  # standard deviation of the noise before rounding
    mean_std: float  # standard error of the mean
    std_std: float  # standard error of the standard deviation
    quantum: float  # step of rounded readings; 0 if they are not rounded
    silent: bool  # whether a dead zone hides the noise; the mean is then unknown
    filter: tuple[float, ...]  # coefficients of the whitening filter; the first one is 1
    number: int  # number of readings
    drift: float = 0.0  # change from the first to the last reading; 0 if it is smaller than the noise
    hidden: HiddenNoise | None = None  # noise, bias and dead zone, if a dead zone hides the noise
    # random walk of the bias, per sqrt(s), and its standard error; None if the bias is assumed to be constant
    walk: tuple[float, float] | None = None
    bias_step: float = 0.0  # standard deviation of the change of the bias between two readings

    @property
    def pole(self) -> float:
        """Return the largest magnitude of the poles of the noise model; 0 for white noise."""
        return float(max(np.abs(np.roots(self.filter)), default=0.0))

    @property
    def innovation(self) -> float:
        """Return the standard deviation of the noise after whitening, in the unit of the readings."""
        if self.walk is not None:
            # The bias that the whitening filter expects has the variance `std` times `bias_step`.
            return float(np.hypot(self.std, np.sqrt(self.std * self.bias_step)))
        return self.std * float(np.sqrt(compute_whitened_share(self.filter)))


def estimate_noise(readings: np.ndarray) -> NoiseEstimate:
    """Estimate the noise statistics of a sensor from at least 20 finite readings at successive ticks."""
    quantum = detect_quantum(readings)
    number = len(readings)
    if _has_excess_zeros(readings, quantum):
        hidden = estimate_hidden_noise(readings, quantum)
        std = 0.0 if hidden is None else hidden.std
        # A few readings beyond a dead zone may be equal by chance.
        if np.count_nonzero(readings) < MIN_READINGS_BEYOND_DEAD_ZONE:
            quantum = 0.0
        return NoiseEstimate(0.0, std, np.inf, np.inf, quantum, True, (1.0,), number, 0.0, hidden)
    if np.ptp(readings) == 0.0:
        return NoiseEstimate(float(readings[0]), 0.0, 0.0, 0.0, quantum, False, (1.0,), number)
    drift = _estimate_drift(readings)
    readings = readings - drift * (np.arange(number) / (number - 1.0) - 0.5)
    rounded = quantum and not drift
    mean, std = _fit_rounded_normal(readings, quantum) if rounded else (readings.mean(), readings.std(ddof=1))
    whitening = fit_whitening_filter(readings - mean)
    # The standard error of the mean of correlated readings follows from the noise spectrum at 0 Hz.
    at_zero = np.sqrt(compute_whitened_share(whitening)) / abs(np.sum(whitening))
    effective = 1.0 + 2.0 * np.sum(autocorrelate(whitening) ** 2)
    # Rounding increases the scatter of the readings.
    width = np.hypot(std, quantum / np.sqrt(12.0))
    return NoiseEstimate(
        float(mean),
        float(std),
        float(width * at_zero / np.sqrt(number)),
        float(width * np.sqrt(effective / (2.0 * number))),
        quantum,
        False,
        whitening,
        number,
        drift,
    )


def recognise_noise_free_readings(noise: NoiseEstimate, contacts: Sequence[np.ndarray]) -> NoiseEstimate:
    """Return the noise of a sensor with constant readings at rest.

    Either a dead zone hides the noise at rest, or there is no noise. The scatter of the readings in contact
    distinguishes these cases.

    Args:
        noise: Noise at rest.
        contacts: Readings of each run in contact at successive ticks.

    Returns:
        The noise at rest without a dead zone if the readings in contact show no noise; otherwise, `noise`.
    """
    if noise.std > 0.0 or not contacts:
        return noise
    readings = np.concatenate(contacts)
    quantum, largest = detect_quantum(readings), float(np.abs(readings).max(initial=0.0))
    steps = [np.diff(force, 3)[np.abs(force[3:]) > MIN_LOUD_SHARE * largest] for force in contacts]
    # Third differences nearly remove a smooth force, and multiply the variance of white noise by 20.
    scatter = 1.4826 * float(np.median(np.abs(np.concatenate(steps)))) / np.sqrt(20.0)
    rounding = max(quantum, noise.quantum) / np.sqrt(12.0)
    if noise.silent and not scatter <= max(MAX_ROUNDING_RATIO * rounding, MAX_SCATTER_SHARE * largest):
        return noise
    error = max(rounding, MAX_SCATTER_SHARE * largest)
    return replace(noise, silent=False, quantum=max(quantum, noise.quantum), mean_std=error, std_std=0.0)


def _has_excess_zeros(readings: np.ndarray, quantum: float) -> bool:
    """Return whether more readings are exactly 0 than noise and rounding can explain."""
    zero = readings == 0.0
    if np.mean(zero) > MIN_ZERO_SHARE and (quantum == 0.0 or np.ptp(readings) < 1.5 * quantum):
        return True
    size = float(np.sqrt(np.mean(readings[~zero] ** 2))) if not zero.all() else 0.0
    # Rounding changes at most a share of 0.4 quantum / std of the readings to 0.
    return size > 0.0 and float(np.mean(zero)) > MIN_EXCESS_ZERO_SHARE + quantum / size


def _estimate_drift(readings: np.ndarray) -> float:
    """Return the linear drift from the first to the last reading, or 0 if it is smaller than the noise."""
    time = np.linspace(-0.5, 0.5, len(readings))
    drift = float(time @ (readings - readings.mean()) / (time @ time))
    return drift if abs(drift) > np.std(readings - drift * time) else 0.0


def detect_quantum(readings: np.ndarray) -> float:
    """Return the quantum to which the readings are rounded, or 0 if they are not rounded."""
    values = np.unique(readings[np.isfinite(readings)])
    if len(values) < 2 or len(values) > MAX_DISTINCT_SHARE * len(readings):
        return 0.0
    scale = np.abs(values).max()
    # A dead zone shifts positive and negative readings, so both signs are treated separately.
    sides = [values[values > 1e-12 * scale], values[values < -1e-12 * scale]]
    gaps = np.concatenate([np.diff(side) for side in sides])
    gaps = gaps[gaps > 1e-9 * scale]
    if not len(gaps):
        return float(np.diff(values).min())
    quantum = gaps.min()
    multiples = np.round(gaps / quantum)
    quantum = gaps.sum() / multiples.sum()
    return float(quantum) if np.all(np.abs(gaps / quantum - multiples) < 0.02) else 0.0


def detect_resolution(values: np.ndarray) -> float:
    """Return the step to whose multiples the values are rounded, or 0 if they are not rounded."""
    steps = np.diff(np.unique(values[np.isfinite(values)]))
    if not len(steps):
        return 0.0
    least = float(np.min(steps))
    return least if np.median(np.abs(steps / least - np.rint(steps / least))) < 0.01 else 0.0


def _fit_rounded_normal(readings: np.ndarray, quantum: float) -> tuple[float, float]:
    """Estimate mean and standard deviation of rounded normal values by maximum likelihood."""
    values, counts = np.unique(np.round(readings / quantum), return_counts=True)
    middle, spread = np.average(values, weights=counts), readings.std() / quantum

    def cost(parameters):
        mean, std = parameters[0], np.exp(parameters[1])
        high, low = (values + 0.5 - mean) / std, (values - 0.5 - mean) / std
        # Use the symmetry for the upper tail, because differences of values near 1 lose digits.
        flip = low > 0.0
        high, low = np.where(flip, -low, high), np.where(flip, -high, low)
        log = special.log_ndtr(high) + np.log1p(
            -np.exp(np.minimum(special.log_ndtr(low) - special.log_ndtr(high), -1e-15))
        )
        return -np.sum(counts * log)

    optimum = optimize.minimize(cost, [middle, np.log(max(spread, 0.2))], method="Nelder-Mead",
                              options={"xatol": 1e-5, "fatol": 1e-6})  # fmt: skip
    return float(optimum.x[0] * quantum), float(np.exp(optimum.x[1]) * quantum)


def fit_whitening_filter(values: np.ndarray) -> tuple[float, ...]:
    """Fit an autoregressive model (a1, a2, ...) and return its whitening filter (1, -a1, -a2, ...)."""
    number = len(values)
    size = 1 << int(np.ceil(np.log2(2 * number)))
    power = np.abs(np.fft.rfft(values, size)) ** 2
    covariance = np.fft.irfft(power, size)[: MAX_AUTOREGRESSION_ORDER + 1] / number
    if covariance[0] <= 0.0:
        return (1.0,)
    best, chosen = 0.0, (1.0,)
    for order in range(1, MAX_AUTOREGRESSION_ORDER + 1):
        coefficients = linalg.solve_toeplitz(covariance[:order], covariance[1 : order + 1])
        variance = 1.0 - coefficients @ covariance[1 : order + 1] / covariance[0]
        criterion = number * np.log(max(variance, 1e-12)) + order * np.log(number)
        if criterion < best:
            best, chosen = criterion, (1.0, *(-coefficients))
    return tuple(float(value) for value in chosen)


def autocorrelate(whitening: tuple[float, ...], longest: int = 200) -> np.ndarray:
    """Return the autocorrelation at lags 1 to `longest` of noise that the filter `whitening` makes white."""
    if len(whitening) == 1:
        return np.zeros(1)
    impulse = np.zeros(4 * longest)
    impulse[0] = 1.0

    response = lfilter([1.0], whitening, impulse)
    correlation = np.correlate(response, response, "full")[len(response) - 1 :]
    return correlation[1 : longest + 1] / correlation[0]


def compute_whitened_share(whitening: tuple[float, ...]) -> float:
    """Return the variance of the noise after whitening, divided by the variance before whitening."""
    if len(whitening) == 1:
        return 1.0
    rho = np.concatenate([[1.0], autocorrelate(whitening)])[: len(whitening)]
    return float(1.0 + np.asarray(whitening[1:]) @ rho[1:])
