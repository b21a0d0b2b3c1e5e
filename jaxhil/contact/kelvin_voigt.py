"""Spring and damper; with no damping the linear law."""

import jax.numpy as jnp

from jaxhil.contact.base import ContactLaw
from jaxhil.contact.reference import kelvin_voigt


class KelvinVoigt(ContactLaw):
    """F = k d + b d', clamped at 0 unless tension is allowed; with b = 0 the linear law F = k d."""

    @property
    def arcs(self):
        return True

    def step(self, parameters, state, penetration, rate):
        force = parameters.stiffness * penetration + parameters.damping * rate
        force = jnp.where(parameters.tension | (force > 0), force, 0)
        return jnp.where(penetration > 0, force, 0), state

    def edge(self, parameters, rate):
        force = parameters.damping * rate
        return jnp.where(parameters.tension | (force > 0), force, 0)

    def hold(self, parameters, state, penetration, rate):
        force = parameters.stiffness * penetration + parameters.damping * rate
        return jnp.where(parameters.tension, 1, force)

    def reference(self, parameters, mass, velocity):
        return kelvin_voigt(mass, parameters.stiffness, parameters.damping, velocity, parameters.tension)
