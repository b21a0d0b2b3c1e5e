"""Smith predictor of the force: (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F.

The second factor is phase lead against the force delay T_l, filtered as there. The first makes up for the lag
T_s of the motion simulator: on the model of a contact at the frequency omega, where the undelayed force would
be F_0 and the one behind the lag F_0 e^(-s T_s), a Smith predictor adds the difference F_0 - F_0 e^(-s T_s);
with e^(-s T_s) by Pade's first order, (1 - s T_s/2)/(1 + s T_s/2), that is T_s s/(1 + T_s s/2) F_0, and what
is measured stands for F_0.

The source's typography admits another reading, F + T_s s/(1 + T_s s/2) (1 + T_l s) F. Behind a pure delay
T_s = 10 ms and a force delay T_l = 8 ms a contact of 3 Hz is left with e = 1.014 by this one and 1.267 by the
other (notebooks/guide/model.md section 6, item 14).
"""

from typing import ClassVar

from jaxhil.compensators.smith import Smith


class SmithPredictor(Smith):
    """F_c = (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F; see the module's text."""

    name: ClassVar[str] = "smith_predictor"
    excess: ClassVar[float] = 3.0

    def combined(self, led, predicted):
        return predicted
