"""Smith predictor of the force: (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F.

The second factor is phase lead against the force delay T_l, filtered as there. The first makes up for the lag
T_s of the motion simulator: a Smith predictor adds F_0 - F_0 e^(-s T_s) of the undelayed force F_0, here with
e^(-s T_s) by Pade's first order and what is measured for F_0. The source's typography admits another reading,
which leaves more error: notebooks/guide/model.md section 6, item 14.
"""

from typing import ClassVar

from jaxhil.laws.shared.smith.simulation import Smith


class SmithPredictor(Smith):
    """F_c = (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F; see the module's text."""

    name: ClassVar[str] = "smith_predictor"
    waits_for_contact: ClassVar[bool] = True
    excess: ClassVar[float] = 3.0

    def combined(self, led, predicted):
        return predicted


COMPENSATOR = SmithPredictor()
