"""Optimal distribution of a multisine's power over its frequency lines.

Lines with the powers p_l give the Fisher information matrix I = sum_l p_l M_l of the parameters theta. The
criterion is trace(A I^-1) with A = J^T J and J = d e / d theta. It is the variance of the errors e that
parameter errors cause (Silvey, Optimal Design, 1980). The limits on stroke, speed, acceleration and force are
linear in the powers: sum_l g_il p_l <= 1. At the optimum, all lines with p_l > 0 satisfy

    trace(A I^-1 M_l I^-1) = sum_i lambda_i g_il,

with lambda_i = 0 for inactive limits. Multiplicative updates converge to the optimum from positive powers
(Silvey, Titterington and Torsney 1978; Yu 2010 for the square root).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

POWER_ITERATIONS = 400  # number of multiplicative updates


@dataclass(frozen=True)
class RunLines:
    """Frequency lines of one run: Fisher information and used share of each limit, both per unit power."""

    information: np.ndarray  # (lines, parameters, parameters), Fisher information M_l per unit power
    use: np.ndarray  # (limits, lines), part g_il of each limit that a line uses per unit power


def optimise_powers(groups: Sequence[RunLines], weight: np.ndarray) -> list[np.ndarray]:
    """Return the powers of the excitation's frequency lines that minimise trace(A I^-1) within the limits.

    I is the Fisher information.

    Args:
        groups: Frequency lines of each run.
        weight: Matrix A, shape (parameters, parameters).
    """
    powers = [make_flat_powers(group) for group in groups]
    multipliers = [np.ones(len(group.use)) for group in groups]
    for _ in range(POWER_ITERATIONS):
        covariance = invert_scaled(sum_information(groups, powers))
        weighted_covariance = covariance @ weight @ covariance
        for index, group in enumerate(groups):
            gain = np.einsum("ij,lji->l", weighted_covariance, group.information)
            power = powers[index] * np.sqrt(np.maximum(gain, 0.0) / (multipliers[index] @ group.use))
            used = group.use @ power
            powers[index] = power / used.max()
            multipliers[index] *= used / used.max()
            multipliers[index] /= multipliers[index].sum()
    return powers


def make_flat_powers(group: RunLines) -> np.ndarray:
    """Return equal powers for all lines of a run, as large as the limits allow."""
    lines = group.use.shape[1]
    return np.full(lines, 1.0 / (group.use @ np.ones(lines)).max())


def sum_information(groups: Sequence[RunLines], powers: Sequence[np.ndarray]) -> np.ndarray:
    """Return the Fisher information of all lines of all runs for the given powers."""
    parts = [np.einsum("l,lij->ij", p, group.information) for group, p in zip(groups, powers, strict=True)]
    return np.sum(parts, axis=0)


def invert_scaled(matrix: np.ndarray) -> np.ndarray:
    """Return the pseudoinverse of a symmetric matrix of parameters with different units."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.linalg.pinv(matrix / np.outer(size, size), rcond=1e-14, hermitian=True) / np.outer(size, size)
