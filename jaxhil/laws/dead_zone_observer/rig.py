"""Phase lead with an observer of the force that the force sensor's dead zone removes.

A dead zone of half-width dz [N] replaces every force of at most dz by 0. A continuous dead zone also
subtracts dz from larger forces; a cut dead zone leaves larger forces unchanged. The observer estimates the
removed force from k_n d. Here k_n is the gain `observer_stiffness`, and d is the measured penetration,
delayed like the force. A first-order low-pass filter smooths the estimate, and the phase lead acts on the sum
of measured force and estimate. The method follows Li et al. 2026: their dead zone is cut, and the gain of
their disturbance observer is near 1 below 15 Hz.
"""

from collections.abc import Mapping
from math import pi
from typing import ClassVar

from jaxhil.rig.bounds import FILTER_TIMES, FORCES, STIFFNESSES, TIMES
from jaxhil.rig.filters import DelayLine, LeadFilter
from jaxhil.rig.registry import Compensator, GainSpecification, register
from jaxhil.rig.surfaces import deflection


@register("dead_zone_observer")
class DeadZoneObserver(Compensator):
    """Compensator F_c = lead(F + w), w = Q u, Q = 1/(1 + s/(2 pi f)).

    lead is the phase lead (`LeadFilter`), F is the measured force, k_n is `observer_stiffness`, f is
    `observer_bandwidth`, and T is the control period. d is the penetration (`deflection`), delayed by
    `identification_delay`. u is k_n d up to `observer_limit`. Beyond this limit, u is `observer_limit` times
    `observer_saturation`, which is 1 for a continuous and 0 for a cut dead zone. Q is realised by Tustin's
    rule with c = 2 pi f T:

    w = ((2 - c) w_prev + c (u + u_prev)) / (2 + c)
    """

    __slots__ = (
        "_alignment", "_beyond", "_clearance", "_corner", "_denominator", "_lead", "_limit", "_observed",
        "_of_observed", "_started", "_stiffness", "_withheld",
    )  # fmt: skip

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "phase_lead": GainSpecification("s", *TIMES),
        "lead_filter": GainSpecification("s", *FILTER_TIMES),
        "observer_stiffness": GainSpecification("N/m", *STIFFNESSES),
        "observer_bandwidth": GainSpecification("Hz", 0.1, 1e5),
        "observer_limit": GainSpecification("N", *FORCES),
        "observer_saturation": GainSpecification("1", 0.0, 1.0),
        "identification_delay": GainSpecification("s", *TIMES),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._lead = LeadFilter(gains["phase_lead"], gains["lead_filter"], period)
        self._alignment = DelayLine(gains["identification_delay"], period)
        self._clearance = clearance
        self._stiffness = gains["observer_stiffness"]
        self._limit = gains["observer_limit"]
        self._beyond = gains["observer_saturation"] * gains["observer_limit"]
        corner = 2.0 * pi * gains["observer_bandwidth"] * period
        self._corner = corner
        self._of_observed = 2.0 - corner
        self._denominator = 2.0 + corner
        self._withheld = 0.0
        self._observed = 0.0
        self._started = False

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the lead-filtered sum [N] of the measured force and the estimated dead-zone force."""
        alignment = self._alignment
        if not self._started:
            alignment.start(position_measured, velocity_desired)
            self._started = True
        force = self._stiffness * deflection(alignment.step(position_measured), self._clearance)
        limit, beyond = self._limit, self._beyond
        withheld = beyond if force > limit else -beyond if force < -limit else force
        observed = (
            self._of_observed * self._observed + self._corner * (withheld + self._withheld)
        ) / self._denominator
        self._withheld = withheld
        self._observed = observed
        return self._lead.step(force_measured + observed)

    def reset(self) -> None:
        """Restart the filters and the delay line."""
        self._lead.reset()
        self._withheld = 0.0
        self._observed = 0.0
        self._started = False
