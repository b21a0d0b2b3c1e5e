"""Position lead: the position command leads the model's position by the motion simulator's lag."""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.rig.bounds import TIMES
from jaxhil.rig.registry import Compensator, GainSpecification, register


@register("position_lead")
class PositionLead(Compensator):
    """Compensator F_c = F, command x + a_1 v + a_2 a, a_1 = position_lead, a_2 = acceleration_lead.

    With a_1 and a_2 of the motion simulator's inverse, 1/G(s) = 1 + a_1 s + a_2 s^2 + ..., the command
    compensates for the simulator's lag.
    """

    __slots__ = ("_of_acceleration", "_of_velocity")

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "position_lead": GainSpecification("s", -TIMES[1], TIMES[1]),
        "acceleration_lead": GainSpecification("s^2", -TIMES[1], TIMES[1]),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._of_velocity = gains["position_lead"]
        self._of_acceleration = gains["acceleration_lead"]

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the measured force [N]."""
        return force_measured

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """Return the position command [m], extrapolated from the numerical model's motion."""
        return position + self._of_velocity * velocity + self._of_acceleration * acceleration
