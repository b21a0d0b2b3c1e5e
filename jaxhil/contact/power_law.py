"""Base class of the contact laws with the elastic force F = k d^n."""

from typing import ClassVar

from jaxhil.contact.base import ContactLaw
from jaxhil.contact.keys import EXPONENT, ContactKey

COMMON_EXPONENTS = (1.0, 1.5, 2.0, 3.0)  # exponents that identification prefers


class PowerLaw(ContactLaw):
    """Base class of the laws with the elastic force k d^n; k is `stiffness` [N/m^n], n is `exponent`."""

    keys: ClassVar[tuple[ContactKey, ...] | None] = (EXPONENT,)
    stiffness_unit: ClassVar[str] = "N/m^n"

    def undamped_peak_force(self, parameters, mass, velocity):
        """Return the force k d^n [N] at the deepest point, where the spring stores all kinetic energy."""
        exponent, energy = parameters.exponent, mass * velocity**2 / 2
        depth = ((exponent + 1) * energy / parameters.stiffness) ** (1 / (exponent + 1))
        return parameters.stiffness * depth**exponent

    def tangent_stiffness(self, parameters, mass, velocity):
        power = parameters.exponent
        depth = ((power + 1) * mass * velocity**2 / (2 * parameters.stiffness)) ** (1 / (power + 1))
        return power * parameters.stiffness * depth ** (power - 1)

    def onset_damping(self, parameters):
        return 0 * parameters.damping

    def nominal_peak_force(self, contact, stiffness, mass, velocity):
        order = contact.exponent + 1
        deepest = (order * mass * velocity**2 / (2 * min(stiffness))) ** (1 / order)
        return max(stiffness) * deepest**contact.exponent
