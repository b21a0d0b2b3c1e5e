"""Phase lead with a lead of its own for each of six axes: F + T_lead dF/dt, channel by channel.

The axes of a rig are late by unlike times, and a lead can make up for what its own channel is late by. The
lead filter is common to all.
"""

from typing import ClassVar

from jaxhil.laws.phase_lead.simulation import PhaseLead
from jaxhil.laws.shared.lead_filter import LEAD_FILTER, PHASE_LEAD
from jaxhil.laws.simulation_base import Gain, Gains

CHANNELS = ("x", "y", "z", "rx", "ry", "rz")


class PhaseLeadPerAxis(PhaseLead):
    """F_c = F + T_lead dF/dt of each channel, filtered; six axes alone have it."""

    name: ClassVar[str] = "phase_lead_per_axis"
    gains: ClassVar[tuple[Gain, ...]] = (
        *(PHASE_LEAD._replace(name=f"{PHASE_LEAD.name}_{axis}") for axis in CHANNELS),
        LEAD_FILTER,
    )

    def channel(self, gains: Gains, channel: int) -> Gains:
        """The gains of one channel, as `PhaseLead` has them."""
        return {**gains, PHASE_LEAD.name: gains[f"{PHASE_LEAD.name}_{CHANNELS[channel]}"]}


COMPENSATOR = PhaseLeadPerAxis()
