"""Sensors at rest: noise, bias, quantum, dead zone, and the noise's colour.

A reading that is rounded to multiples of a quantum says between which two numbers the signal was; mean and
standard deviation are those under which the counts of the multiples are most likely, which stays right where
the noise is smaller than the quantum. Coloured noise is an autoregression (Yule and Walker's equations, the
order by the Bayesian information criterion); its inverse makes residuals white.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize, special
from scipy.signal import lfilter

HIGHEST = 8  # order of the autoregression
FEWEST_BEYOND = 20  # readings beyond a dead zone, from which they tell it
REPEATED = 0.2  # distinct values over readings, below which values come in steps
ROUNDED_TO_0 = 0.02  # share of exact zeros beyond those of rounding, from which a dead zone makes them
GAP = 0.3  # of the mean reading beyond a dead zone, above which no reading of this kind is the smallest
SILENT = 0.5  # share of exact zeros from which a reading is that of a dead zone


@dataclass(frozen=True)
class Noise:
    """One sensor's readings where nothing moves."""

    mean: float  # of the readings, in their unit
    std: float
    mean_std: float  # standard error of the mean
    std_std: float  # and of the standard deviation
    quantum: float  # 0 where readings come in no steps
    silent: bool  # a dead zone hides some or all of the readings: the mean is unknown
    filter: tuple[float, ...]  # makes the noise white, its first coefficient 1
    number: int  # readings
    drift: float = 0.0  # of the readings, from the first to the last; 0 where it is lost in the noise
    dead_zone: tuple[float, float] | None = None  # less the bias, and its standard error, where readings tell

    @property
    def pole(self) -> float:
        """Largest magnitude of the noise's poles; 0 for white noise."""
        return float(max(np.abs(np.roots(self.filter)), default=0.0))

    @property
    def innovation(self) -> float:
        """Standard deviation [their unit] of what the filter leaves."""
        return self.std * float(np.sqrt(whitened_share(self.filter)))


def at_rest(readings: np.ndarray) -> Noise:
    """Of at least 20 readings on successive ticks, finite."""
    quantum = steps(readings)
    number = len(readings)
    if _is_hidden(readings, quantum):
        std, dead_zone = _beyond(readings)
        return Noise(0.0, std, np.inf, np.inf, quantum, True, (1.0,), number, 0.0, dead_zone)
    drift = _drift(readings)
    readings = readings - drift * (np.arange(number) / (number - 1.0) - 0.5)
    rounded = quantum and not drift
    mean, std = _binned(readings, quantum) if rounded else (readings.mean(), readings.std(ddof=1))
    colour = autoregression(readings - mean)
    # The mean of correlated readings is less certain, by what the noise holds at frequency 0.
    at_zero = np.sqrt(whitened_share(colour)) / abs(np.sum(colour))
    effective = 1.0 + 2.0 * np.sum(_correlations(colour) ** 2)
    # Rounding adds to what has to be told apart.
    width = np.hypot(std, quantum / np.sqrt(12.0))
    return Noise(
        float(mean),
        float(std),
        float(width * at_zero / np.sqrt(number)),
        float(width * np.sqrt(effective / (2.0 * number))),
        quantum,
        False,
        colour,
        number,
        drift,
    )


def _is_hidden(readings: np.ndarray, quantum: float) -> bool:
    """Tell whether more readings are exactly 0 than noise and rounding would make so."""
    zero = readings == 0.0
    if np.mean(zero) > SILENT and (quantum == 0.0 or np.ptp(readings) < 1.5 * quantum):
        return True
    size = float(np.sqrt(np.mean(readings[~zero] ** 2))) if not zero.all() else 0.0
    # Rounding makes at most 0.4 quanta over the standard deviation of normal readings 0.
    return size > 0.0 and float(np.mean(zero)) > ROUNDED_TO_0 + quantum / size


def _beyond(readings: np.ndarray) -> tuple[float, tuple[float, float] | None]:
    """Return the noise's standard deviation, and the dead zone with its error, by the noise beyond it.

    A normal number n is read as sign(n) max(|n| - D, 0): the maximum of the likelihood over D and the
    standard deviation, of a bias of 0. Readings that leave a gap around 0 have a dead zone of another kind.
    """
    size = np.abs(readings[readings != 0.0])
    zeros, number = len(readings) - len(size), len(size)
    if number < FEWEST_BEYOND or size.min() > GAP * size.mean():
        return 0.0, None

    def cost(parameters):
        dead_zone, std = np.exp(parameters)
        hidden = special.log_ndtr(-dead_zone / std)
        inside = np.log(-np.expm1(np.log(2.0) + hidden)) if hidden < -np.log(2.0) else -np.inf
        return -zeros * inside + 0.5 * np.sum(((size + dead_zone) / std) ** 2) + number * np.log(std)

    start = np.log([size.mean(), 2.0 * size.mean()])
    found = optimize.minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-8})
    dead_zone, std = np.exp(found.x)
    # The curvature of the likelihood, by central differences.
    step = 1e-3
    shifts = step * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1], [1, 0], [-1, 0], [0, 1], [0, -1]])
    both, up, down, neither, a, b, c, d = (cost(found.x + shift) for shift in shifts)
    across = (both - up - down + neither) / 4.0
    curvature = np.array([[a + b - 2 * found.fun, across], [across, c + d - 2 * found.fun]]) / step**2
    variance = float(np.linalg.inv(curvature)[0, 0])
    if not variance > 0.0:
        return 0.0, None
    return float(std), (float(dead_zone), float(dead_zone * np.sqrt(variance)))


def _drift(readings: np.ndarray) -> float:
    """From the first to the last, by a straight line, where that is more than what is left scatters."""
    time = np.linspace(-0.5, 0.5, len(readings))
    drift = float(time @ (readings - readings.mean()) / (time @ time))
    return drift if abs(drift) > np.std(readings - drift * time) else 0.0


def steps(readings: np.ndarray) -> float:
    """The quantum to whose multiples readings are rounded, 0 where there is none."""
    values = np.unique(readings[np.isfinite(readings)])
    if len(values) < 2 or len(values) > REPEATED * len(readings):
        return 0.0
    scale = np.abs(values).max()
    # A dead zone shifts the multiples on either side of 0 apart.
    sides = [values[values > 1e-12 * scale], values[values < -1e-12 * scale]]
    gaps = np.concatenate([np.diff(side) for side in sides])
    gaps = gaps[gaps > 1e-9 * scale]
    if not len(gaps):
        return float(np.diff(values).min())
    quantum = gaps.min()
    multiples = np.round(gaps / quantum)
    quantum = gaps.sum() / multiples.sum()
    return float(quantum) if np.all(np.abs(gaps / quantum - multiples) < 0.02) else 0.0


def _binned(readings: np.ndarray, quantum: float) -> tuple[float, float]:
    """Mean and standard deviation of greatest likelihood of a rounded normal number."""
    values, counts = np.unique(np.round(readings / quantum), return_counts=True)
    middle, spread = np.average(values, weights=counts), readings.std() / quantum

    def cost(parameters):
        mean, std = parameters[0], np.exp(parameters[1])
        high, low = (values + 0.5 - mean) / std, (values - 0.5 - mean) / std
        # The upper tail by symmetry: differences of numbers near 1 lose digits.
        flip = low > 0.0
        high, low = np.where(flip, -low, high), np.where(flip, -high, low)
        log = special.log_ndtr(high) + np.log1p(
            -np.exp(np.minimum(special.log_ndtr(low) - special.log_ndtr(high), -1e-15))
        )
        return -np.sum(counts * log)

    found = optimize.minimize(cost, [middle, np.log(max(spread, 0.2))], method="Nelder-Mead",
                              options={"xatol": 1e-5, "fatol": 1e-6})  # fmt: skip
    return float(found.x[0] * quantum), float(np.exp(found.x[1]) * quantum)


def autoregression(values: np.ndarray) -> tuple[float, ...]:
    """Coefficients (1, -a1, -a2, ...) of the filter that makes the values white."""
    number = len(values)
    size = 1 << int(np.ceil(np.log2(2 * number)))
    power = np.abs(np.fft.rfft(values, size)) ** 2
    covariance = np.fft.irfft(power, size)[: HIGHEST + 1] / number
    if covariance[0] <= 0.0:
        return (1.0,)
    best, chosen = 0.0, (1.0,)
    for order in range(1, HIGHEST + 1):
        coefficients = linalg.solve_toeplitz(covariance[:order], covariance[1 : order + 1])
        variance = 1.0 - coefficients @ covariance[1 : order + 1] / covariance[0]
        criterion = number * np.log(max(variance, 1e-12)) + order * np.log(number)
        if criterion < best:
            best, chosen = criterion, (1.0, *(-coefficients))
    return tuple(float(value) for value in chosen)


def _correlations(colour: tuple[float, ...], longest: int = 200) -> np.ndarray:
    """Autocorrelation of the noise at lags 1, 2, ... ."""
    if len(colour) == 1:
        return np.zeros(1)
    impulse = np.zeros(4 * longest)
    impulse[0] = 1.0

    answer = lfilter([1.0], colour, impulse)
    every = np.correlate(answer, answer, "full")[len(answer) - 1 :]
    return every[1 : longest + 1] / every[0]


def whitened_share(colour: tuple[float, ...]) -> float:
    """Variance after the whitening filter over that before it."""
    if len(colour) == 1:
        return 1.0
    rho = np.concatenate([[1.0], _correlations(colour)])[: len(colour)]
    return float(1.0 + np.asarray(colour[1:]) @ rho[1:])
