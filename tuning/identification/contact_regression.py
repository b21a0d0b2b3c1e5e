"""Linear least squares for the coefficients of a contact law, at several positions of the surface at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np


@dataclass(frozen=True)
class CoefficientFit:
    """Linear fit of the coefficients at one delay and surface."""

    coefficients: np.ndarray
    covariance: np.ndarray
    misfit: float  # chi-squared: sum of squares over the variance of the noise
    evidence: float  # log posterior density of delay and plane, up to a constant
    slope: float = 0.0  # derivative of misfit / 2 by the plane [1/m]
    curvature: float = 0.0  # second derivative by the plane, coefficients fitted [1/m^2]
    plane: float = 0.0  # m, plane of the fit
    by_plane: np.ndarray | None = None  # derivative of the coefficients by the plane, if that is fitted


class PseudoRows(NamedTuple):
    """Few rows that have the same sum of squares, for all coefficients, as many readings."""

    design: np.ndarray  # (planes, coefficients, rows), over the noise's standard deviation
    target: np.ndarray  # (rows,), over the noise's standard deviation
    by_plane: np.ndarray  # 1/m, derivative of `design` by the plane


class LeastSquaresFit(NamedTuple):
    """Fit at each plane; design and residuals are divided by the noise's standard deviation."""

    coefficients: np.ndarray  # (planes, coefficients)
    covariance: np.ndarray  # (planes, coefficients, coefficients)
    misfit: np.ndarray  # (planes,), chi-squared
    residual: np.ndarray  # (planes, rows)
    design: np.ndarray  # (planes, coefficients, rows)


def fit_coefficients(
    design: np.ndarray,
    target: np.ndarray,
    rest: tuple[float, float, float],
    bias_alone: float,
    bias_prior: tuple[float, float] | None,
) -> LeastSquaresFit:
    """Return the least-squares fit at each plane.

    Args:
        design: Functions of the law and, last, the bias, (planes, coefficients, rows).
        target: Readings, (rows,).
        rest: Number, sum and sum of squares of the readings that depend on the bias alone.
        bias_alone: Such a reading for a bias of 1 N.
        bias_prior: Bias [N] and its standard deviation from runs at rest, or None.
    """
    count, total, square = rest
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
    """Return the force of the law without the bias, (planes, rows)."""
    return (coefficients[..., None, :-1] @ columns)[:, 0]


def sum_products(table: np.ndarray, values: np.ndarray) -> Any:
    """Return the sums of products along the rows.

    BLAS would split the sum by its number of threads, which changes the last bits.
    """
    return np.einsum("...m,m->...", table, values)


def sum_and_squares(values: np.ndarray) -> tuple[int, float, float]:
    """Return the number of values, their sum and that of their squares."""
    return len(values), float(values.sum()), float(sum_products(values, values))
