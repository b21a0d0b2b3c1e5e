"""Virtual contact (EPOS): a virtual spring and damper act on the model in addition to the real contact."""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.rig.bounds import DAMPINGS, STIFFNESSES
from jaxhil.rig.registry import Compensator, GainSpecification, register
from jaxhil.rig.surfaces import deflection


@register("virtual_contact")
class VirtualContact(Compensator):
    """Compensator F_c = F + k_v d + b_v v_d while the model has the penetration d; otherwise F_c = F."""

    __slots__ = ("_clearance", "_damping", "_stiffness")

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "virtual_stiffness": GainSpecification("N/m", -STIFFNESSES[1], STIFFNESSES[1]),
        "virtual_damping": GainSpecification("N s/m", *DAMPINGS),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._stiffness = gains["virtual_stiffness"]
        self._damping = gains["virtual_damping"]
        self._clearance = clearance

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the sum [N] of the measured force and the virtual contact's force."""
        depth = deflection(position_desired, self._clearance)
        if depth == 0.0:
            return force_measured
        return force_measured + (self._stiffness * depth + self._damping * velocity_desired)
