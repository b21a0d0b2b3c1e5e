"""Time-domain passivity control (De Stefano et al.): no contact returns more energy than it absorbed."""

from collections.abc import Mapping
from math import inf
from typing import ClassVar

from jaxhil.rig.registry import Compensator, GainSpecification, register


@register("passivity")
class Passivity(Compensator):
    """Compensator F_c = F, or F_c = -E/(T v_d) if E + T F v_d is negative.

    E is the energy that the numerical model has given to the contact until this tick, v_d the velocity of the
    numerical model, and T the control period. Each period adds to E the product of T, F_c and the mean of v_d
    at the start and the end of the period. This product is the energy that the model loses, for every mass
    and integrator. The second form of F_c acts like a virtual damper that returns E to 0. The magnitude of
    F_c never exceeds the magnitude of F.
    """

    __slots__ = ("_command", "_energy", "_period", "_velocity")

    gains: ClassVar[Mapping[str, GainSpecification]] = {}

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._period = period
        self._energy = 0.0
        self._command = 0.0
        self._velocity = 0.0

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the measured force [N], reduced if the contact would return more energy than it absorbed."""
        energy = self._energy + self._command * (0.5 * self._period * (self._velocity + velocity_desired))
        # Do not store an infinite or NaN energy, because all later energies would not be finite either.
        if -inf < energy < inf:
            self._energy = energy
        travel = self._period * velocity_desired
        command = force_measured
        if self._energy + force_measured * travel < 0.0:
            limit = abs(force_measured)
            command = 0.0 if travel == 0.0 else min(max(-self._energy / travel, -limit), limit)
        self._command = command
        self._velocity = velocity_desired
        return command

    def reset(self) -> None:
        """Set the observed energy to 0."""
        self._energy = 0.0
        self._command = 0.0
        self._velocity = 0.0
