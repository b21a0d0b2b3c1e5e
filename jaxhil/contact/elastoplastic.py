"""Elastoplastic contact: loading along one slope, unloading from the deepest point along a steeper one."""

from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.float_law import FloatLaw, clamp_force
from jaxhil.contact.keys import ContactKey


class Elastoplastic(ContactLaw):
    """Contact law F = max(0, k d_max - k_u (d_max - d)), k_u = r k, of a mechanism that yields.

    k is `stiffness` [N/m], r is `unloading_ratio` >= 1. The state is the deepest penetration d_max [m]. At
    d = d_max the force is k d. It falls along the slope k_u to 0 at d = d_max (1 - 1/r), rises along the same
    line up to d_max and continues along k from there. The loss is the triangle between the two lines: the
    energy M v^2/2 = k d_max^2/2 goes in, 1/r of it comes back, so that e = 1/sqrt(r). The law has no damping.

    The dent is lost when the mechanism leaves the surface (d <= 0): every new contact begins undeformed, and
    each of two surfaces has its own dent. Only a touch within the dent (0 < d < d_max) still sees it.
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
    damped: ClassVar[bool] = False
    dissipates_by: ClassVar[str] = "yielding"

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
        """Return a quarter period of the frequency sqrt(k/M) inward and of sqrt(k_u/M) outward."""
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
        """Multiply the unloading ratio r by exp(2 pi zeta), since e* = 1/sqrt(r)."""
        return "unloading_ratio", drawn("unloading_ratio") * np.exp(2 * np.pi * ratio[:, 0])

    def in_floats(self, contact, stiffness, damping):
        return _in_floats(stiffness, contact.unloading_ratio, 0.0)


def _in_floats(stiffness: float, unloading_ratio: float, deepest: float) -> FloatLaw:
    """Return the law after a penetration d_max: F = k d_max - k_u (d_max - d) >= 0, k d beyond d_max."""

    def spring(depth: float, rate: float) -> float:
        if depth >= deepest:
            return stiffness * depth
        return stiffness * deepest - stiffness * unloading_ratio * (deepest - depth)

    def loaded(depth: float) -> FloatLaw:
        return _in_floats(stiffness, unloading_ratio, depth)

    return clamp_force(spring, lambda rate: 0.0)._replace(loaded=loaded)
