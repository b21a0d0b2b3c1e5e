"""Phase lead of the measured force (Shimoji): F + T_lead dF/dt, first-order inverse of the force delay."""

from typing import ClassVar

import jax.numpy as jnp

from jaxhil.laws.shared.lead_filter import (
    LEAD_FILTER,
    PHASE_LEAD,
    LeadState,
    apply_lead_filter,
    build_lead_filter,
    lead_amplification,
)
from jaxhil.laws.shared.nominal_values import FORCE_DELAY
from jaxhil.laws.simulation_base import Compensator, Gain


class PhaseLead(Compensator):
    """Compensator F_c = F + T_lead dF/dt, with a filtered derivative."""

    name: ClassVar[str] = "phase_lead"
    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY,)
    waits_for_contact: ClassVar[bool] = True
    reads_position: ClassVar[bool] = False
    gains: ClassVar[tuple[Gain, ...]] = (PHASE_LEAD, LEAD_FILTER)

    def prepare(self, gains, constants):
        return build_lead_filter(gains, constants)

    def noise_amplification(self, gains, constants):
        return lead_amplification(self.prepare(gains, constants))

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        return LeadState(zeros, zeros)

    def step(self, prepared, state, signals, tick):
        return apply_lead_filter(prepared, state, signals.force_measured)


COMPENSATOR = PhaseLead()
