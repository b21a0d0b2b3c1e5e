"""A mechanism that yields: it loads along one slope and unloads from its deepest point along a steeper."""

from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.float_law import FloatLaw, clamped
from jaxhil.contact.keys import Key


class Elastoplastic(ContactLaw):
    """F = max(0, k d_max - k_u (d_max - d)), k_u = r k: `stiffness` k [N/m], `unloading_ratio` r >= 1.

    The state is the deepest penetration d_max [m]. At d = d_max the force is k d; it falls along k_u to 0 at
    d = d_max (1 - 1/r), rises along the same line up to d_max and goes on along k from there. What is lost is
    the triangle between the lines: M v^2/2 = k d_max^2/2 goes in, 1/r of it comes back, e = 1/sqrt(r).
    There is no damping beside it.

    A surface that the mechanism has left (d <= 0) has forgotten its dent: every contact meets a fresh
    element, either surface of two has its own, and only a touch before the dent is left meets the dent.
    """

    name: ClassVar[str] = "elastoplastic"
    keys: ClassVar = (
        Key(
            "unloading_ratio",
            "slope of unloading over that of loading, for {laws}",
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
        """Return a quarter of a period of sqrt(k/M) in, of sqrt(k_u/M) out."""
        from jaxhil.contact.reference import Reference

        frequency = jnp.sqrt(parameters.stiffness / mass)
        restitution = 1 / jnp.sqrt(parameters.unloading_ratio)
        return Reference(
            restitution=restitution,
            peak_force=mass * velocity * frequency,
            duration=jnp.pi / 2 / frequency * (1 + restitution),
        )

    def undamped_peak_force(self, parameters, mass, velocity):
        return np.sqrt(2 * (mass * velocity**2 / 2) * parameters.stiffness)

    def tangent_stiffness(self, parameters, mass, velocity):
        return parameters.stiffness * parameters.unloading_ratio

    def perturb_damping(self, drawn, ratio, mass, velocity):
        """Multiply the unloading ratio by exp(2 pi zeta), as e* is its power -1/2."""
        return "unloading_ratio", drawn("unloading_ratio") * np.exp(2 * np.pi * ratio[:, 0])

    def in_floats(self, contact, stiffness, damping):
        return _in_floats(stiffness, contact.unloading_ratio, 0.0)


def _in_floats(stiffness: float, unloading_ratio: float, deepest: float) -> FloatLaw:
    """Return F = k d_max - k_u (d_max - d) >= 0 after the penetration d_max; k d beyond it."""

    def spring(depth: float, rate: float) -> float:
        if depth >= deepest:
            return stiffness * depth
        return stiffness * deepest - stiffness * unloading_ratio * (deepest - depth)

    def loaded(depth: float) -> FloatLaw:
        return _in_floats(stiffness, unloading_ratio, depth)

    return clamped(spring, lambda rate: 0.0)._replace(loaded=loaded)
