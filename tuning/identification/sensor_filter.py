"""First-order lag of a force sensor over one control period, in closed form.

The lag integrates the force between two readings. A smooth force is approximated by the parabola through its
values at both ends and in the middle. At an onset of damped contact the force jumps; before the onset it is
0.
"""

from __future__ import annotations

import numpy as np


def compute_lag_weights(rate: float) -> tuple[float, tuple[float, float, float]]:
    """Return the pole of a sampled first-order lag and the weights of the force in a period.

    The weights are exact if the force is a parabola.

    Args:
        rate: Control period over the time constant.

    Returns:
        The pole, and the weights of the force at the end, in the middle and at the beginning of the period.
    """
    pole = float(np.exp(-rate))
    # Moments of rate exp(-(1 - s) rate) over s = 0..1.
    first = 1.0 - pole
    second = 1.0 - first / rate
    third = 1.0 - 2.0 * second / rate
    last, half, now = np.linalg.solve(
        [[1.0, 1.0, 1.0], [0.0, 0.5, 1.0], [0.0, 0.25, 1.0]], [first, second, third]
    )
    return pole, (float(now), float(half), float(last))


def compute_onset_weights(rate: float, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of the force just after an onset and at the end of the period.

    The force is 0 before the onset and linear in time after it.

    Args:
        rate: Control period over the time constant.
        left: Shares of the period that remain after the onset.
    """
    total = -np.expm1(-rate * left)
    end = 1.0 - total / (rate * left)
    return total - end, end


def compute_onset_shares(
    last: np.ndarray, half: np.ndarray, now: np.ndarray, plane: np.ndarray
) -> np.ndarray:
    """Return the share of the period after the position crosses the surface; 0 without a crossing.

    `last`, `half` and `now` are positions [m] at the beginning, in the middle and at the end of the period,
    with linear motion between them.
    """
    late = half <= plane
    start, stop = np.where(late, half, last), np.where(late, now, half)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = 0.5 * (stop - plane) / (stop - start) + np.where(late, 0.0, 0.5)
    return np.where((last <= plane) & (now > plane), left, 0.0)
