"""Preloaded spring with dry friction: F = F_0 + k d + F_r sign(d'), clamped at 0."""

from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.float_law import clamp_force
from jaxhil.contact.keys import ContactKey


class Preloaded(ContactLaw):
    """Contact law F = max(0, F_0 + k d + F_r sign(d')) of a preloaded spring with dry friction.

    F_0 is `preload` [N], k is `stiffness` [N/m], and F_r is `friction` [N], Coulomb friction against the
    motion. The force jumps at the onset and when the motion reverses. The law has no damping.

    The ideal contact with the equivalent mass M and the approach speed v is a harmonic oscillation with
    omega = sqrt(k/M). The inward motion oscillates about d = -s, s = (F_0 + F_r)/k, and the outward motion
    about d = -r, r = (F_0 - F_r)/k. The deepest point d_m satisfies (d_m + s)^2 = s^2 + (v/omega)^2. The
    contact ends when d or F crosses 0, with the restitution e = (omega/v) sqrt((d_m + r)^2 - max(r, 0)^2).
    If F_0 + k d_m <= F_r, friction holds the mechanism at d_m, and e = 0.
    """

    name: ClassVar[str] = "preloaded"
    keys: ClassVar = (
        ContactKey("preload", "spring force at the touch, for {laws}", "N", {"ge": 0.0}, default=0.0),
        ContactKey(
            "friction",
            "dry friction force against the motion, for {laws}",
            "N",
            {"ge": 0.0},
            default=0.0,
            name_in_six_axes="dry_friction",
            meaning_in_six_axes="force against the change of the depth, for {laws}",
        ),
    )
    is_damped: ClassVar[bool] = False
    dissipation_process: ClassVar[str] = "friction"

    @property
    def has_reversal_jump(self):
        return True

    def step(self, parameters, state, penetration, rate):
        force = self.separation_function(parameters, state, penetration, rate)
        return jnp.where((penetration > 0) & (force > 0), force, 0), state

    def onset_force(self, parameters, rate):
        force = self._constant(parameters, rate)
        return jnp.where(force > 0, force, 0)

    def separation_function(self, parameters, state, penetration, rate):
        return self._constant(parameters, rate) + parameters.stiffness * penetration

    def ideal_contact(self, parameters, mass, velocity):
        from jaxhil.contact.ideal_contact import IdealContact

        frequency = jnp.sqrt(parameters.stiffness / mass)
        inward = (parameters.preload + parameters.friction) / parameters.stiffness
        outward = (parameters.preload - parameters.friction) / parameters.stiffness
        swing = velocity / frequency
        turning = jnp.sqrt(inward**2 + swing**2)
        # This is d_m + r; the difference (d_m + s) - s would lose digits at a strong preload.
        amplitude = swing**2 / (turning + inward) + outward
        sticks = amplitude <= 0
        amplitude = jnp.where(sticks, 1, amplitude)
        end = jnp.where(outward > 0, outward, 0)
        speed = jnp.sqrt((amplitude - end) * (amplitude + end))
        duration = (jnp.arctan2(swing, inward) + jnp.arctan2(speed, end)) / frequency
        return IdealContact(
            restitution=jnp.where(sticks, 0, speed / swing),
            peak_force=parameters.stiffness * turning,
            duration=jnp.where(sticks, jnp.inf, duration),
        )

    def perturb_damping(self, drawn, ratio, mass, velocity):
        """Add friction that dissipates the fraction 1 - exp(-2 pi zeta) of the kinetic energy.

        zeta is the damping ratio `ratio`. The length of the friction's path is estimated as twice the deepest
        penetration of the contact without friction.
        """
        preload, friction, stiffness = drawn("preload"), drawn("friction"), drawn("stiffness")[:, 0]
        energy = (mass * velocity**2)[:, 0] / 2
        deepest = 2 * energy / (preload + np.sqrt(preload**2 + 2 * stiffness * energy))
        loss = energy * -np.expm1(-2 * np.pi * ratio[:, 0])
        return "friction", friction + loss / (2 * deepest)

    def as_float_law(self, contact, stiffness, damping):
        def constant(rate: float) -> float:
            return contact.preload + contact.friction * ((rate > 0.0) - (rate < 0.0))

        def spring(depth: float, rate: float) -> float:
            return constant(rate) + stiffness * depth

        return clamp_force(spring, constant)

    def _constant(self, parameters, rate):
        """Return the part of the force [N] that does not depend on the depth, F_0 + F_r sign(d')."""
        return parameters.preload + parameters.friction * jnp.sign(rate)
