"""Phase lead in six axes, with one lead time for all channels of the wrench."""

from typing import ClassVar

import jax.numpy as jnp

from jaxhil.laws.shared.lead_filter import (
    LEAD_FILTER,
    PHASE_LEAD,
    LeadState,
    apply_lead_filter,
    build_lead_filter,
)
from jaxhil.laws.shared.nominal_values import FORCE_DELAY, axis_lags, force_delay
from jaxhil.laws.simulation_base import Gain, Gains
from jaxhil.laws.six_axis_base import COORDINATES, SixAxisCompensator, lag_leads

# The best lead of a contact with friction or a latch can be longer than the delay of the whole loop.
SIX_AXIS_PHASE_LEAD = PHASE_LEAD._replace(
    upper=lambda mechanism: 2 * (force_delay(mechanism) + max(axis_lags(mechanism)))
)


class PhaseLead(SixAxisCompensator):
    """Compensator F_c = F + T_lead dF/dt on each channel of the wrench, with a filtered derivative."""

    name: ClassVar[str] = "phase_lead"
    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY,)
    gains: ClassVar[tuple[Gain, ...]] = (SIX_AXIS_PHASE_LEAD, LEAD_FILTER, *lag_leads(equalise=False))

    def channel(self, gains: Gains, name: str) -> Gains:
        """Return the gains of the lead filter for one channel of the wrench, by name."""
        return gains

    def prepare(self, gains, constants):
        return tuple(
            build_lead_filter(self.channel(gains, name), constants.of_channel) for name in COORDINATES
        )

    def init(self, prepared, constants, start, ring):
        zeros = jnp.zeros_like(constants.control_period)
        return tuple(LeadState(zeros, zeros) for _ in COORDINATES)

    def step(self, prepared, state, signals, tick):
        pairs = [apply_lead_filter(*channel) for channel in zip(prepared, state, signals.wrench, strict=True)]
        commands, states = zip(*pairs, strict=True)
        return commands, states


COMPENSATOR = PhaseLead()
