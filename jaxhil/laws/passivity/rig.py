"""Time-domain passivity: the contact never gives back more energy than it has taken (De Stefano et al.)."""

from collections.abc import Mapping
from math import inf
from typing import ClassVar

from jaxhil.rig.registry import Compensator, GainSpecification, register


@register("passivity")
class Passivity(Compensator):
    """F_c = F, but where E = E_before + T F v_d < 0 such that E becomes 0: F_c = -E_before/(T v_d).

    That is virtual damping alpha = -E/(T v_d^2). E_before >= 0, so that T v_d is not 0 there and F_c lies
    between 0 and F.
    """

    __slots__ = ("_energy", "_period")

    gains: ClassVar[Mapping[str, GainSpecification]] = {}

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._period = period
        self._energy = 0.0

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """The measured force [N], less where the contact would give back more than it has taken."""
        travel = self._period * velocity_desired
        before = self._energy
        energy = before + force_measured * travel
        if energy < 0.0:
            self._energy = 0.0
            return -before / travel
        # What is beyond all numbers is not taken in: it would stay so.
        if energy < inf:
            self._energy = energy
        return force_measured

    def reset(self) -> None:
        """Forget the energy."""
        self._energy = 0.0
