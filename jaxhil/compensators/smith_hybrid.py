"""The mean of Smith predictor and phase lead: (1 + (1/2) T_s s/(1 + T_s s/2)) (1 + T_l s) F.

Half of the lag T_s is predicted, the other half stays: less amplification of noise for more divergence. See
`smith_predictor`.
"""

from typing import ClassVar

from jaxhil.compensators.base import Compensator, Gain
from jaxhil.compensators.estimates import FORCE_DELAY, SIMULATOR_LAG
from jaxhil.compensators.phase_lead import LEAD_FILTER, PHASE_LEAD
from jaxhil.compensators.smith_predictor import (
    LAG,
    cascade_amplification,
    smith_filters,
    smith_forces,
    smith_restart,
    smith_start,
)


class SmithHybrid(Compensator):
    """F_c = (F_smith + F_lead)/2; see the module's text."""

    name: ClassVar[str] = "smith_hybrid"
    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY, SIMULATOR_LAG)
    gains: ClassVar[tuple[Gain, ...]] = (PHASE_LEAD, LEAD_FILTER, LAG)

    def prepare(self, gains, constants):
        return smith_filters(gains, constants)

    def noise_amplification(self, gains, constants):
        # 1 + (1/2) T_s s/(1 + T_s s/2) = (1 + T_s s)/(1 + T_s s/2).
        return cascade_amplification(gains, constants, 2.0)

    def init(self, gains, constants, ring):
        return smith_start(constants)

    def restart(self, gains, state, begins, fresh):
        return smith_restart(state, begins)

    def step(self, prepared, state, signals, tick):
        led, predicted, state = smith_forces(prepared, state, signals.force_measured)
        return (predicted + led) / 2, state
