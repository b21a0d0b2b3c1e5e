"""Elastoplastic contact law: in unloading, the force has a steeper slope than in loading."""

from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.float_law import FloatLaw, clamp_force
from jaxhil.contact.keys import ContactKey


class Elastoplastic(ContactLaw):
    """Contact law F = max(0, k d_max - k_u (d_max - d)), k_u = r k, with plastic deformation.

    k is `stiffness` [N/m], r is `unloading_ratio` >= 1, and the state d_max [m] is the deepest penetration so
    far. Loading beyond d_max follows F = k d. Unloading and reloading below d_max follow the slope k_u; the
    force is 0 for d <= d_max (1 - 1/r). The mechanism absorbs the energy k d_max^2/2 and returns the fraction
    1/r of this energy, so that the restitution is e = 1/sqrt(r). The law has no damping.

    d_max is reset to 0 when the mechanism leaves the surface (d <= 0), so that every contact starts
    undeformed. Without contact force at a depth d > 0, d_max is not reset.
    """

    name: ClassVar[str] = "elastoplastic"
    keys: ClassVar = (
        ContactKey(
            "unloading_ratio",
            "ratio of the unloading slope to the loading slope, for {laws}",
            "1",
            {"ge": 1.0},
            neutral=1.0,
        ),
    )
    is_damped: ClassVar[bool] = False
    dissipation_process: ClassVar[str] = "yielding"

    @property
    def has_memory(self):
        return True

    def init(self, penetration):
        return (jnp.zeros_like(penetration),)

    @property
    def is_locally_parabolic(self):
        return True

    def step(self, parameters, state, penetration, rate):
        (deepest,) = state
        force = self.separation_function(parameters, state, penetration, rate)
        deepest = jnp.where(penetration > deepest, penetration, deepest)
        deepest = jnp.where(penetration > 0, deepest, 0)
        return jnp.where((penetration > 0) & (force > 0), force, 0), (deepest,)

    def breakpoints(self, parameters, state):
        return state

    def onset_force(self, parameters, rate):
        return jnp.zeros_like(rate)

    def separation_function(self, parameters, state, penetration, rate):
        (deepest,) = state
        above = deepest - penetration
        slope = parameters.stiffness * parameters.unloading_ratio
        return parameters.stiffness * deepest - jnp.where(above > 0, slope, parameters.stiffness) * above

    def ideal_contact(self, parameters, mass, velocity):
        """Return the ideal contact, which consists of two quarter periods of harmonic oscillations.

        The angular frequency is sqrt(k/M) during the inward motion and sqrt(r k/M) during the outward motion.
        k is the stiffness, r is the unloading ratio, and M is `mass`.
        """
        from jaxhil.contact.ideal_contact import IdealContact

        frequency = jnp.sqrt(parameters.stiffness / mass)
        restitution = 1 / jnp.sqrt(parameters.unloading_ratio)
        return IdealContact(
            restitution=restitution,
            peak_force=mass * velocity * frequency,
            duration=jnp.pi / 2 / frequency * (1 + restitution),
        )

    def undamped_peak_force(self, parameters, mass, velocity):
        return np.sqrt(2 * (mass * velocity**2 / 2) * parameters.stiffness)

    def tangent_stiffness(self, parameters, mass, velocity):
        return parameters.stiffness * parameters.unloading_ratio

    def perturb_damping(self, drawn, ratio, mass, velocity):
        """Multiply the unloading ratio r by exp(2 pi zeta), where zeta is the damping ratio `ratio`.

        This multiplies the restitution 1/sqrt(r) by exp(-pi zeta).
        """
        return "unloading_ratio", drawn("unloading_ratio") * np.exp(2 * np.pi * ratio[:, 0])

    def as_float_law(self, contact, stiffness, damping):
        return _as_float_law(stiffness, contact.unloading_ratio, 0.0)


def _as_float_law(stiffness: float, unloading_ratio: float, deepest: float) -> FloatLaw:
    """Return the elastoplastic law in Python floats, for a largest penetration so far of `deepest` [m]."""

    def spring(depth: float, rate: float) -> float:
        if depth >= deepest:
            return stiffness * depth
        return stiffness * deepest - stiffness * unloading_ratio * (deepest - depth)

    def loaded_law(depth: float) -> FloatLaw:
        return _as_float_law(stiffness, unloading_ratio, depth)

    return clamp_force(spring, lambda rate: 0.0)._replace(loaded_law=loaded_law)
