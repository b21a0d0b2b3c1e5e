"""Optimal distribution of a multisine's power over its lines.

Lines of power p_l give the information I = sum_l p_l M_l on the parameters theta. The criterion is trace(A
I^-1) with A = J^T J, J = d e / d theta: the variance of the errors e that the parameters' errors cause
(Silvey, Optimal Design, 1980). Limits on stroke, speed, acceleration and force are linear: sum_l g_il p_l <=
1. At the optimum, every line in use has the same ratio of gain to use of the limits,

    trace(A I^-1 M_l I^-1) = sum_i lambda_i g_il,

with lambda_i = 0 for inactive limits. Multiplicative updates converge to it from powers > 0 (Silvey,
Titterington and Torsney 1978; Yu 2010 for the square root).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

POWER_ITERATIONS = 400


@dataclass(frozen=True)
class RunLines:
    """Lines of one run."""

    information: np.ndarray  # (lines, parameters, parameters), per unit power
    use: np.ndarray  # (limits, lines), share of each limit per unit power


def optimise_powers(groups: Sequence[RunLines], weight: np.ndarray) -> list[np.ndarray]:
    """Return the powers of each group that minimize trace(A I^-1) within its limits; A is `weight`."""
    powers = [make_flat_powers(group) for group in groups]
    prices = [np.ones(len(group.use)) for group in groups]
    for _ in range(POWER_ITERATIONS):
        spread = invert_scaled(sum_information(groups, powers))
        worth = spread @ weight @ spread
        for index, group in enumerate(groups):
            gain = np.einsum("ij,lji->l", worth, group.information)
            power = powers[index] * np.sqrt(np.maximum(gain, 0.0) / (prices[index] @ group.use))
            used = group.use @ power
            powers[index] = power / used.max()
            prices[index] *= used / used.max()
            prices[index] /= prices[index].sum()
    return powers


def make_flat_powers(group: RunLines) -> np.ndarray:
    """Return equal powers at all lines, as large as the limits allow."""
    lines = group.use.shape[1]
    return np.full(lines, 1.0 / (group.use @ np.ones(lines)).max())


def sum_information(groups: Sequence[RunLines], powers: Sequence[np.ndarray]) -> np.ndarray:
    """Return the information matrix of all lines together."""
    parts = [np.einsum("l,lij->ij", p, group.information) for group, p in zip(groups, powers, strict=True)]
    return np.sum(parts, axis=0)


def invert_scaled(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a symmetric matrix whose parameters have very different units."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.linalg.pinv(matrix / np.outer(size, size), rcond=1e-14, hermitian=True) / np.outer(size, size)
