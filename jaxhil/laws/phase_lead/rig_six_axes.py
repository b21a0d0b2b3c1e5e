"""Phase lead of the measured wrench, with the same lead time for all channels."""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.rig.bounds import FILTER_TIMES, TIMES
from jaxhil.rig.registry import GainSpecification
from jaxhil.rig.six_axes.filters import WrenchLead
from jaxhil.rig.six_axes.registry import ModelConstants, SixAxisCompensator, register_six_axes
from jaxhil.rig.six_axes.vectors import AXES, LAG_LEADS, lead_pose
from jaxhil.rig.types import Gains, Positive


@register_six_axes("phase_lead")
class PhaseLead(SixAxisCompensator):
    """Compensator F_c = (1 + T_1 s)/(1 + T_2 s) F for each channel F, as on one axis."""

    __slots__ = ("_lead", "_pose_leads")

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "phase_lead": GainSpecification("s", *TIMES),
        "lead_filter": GainSpecification("s", *FILTER_TIMES),
        **{name: GainSpecification("s", *TIMES) for name in LAG_LEADS},
    }

    def __init__(self, gains: Gains, constants: ModelConstants, period: Positive) -> None:
        self._lead = WrenchLead([gains["phase_lead"]] * AXES, gains["lead_filter"], period)
        self._pose_leads = [gains[name] for name in LAG_LEADS]

    def step(self, wrench, pose_desired, twist_desired, pose_measured):
        """Return the measured wrench after the lead filter [N, N m]."""
        return self._lead.step(wrench)

    def pose_command(self, pose, rates):
        """Return the pose command [m, rad]: the pose extrapolated by the lead times `lag_lead_...`."""
        return lead_pose(self._pose_leads, pose, rates)

    def reset(self) -> None:
        """Set the past inputs and outputs of the filters to 0."""
        self._lead.reset()
