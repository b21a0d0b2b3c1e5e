"""Stiffness that varies within a contact: buffers and hard stops."""

import jax.numpy as jnp

from jaxhil.contact.base import ContactLaw
from jaxhil.contact.reference import piecewise_linear


class PiecewiseLinear(ContactLaw):
    """Slopes k_1, k_2, ... between depths d_1 < d_2 < ...; F = sum_i k_i overlap_i(d) + b d' >= 0.

    Segment i spans d_{i-1} to d_i (d_0 = 0); the last slope goes on.
    """

    def step(self, parameters, state, penetration, rate):
        force = self.hold(parameters, state, penetration, rate)
        return jnp.where((penetration > 0) & (force > 0), force, 0), state

    def hold(self, parameters, state, penetration, rate):
        segments = parameters.stiffness.shape[0]
        force = parameters.damping * rate
        for i in range(segments):
            overlap = penetration if i == 0 else penetration - parameters.depths[i - 1]
            overlap = jnp.where(overlap > 0, overlap, 0)
            if i < segments - 1:
                lower = 0 if i == 0 else parameters.depths[i - 1]
                overlap = jnp.minimum(overlap, parameters.depths[i] - lower)
            force = force + parameters.stiffness[i] * overlap
        return force

    def corners(self, parameters, state):
        return tuple(parameters.depths)

    def edge(self, parameters, rate):
        force = parameters.damping * rate
        return jnp.where(force > 0, force, 0)

    def reference(self, parameters, mass, velocity):
        return piecewise_linear(mass, parameters.stiffness, parameters.depths, parameters.damping, velocity)
