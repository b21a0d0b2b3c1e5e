"""Roots within a bracket: functions for which Newton's method overshoots, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhil.simulation.roots import ARGUMENT_TOLERANCE, find_sign_change

POWERS = np.array([1.0, 0.5, 0.2, 0.1])


def root_of(height):
    """Return the roots of s^p - height between 0 and 1, one for each power p in `POWERS`."""

    def function(height, s):
        touching = s > 0
        # The inner `where` keeps the derivative finite at 0.
        power = jnp.where(touching, s, 1) ** jnp.broadcast_to(POWERS, s.shape)
        return jnp.where(touching, power, 0) - height

    zeros = jnp.zeros_like(POWERS)
    return find_sign_change(function, height, zeros, zeros + 1, zeros + 1)


@pytest.mark.parametrize("height", [0.9, 0.3, 0.1])
def test_bracketed_roots_of_powers_match_closed_form(height):
    result, slope = jax.jvp(root_of, (jnp.asarray(height),), (jnp.ones(()),))
    np.testing.assert_allclose(result, height ** (1 / POWERS), rtol=0, atol=ARGUMENT_TOLERANCE)
    np.testing.assert_allclose(slope, height ** (1 / POWERS - 1) / POWERS, rtol=1e-3, atol=1e-6)
