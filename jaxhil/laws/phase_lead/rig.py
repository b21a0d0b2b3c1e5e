"""Phase lead of the measured force: filtered first-order inverse of the force delay."""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.rig.bounds import FILTER_TIMES, TIMES
from jaxhil.rig.filters import LeadFilter
from jaxhil.rig.registry import Compensator, GainSpecification, register


@register("phase_lead")
class PhaseLead(Compensator):
    """Compensator F_c = (1 + T_1 s)/(1 + T_2 s) F by Tustin's rule.

    T_1 = phase_lead + lead_filter, T_2 = lead_filter: the net lead is `phase_lead`. The rule of the
    literature sets the net lead to the delay of the force measurement.
    """

    __slots__ = ("_lead",)

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "phase_lead": GainSpecification("s", *TIMES),
        "lead_filter": GainSpecification("s", *FILTER_TIMES),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._lead = LeadFilter(gains["phase_lead"], gains["lead_filter"], period)

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the lead-filtered force [N]."""
        return self._lead.step(force_measured)

    def reset(self) -> None:
        """Set the past input and output of the filter to 0."""
        self._lead.reset()
