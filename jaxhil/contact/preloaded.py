"""A preloaded spring with dry friction: F = F_0 + k d + F_r sign(d'), clamped at 0."""

import jax.numpy as jnp

from jaxhil.contact.base import ContactLaw
from jaxhil.contact.reference import Reference


class Preloaded(ContactLaw):
    """F = max(0, F_0 + k d + F_r sign(d')): `preload` F_0 [N], `stiffness` k [N/m], `friction` F_r [N], which
    works against the motion (Coulomb). The touch is a jump, and so is the turning point. There is no damping
    beside it.

    Each way is an oscillation about a centre outside the surface, by s = (F_0 + F_r)/k on the way in, by
    r = (F_0 - F_r)/k on the way out: with the deepest point d, (d + s)^2 = s^2 + (v/omega)^2, and at
    separation, where d or F goes through 0, e v/omega = sqrt((d + r)^2 - max(r, 0)^2). What friction holds at
    its deepest point, F_0 + k d <= F_r, stays there.
    """

    @property
    def jumps(self):
        return True

    def step(self, parameters, state, penetration, rate):
        force = self.hold(parameters, state, penetration, rate)
        return jnp.where((penetration > 0) & (force > 0), force, 0), state

    def edge(self, parameters, rate):
        force = self._constant(parameters, rate)
        return jnp.where(force > 0, force, 0)

    def hold(self, parameters, state, penetration, rate):
        return self._constant(parameters, rate) + parameters.stiffness * penetration

    def reference(self, parameters, mass, velocity):
        frequency = jnp.sqrt(parameters.stiffness / mass)
        inward = (parameters.preload + parameters.friction) / parameters.stiffness
        outward = (parameters.preload - parameters.friction) / parameters.stiffness
        swing = velocity / frequency
        turning = jnp.sqrt(inward**2 + swing**2)
        # d + s less s, without the cancellation of a strong preload.
        amplitude = swing**2 / (turning + inward) + outward
        sticks = amplitude <= 0
        amplitude = jnp.where(sticks, 1, amplitude)
        left = jnp.where(outward > 0, outward, 0)
        speed = jnp.sqrt((amplitude - left) * (amplitude + left))
        lasts = (jnp.arctan2(swing, inward) + jnp.arctan2(speed, left)) / frequency
        return Reference(
            restitution=jnp.where(sticks, 0, speed / swing),
            peak_force=parameters.stiffness * turning,
            duration=jnp.where(sticks, jnp.inf, lasts),
        )

    def _constant(self, parameters, rate):
        return parameters.preload + parameters.friction * jnp.sign(rate)
