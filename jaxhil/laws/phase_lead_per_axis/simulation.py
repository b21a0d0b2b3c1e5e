"""Phase lead with a lead time for each of six axes: F + T_lead dF/dt, channel by channel.

The axes of a rig have different delays, and each lead time can compensate for that of its channel. The lead
filter is common to all channels.
"""

from typing import ClassVar

from jaxhil.laws.phase_lead.simulation import PhaseLead
from jaxhil.laws.shared.lead_filter import LEAD_FILTER, PHASE_LEAD
from jaxhil.laws.simulation_base import Gain, Gains

CHANNELS = ("x", "y", "z", "rx", "ry", "rz")


class PhaseLeadPerAxis(PhaseLead):
    """Compensator F_c = F + T_lead dF/dt of each channel, filtered; for six axes only."""

    name: ClassVar[str] = "phase_lead_per_axis"
    gains: ClassVar[tuple[Gain, ...]] = (
        *(PHASE_LEAD._replace(name=f"{PHASE_LEAD.name}_{axis}") for axis in CHANNELS),
        LEAD_FILTER,
    )

    def channel(self, gains: Gains, channel: int) -> Gains:
        """Return the gains of one channel, 0 to 5, with the names of `PhaseLead`."""
        return {**gains, PHASE_LEAD.name: gains[f"{PHASE_LEAD.name}_{CHANNELS[channel]}"]}


COMPENSATOR = PhaseLeadPerAxis()
