"""Phase lead of the measured wrench, and response-error feedback along the docking axis in contact.

    F_c = lead(F) + g k_hat (x_d - x_a) + g_b b_hat (v_d - v_a)

x = -z is the position and v the velocity along the docking axis. The index d marks the numerical model, the
index a the measured motion. The gains are g and g_b; k_hat and b_hat are the identified stiffness and
damping. In contact, the force exceeds `contact_threshold`; the surface is at the last position before
contact. All other channels are lead(F).
"""

from collections.abc import Mapping
from typing import ClassVar

from jaxhil.laws.shared.recursive_least_squares.rig import ContactIdentification
from jaxhil.rig.bounds import FILTER_TIMES, FORCES, TIMES
from jaxhil.rig.filters import DelayLine, VelocityFilter
from jaxhil.rig.registry import GainSpecification
from jaxhil.rig.six_axes.filters import WrenchLead
from jaxhil.rig.six_axes.registry import ModelConstants, SixAxisCompensator, register_six_axes
from jaxhil.rig.six_axes.vectors import AXES, LAG_LEADS, lead_pose
from jaxhil.rig.types import Gains, Positive

DOCKING_AXIS = 2  # index of z


@register_six_axes("response_error")
class ResponseError(SixAxisCompensator):
    """Compensator: phase lead on all channels, and correction of the simulator's lag on the docking axis."""

    __slots__ = (
        "_aligned", "_aligned_velocity", "_alignment", "_identification", "_in_contact", "_lead",
        "_pose_leads", "_response_error", "_response_error_damping", "_started", "_surface", "_threshold",
        "_velocity",
    )  # fmt: skip

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "phase_lead": GainSpecification("s", *TIMES),
        "lead_filter": GainSpecification("s", *FILTER_TIMES),
        "response_error": GainSpecification("1", 0.0, 2.0),
        "response_error_damping": GainSpecification("1", 0.0, 2.0),
        "stiffness_covariance": GainSpecification("1/m^2", 0.0, 1e20),
        "damping_covariance": GainSpecification("s^2/m^2", 0.0, 1e12),
        "forgetting": GainSpecification("1", 0.5, 1.0),
        "velocity_filter": GainSpecification("s", *FILTER_TIMES),
        "identification_delay": GainSpecification("s", *TIMES),
        "contact_threshold": GainSpecification("N", *FORCES),
        **{name: GainSpecification("s", *TIMES) for name in LAG_LEADS},
    }

    def __init__(self, gains: Gains, constants: ModelConstants, period: Positive) -> None:
        self._lead = WrenchLead([gains["phase_lead"]] * AXES, gains["lead_filter"], period)
        self._pose_leads = [gains[name] for name in LAG_LEADS]
        self._response_error = gains["response_error"]
        self._response_error_damping = gains["response_error_damping"]
        self._threshold = gains["contact_threshold"]
        self._velocity = VelocityFilter(gains["velocity_filter"], period)
        self._aligned_velocity = VelocityFilter(gains["velocity_filter"], period)
        self._alignment = DelayLine(gains["identification_delay"], period)
        self._identification = ContactIdentification(
            0.0, 0.0, gains["stiffness_covariance"], gains["damping_covariance"], gains["forgetting"]
        )
        self.reset()

    def reset(self) -> None:
        """Restart filters, delay line and identification."""
        self._lead.reset()
        self._identification.reset()
        self._started = False
        self._in_contact = False
        self._aligned = 0.0
        self._surface = 0.0

    def step(self, wrench, pose_desired, twist_desired, pose_measured):
        """Return the compensated wrench [N, N m]."""
        force = wrench[DOCKING_AXIS]
        travel = -pose_measured[DOCKING_AXIS]
        speed = -twist_desired[DOCKING_AXIS]
        begins = not self._started
        if begins:
            self._alignment.start(travel, speed)
            self._velocity.start(travel, speed)
            self._started = True
        aligned = self._alignment.step(travel)
        if begins:
            self._aligned_velocity.start(aligned, speed)
            self._aligned = aligned
        velocity = self._velocity.step(travel)
        aligned_velocity = self._aligned_velocity.step(aligned)
        if not self._in_contact:
            self._surface = self._aligned
        self._aligned = aligned
        self._in_contact = abs(force) > self._threshold
        command = list(self._lead.step(wrench))
        if self._in_contact:
            identification = self._identification
            identification.update(force, aligned - self._surface, aligned_velocity, 1.0)
            stiffness = max(identification.stiffness, 0.0)
            damping = max(identification.damping, 0.0)
            command[DOCKING_AXIS] += self._response_error * stiffness * (
                -pose_desired[DOCKING_AXIS] - travel
            ) + self._response_error_damping * damping * (speed - velocity)
        return command

    def pose_command(self, pose, rates):
        """Return the pose command [m, rad]: the pose extrapolated by the lead times `lag_lead_...`."""
        return lead_pose(self._pose_leads, pose, rates)
