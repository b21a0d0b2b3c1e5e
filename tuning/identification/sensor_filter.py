"""Response of a force sensor with a low-pass filter over one control period, in closed form.

A sensor with a lag integrates the force between two readings. A smooth force is approximated by the parabola
through its values at the beginning, in the middle and at the end of the period. At the onset of a damped
contact, the force jumps, which requires other weights. A filter of higher order is a weighted sum of lags
with complex rates (`jaxhil.mechanism.sensor_filter`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.signal import lfilter

from jaxhil.mechanism.sensor_filter import FilterModes
from tuning.identification.drifting_noise import LONG_FILTER, subtract_weighted_mean
from tuning.identification.nearby_rows import Onsets


def apply_filter(
    modes: FilterModes,
    rate: float,
    tables: list[np.ndarray],
    whitening: tuple[float, ...],
    onsets: Onsets | None = None,
    first: np.ndarray | None = None,
    lost: np.ndarray | None = None,
) -> np.ndarray:
    """Apply a low-pass filter and a whitening filter to forces or regressors, along the last axis (rows).

    Args:
        modes: Parallel form of the filter.
        rate: Control period multiplied by the filter's angular cutoff frequency.
        tables: Forces at the times of the rows, and forces half a period earlier, of the same shape.
        whitening: Coefficients of the whitening filter.
        onsets: Onsets of contact between two rows, or None.
        first: Forces just after the onsets, shape (regressors, onsets), or None without onsets.
        lost: Flags of the rows whose reading is lost (`subtract_weighted_mean`), or None.
    """
    total: Any = 0.0
    for mode_rate, weight in zip(modes.rates, modes.weights, strict=True):
        mode = rate * (mode_rate if mode_rate.imag else mode_rate.real)
        pole, (now, half, last) = compute_lag_weights(mode)
        drive = now * tables[0] + half * tables[1]
        drive[..., 1:] += last * tables[0][..., :-1]
        if onsets is not None:
            after, end = compute_onset_weights(mode, onsets.share)
            then = tables[0][onsets.plane, :, onsets.row].T
            drive[onsets.plane, :, onsets.row] = (after * first + end * then).T
        lagged: Any
        if len(whitening) > LONG_FILTER:
            lagged = np.asarray(lfilter([1.0], [1.0, -pole], drive))
            lagged = subtract_weighted_mean(lagged, whitening, lost)
        else:
            lagged = lfilter(whitening, [1.0, -pole], drive)
        total = total + (weight * lagged if weight.imag else weight.real * lagged).real
    return total


def compute_lag_weights(rate: Any) -> tuple[Any, tuple[Any, Any, Any]]:
    """Return the pole of a sampled first-order lag, and the weights of the force during a control period.

    The new reading is the pole times the previous reading, plus the weighted sum of three forces. The sum is
    exact if the force is a parabola in time.

    Args:
        rate: Control period divided by the time constant; may be complex.

    Returns:
        The pole, and the weights of the force at the end, in the middle and at the beginning of the period.
    """
    pole = np.exp(-rate).item()
    # Moments of order 0, 1 and 2 of rate exp(-(1 - s) rate) over s = 0..1.
    first = 1.0 - pole
    second = 1.0 - first / rate
    third = 1.0 - 2.0 * second / rate
    last, half, now = np.linalg.solve(
        [[1.0, 1.0, 1.0], [0.0, 0.5, 1.0], [0.0, 0.25, 1.0]], [first, second, third]
    )
    return pole, (now.item(), half.item(), last.item())


def compute_onset_weights(rate: Any, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of the forces just after an onset of contact and at the end of the control period.

    The weighted sum of both forces is the change of the reading during the period, if the force is 0 before
    the onset and linear in time after the onset.

    Args:
        rate: Control period divided by the time constant; may be complex.
        left: Share of the period after the onset.
    """
    total = -np.expm1(-rate * left)
    end = 1.0 - total / (rate * left)
    return total - end, end


def compute_onset_shares(
    last: np.ndarray, half: np.ndarray, now: np.ndarray, plane: np.ndarray
) -> np.ndarray:
    """Return the share of a control period that lies after the onset of contact; 0 without an onset.

    The motion is linear in each half of the period.

    Args:
        last: Position at the beginning of the period [m].
        half: Position in the middle of the period [m].
        now: Position at the end of the period [m].
        plane: Position of the surface [m].
    """
    late = half <= plane
    start, stop = np.where(late, half, last), np.where(late, now, half)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = 0.5 * (stop - plane) / (stop - start) + np.where(late, 0.0, 0.5)
    return np.where((last <= plane) & (now > plane), left, 0.0)
