"""Smith predictor of the force: (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F.

The second factor is phase lead for the force delay T_l, filtered as in `phase_lead`. The first factor
compensates for the lag T_s of the motion simulator: a Smith predictor adds F_0 - F_0 e^(-s T_s) for the
undelayed force F_0. Here e^(-s T_s) is replaced by its first-order Pade approximation, F_0 by the force
behind the lead. The formula in the source can also be read in a way that leaves a larger error
(notebooks/guide/model.md section 6, item 14).
"""

from typing import ClassVar

from jaxhil.laws.shared.smith.simulation import Smith


class SmithPredictor(Smith):
    """Compensator F_c = (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F; see the module's docstring."""

    name: ClassVar[str] = "smith_predictor"
    waits_for_contact: ClassVar[bool] = True
    excess: ClassVar[float] = 3.0

    def combined(self, led, predicted):
        return predicted


COMPENSATOR = SmithPredictor()
