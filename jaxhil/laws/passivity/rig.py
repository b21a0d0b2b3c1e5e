"""Time-domain passivity control (De Stefano et al.): a contact returns at most the energy it absorbed."""

from collections.abc import Mapping
from math import inf
from typing import ClassVar

from jaxhil.rig.registry import Compensator, GainSpecification, register


@register("passivity")
class Passivity(Compensator):
    """Compensator F_c = F, or F_c = -E_before/(T v_d) if E = E_before + T F v_d would be negative.

    E is the energy that the numerical model has given to the contact, v_d the velocity of the numerical
    model, and T the control period. The second force makes E = 0; it corresponds to a virtual damping
    alpha = -E/(T v_d^2). Because E_before >= 0, the divisor T v_d is then not 0, and F_c is between 0 and F.
    """

    __slots__ = ("_energy", "_period")

    gains: ClassVar[Mapping[str, GainSpecification]] = {}

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._period = period
        self._energy = 0.0

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the measured force [N], reduced if the contact would return more energy than it absorbed."""
        travel = self._period * velocity_desired
        before = self._energy
        energy = before + force_measured * travel
        if energy < 0.0:
            self._energy = 0.0
            return -before / travel
        # Do not store an infinite or NaN energy, because it would never become finite again.
        if energy < inf:
            self._energy = energy
        return force_measured

    def reset(self) -> None:
        """Set the observed energy to 0."""
        self._energy = 0.0
