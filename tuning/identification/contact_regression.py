"""Linear least squares for the coefficients of a contact law, at several surface positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np


@dataclass(frozen=True)
class CoefficientFit:
    """Linear fit of the coefficients of a contact law, at one force delay and surface position."""

    coefficients: np.ndarray  # (coefficients,), in SI units; the last one is the bias [N]
    covariance: np.ndarray  # (coefficients, coefficients), covariance of the coefficients
    misfit: float  # chi-squared: sum of squared residuals divided by the variance of the noise
    evidence: float  # log posterior density of force delay and surface position, up to a constant
    slope: float = 0.0  # 1/m, derivative of misfit / 2 with respect to the surface position
    # 1/m^2, second derivative of misfit / 2, if the coefficients are fitted at every surface position
    curvature: float = 0.0
    plane: float = 0.0  # surface position of the fit [m]
    # derivative of the coefficients with respect to the surface position; None if the position is specified
    by_plane: np.ndarray | None = None


class PseudoRows(NamedTuple):
    """Few regression rows that replace the many readings of runs well below the surface.

    See `tuning.identification.deep_contact`. Rows are divided by the standard deviation of the noise.
    """

    design: np.ndarray  # (surface positions, coefficients, rows), design matrix
    target: np.ndarray  # (rows,), readings
    by_plane: np.ndarray  # 1/m, derivative of `design` with respect to the surface position


class LeastSquaresFit(NamedTuple):
    """Least-squares fits at several surface positions.

    Readings are divided by the standard deviation of the noise.
    """

    coefficients: np.ndarray  # (surface positions, coefficients)
    covariance: np.ndarray  # (surface positions, coefficients, coefficients), covariance of the coefficients
    misfit: np.ndarray  # (surface positions,), chi-squared
    residual: np.ndarray  # (surface positions, rows), prediction minus reading
    design: np.ndarray  # (surface positions, coefficients, rows), design matrix


def fit_coefficients(
    design: np.ndarray,
    target: np.ndarray,
    bias_readings: tuple[float, float, float],
    bias_alone: float,
    bias_prior: tuple[float, float] | None,
) -> LeastSquaresFit:
    """Fit the coefficients of a contact law by least squares at each surface position.

    Args:
        design: Design matrix, shape (surface positions, coefficients, rows); the last regressor is the bias.
        target: Readings, shape (rows,).
        bias_readings: Number, sum and sum of squares of further readings, which depend on the bias alone.
        bias_alone: Value of these further readings for a bias of 1 N.
        bias_prior: Mean and standard deviation of the bias [N] from standstill runs, or None.
    """
    count, total, square = bias_readings
    normal, right = design @ design.swapaxes(1, 2), sum_products(design, target)
    normal[:, -1, -1] += count * bias_alone**2
    right[:, -1] += total * bias_alone
    if bias_prior is not None:
        mean, error = bias_prior
        normal[:, -1, -1] += error**-2
        right[:, -1] += mean * error**-2
    size = np.sqrt(np.maximum(np.einsum("pii->pi", normal), 1e-60))
    scale = size[:, :, None] * size[:, None]
    covariance = np.linalg.inv(normal / scale + 1e-13 * np.eye(size.shape[1])) / scale
    coefficients = np.einsum("pij,pj->pi", covariance, right)
    residual = (coefficients[:, None] @ design)[:, 0] - target
    misfit = np.einsum("pm,pm->p", residual, residual)
    bias = coefficients[:, -1] * bias_alone
    misfit += square + bias * (count * bias - 2.0 * total)
    if bias_prior is not None:
        mean, error = bias_prior
        misfit = misfit + ((coefficients[:, -1] - mean) / error) ** 2
    return LeastSquaresFit(coefficients, covariance, misfit, residual, design)


def compute_force(coefficients: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the force [N] of the contact law without the bias, shape (surface positions, rows)."""
    return (coefficients[..., None, :-1] @ columns)[:, 0]


def sum_products(table: np.ndarray, values: np.ndarray) -> Any:
    """Return the sum of `table` times `values` over the rows (last axis).

    BLAS is not used, because its number of threads would change the last bits of the sum.
    """
    return np.einsum("...m,m->...", table, values)


def sum_and_squares(values: np.ndarray) -> tuple[int, float, float]:
    """Return the number of values, the sum of the values and the sum of their squares."""
    return len(values), float(values.sum()), float(sum_products(values, values))
