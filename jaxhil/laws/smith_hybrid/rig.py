"""Mean of Smith predictor and phase lead."""

from jaxhil.laws.shared.smith.rig import Smith
from jaxhil.rig.registry import register


@register("smith_hybrid")
class SmithHybrid(Smith):
    """Compensator F_c = (F_smith + F_lead)/2, the mean of `smith_predictor` and `phase_lead`."""

    __slots__ = ()

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the mean [N] of the lead-filtered force and the predicted force."""
        led = self._lead.step(force_measured)
        return 0.5 * (self._predictor.step(led) + led)
