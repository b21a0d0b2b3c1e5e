"""How a multisine's power is best spread over its lines.

Lines of power p_l give the information I = sum_l p_l M_l on the parameters theta, and what is to be small is
trace(A I^-1): with A = J^T J, J = d e / d theta, the variance of the errors e that the parameters' errors
make (Silvey, Optimal Design, 1980). Limits are linear: sum_l g_il p_l <= 1, on stroke, speed, acceleration,
force. At the best powers every line in use gains per unit of what it uses the same,

    trace(A I^-1 M_l I^-1) = sum_i lambda_i g_il,

with lambda_i = 0 for limits that are not met; multiplicative updates go there from powers that are all > 0
(Silvey, Titterington and Torsney 1978; Yu 2010 for the square root).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

ROUNDS = 400


@dataclass(frozen=True)
class Group:
    """The lines of one run."""

    information: np.ndarray  # (lines, parameters, parameters), of unit power
    use: np.ndarray  # (limits, lines), share of each limit that unit power takes


def best_powers(groups: Sequence[Group], weight: np.ndarray) -> list[np.ndarray]:
    """Powers of each group's lines that make trace(A I^-1) least, A the `weight`, within its limits."""
    powers = [flat_powers(group) for group in groups]
    prices = [np.ones(len(group.use)) for group in groups]
    for _ in range(ROUNDS):
        spread = inverse(information(groups, powers))
        worth = spread @ weight @ spread
        for place, group in enumerate(groups):
            gain = np.einsum("ij,lji->l", worth, group.information)
            power = powers[place] * np.sqrt(np.maximum(gain, 0.0) / (prices[place] @ group.use))
            used = group.use @ power
            powers[place] = power / used.max()
            prices[place] *= used / used.max()
            prices[place] /= prices[place].sum()
    return powers


def flat_powers(group: Group) -> np.ndarray:
    """The same power at all lines, as much as the limits allow."""
    lines = group.use.shape[1]
    return np.full(lines, 1.0 / (group.use @ np.ones(lines)).max())


def information(groups: Sequence[Group], powers: Sequence[np.ndarray]) -> np.ndarray:
    """Of all lines together."""
    parts = [np.einsum("l,lij->ij", p, one.information) for one, p in zip(groups, powers, strict=True)]
    return np.sum(parts, axis=0)


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Of a symmetric matrix whose parameters are in units far apart."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.linalg.pinv(matrix / np.outer(size, size), rcond=1e-14, hermitian=True) / np.outer(size, size)
