"""No compensation: the numerical model feels the measured force, F_c = F."""

from collections.abc import Mapping
from typing import ClassVar

from .registry import GainSpecification, register


@register("retrospective_reference")
class NoCompensation:
    """F_c = F. The baseline, whose contacts diverge with the loop's delay."""

    __slots__ = ()

    gains: ClassVar[Mapping[str, GainSpecification]] = {}

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        pass

    @property
    def identified(self) -> tuple[float, float]:
        """(0, 0): this law identifies nothing."""
        return 0.0, 0.0

    def step(
        self,
        force_measured: float,
        position_desired: float,
        velocity_desired: float,
        position_measured: float,
    ) -> float:
        """The measured force [N]."""
        return force_measured

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """The numerical model's position [m] itself."""
        return position

    def reset(self) -> None:
        """Nothing to restart."""

    def next_contact(self) -> None:
        """Nothing to restart."""
