"""Response-error compensation with real-time identification of the contact.

    F_c = y + gate (g k (x_d - x_m) + g_b b (v_d - v_m))

y is the lead-filtered force, k and b are the identified contact stiffness and damping, and x_d - x_m is the
distance by which the motion simulator lags behind the numerical model. The compensator needs no model of the
simulator. The gate is open while the position, delayed like the force, is in contact. It opens and closes
smoothly within two periods, as a function of the time (between two ticks) at which the position crosses the
surface. F_c is not clamped, because a clamp increases the divergence.

Source: Qi, Zhao, Gao, Ren, Hu, "Divergence compensation for hardware-in-the-loop simulation of
stiffness-varying discrete contact in space", Acta Astronautica 2016, and later papers of that group.
"""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.laws.shared.gates.rig import gate, share_beyond
from jaxhil.laws.shared.recursive_least_squares.rig import ContactIdentification
from jaxhil.rig.bounds import DAMPINGS, FILTER_TIMES, FORCES, STIFFNESSES, TIMES
from jaxhil.rig.filters import DelayLine, LeadFilter, VelocityFilter
from jaxhil.rig.registry import Compensator, GainSpecification, register
from jaxhil.rig.surfaces import deflection


@register("response_error")
class ResponseError(Compensator):
    """Compensator F_c = lead-filtered force + contact force that is missing due to the simulator's lag.

    The measured force is older than the measured position. The identification of stiffness and damping
    therefore uses the aligned position: the measured position, delayed by `identification_delay`. The weight
    of a reading is the product of two gates: aligned position in contact, and force above
    `contact_threshold`.
    """

    __slots__ = (
        "_aligned", "_aligned_velocity", "_alignment", "_clearance", "_contact_share", "_force",
        "_force_share", "_identification", "_lead", "_period", "_response_error", "_response_error_damping",
        "_started", "_threshold", "_velocity",
    )  # fmt: skip

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "phase_lead": GainSpecification("s", *TIMES),
        "lead_filter": GainSpecification("s", *FILTER_TIMES),
        "response_error": GainSpecification("1", 0.0, 2.0),
        "response_error_damping": GainSpecification("1", 0.0, 2.0),
        "initial_stiffness": GainSpecification("N/m", *STIFFNESSES),
        "initial_damping": GainSpecification("N s/m", *DAMPINGS),
        "stiffness_covariance": GainSpecification("1/m^2", 0.0, 1e20),
        "damping_covariance": GainSpecification("s^2/m^2", 0.0, 1e12),
        "forgetting": GainSpecification("1", 0.5, 1.0),
        "contact_threshold": GainSpecification("N", *FORCES),
        "identification_delay": GainSpecification("s", *TIMES),
        "velocity_filter": GainSpecification("s", *FILTER_TIMES),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._period = period
        self._clearance = clearance
        self._threshold = gains["contact_threshold"]
        self._response_error = gains["response_error"]
        self._response_error_damping = gains["response_error_damping"]
        self._lead = LeadFilter(gains["phase_lead"], gains["lead_filter"], period)
        self._velocity = VelocityFilter(gains["velocity_filter"], period)
        self._aligned_velocity = VelocityFilter(gains["velocity_filter"], period)
        self._alignment = DelayLine(gains["identification_delay"], period)
        self._identification = ContactIdentification(
            gains["initial_stiffness"],
            gains["initial_damping"],
            gains["stiffness_covariance"],
            gains["damping_covariance"],
            gains["forgetting"],
        )
        self._aligned = 0.0
        self._force = 0.0
        self._contact_share = 0.0
        self._force_share = 0.0
        self._started = False

    @property
    def identified(self) -> tuple[float, float]:
        """Return the identified stiffness [N/m] and damping [N s/m]."""
        return self._identification.stiffness, self._identification.damping

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the compensated force F_c [N]."""
        if not self._started:
            self._start(position_measured, velocity_desired)
        force = self._lead.step(force_measured)
        velocity_measured = self._velocity.step(position_measured)
        aligned = self._alignment.step(position_measured)
        aligned_velocity = self._aligned_velocity.step(aligned)

        aligned_before = self._aligned
        clearance = self._clearance
        depth = deflection(aligned, clearance)
        contact_share = share_beyond(depth, deflection(aligned_before, clearance), aligned - aligned_before)
        contact_gate = gate(contact_share, self._contact_share)
        threshold = self._threshold
        size = abs(force_measured)
        size_before = self._force
        force_share = share_beyond(
            size - threshold if size > threshold else 0.0,
            size_before - threshold if size_before > threshold else 0.0,
            size - size_before,
        )
        force_gate = gate(force_share, self._force_share)
        self._aligned = aligned
        self._force = size
        self._contact_share = contact_share
        self._force_share = force_share

        if contact_gate == 0.0:
            return force
        identification = self._identification
        if force_gate != 0.0:
            identification.update(force_measured, depth, aligned_velocity, contact_gate * force_gate)
        return force + contact_gate * (
            self._response_error * identification.stiffness * (position_desired - position_measured)
            + self._response_error_damping * identification.damping * (velocity_desired - velocity_measured)
        )

    def _start(self, position: float, velocity: float) -> None:
        # Assume uniform motion before the first tick, so that every filter begins in steady state.
        alignment = self._alignment
        alignment.start(position, velocity)
        self._velocity.start(position, velocity)
        aligned = alignment.step(position)
        self._aligned_velocity.start(aligned, velocity)
        self._aligned = aligned - self._period * velocity
        # The step above only served to compute the aligned position; restart the delay line.
        alignment.start(position, velocity)
        self._force = 0.0
        self._contact_share = 0.0
        self._force_share = 0.0
        self._started = True

    def reset(self) -> None:
        """Restart the filters, the delay line and the identification."""
        self._lead.reset()
        self._identification.reset()
        self._started = False

    def next_contact(self) -> None:
        """Restart the filters, the delay line and the covariance; keep identified stiffness and damping."""
        self._lead.reset()
        self._identification.restart_covariance()
        self._started = False
