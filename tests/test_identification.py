"""Recursive identification in JAX and in the runtime, compared with weighted batch least squares."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxhil.laws.shared.recursive_least_squares.rig import ContactIdentification
from jaxhil.laws.shared.recursive_least_squares.simulation import ContactEstimate, update_estimate

INITIAL = (2.0, -1.0)
VARIANCES = (5.0, 0.5)


def on_jax(readings, weights, forgetting):
    start = (*INITIAL, 0.0, *VARIANCES)
    state = ContactEstimate(*(jnp.asarray(value) for value in start))
    most = tuple(jnp.asarray(d) for d in VARIANCES)
    for (depth, rate, force), weight in zip(readings, weights, strict=True):
        values = (jnp.asarray(value) for value in (depth, rate, force, weight))
        state = update_estimate(state, jnp.asarray(forgetting), most, *values)
    return [float(leaf) for leaf in state]


def rig(readings, weights, forgetting):
    state = ContactIdentification(*INITIAL, *VARIANCES, forgetting)
    for (depth, rate, force), weight in zip(readings, weights, strict=True):
        state.update(float(force), float(depth), float(rate), float(weight))
    return [getattr(state, name) for name in ContactEstimate._fields]


def batch(readings, weights, forgetting):
    """Return parameters and their covariance P by weighted batch least squares with forgetting.

    The values are theta_1, theta_2, and U_12, D_1 and D_2 of the factors P = U D U'.
    """
    retention = 1 - weights * (1 - forgetting)
    faded = np.append(np.cumprod(retention[::-1])[::-1][1:], 1.0)
    phi, force = readings[:, :2], readings[:, 2]
    prior = np.prod(retention) * np.diag(1 / np.array(VARIANCES))
    information = prior + np.einsum("n,ni,nj->ij", weights * faded, phi, phi)
    covariance = np.linalg.inv(information)
    theta = covariance @ (prior @ INITIAL + np.einsum("n,ni,n->i", weights * faded, phi, force))
    coupling = covariance[0, 1] / covariance[1, 1]
    return [*theta, coupling, covariance[0, 0] - coupling * covariance[0, 1], covariance[1, 1]]


SIDES = pytest.mark.parametrize("identify", [on_jax, rig])


@SIDES
@pytest.mark.parametrize("forgetting", [0.9, 0.98, 1.0])
def test_recursive_identification_equals_weighted_batch_least_squares(identify, forgetting):
    rng = np.random.default_rng(0)
    # Large regressors come first: the bound on the covariance is never active.
    readings = rng.normal(size=(30, 3)) + np.array([[3.0, 6.0, 0.0], [-5.0, 5.0, 0.0]] + 28 * [[0.0] * 3])
    weights = np.r_[1.0, 1.0, rng.uniform(0, 1, 28)]
    expected = batch(readings, weights, forgetting)
    assert abs(expected[0] - INITIAL[0]) > 0.5
    np.testing.assert_allclose(identify(readings, weights, forgetting), expected, rtol=1e-10)


@SIDES
def test_recursive_identification_is_linear_in_small_weights(identify):
    rng = np.random.default_rng(1)
    readings = rng.normal(size=(3, 3))
    weights = np.array([1.0, 0.5, 0.0])
    before = identify(readings[:2], weights[:2], 0.9)
    np.testing.assert_allclose(identify(readings, weights, 0.9), before, rtol=1e-15)
    moved = [np.array(identify(readings, np.array([1.0, 0.5, w]), 0.9)) - before for w in (1e-6, 2e-6)]
    np.testing.assert_allclose(moved[1], 2 * moved[0], rtol=1e-4)
    assert np.all(np.abs(moved[0]) < 1e-5) and np.any(moved[0] != 0)
