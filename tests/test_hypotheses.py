"""Which delays and lags the bank supposes, in JAX as in the controller."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxhil.compensators import hypotheses as in_jax
from jaxhil.runtime.laws.hypotheses import AS_TOLD, DELAYS, FIRST_LAG, HYPOTHESES, LAGGING, suppose

SPREAD = 0.001


def test_where_no_lag_is_told_lags_have_the_given_delay_and_are_rare():
    supposed = suppose(SPREAD, 0.0)
    np.testing.assert_allclose(supposed.lags, 0.00025 * np.arange(1, 18))
    np.testing.assert_array_equal(supposed.offsets[FIRST_LAG:], 0)
    np.testing.assert_array_equal(supposed.older[FIRST_LAG:], supposed.lags)
    np.testing.assert_array_equal(supposed.first[FIRST_LAG:], LAGGING)
    assert supposed.untold == FIRST_LAG


@pytest.mark.parametrize("lag", [2e-6, 0.0004, 0.003, 0.02])
def test_a_lag_that_is_told_has_the_delays_that_are_supposed(lag):
    """Its delays are without the lag, which is part of the given one; longer ones are rare."""
    supposed = suppose(SPREAD, lag)
    told, longer = slice(FIRST_LAG, supposed.untold), slice(supposed.untold, None)
    np.testing.assert_array_equal(supposed.lags[:AS_TOLD], lag)
    np.testing.assert_allclose(supposed.older[told], SPREAD * np.linspace(-1, 1, AS_TOLD), atol=1e-17)
    np.testing.assert_allclose(supposed.offsets[longer], -lag)
    np.testing.assert_allclose(supposed.lags[AS_TOLD:], lag + 0.0005 * np.arange(1, 9))
    assert np.sum(supposed.first[told]) == pytest.approx(np.sum(supposed.first[:FIRST_LAG]))
    assert np.all(supposed.first[longer] < 1e-3 * supposed.first[0])


@pytest.mark.parametrize("lag", [0.0, 1e-320, 2e-6, 0.0004, 0.003])
def test_both_languages_suppose_the_same(lag):
    ours, theirs = suppose(SPREAD, lag), in_jax.suppose(jnp.full((2,), SPREAD), jnp.full((2,), lag))
    for name in theirs._fields:
        found, wanted = np.asarray(getattr(theirs, name)), getattr(ours, name)
        np.testing.assert_allclose(found, np.stack([wanted] * 2, axis=1), rtol=1e-14, atol=1e-18)


def test_each_delay_is_there_twice():
    supposed = suppose(SPREAD, 0.001)
    assert len(supposed.offsets) == HYPOTHESES
    np.testing.assert_array_equal(supposed.offsets[:DELAYS], supposed.offsets[DELAYS:FIRST_LAG])
    np.testing.assert_array_equal(supposed.first[DELAYS:FIRST_LAG], 0)
    np.testing.assert_array_equal(supposed.either[:FIRST_LAG], 0.5)
