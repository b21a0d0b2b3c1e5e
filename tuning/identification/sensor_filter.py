"""A force sensor's first-order lag over one control period, in closed form.

The lag integrates the force between two readings. Where the force is smooth a parabola through both ends and
the middle stands for it; where contact begins in between, a damped force jumps, and the part before is 0.
"""

from __future__ import annotations

import numpy as np


def lag_weights(rate: float) -> tuple[float, tuple[float, float, float]]:
    """What a lag keeps of itself over a period, and the weights of the force at the end, the middle and the
    beginning of the period; exact where the force is a parabola. `rate`: period over the time constant."""
    pole = float(np.exp(-rate))
    # Moments of rate exp(-(1 - s) rate) over s = 0..1.
    first = 1.0 - pole
    second = 1.0 - first / rate
    third = 1.0 - 2.0 * second / rate
    last, half, now = np.linalg.solve(
        [[1.0, 1.0, 1.0], [0.0, 0.5, 1.0], [0.0, 0.25, 1.0]], [first, second, third]
    )
    return pole, (float(now), float(half), float(last))


def onset_weights(rate: float, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the force just after contact began and at the end of the period, of a force that is 0 before
    and a line after; `left`: share of the period that was left then."""
    whole = -np.expm1(-rate * left)
    end = 1.0 - whole / (rate * left)
    return whole - end, end


def onsets(last: np.ndarray, half: np.ndarray, now: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Share of the period left when the position passed the plane, 0 where it did not: positions [m] at the
    beginning, in the middle and at the end of the period, and lines between them."""
    late = half <= plane
    start, stop = np.where(late, half, last), np.where(late, now, half)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = 0.5 * (stop - plane) / (stop - start) + np.where(late, 0.0, 0.5)
    return np.where((last <= plane) & (now > plane), left, 0.0)
