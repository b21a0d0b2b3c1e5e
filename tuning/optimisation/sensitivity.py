"""How far each gain may move from the optimum before the objective rises by a given share of itself.

Read off the residuals' Jacobian at the optimum. Kinks of the objective are not seen.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

RISE = 0.01  # of the loss


class Sensitivity(NamedTuple):
    """How far each gain may move, as a share of its range; see `sensitivity`."""

    alone: Float[np.ndarray, "gains"]  # the others held
    together: Float[np.ndarray, "gains"]  # the others moved along, at their best


def sensitivity(jacobian: Float[np.ndarray, "residuals gains"], loss: float) -> Sensitivity:
    """Which gains the objective L = |r|^2 / 2 holds at its optimum, and which it leaves open.

    `jacobian` is J = dr/du, u each gain as a share of its range. Around the optimum

        L(u + d) = L (1 + d^T A d rise),    A = J^T J / (2 rise L)

    so that d^T A d <= 1 is where L rises by no more than `RISE` of itself. No gain moves by more than its
    range, whatever the objective says: B = A + 1 in place of A, and

        alone_p = B_pp^(-1/2),        together_p = ((B^-1)_pp)^(1/2)

    A gain with `together` near one is of no account or made up for by others; `alone` tells which.

    Source: Transtrum, Machta, Sethna, "Geometry of nonlinear least squares with applications to sloppy
    models and optimization", Phys. Rev. E 83, 036701 (2011).
    """
    gains = jacobian.shape[1]
    # Fewer residuals than gains leave directions that nothing depends on.
    padded = np.concatenate([jacobian, np.zeros((max(0, gains - len(jacobian)), gains))])
    _, values, directions = np.linalg.svd(padded, full_matrices=False)
    scale = 2 * RISE * max(loss, np.finfo(float).tiny)
    # Half axes of the region, along its principal directions.
    radius = 1 / np.hypot(values / np.sqrt(scale), 1)
    covariance = (directions.T * radius**2) @ directions
    alone = 1 / np.sqrt(np.sum(jacobian**2, axis=0) / scale + 1)
    return Sensitivity(alone, np.sqrt(np.diag(covariance)))
