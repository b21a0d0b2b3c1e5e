"""Phase lead in six axes: F + T_lead dF/dt on each channel of the wrench, with a separate lead time.

The axes of a rig have different delays; each lead time can compensate for the delay of its channel. All
channels have the same time constant of the lead filter.
"""

from typing import ClassVar

from jaxhil.laws.phase_lead.simulation_six_axes import SIX_AXIS_PHASE_LEAD, PhaseLead
from jaxhil.laws.shared.lead_filter import LEAD_FILTER, PHASE_LEAD
from jaxhil.laws.simulation_base import Gain
from jaxhil.laws.six_axis_base import COORDINATES, lag_leads


class PhaseLeadPerAxis(PhaseLead):
    """Compensator F_c = F + T_lead dF/dt on each channel, with separate T_lead and filtered derivative."""

    name: ClassVar[str] = "phase_lead_per_axis"
    gains: ClassVar[tuple[Gain, ...]] = (
        *(SIX_AXIS_PHASE_LEAD._replace(name=f"{PHASE_LEAD.name}_{axis}") for axis in COORDINATES),
        LEAD_FILTER,
        *lag_leads(equalise=False),
    )

    def channel(self, gains, name):
        return {**gains, PHASE_LEAD.name: gains[f"{PHASE_LEAD.name}_{name}"]}


COMPENSATOR = PhaseLeadPerAxis()
