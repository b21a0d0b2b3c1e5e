"""Gains and unit coordinates: one to one within the bounds, and differentiable at the bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuning.optimisation.unit_box import GainBounds, to_coordinates, to_gains

BOUNDS = GainBounds(np.array([0.0, 1e-3, 0.4]), np.array([2.0, 10.0, 0.4]), np.array([0.0, 1.0, 0.0]))


@given(st.floats(0, 1), st.floats(0, 1))
def test_gains_and_unit_coordinates_map_one_to_one(linear, logarithmic):
    gains = np.array([2 * linear, 1e-3 * 1e4**logarithmic, 0.4])
    coordinates = to_coordinates(gains, BOUNDS)
    np.testing.assert_allclose(coordinates, [linear, logarithmic, 0], atol=1e-12)
    np.testing.assert_allclose(to_gains(coordinates, BOUNDS), gains, rtol=1e-12)
    np.testing.assert_allclose(to_gains(jnp.array(coordinates), BOUNDS), gains, rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize("share", [-3.0, -1e-17, 0.0, 1.0, 1 + 1e-15, 7.0])
def test_gains_mapped_from_unit_coordinates_stay_within_bounds(share):
    gains = to_gains(np.full(3, share), BOUNDS)
    bound = (BOUNDS.lower, BOUNDS.upper)[int(share > 0.5)]
    np.testing.assert_allclose(gains, bound, rtol=1e-12, atol=0)
    beyond = bound + np.array([share, 0, 0])
    np.testing.assert_allclose(to_coordinates(beyond, BOUNDS)[0], round(min(max(share, 0), 1)))


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_unit_coordinate_derivatives_at_bounds_equal_derivatives_inside(share):
    slope = jax.jacfwd(lambda coordinates: to_gains(coordinates, BOUNDS))(jnp.full(3, share))
    gains = to_gains(np.full(3, share), BOUNDS)
    np.testing.assert_allclose(np.diag(slope), [2.0, gains[1] * np.log(1e4), 0.0], rtol=1e-12)
