"""Smith predictor of the force: (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F.

The second factor is the phase lead for the force delay T_l, filtered as in `phase_lead`. The first factor
compensates for the lag T_s of the motion simulator: a Smith predictor adds F_0 - F_0 e^(-s T_s), where F_0 is
the undelayed force. Here the lead-filtered force replaces F_0, and a first-order Pade approximation replaces
e^(-s T_s). The formula in the source is ambiguous; its other interpretation has a larger error
(notebooks/guide/model.md section 6, item 14).
"""

from typing import ClassVar

from jaxhil.laws.shared.smith.simulation import Smith


class SmithPredictor(Smith):
    """Compensator F_c = (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F; T_s: drive lag, T_l: force delay."""

    name: ClassVar[str] = "smith_predictor"
    waits_for_contact: ClassVar[bool] = True
    excess: ClassVar[float] = 3.0

    def combined(self, led, predicted):
        return predicted


COMPENSATOR = SmithPredictor()
