"""A mechanism that yields: it loads along one slope and unloads from its deepest point along a steeper."""

import jax.numpy as jnp

from jaxhil.contact.base import ContactLaw
from jaxhil.contact.reference import Reference


class Elastoplastic(ContactLaw):
    """F = max(0, k d_max - k_u (d_max - d)), k_u = r k: `stiffness` k [N/m], `unloading_ratio` r >= 1.

    The state is the deepest penetration d_max [m]. At d = d_max the force is k d; it falls along k_u to 0 at
    d = d_max (1 - 1/r), rises along the same line up to d_max and goes on along k from there. What is lost is
    the triangle between the lines: M v^2/2 = k d_max^2/2 goes in, 1/r of it comes back, e = 1/sqrt(r).
    There is no damping beside it.

    A surface that the mechanism has left (d <= 0) has forgotten its dent: every contact meets a fresh
    element, either surface of two has its own, and only a touch before the dent is left meets the dent.
    """

    @property
    def remembers(self):
        return True

    def init(self, penetration):
        return (jnp.zeros_like(penetration),)

    @property
    def arcs(self):
        return True

    def step(self, parameters, state, penetration, rate):
        (deepest,) = state
        force = self.hold(parameters, state, penetration, rate)
        deepest = jnp.where(penetration > deepest, penetration, deepest)
        deepest = jnp.where(penetration > 0, deepest, 0)
        return jnp.where((penetration > 0) & (force > 0), force, 0), (deepest,)

    def corners(self, parameters, state):
        return state

    def edge(self, parameters, rate):
        return jnp.zeros_like(rate)

    def hold(self, parameters, state, penetration, rate):
        (deepest,) = state
        above = deepest - penetration
        slope = parameters.stiffness * parameters.unloading_ratio
        return parameters.stiffness * deepest - jnp.where(above > 0, slope, parameters.stiffness) * above

    def reference(self, parameters, mass, velocity):
        """In closed form: a quarter of a period of sqrt(k/M) in, of sqrt(k_u/M) out."""
        frequency = jnp.sqrt(parameters.stiffness / mass)
        restitution = 1 / jnp.sqrt(parameters.unloading_ratio)
        return Reference(
            restitution=restitution,
            peak_force=mass * velocity * frequency,
            duration=jnp.pi / 2 / frequency * (1 + restitution),
        )
