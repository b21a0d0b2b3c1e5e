"""No compensation in six axes: the measured wrench acts on the numerical model."""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.rig.registry import GainSpecification
from jaxhil.rig.six_axes.registry import ModelConstants, SixAxisCompensator, register_six_axes
from jaxhil.rig.types import Gains, Positive


@register_six_axes("none")
class NoCompensation(SixAxisCompensator):
    """Baseline without compensation: the wrench command W_c is the measured wrench W.

    The loop's delay adds energy in every contact.
    """

    __slots__ = ()

    gains: ClassVar[Mapping[str, GainSpecification]] = {}

    def __init__(self, gains: Gains, constants: ModelConstants, period: Positive) -> None:
        pass

    def step(self, wrench, pose_desired, twist_desired, pose_measured):
        """Return the measured wrench [N, N m]."""
        return list(wrench)
