"""Tolerance of each tuned gain: the change of the gain that raises the objective by `LOSS_RISE`.

The tolerances follow from the Jacobian of the residuals at the optimum. They ignore kinks of the objective.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LOSS_RISE = 0.01  # relative rise of the objective that defines a tolerance [1]


class GainTolerances(NamedTuple):
    """Tolerance of each gain, as a fraction of the gain's range."""

    alone: Float[np.ndarray, "gains"]  # tolerance if all other gains are fixed [1]
    together: Float[np.ndarray, "gains"]  # tolerance if the other gains are readjusted to the optimum [1]


def compute_gain_tolerance(jacobian: Float[np.ndarray, "residuals gains"], loss: float) -> GainTolerances:
    """Compute the tolerance of each gain at the optimum of the objective L = |r|^2 / 2.

    `jacobian` is J = dr/du, where r are the residuals and u the unit coordinates of the gains. `loss` is L at
    the optimum. Around the optimum

        L(u + d) = L (1 + rise d^T A d),    A = J^T J / (2 rise L),    rise = `LOSS_RISE`

    so that d^T A d = 1 where L has risen by the fraction `LOSS_RISE`. A is replaced by B = A + I with the
    identity I, so that no gain moves by more than its range. The tolerances of gain number p are

        alone_p = B_pp^(-1/2),        together_p = ((B^-1)_pp)^(1/2)

    with the other gains fixed (alone) or readjusted to the optimum (together). A gain with `together` near 1
    is insensitive or is compensated by other gains; `alone` distinguishes the two cases.

    Source: Transtrum, Machta, Sethna, "Geometry of nonlinear least squares with applications to sloppy
    models and optimization", Phys. Rev. E 83, 036701 (2011).
    """
    gains = jacobian.shape[1]
    # If there are fewer residuals than gains, rows of zeros stand for the directions that have no effect.
    padded = np.concatenate([jacobian, np.zeros((max(0, gains - len(jacobian)), gains))])
    _, values, directions = np.linalg.svd(padded, full_matrices=False)
    scale = 2 * LOSS_RISE * max(loss, np.finfo(float).tiny)
    # semi-axes of the ellipsoid d^T B d = 1
    radius = 1 / np.hypot(values / np.sqrt(scale), 1)
    covariance = (directions.T * radius**2) @ directions
    alone = 1 / np.sqrt(np.sum(jacobian**2, axis=0) / scale + 1)
    return GainTolerances(alone, np.sqrt(np.diag(covariance)))
