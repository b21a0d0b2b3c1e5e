"""Hunt and Crossley's contact law: F = k d^n (1 + (3/2) chi d'), clamped at 0."""

from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.float_law import FloatLaw
from jaxhil.contact.power_law import COMMON_EXPONENTS, PowerLaw
from jaxhil.contact.regression import Regression, RegressionFamily


class HuntCrossley(PowerLaw):
    """Contact law F = max(0, k d^n (1 + (3/2) chi d')) (Hunt and Crossley 1975).

    k is `stiffness` [N/m^n], n is `exponent` (1.5 for Hertz), and chi is `damping` [s/m].
    """

    name: ClassVar[str] = "hunt_crossley"
    damping_unit: ClassVar[str] = "s/m"
    FAST_EXPONENTS: ClassVar = (1.0, 1.5)  # exponents n for which d^n needs no power function, which is slow

    # n, if it is in `FAST_EXPONENTS` and equal for all batch elements; else None
    exponent: float | None = None

    @property
    def is_locally_parabolic(self):
        return True

    def specialise(self, contact, drawn):
        is_fast = not drawn("exponent") and contact.exponent in self.FAST_EXPONENTS
        return HuntCrossley(contact.exponent) if is_fast else self

    def step(self, parameters, state, penetration, rate):
        # The inner `where` keeps the derivative of d^n finite at d <= 0.
        touching = penetration > 0
        depth = jnp.where(touching, penetration, 1)
        force = parameters.stiffness * self._power(depth, parameters)
        force = force * (1 + 1.5 * parameters.damping * rate)
        return jnp.where(touching & (force > 0), force, 0), state

    def onset_force(self, parameters, rate):
        return jnp.zeros_like(rate)

    def separation_function(self, parameters, state, penetration, rate):
        return 1 + 1.5 * parameters.damping * rate

    def ideal_contact(self, parameters, mass, velocity):
        from jaxhil.contact.ideal_contact import ideal_hunt_crossley

        return ideal_hunt_crossley(
            mass, parameters.stiffness, parameters.exponent, parameters.damping, velocity
        )

    def damping_ratio(self, damping, mass, velocity, frequency):
        """Return the damping ratio zeta = chi v/pi, where chi is `damping` and v is the approach speed.

        The restitution is about 1 - chi v for this law, and about 1 - pi zeta for a linear oscillator.
        """
        return damping * velocity / np.pi

    def perturb_damping(self, drawn, ratio, mass, velocity):
        """Add pi zeta/v to `damping`, where zeta is the damping ratio `ratio` and v the approach speed.

        With chi = `damping`, the restitution is about 1 - chi v; it decreases by about pi zeta.
        """
        return "damping", drawn("damping") + np.pi * ratio / velocity * np.ones_like(drawn("stiffness"))

    def as_float_law(self, contact, stiffness, damping):
        exponent = contact.exponent

        def hold(depth: float, rate: float) -> float:
            return 1.0 + 1.5 * damping * rate

        def force(depth: float, rate: float) -> float:
            factor = 1.0 + 1.5 * damping * rate
            return stiffness * depth**exponent * factor if factor > 0.0 else 0.0

        return FloatLaw(force, hold, lambda rate: 0.0)

    def regression(self, contact):
        return _regression(contact.exponent)

    def families(self, deepest, entries):
        return [RegressionFamily(_regression, 1.05, 3.0, COMMON_EXPONENTS[1:])]

    def coefficients(self, contact, stiffness, damping):
        return [stiffness, stiffness * damping]

    def file_values(self, fitted, entry):
        values = super().file_values(fitted, entry)
        return {**values, f"contact.damping.{entry}": fitted["damping"] / fitted["stiffness"]}

    def _power(self, depth, parameters):
        if self.exponent == 1.0:
            return depth
        return depth * jnp.sqrt(depth) if self.exponent == 1.5 else depth**parameters.exponent


def _regression(exponent: float) -> Regression:
    """Return the regression F = k d^n (1 + 1.5 chi d') with the unknown coefficients k and k chi.

    `exponent` is n, and chi is the damping [s/m].
    """
    return Regression(
        "hunt_crossley",
        lambda d, v: [d**exponent, 1.5 * v * d**exponent],
        ("stiffness", "damping"),
        shape={"exponent": exponent},
    )
