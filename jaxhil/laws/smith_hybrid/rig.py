"""The mean of Smith predictor and phase lead."""

from jaxhil.laws.shared.smith.rig import Smith
from jaxhil.rig.registry import register


@register("smith_hybrid")
class SmithHybrid(Smith):
    """F_c = (F_smith + F_lead)/2, the forces of `smith_predictor` and `phase_lead` with these gains."""

    __slots__ = ()

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """The mean of the measured force [N] led, and led and predicted."""
        led = self._lead.step(force_measured)
        return 0.5 * (self._predictor.step(led) + led)
