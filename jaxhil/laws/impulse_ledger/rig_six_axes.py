"""Six-axis impulse ledger: compensator that accounts for impulses at the numerical model's delayed time.

A wrench reading at time t is the wrench that should have acted on the numerical model at t - D, where D is
the delay of the whole loop. The compensator credits the impulse of every reading to the model's time t - D,
predicts the contact force from t - D to t with a scalar contact model, and commands the impulse that the
model still owes: the credited and predicted impulse minus the impulse commanded so far. `six_axes/README.md`
states the equations (a) to (e) to which the comments refer.
"""

from collections.abc import Mapping
from math import pi, sqrt
from typing import ClassVar

from jaxhil.laws.impulse_ledger.six_axes.constants import LATE, MIN_CONTACT_READINGS
from jaxhil.laws.impulse_ledger.six_axes.impulse_accounting.rig import Ledger
from jaxhil.laws.impulse_ledger.six_axes.reading.rig import SixAxisReader
from jaxhil.rig.bounds import DAMPINGS_BY_MASS, FORCES, STIFFNESSES_BY_MASS, TIMES
from jaxhil.rig.law_status import IDENTIFIED, OUT_OF_CONTACT, SATURATED, TOO_SHORT, UNSURE
from jaxhil.rig.registry import GainSpecification
from jaxhil.rig.six_axes.registry import ModelConstants, SixAxisCompensator, register_six_axes
from jaxhil.rig.six_axes.vectors import AXES, LAG_LEADS, add_multiple, lead_pose, wrench_at_target
from jaxhil.rig.types import Gains, Positive

MIN_SPREAD = 1e-3  # lower bound of a prior's standard deviation, so that the variance is not 0


@register_six_axes("impulse_ledger")
class ImpulseLedger(SixAxisCompensator):
    """Compensator that commands the contact impulse missing on the model; see the module's docstring."""

    __slots__ = (
        "_impulse", "_in_contact", "_ledger", "_period", "_pose_leads", "_reader", "_release_time", "_unpaid",
        "status",
    )  # fmt: skip
    _period: Positive

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "velocity_gain": GainSpecification("1/s", 0.0, 1e5),
        "position_gain": GainSpecification("1/s", 0.0, 100.0),
        "direction_pole": GainSpecification("1", 0.0, 0.95),
        "stiffness_spread": GainSpecification("1/s^2", MIN_SPREAD, STIFFNESSES_BY_MASS[1]),
        "damping_spread": GainSpecification("1/s", MIN_SPREAD, DAMPINGS_BY_MASS[1]),
        "force_spread": GainSpecification("1/s", MIN_SPREAD, DAMPINGS_BY_MASS[1]),
        "curvature_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
        "forgetting": GainSpecification("1", 0.5, 1.0),
        "correction_limit": GainSpecification("1", 0.0, 20.0),
        "release_time": GainSpecification("s", *TIMES),
        "settle": GainSpecification("s", *TIMES),
        "identification_delay": GainSpecification("s", *TIMES),
        "pose_filter": GainSpecification("s", *TIMES),
        "force_noise": GainSpecification("N", *FORCES),
        "torque_noise": GainSpecification("N m", *FORCES),
        **{name: GainSpecification("s", *TIMES) for name in LAG_LEADS},
    }

    def __init__(self, gains: Gains, constants: ModelConstants, period: Positive) -> None:
        self._period = period
        self._release_time = gains["release_time"]
        self._pose_leads = [gains[name] for name in LAG_LEADS]
        self._reader = SixAxisReader(gains, constants, period)
        self._ledger = Ledger(gains, constants, period)
        self.reset()

    def reset(self) -> None:
        """Begin a new run: forget all contacts, readings and commanded impulses."""
        self._reader.reset()
        self._ledger.reset()
        self._impulse = [0.0] * AXES  # I_c, impulse commanded so far [N s, N m s]
        self._in_contact = False
        self._unpaid = 0.0
        self.status = OUT_OF_CONTACT

    @property
    def loop_delay(self) -> float:
        """Return the hardware's delay D [s] relative to the model in the last contact; 0 before contacts."""
        return self._ledger.delay * self._period

    @property
    def unpaid_impulse(self) -> float:
        """Return the missing impulse after the last contact, divided by the impulse of all contacts."""
        return self._unpaid

    def step(self, wrench, pose_desired, twist_desired, pose_measured):
        """Return the wrench command on the numerical model about the target's origin T [N, N m]."""
        reader, ledger = self._reader, self._ledger
        reader.read(wrench, pose_desired, twist_desired, pose_measured, self._impulse, self._in_contact)
        begins = reader.loud and not self._in_contact
        if begins:
            ledger.begin(reader, pose_desired, twist_desired)
            self._in_contact = True
        if not self._in_contact:
            reader.weigh_tool()
            reader.quiet += 1.0
            self.status = OUT_OF_CONTACT
            return [0.0] * AXES
        command = ledger.follow(reader, self._impulse, begins)
        self.status = self._evaluate()
        reader.quiet = 0.0 if reader.loud else reader.quiet + 1.0
        if reader.quiet * self._period > self._release_time:
            self._in_contact = False
            self._unpaid = ledger.unpaid_share()
            return [0.0] * AXES
        self._impulse = add_multiple(self._impulse, self._period, command)
        return wrench_at_target(command, pose_desired)

    def pose_command(self, pose, rates):
        """Return the pose [m, rad], each coordinate extrapolated by its gain so that all lag equally."""
        return lead_pose(self._pose_leads, pose, rates)

    def _evaluate(self) -> int:
        """Return the quality of the last command as one of the numbers in `jaxhil.rig.law_status`."""
        ledger = self._ledger
        if ledger.tangent.readings < MIN_CONTACT_READINGS:
            return UNSURE
        if self.loop_delay * sqrt(ledger.tangent.stiffness) > LATE * pi:
            return TOO_SHORT
        return SATURATED if ledger.is_limited else IDENTIFIED
