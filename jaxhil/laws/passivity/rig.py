"""Time-domain passivity control (De Stefano et al.): the contact never returns more energy than it took."""

from collections.abc import Mapping
from math import inf
from typing import ClassVar

from jaxhil.rig.registry import Compensator, GainSpecification, register


@register("passivity")
class Passivity(Compensator):
    """Compensator F_c = F, or F_c = -E_before/(T v_d) where E = E_before + T F v_d < 0, which makes E = 0.

    This is virtual damping alpha = -E/(T v_d^2). Because E_before >= 0, T v_d is not 0 there and F_c lies
    between 0 and F.
    """

    __slots__ = ("_energy", "_period")

    gains: ClassVar[Mapping[str, GainSpecification]] = {}

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._period = period
        self._energy = 0.0

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the measured force [N], reduced if the contact would return more energy than it took."""
        travel = self._period * velocity_desired
        before = self._energy
        energy = before + force_measured * travel
        if energy < 0.0:
            self._energy = 0.0
            return -before / travel
        # An infinite or NaN energy is not stored: it would remain so.
        if energy < inf:
            self._energy = energy
        return force_measured

    def reset(self) -> None:
        """Set the energy to 0."""
        self._energy = 0.0
