"""Tolerance of each gain: its distance from the optimum at which the objective rises by a given share.

It follows from the residuals' Jacobian at the optimum, and does not take kinks of the objective into account.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LOSS_RISE = 0.01  # relative rise of the loss


class GainTolerances(NamedTuple):
    """Tolerance of each gain, as a share of its range."""

    alone: Float[np.ndarray, "gains"]  # with all other gains fixed
    together: Float[np.ndarray, "gains"]  # with all other gains readjusted to their best values


def compute_gain_tolerance(jacobian: Float[np.ndarray, "residuals gains"], loss: float) -> GainTolerances:
    """Return the tolerance of each gain at the optimum of the objective L = |r|^2 / 2.

    `jacobian` is J = dr/du, with the gains u as shares of their ranges. Around the optimum

        L(u + d) = L (1 + d^T A d rise),    A = J^T J / (2 rise L)

    so that L rises by at most `LOSS_RISE` of itself for d^T A d <= 1. To limit the movement of a gain to its
    range, B = A + 1 replaces A, and

        alone_p = B_pp^(-1/2),        together_p = ((B^-1)_pp)^(1/2)

    A gain with `together` near 1 is insensitive or is compensated by other gains; `alone` distinguishes the
    two cases.

    Source: Transtrum, Machta, Sethna, "Geometry of nonlinear least squares with applications to sloppy
    models and optimization", Phys. Rev. E 83, 036701 (2011).
    """
    gains = jacobian.shape[1]
    # With fewer residuals than gains, zero rows add the directions on which no residual depends.
    padded = np.concatenate([jacobian, np.zeros((max(0, gains - len(jacobian)), gains))])
    _, values, directions = np.linalg.svd(padded, full_matrices=False)
    scale = 2 * LOSS_RISE * max(loss, np.finfo(float).tiny)
    # These are the semi-axes of the region.
    radius = 1 / np.hypot(values / np.sqrt(scale), 1)
    covariance = (directions.T * radius**2) @ directions
    alone = 1 / np.sqrt(np.sum(jacobian**2, axis=0) / scale + 1)
    return GainTolerances(alone, np.sqrt(np.diag(covariance)))
