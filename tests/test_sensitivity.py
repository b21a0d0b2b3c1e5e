"""Tolerance of each gain for a given rise of the objective, compared with closed forms."""

import numpy as np
import pytest

from tuning.optimisation.sensitivity import LOSS_RISE, compute_gain_tolerance

STIFF_ENOUGH = 0.05  # largest gain tolerance [unit box] for a stiff gain, on which the box has little effect


def quadratic():
    """Return a Jacobian J for three gains with a stiff and a weak direction; the third gain has no effect."""
    return np.array([[300.0, 300.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def test_gain_tolerance_is_change_that_raises_loss_by_stated_amount():
    jacobian, loss = np.array([[50.0, 0.0], [0.0, 20.0]]), 0.5
    result = compute_gain_tolerance(jacobian, loss)
    # The change d satisfies d^2 J^2 / 2 = rise * loss, within the unit box.
    allowed = np.sqrt(2 * LOSS_RISE * loss) / np.array([50.0, 20.0])
    np.testing.assert_allclose(result.alone, 1 / np.hypot(1 / allowed, 1), rtol=1e-12)
    np.testing.assert_allclose(result.together, result.alone, rtol=1e-12)


def test_gains_that_compensate_each_other_have_large_joint_tolerance():
    result = compute_gain_tolerance(quadratic(), 0.5)
    assert result.alone[0] == pytest.approx(result.alone[1], rel=1e-4)
    assert result.alone[0] < 1e-3
    assert result.together[0] > 30 * result.alone[0]
    assert result.together[2] == result.alone[2] == 1


def test_loss_at_gain_tolerance_is_higher_by_the_stated_amount():
    generator = np.random.default_rng(7)
    jacobian, residuals = 40 * generator.standard_normal((9, 4)), generator.standard_normal(9)
    # At the optimum of linear least squares, the residuals are orthogonal to J.
    residuals -= jacobian @ np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
    loss = np.sum(residuals**2) / 2
    result = compute_gain_tolerance(jacobian, loss)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    for gain in range(4):
        alone = result.alone[gain] * np.eye(4)[gain]
        # The other gains are re-optimised: move along the gain's column of the covariance.
        together = result.together[gain] * covariance[gain] / covariance[gain, gain]
        for step in (alone, together):
            assert np.max(np.abs(step)) < STIFF_ENOUGH
            moved = np.sum((residuals + jacobian @ step) ** 2) / 2
            assert moved == pytest.approx((1 + LOSS_RISE) * loss, rel=LOSS_RISE * STIFF_ENOUGH**2)


def test_gains_not_determined_by_residuals_have_tolerance_of_the_whole_range():
    result = compute_gain_tolerance(np.array([[3.0, 0.0, 4.0]]), 0.5)
    assert result.together[1] == pytest.approx(1)
