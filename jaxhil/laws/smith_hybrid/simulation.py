"""Mean of Smith predictor and phase lead: (1 + (1/2) T_s s/(1 + T_s s/2)) (1 + T_l s) F.

The hybrid compensates for half of the lag T_s. Compared with `smith_predictor`, the hybrid amplifies the
noise less, but contacts diverge more.
"""

from typing import ClassVar

from jaxhil.laws.shared.smith.simulation import Smith


class SmithHybrid(Smith):
    """Compensator F_c = (F_smith + F_lead)/2; see the module's docstring."""

    name: ClassVar[str] = "smith_hybrid"
    waits_for_contact: ClassVar[bool] = True
    # 1 + (1/2) T_s s/(1 + T_s s/2) = (1 + T_s s)/(1 + T_s s/2).
    excess: ClassVar[float] = 2.0

    def combined(self, led, predicted):
        return (predicted + led) / 2


COMPENSATOR = SmithHybrid()
