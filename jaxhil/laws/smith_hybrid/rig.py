"""Mean of Smith predictor and phase lead."""

from jaxhil.laws.shared.smith.rig import Smith
from jaxhil.rig.registry import register


@register("smith_hybrid")
class SmithHybrid(Smith):
    """Compensator F_c = (F_smith + F_lead)/2, from `smith_predictor` and `phase_lead` with these gains."""

    __slots__ = ()

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the mean of the forces behind the lead and behind lead and predictor [N]."""
        led = self._lead.step(force_measured)
        return 0.5 * (self._predictor.step(led) + led)
