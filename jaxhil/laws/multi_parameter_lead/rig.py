"""Multi-parameter phase lead: weighted sum of the measured force and its filtered rate."""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.rig.bounds import FILTER_TIMES, TIMES
from jaxhil.rig.filters import VelocityFilter
from jaxhil.rig.registry import Compensator, GainSpecification, register


@register("multi_parameter_lead")
class MultiParameterLead(Compensator):
    """Compensator F_c = a F + b w, w = s/(1 + T_2 s) F by Tustin's rule.

    a = force_gain, b = force_rate_gain, T_2 = lead_filter. The literature chooses a and b to place a root of
    the delayed contact's characteristic equation (Osaki, Konno).
    """

    __slots__ = ("_force_gain", "_force_rate_gain", "_rate")

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "force_gain": GainSpecification("1", -2.1, 2.1),
        "force_rate_gain": GainSpecification("s", -2.0 * TIMES[1], 2.0 * TIMES[1]),
        "lead_filter": GainSpecification("s", *FILTER_TIMES),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._force_gain = gains["force_gain"]
        self._force_rate_gain = gains["force_rate_gain"]
        self._rate = VelocityFilter(gains["lead_filter"], period)

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the weighted sum of the measured force and its rate [N]."""
        rate = self._rate.step(force_measured)
        return self._force_gain * force_measured + self._force_rate_gain * rate

    def reset(self) -> None:
        """Restart the filter with a force of 0."""
        self._rate.start(0.0, 0.0)
