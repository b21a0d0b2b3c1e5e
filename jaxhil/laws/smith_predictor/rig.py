"""Smith predictor of the force: phase lead for the force delay, prediction for the motion simulator's lag."""

from jaxhil.laws.shared.smith.rig import Smith
from jaxhil.rig.registry import register


@register("smith_predictor")
class SmithPredictor(Smith):
    """Compensator F_c = (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F; T_s: drive lag, T_l: force delay."""

    __slots__ = ()

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the predicted force [N]."""
        return self._predictor.step(self._lead.step(force_measured))
