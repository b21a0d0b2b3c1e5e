"""No compensation: the measured force acts on the numerical model, F_c = F."""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.rig.registry import Compensator, GainSpecification, register


@register("none")
class NoCompensation(Compensator):
    """Compensator F_c = F, the baseline: its contacts diverge because of the delays in the loop."""

    __slots__ = ()

    gains: ClassVar[Mapping[str, GainSpecification]] = {}

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        pass

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the measured force [N]."""
        return force_measured
