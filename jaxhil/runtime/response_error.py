"""Response-error force compensation with real-time identification of the contact.

F_c = y + g k (x_d - x_m) + g_b b (v_d - v_m): y is the phase-led force, k and b the identified
contact stiffness and damping, x_d - x_m the position by which the motion simulator lags the
numerical model. No model of the simulator is used. The response term acts only while the
delay-aligned position is in contact, and F_c is not clamped: a clamp makes the divergence worse.

Source: Qi, Zhao, Gao, Ren, Hu, "Divergence compensation for hardware-in-the-loop simulation of
stiffness-varying discrete contact in space", Acta Astronautica 2016, and later papers of that
group.
"""

from collections.abc import Mapping
from typing import ClassVar

from .filters import DelayLine, LeadFilter, VelocityFilter
from .identification import ContactIdentification
from .registry import GainSpecification, register


@register("response_error")
class ResponseError:
    """Phase lead, plus the force that the motion simulator's response error leaves out.

    The measured force is late against the measured position, so the identification regresses it on
    the position delayed by `identification_delay` (the delay-aligned position). That position x
    deflects the contact by x where x > 0, by x + clearance where x < -clearance, and by 0 in
    between.
    """

    __slots__ = (
        "_aligned_velocity",
        "_alignment",
        "_clearance",
        "_identification",
        "_lead",
        "_response_error",
        "_response_error_damping",
        "_started",
        "_threshold",
        "_velocity",
    )

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "phase_lead": GainSpecification("s"),
        "lead_filter": GainSpecification("s", lowest=0.0, exclusive=True),
        "response_error": GainSpecification("1"),
        "response_error_damping": GainSpecification("1"),
        "initial_stiffness": GainSpecification("N/m"),
        "initial_damping": GainSpecification("N s/m"),
        "stiffness_covariance": GainSpecification("1/m^2", lowest=0.0),
        "damping_covariance": GainSpecification("s^2/m^2", lowest=0.0),
        "forgetting": GainSpecification("1", lowest=0.0, highest=1.0, exclusive=True),
        "contact_threshold": GainSpecification("N", lowest=0.0),
        "identification_delay": GainSpecification("s", lowest=0.0),
        "velocity_filter": GainSpecification("s", lowest=0.0),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
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
        self._started = False

    @property
    def identified(self) -> tuple[float, float]:
        """Identified stiffness [N/m] and damping [N s/m]."""
        return self._identification.stiffness, self._identification.damping

    def step(
        self,
        force_measured: float,
        position_desired: float,
        velocity_desired: float,
        position_measured: float,
    ) -> float:
        """The compensated force F_c [N]."""
        if not self._started:
            self._start(position_measured, velocity_desired)
        force = self._lead.step(force_measured)
        velocity_measured = self._velocity.step(position_measured)
        aligned = self._alignment.step(position_measured)
        aligned_velocity = self._aligned_velocity.step(aligned)

        clearance = self._clearance
        if aligned > 0.0:
            deflection = aligned
        elif aligned < -clearance:
            deflection = aligned + clearance
        else:
            return force

        identification = self._identification
        threshold = self._threshold
        if force_measured > threshold or force_measured < -threshold:
            identification.update(force_measured, deflection, aligned_velocity)
        return (
            force
            + self._response_error * identification.stiffness * (position_desired - position_measured)
            + self._response_error_damping * identification.damping * (velocity_desired - velocity_measured)
        )

    def _start(self, position: float, velocity: float) -> None:
        # Before the first tick the motion is uniform, so every filter begins in steady state.
        alignment = self._alignment
        alignment.start(position, velocity)
        self._velocity.start(position, velocity)
        self._aligned_velocity.start(alignment.step(position), velocity)
        # That step only asked for the aligned position: the tick itself takes the sample in.
        alignment.start(position, velocity)
        self._started = True

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """The numerical model's position [m] itself."""
        return position

    def reset(self) -> None:
        """Restart filters, delay line and identification."""
        self._lead.reset()
        self._identification.reset()
        self._started = False

    def next_contact(self) -> None:
        """Restart filters, delay line and covariance; keep the identified stiffness and damping."""
        self._lead.reset()
        self._identification.restart_covariance()
        self._started = False
