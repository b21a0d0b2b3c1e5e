"""A preloaded spring with dry friction: F = F_0 + k d + F_r sign(d'), clamped at 0."""

from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.float_law import clamped
from jaxhil.contact.keys import Key


class Preloaded(ContactLaw):
    """F = max(0, F_0 + k d + F_r sign(d')): `preload` F_0 [N], `stiffness` k [N/m], `friction` F_r [N], which
    works against the motion (Coulomb). The touch is a jump, and so is the turning point. There is no damping
    beside it.

    Each way is an oscillation about a centre outside the surface, by s = (F_0 + F_r)/k on the way in, by
    r = (F_0 - F_r)/k on the way out: with the deepest point d, (d + s)^2 = s^2 + (v/omega)^2, and at
    separation, where d or F goes through 0, e v/omega = sqrt((d + r)^2 - max(r, 0)^2). What friction holds at
    its deepest point, F_0 + k d <= F_r, stays there.
    """

    name: ClassVar[str] = "preloaded"
    keys: ClassVar = (
        Key("preload", "of the spring at the touch, for {laws}", "N", {"ge": 0.0}, default=0.0),
        Key(
            "friction",
            "dry friction against the motion, for {laws}",
            "N",
            {"ge": 0.0},
            default=0.0,
            name_in_six_axes="dry_friction",
            meaning_in_six_axes="against the depth's motion, for {laws}",
        ),
    )
    damped: ClassVar[bool] = False
    dissipates_by: ClassVar[str] = "friction"

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
        from jaxhil.contact.reference import Reference

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

    def perturb_damping(self, drawn, ratio, mass, velocity):
        """Add the friction that takes 1 - e*^2 of the energy on the way to the deepest point without it, and
        back."""
        preload, friction, stiffness = drawn("preload"), drawn("friction"), drawn("stiffness")[:, 0]
        energy = (mass * velocity**2)[:, 0] / 2
        deepest = 2 * energy / (preload + np.sqrt(preload**2 + 2 * stiffness * energy))
        lost = energy * -np.expm1(-2 * np.pi * ratio[:, 0])
        return "friction", friction + lost / (2 * deepest)

    def in_floats(self, contact, stiffness, damping):
        def constant(rate: float) -> float:
            return contact.preload + contact.friction * ((rate > 0.0) - (rate < 0.0))

        def spring(depth: float, rate: float) -> float:
            return constant(rate) + stiffness * depth

        return clamped(spring, constant)

    def _constant(self, parameters, rate):
        return parameters.preload + parameters.friction * jnp.sign(rate)
