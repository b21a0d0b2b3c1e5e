"""Factorisation of a covariance matrix for normal draws; the matrix may be singular."""

import numpy as np


def factorise_covariance(covariance: np.ndarray) -> np.ndarray:
    """Return matrices L with L L^T = `covariance`, both of shape (..., n, n).

    L is the symmetric square root of the correlation matrix, multiplied by the standard deviations. This root
    does not depend on the signs of eigenvectors, which rounding may reverse. Negative eigenvalues, which
    result from rounding, are replaced by 0.
    """
    deviation = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    scale = np.where(deviation > 0.0, deviation, 1.0)
    values, vectors = np.linalg.eigh(covariance / (scale[..., :, None] * scale[..., None, :]))
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :] @ vectors.swapaxes(-1, -2)
    return scale[..., :, None] * root
