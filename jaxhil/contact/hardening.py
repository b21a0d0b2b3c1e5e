"""A spring that stiffens with depth, and a damper: F = k d (1 + (d/d_0)^2) + b d', clamped at 0."""

import jax.numpy as jnp

from jaxhil.contact.base import ContactLaw


class Hardening(ContactLaw):
    """F = max(0, k d (1 + (d/d_0)^2) + b d'): `stiffness` k [N/m] at the surface, four times that slope at
    the depth d_0, `reference_depth` [m]. Duffing's oscillator, one-sided.

    The reference is integrated. Without damping e = 1, and k d^2/2 + k d^4/(4 d_0^2) = M v^2/2 at the
    deepest point, where the force is largest.
    """

    @property
    def arcs(self):
        return True

    def step(self, parameters, state, penetration, rate):
        force = self.hold(parameters, state, penetration, rate)
        return jnp.where((penetration > 0) & (force > 0), force, 0), state

    def edge(self, parameters, rate):
        force = parameters.damping * rate
        return jnp.where(force > 0, force, 0)

    def hold(self, parameters, state, penetration, rate):
        stiffening = 1 + (penetration / parameters.reference_depth) ** 2
        return parameters.stiffness * penetration * stiffening + parameters.damping * rate
