"""Phase lead of the measured wrench, with a separate lead time for each channel."""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.laws.phase_lead.rig_six_axes import PhaseLead
from jaxhil.rig.bounds import FILTER_TIMES, TIMES
from jaxhil.rig.registry import GainSpecification
from jaxhil.rig.six_axes.filters import WrenchLead
from jaxhil.rig.six_axes.registry import ModelConstants, register_six_axes
from jaxhil.rig.six_axes.vectors import COORDINATES, LAG_LEADS
from jaxhil.rig.types import Gains, Positive


@register_six_axes("phase_lead_per_axis")
class PhaseLeadPerAxis(PhaseLead):
    """Compensator F_c = (1 + T_1 s)/(1 + T_2 s) F for each channel F, with its own T_1 and a common T_2."""

    __slots__ = ()

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        **{f"phase_lead_{axis}": GainSpecification("s", *TIMES) for axis in COORDINATES},
        "lead_filter": GainSpecification("s", *FILTER_TIMES),
        **{name: GainSpecification("s", *TIMES) for name in LAG_LEADS},
    }

    def __init__(self, gains: Gains, constants: ModelConstants, period: Positive) -> None:
        self._lead = WrenchLead(
            [gains[f"phase_lead_{axis}"] for axis in COORDINATES], gains["lead_filter"], period
        )
        self._pose_leads = [gains[name] for name in LAG_LEADS]
