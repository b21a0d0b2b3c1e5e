"""Hertz contact with damping proportional to depth: F = k d^n + b d' d/d_0, clamped at 0.

d_0 is the reference depth.
"""

from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.float_law import FloatLaw
from jaxhil.contact.keys import EXPONENT, REFERENCE_DEPTH
from jaxhil.contact.power_law import COMMON_EXPONENTS, PowerLaw
from jaxhil.contact.regression import Regression, RegressionFamily

DEFAULT_REFERENCE_DEPTH = 1e-3  # reference depth d_0 for which identification fits b [m]


class DepthDamped(PowerLaw):
    """Contact law F = max(0, k d^n + b d' d/d_0), with damping proportional to depth.

    k is `stiffness` [N/m^n], n is `exponent` (1.5 for Hertz), d_0 is `reference_depth` [m], and b is
    `damping` [N s/m], the damping constant at the depth d_0. The force does not jump at the onset. During the
    outward motion, the surfaces separate at the depth d > 0 where k d^(n-1) = b |d'|/d_0.

    The ideal contact is integrated numerically. Without damping, or for n = 1, this law equals Hunt and
    Crossley's law (`HuntCrossley`) with chi = 2 b/(3 k d_0).
    """

    name: ClassVar[str] = "depth_damped"
    keys: ClassVar = (EXPONENT, REFERENCE_DEPTH)

    def step(self, parameters, state, penetration, rate):
        # The inner `where` keeps the derivative of d^n finite at d <= 0.
        touching = penetration > 0
        depth = jnp.where(touching, penetration, 1)
        force = parameters.stiffness * depth**parameters.exponent
        force = force + parameters.damping * rate * (depth / parameters.reference_depth)
        return jnp.where(touching & (force > 0), force, 0), state

    def onset_force(self, parameters, rate):
        return jnp.zeros_like(rate)

    def separation_function(self, parameters, state, penetration, rate):
        """Return F/d before clamping at 0; for d <= 0, return the limit of F/d as d goes to 0."""
        touching = penetration > 0
        power = jnp.where(touching, penetration, 1) ** (parameters.exponent - 1)
        power = jnp.where(touching | (parameters.exponent == 1), power, 0)
        return parameters.stiffness * power + parameters.damping * rate / parameters.reference_depth

    def perturb_damping(self, drawn, ratio, mass, velocity):
        """Add to `damping` the effect of Hunt and Crossley's damping constant chi = pi zeta/v.

        zeta is the damping ratio `ratio`, and v is the approach speed. At the deepest penetration of the
        undamped contact, the added force equals the damping force of Hunt and Crossley's law.
        """
        stiffness, order = drawn("stiffness"), drawn("exponent")[:, None] + 1
        depth = (order * mass * velocity**2 / (2 * stiffness)) ** (1 / order)
        reference_depth = drawn("reference_depth")[:, None]
        added = 1.5 * np.pi * ratio / velocity * stiffness * depth ** (order - 2) * reference_depth
        return "damping", drawn("damping") + added

    def as_float_law(self, contact, stiffness, damping):
        exponent, reference_depth = contact.exponent, contact.reference_depth

        def hold(depth: float, rate: float) -> float:
            return stiffness * max(depth, 0.0) ** (exponent - 1.0) + damping * rate / reference_depth

        def force(depth: float, rate: float) -> float:
            value = stiffness * depth**exponent + damping * rate * (depth / reference_depth)
            return value if value > 0.0 else 0.0

        return FloatLaw(force, hold, lambda rate: 0.0)

    def regression(self, contact):
        return _regression(contact.exponent, contact.reference_depth)

    def families(self, deepest, entries):
        return [
            RegressionFamily(
                lambda exponent: _regression(exponent, DEFAULT_REFERENCE_DEPTH), 1.0, 3.0, COMMON_EXPONENTS
            )
        ]


def _regression(exponent: float, reference_depth: float) -> Regression:
    """Return the regression F = k d^n + b d' d/d_0 with the unknown coefficients k and b."""
    return Regression(
        "depth_damped",
        lambda d, v: [d**exponent],
        ("stiffness", "damping"),
        lambda d, v: [d * v / reference_depth],
        shape={"exponent": exponent, "reference_depth": reference_depth},
    )
