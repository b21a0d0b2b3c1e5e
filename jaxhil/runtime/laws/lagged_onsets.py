"""Where a surface was met by each of several lags: `lagged_onset` in NumPy, all lags and places at a time."""

import numpy as np

from .lagged_onset import AFTER, BEFORE, DAMPING_VARIANCE, PLACES
from .onset import SQUARINGS, STIFFNESS, STIFFNESS_VARIANCE, exponential

_STEPS = np.arange(PLACES, dtype=float) / (PLACES - 1)


def lagged_onsets(
    lags: np.ndarray, depths: list[float], forces: list[float], variance: float, tick: float
) -> tuple[np.ndarray, np.ndarray]:
    """Of each lag [s] the mean and the variance of the place [s], from readings at depths beyond where the
    surface was met by them alone; the forces' variance [1/s^2], a tick [s]."""
    lag = lags[:, None]
    first = lag + BEFORE * tick
    width = first + AFTER * tick
    places = width * _STEPS - first
    s = np.array(depths)[:, None, None] - places
    force = np.array(forces)[:, None, None]
    beyond = s > 0.0
    s = np.where(beyond, s, 0.0)
    g = 1.0 - exponential(s / lag, SQUARINGS)
    q = s - lag * g
    weighted, weight = g / variance, q / variance
    # Sums over the readings, one after another; no force may be none of a number.
    a = 1.0 / DAMPING_VARIANCE + np.add.reduce(weighted * g, axis=0)
    b = np.add.reduce(weighted * q, axis=0)
    c = 1.0 / STIFFNESS_VARIANCE + np.add.reduce(weight * q, axis=0)
    y = np.add.reduce(np.where(beyond, weighted * force, 0.0), axis=0)
    z = STIFFNESS / STIFFNESS_VARIANCE + np.add.reduce(np.where(beyond, weight * force, 0.0), axis=0)
    determinant = a * c - b * b
    explained = 0.5 * ((c * y * y - 2.0 * (b * y * z) + a * z * z) / determinant)
    most = np.fmax.reduce(explained, axis=1, initial=-np.inf)[:, None]
    likely = exponential(most - explained, SQUARINGS) / np.sqrt(determinant)
    total = _of_places(likely)
    mean = _of_places(likely * places) / total
    square = _of_places(likely * (places * places)) / total
    step = width[:, 0] / (PLACES - 1)
    return mean, square - mean * mean + step * step / 12.0


def _of_places(values: np.ndarray) -> np.ndarray:
    """The sum of each lag, one place after another."""
    return np.add.accumulate(values, axis=1)[:, -1]
