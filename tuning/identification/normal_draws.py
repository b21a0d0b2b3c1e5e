"""Draws of normal parameters whose covariance may be singular to rounding."""

import numpy as np


def factorise_covariance(covariance: np.ndarray) -> np.ndarray:
    """Return L with L L' the covariance, (..., n, n); negative eigenvalues of its correlation become 0."""
    deviation = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    scale = np.where(deviation > 0.0, deviation, 1.0)
    values, vectors = np.linalg.eigh(covariance / (scale[..., :, None] * scale[..., None, :]))
    return scale[..., :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
