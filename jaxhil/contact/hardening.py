"""Hardening spring with a damper: F = k d (1 + (d/d_0)^2) + b d', clamped at 0."""

import math
from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.float_law import clamp_force
from jaxhil.contact.keys import REFERENCE_DEPTH
from jaxhil.contact.regression import Regression, RegressionFamily


class Hardening(ContactLaw):
    """Contact law F = max(0, k d (1 + (d/d_0)^2) + b d'), a one-sided Duffing oscillator.

    k is `stiffness` [N/m], d_0 is `reference_depth` [m], and b is `damping` [N s/m]. The slope of the
    spring's force is k at the surface and 4 k at the depth d_0.

    The ideal contact is integrated numerically. Without damping, the restitution is 1, and the force is
    largest at the deepest point. There, k d^2/2 + k d^4/(4 d_0^2) = M v^2/2 with the equivalent mass M [kg]
    and the approach speed v [m/s].
    """

    name: ClassVar[str] = "hardening"
    keys: ClassVar = (REFERENCE_DEPTH,)

    @property
    def is_locally_parabolic(self):
        return True

    def step(self, parameters, state, penetration, rate):
        force = self.separation_function(parameters, state, penetration, rate)
        return jnp.where((penetration > 0) & (force > 0), force, 0), state

    def onset_force(self, parameters, rate):
        force = parameters.damping * rate
        return jnp.where(force > 0, force, 0)

    def separation_function(self, parameters, state, penetration, rate):
        stiffening = 1 + (penetration / parameters.reference_depth) ** 2
        return parameters.stiffness * penetration * stiffening + parameters.damping * rate

    def undamped_peak_force(self, parameters, mass, velocity):
        """Return the force [N] at the deepest point, where the spring stores all kinetic energy."""
        energy, unit = mass * velocity**2 / 2, parameters.reference_depth
        square = np.sqrt(1 + 4 * energy / (parameters.stiffness * unit**2)) - 1
        return parameters.stiffness * unit * np.sqrt(square) * (1 + square)

    def tangent_stiffness(self, parameters, mass, velocity):
        energy = mass * velocity**2 / (parameters.stiffness * parameters.reference_depth**2)
        return parameters.stiffness * (1 + 3 * (np.sqrt(1 + 2 * energy) - 1))

    def nominal_peak_force(self, contact, stiffness, mass, velocity):
        energies = [mass * velocity**2 / (k * contact.reference_depth**2) for k in stiffness]
        depths = [math.sqrt(2 * energy / (1 + math.sqrt(1 + 2 * energy))) for energy in energies]
        forces = [k * depth * (1 + depth**2) for k, depth in zip(stiffness, depths, strict=True)]
        return contact.reference_depth * max(forces)

    def perturb_damping(self, drawn, ratio, mass, velocity):
        """Add 2 zeta sqrt(k M) to `damping`, where zeta is `ratio`, k `stiffness` and M `mass`."""
        return "damping", drawn("damping") + 2 * ratio * np.sqrt(drawn("stiffness") * mass)

    def as_float_law(self, contact, stiffness, damping):
        reference_depth = contact.reference_depth

        def spring(depth: float, rate: float) -> float:
            return stiffness * depth * (1.0 + (depth / reference_depth) ** 2) + damping * rate

        return clamp_force(spring, lambda rate: damping * rate)

    def regression(self, contact):
        """Return the regression F = c_1 d + c_2 d^3 + c_3 d' with c_1 = k, c_2 = k/d_0^2 and c_3 = b."""
        names = ("stiffness", "cubic", "damping")
        return Regression("hardening", lambda d, v: [d, d**3], names, lambda d, v: [v])

    def families(self, deepest, entries):
        return [RegressionFamily(lambda _: self.regression(None))] if entries == 1 else []

    def coefficients(self, contact, stiffness, damping):
        return [stiffness, stiffness / contact.reference_depth**2, damping]

    def file_values(self, fitted, entry):
        # The bounds keep the reference depth finite if the cubic coefficient is 0 or negative.
        ratio = fitted["stiffness"] / np.maximum(fitted["cubic"], 1e-12)
        depth = np.sqrt(np.maximum(ratio, 1e-12))
        return {**super().file_values(fitted, entry), "contact.reference_depth": depth}
