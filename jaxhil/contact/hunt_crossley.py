"""A power of the penetration, damped in proportion to itself."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from jaxhil.contact.base import ContactLaw
from jaxhil.contact.reference import hunt_crossley


class HuntCrossley(ContactLaw):
    """F = k d^n (1 + (3/2) chi d'), n = 1.5 for Hertz (Hunt and Crossley 1975)."""

    QUICK: ClassVar = (1.0, 1.5)  # n that need no powers, which are worked out number by number

    # n where it is one of those in every lane and nothing is differentiated by it
    exponent: float | None = eqx.field(static=True, default=None)

    @property
    def arcs(self):
        return True

    def step(self, parameters, state, penetration, rate):
        # The inner `where` keeps the derivative of d^n finite at d <= 0.
        touching = penetration > 0
        depth = jnp.where(touching, penetration, 1)
        force = parameters.stiffness * self._power(depth, parameters)
        force = force * (1 + 1.5 * parameters.damping * rate)
        return jnp.where(touching & (force > 0), force, 0), state

    def edge(self, parameters, rate):
        return jnp.zeros_like(rate)

    def hold(self, parameters, state, penetration, rate):
        return 1 + 1.5 * parameters.damping * rate

    def reference(self, parameters, mass, velocity):
        return hunt_crossley(mass, parameters.stiffness, parameters.exponent, parameters.damping, velocity)

    def _power(self, depth, parameters):
        if self.exponent == 1.0:
            return depth
        return depth * jnp.sqrt(depth) if self.exponent == 1.5 else depth**parameters.exponent
