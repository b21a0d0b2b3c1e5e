"""The mean of Smith predictor and phase lead."""

from collections.abc import Mapping
from typing import ClassVar

from ..filters import LeadFilter
from ..registry import Compensator, GainSpecification, register


@register("smith_hybrid")
class SmithHybrid(Compensator):
    """F_c = (F_smith + F_lead)/2, the forces of `smith_predictor` and `phase_lead` with these gains."""

    __slots__ = ("_lead", "_predictor")

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "phase_lead": GainSpecification("s"),
        "lead_filter": GainSpecification("s", lowest=0.0, exclusive=True),
        "simulator_lag": GainSpecification("s", lowest=0.0),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        lag = gains["simulator_lag"]
        self._lead = LeadFilter(gains["phase_lead"], gains["lead_filter"], period)
        self._predictor = LeadFilter(lag, 0.5 * lag, period)

    def step(
        self,
        force_measured: float,
        position_desired: float,
        velocity_desired: float,
        position_measured: float,
    ) -> float:
        """The mean of the measured force [N] led, and led and predicted."""
        led = self._lead.step(force_measured)
        return 0.5 * (self._predictor.step(led) + led)

    def reset(self) -> None:
        """Restart the filters."""
        self._lead.reset()
        self._predictor.reset()
