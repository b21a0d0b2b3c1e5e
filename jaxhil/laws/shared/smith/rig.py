"""Base of `smith_predictor` and `smith_hybrid`: a phase lead, followed by a prediction of the force."""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.rig.bounds import FILTER_TIMES, TIMES
from jaxhil.rig.filters import LeadFilter
from jaxhil.rig.registry import Compensator, GainSpecification


class Smith(Compensator):
    """Base class with the filters 1 + T_l s and 1 + T_s s/(1 + T_s s/2), discretised by Tustin's rule.

    T_l is the gain `phase_lead`, and T_s the gain `simulator_lag`. As in `PhaseLead`, the first filter has
    the time constant `lead_filter`.
    """

    __slots__ = ("_lead", "_predictor")

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "phase_lead": GainSpecification("s", *TIMES),
        "lead_filter": GainSpecification("s", *FILTER_TIMES),
        "simulator_lag": GainSpecification("s", *TIMES),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        lag = gains["simulator_lag"]
        self._lead = LeadFilter(gains["phase_lead"], gains["lead_filter"], period)
        self._predictor = LeadFilter(lag, 0.5 * lag, period)

    def reset(self) -> None:
        """Set the past inputs and outputs of the filters to 0."""
        self._lead.reset()
        self._predictor.reset()
