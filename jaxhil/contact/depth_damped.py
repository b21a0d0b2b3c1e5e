"""Hertz's contact with a damper that works by depth: F = k d^n + b d' d/d_0, clamped at 0."""

import jax.numpy as jnp

from jaxhil.contact.base import ContactLaw


class DepthDamped(ContactLaw):
    """F = max(0, k d^n + b d' d/d_0): `stiffness` k [N/m^n], n the `exponent` (1.5 for Hertz), `damping`
    b [N s/m] at the depth d_0, `reference_depth` [m]. There is no jump at the touch; on the way out the
    surfaces part inside, where k d^(n-1) = b |d'|/d_0.

    The reference is integrated. Without damping it is that of Hunt and Crossley's law; with n = 1 their law
    with chi = 2 b/(3 k d_0), whose reference has a closed form.
    """

    def step(self, parameters, state, penetration, rate):
        # The inner `where` keeps the derivative of d^n finite at d <= 0.
        touching = penetration > 0
        depth = jnp.where(touching, penetration, 1)
        force = parameters.stiffness * depth**parameters.exponent
        force = force + parameters.damping * rate * (depth / parameters.reference_depth)
        return jnp.where(touching & (force > 0), force, 0), state

    def edge(self, parameters, rate):
        return jnp.zeros_like(rate)

    def hold(self, parameters, state, penetration, rate):
        """F/d; outside, its damping's part alone, but for a linear spring, which has no end there."""
        touching = penetration > 0
        power = jnp.where(touching, penetration, 1) ** (parameters.exponent - 1)
        power = jnp.where(touching | (parameters.exponent == 1), power, 0)
        return parameters.stiffness * power + parameters.damping * rate / parameters.reference_depth
