"""Controller of a six-axis rig, which the rig calls once per control period.

Like the one-axis controller (`jaxhil.rig.controller`), this controller checks the inputs, audits every
contact and limits the outputs. The compensator that the gain file names computes the wrench. A trip is
latched until `reset`: the wrench ramps to 0, and the pose command retraces its path backwards. After
construction no method raises, and each method takes bounded time. C and T are the frames of the chaser's and
the target's interface.
"""

from collections.abc import Sequence
from math import nan
from typing import Any

from jaxhil.rig.clock import Clock
from jaxhil.rig.controller_base import ControllerBase
from jaxhil.rig.conversion import as_float
from jaxhil.rig.errors import make_gain_file_error
from jaxhil.rig.faults import CLOCK, LAW_IN_DOUBT, TARE, UNUSABLE
from jaxhil.rig.law_status import UNSTATED
from jaxhil.rig.six_axes.faults import SIX_AXIS_FAULTS
from jaxhil.rig.six_axes.gain_file import SixAxisGainFile, check_six_axis_document
from jaxhil.rig.six_axes.inputs import SixAxisInputGuard, WrenchTare
from jaxhil.rig.six_axes.outputs import PoseGuard, WrenchGuard
from jaxhil.rig.six_axes.registry import SIX_AXIS_COMPENSATORS, ModelConstants, SixAxisCompensator
from jaxhil.rig.six_axes.sensor import SensorReader
from jaxhil.rig.six_axes.vectors import AXES, Vector, coordinate_rates, is_finite
from jaxhil.rig.six_axes.watchdog import SixAxisWatchdog
from jaxhil.rig.types import Limits, Positive

CHANNEL_NAMES = ("fx", "fy", "fz", "mx", "my", "mz", "x", "y", "z", "rx", "ry", "rz")


class Controller6(ControllerBase):
    """Six-axis controller of the rig: a compensator with checks of its inputs, outputs and contacts.

    Attributes:
        faults: bits of the present tick's faults (`faults.SIX_AXIS_FAULTS`).
        seen: bits of all faults since `reset`.
        cause: bits of the faults that tripped the controller; 0 if it is not tripped.
        channels: bits of the sensor channels that have a fault in this tick, first wrench, then pose.
    """

    __slots__ = (
        "_clock", "_command", "_detail", "_forces", "_inputs", "_law", "_period", "_poses", "_sensor",
        "_sent", "_stopped", "_tare", "_watchdog", "cause", "faults", "seen",
    )  # fmt: skip
    fault_table = SIX_AXIS_FAULTS
    _check = staticmethod(check_six_axis_document)
    _command: Vector
    _sent: Vector
    _law: SixAxisCompensator
    _watchdog: SixAxisWatchdog

    def __init__(self, gain_file: SixAxisGainFile, source: str = "gain document") -> None:
        law = SIX_AXIS_COMPENSATORS[gain_file.compensator]
        period, constants = gain_file.control_period, gain_file.constants
        self._period = period
        try:
            self._law = law(gain_file.gains, constants, period)
        except ValueError as error:
            raise make_gain_file_error(
                source, "gains", str(error), "gains suitable for the control period"
            ) from None
        self._guard(gain_file.limits, constants, period)

    def _guard(self, limits: Limits, constants: ModelConstants, period: Positive) -> None:
        """Create the checks of tick times, inputs, contacts and outputs, and reset the controller."""
        self._period = period
        self._clock = Clock(limits, period)
        self._sensor = SensorReader(constants)
        self._tare = WrenchTare(limits)
        self._inputs = SixAxisInputGuard(limits)
        self._watchdog = SixAxisWatchdog(limits, constants, period, self._law.status != UNSTATED)
        self._forces = WrenchGuard(limits, period)
        self._poses = PoseGuard(limits, period)
        self._command = [0.0] * AXES
        self._sent = [0.0] * AXES
        self._stopped = False
        self.cause = 0
        self._restart()

    @property
    def channels(self) -> int:
        """Return the bits of the sensor channels that have a fault in this tick, first wrench, then pose."""
        return self._inputs.channels

    @property
    def at_rest(self) -> bool:
        """Return whether the pose command has come to rest after a trip."""
        return self.cause != 0 and self._poses.at_rest

    @property
    def bias(self) -> Vector:
        """Return the force sensor's bias [N, N m] from the last successful tare; 0 before a tare."""
        return list(self._tare.bias)

    @property
    def loop_delay(self) -> float:
        """Return the hardware's delay [s] relative to the model in the last contact; 0 if unknown."""
        return self._law.loop_delay

    @property
    def unpaid_impulse(self) -> float:
        """Return the remaining impulse error after a contact, as a share of the contact's impulse [1].

        The share is 0 if the compensator does not know it.
        """
        return self._law.unpaid_impulse

    @property
    def last_audit(self) -> tuple[float, float, float]:
        """Return momentum error, energy gain and uncorrected impulse error of the last audit [1]."""
        watchdog = self._watchdog
        return watchdog.momentum_error, watchdog.energy_gain, watchdog.unpaid_impulse

    def from_sensor(self, reading: Sequence[float], pose: Sequence[float]) -> Vector:
        """Convert a reading of the force sensor to the wrench that `step` and `tare` expect.

        A sensor on the moving side reads in the axes and about the origin of C; the weight of its tool is
        subtracted. A sensor on the fixed side reads in the axes and about the origin of T (section 5 of
        notebooks/guide/six_axes.md).

        Args:
            reading: reading of the sensor, about the origin of its frame [N, N m].
            pose: measured pose of C relative to T [m, rad].

        Returns:
            Wrench on the chaser about T's origin, in T axes [N, N m]; NaN if an argument is not six numbers.
        """
        return self._convert(as_vector(reading), as_vector(pose))

    def _convert(self, reading: Vector, pose: Vector) -> Vector:
        """Convert a reading of the force sensor to the wrench that `step` and `tare` expect.

        The reading [N, N m] is about the origin of the sensor's frame; the pose [m, rad] is the measured pose
        of C relative to T.
        """
        return self._sensor.convert(reading, pose)

    def tare(self, wrench: Sequence[float]) -> bool:
        """Add one wrench reading out of contact to the tare; return True when the tare has ended.

        Call this method once per tick before a run, until it returns True. The controller then subtracts the
        mean of these readings from every reading until the next tare. Unusable readings trip the controller
        with the fault `tare`.

        Args:
            wrench: wrench reading [N, N m].
        """
        return self._take(as_vector(wrench))

    def _take(self, wrench: Vector) -> bool:
        """Add one wrench reading out of contact to the tare; return true when the tare has ended."""
        if self.cause:
            return True
        over = self._tare.take(wrench)
        if self._tare.fatal:
            self._fail(TARE, "a reading out of contact")
        return over

    def step(
        self,
        wrench: Sequence[float],
        pose_desired: Sequence[float],
        twist_desired: Sequence[float],
        pose_measured: Sequence[float],
        time: float | None = None,
    ) -> Vector:
        """Return the wrench W_c [N, N m] on the numerical model for this tick, about T's origin.

        After a trip the wrench ramps to 0 and stays there until `reset`.

        Args:
            wrench: measured wrench on the chaser about T's origin, in T axes [N, N m].
            pose_desired: pose of C relative to T in the numerical model [m, rad].
            twist_desired: twist of C relative to T in the numerical model [m/s, rad/s].
            pose_measured: measured pose of C relative to T on the hardware [m, rad].
            time: time of the tick [s]; if None, the controller does not detect late and missed ticks.
        """
        return self._step(
            as_vector(wrench),
            as_vector(pose_desired),
            as_vector(twist_desired),
            as_vector(pose_measured),
            None if time is None else as_float(time),
        )

    def _step(
        self,
        wrench: Vector,
        pose_desired: Vector,
        twist_desired: Vector,
        pose_measured: Vector,
        time: float | None,
    ) -> Vector:
        """Return the wrench W_c [N, N m] on the numerical model for this tick, about T's origin.

        After a trip the wrench ramps to 0 and stays there until `reset`. The arguments are the measured
        wrench on the chaser about T's origin [N, N m], the numerical model's pose [m, rad] and twist [m/s,
        rad/s], the measured pose [m, rad], and the tick's time [s] or NULL.
        """
        forces, inputs = self._forces, self._inputs
        self.faults = 0
        inputs.locate(pose_measured)
        if self.cause:
            forces.fade()
            return list(forces.output)
        faults = 0
        fatal = 0
        if time is not None:
            faults = self._clock.tick(time)
            if self._clock.fatal:
                fatal = faults
        faults |= inputs.check(wrench, pose_desired, twist_desired, pose_measured, self._tare.bias)
        fatal |= inputs.fatal
        law, watchdog = self._law, self._watchdog
        if watchdog.on and not fatal:
            alarm = watchdog.tick(
                forces.output,
                law.status,
                law.loop_delay,
                law.unpaid_impulse,
                inputs.wrench,
                pose_desired,
                twist_desired,
            )
            faults |= alarm
            fatal = alarm & ~LAW_IN_DOUBT
        if not fatal:
            try:
                computed = self._compute(pose_desired, twist_desired)
            except Exception:  # whatever the compensator raises, the rig needs a command
                computed = False
            if not computed:
                self._command[0] = nan
            faults |= forces.limit(self._command)
            fatal = forces.fatal
        self.faults = faults
        self.seen |= faults
        if fatal:
            self._fail(fatal, self._describe(fatal))
            forces.fade()
        return list(forces.output)

    def _compute(self, pose_desired: Vector, twist_desired: Vector) -> bool:
        """Compute the compensator's wrench from the checked readings. Return true to mark success."""
        inputs = self._inputs
        self._command = self._law.step(inputs.wrench, pose_desired, twist_desired, inputs.measured)
        return True

    def pose_command(
        self, pose: Sequence[float], twist: Sequence[float], acceleration: Sequence[float] | None = None
    ) -> Vector:
        """Return the pose [m, rad] to command for the numerical model's motion after this tick's step.

        Two successive commands differ by at most `velocity_limit` and `angular_velocity_limit` times the
        period. A run's first command may differ from the measured pose by the same step. Out of contact, the
        limits are `start_distance` and `start_angle` instead, because moving drives lag behind. Before a
        run's first `step`, the model's pose replaces the measured pose.

        After a trip, the commands brake and then retrace their path for `retreat_distance`. The commands
        start from the last command or, if there is none, from the last measured pose.

        Args:
            pose: pose of C relative to T in the numerical model [m, rad].
            twist: twist of C relative to T in the numerical model [m/s, rad/s].
            acceleration: acceleration of the numerical model; no compensator uses it.
        """
        return self._pose_command(as_vector(pose), as_vector(twist))

    def _pose_command(self, pose: Vector, twist: Vector) -> Vector:
        """Return the pose [m, rad] to command for the numerical model's motion after this tick's step.

        The arguments are pose [m, rad] and twist [m/s, rad/s] of C relative to T in the numerical model.
        """
        poses, inputs = self._poses, self._inputs
        if not self.cause:
            computed = is_finite(pose) and is_finite(twist)
            if computed:
                computed = self._try_lead(pose, twist)
            if not computed:
                self._sent[0] = nan
            is_free = not self._law.is_acting
            faults = poses.limit(self._sent, pose, inputs.located, inputs.is_located, is_free)
            self.faults |= faults
            self.seen |= faults
            if not poses.fatal:
                return list(poses.output)
            self._fail(poses.fatal, "" if computed else "the numerical model's motion")
        poses.retreat(inputs.located, pose)
        return list(poses.output)

    def _try_lead(self, pose: Vector, twist: Vector) -> bool:
        """Try to compute the compensator's pose command; return whether this has succeeded."""
        try:
            computed = self._lead(pose, twist)
        except Exception:  # whatever the compensator raises, the rig needs a command
            computed = False
        return computed

    def _lead(self, pose: Vector, twist: Vector) -> bool:
        """Compute the compensator's pose command; return True, unless the compensator raises an exception."""
        self._sent = self._law.pose_command(pose, coordinate_rates(pose, twist))
        return True

    def reset(self) -> bool:
        """Restart everything except the tare. While the emergency stop is active, do nothing; return False.

        Wrench and pose command continue from their last values without a jump. If something else has moved
        the drives since the trip, also call `next_contact`.
        """
        if self._stopped or self.cause & UNUSABLE:
            return False
        self._restart()
        return True

    def _restart(self) -> None:
        """Restart everything except the tare."""
        self._law.reset()
        self._clock.reset()
        self._tare.restart()
        self._inputs.restart()
        self._watchdog.restart()
        self._forces.restart()
        self._poses.restart()
        self.cause = 0
        self.faults = 0
        self.seen = 0
        self._detail = ""

    def next_contact(self) -> None:
        """Begin a new run: restart filters, delay lines and estimates.

        Call this method after the rig has moved to the start of the run: the first pose command continues
        from the measured pose, not from the last command. A trip stays latched, and the gap before the next
        tick counts no missed ticks. If a contact has not ended, it is audited first, and `faults` contains
        the faults of this audit until the next `step`.
        """
        if self.cause:
            return
        law = self._law
        faults = self._watchdog.conclude(self._forces.output, law.status, law.unpaid_impulse)
        self.faults = faults
        self.seen |= faults
        fatal = faults & ~LAW_IN_DOUBT
        if fatal:
            self._fail(fatal, self._describe(fatal))
            return
        law.next_contact()
        self._clock.pause()
        self._inputs.restart()
        self._inputs.is_located = False
        self._watchdog.restart()
        self._poses.release()

    def _describe(self, fatal: int) -> str:
        """Describe a trip (faults `fatal`): name the bad sensor channels, or else give the audit's values."""
        if fatal & CLOCK:
            return ""
        bad = [name for n, name in enumerate(CHANNEL_NAMES) if self._inputs.channels >> n & 1]
        if bad:
            return ", ".join(bad)
        return self._watchdog.detail(fatal)


def as_vector(values: Any) -> Vector:
    """Convert six values to floats; an object that is not a number becomes NaN.

    If there are not six values, all results are NaN.
    """
    try:
        vector = [value if type(value) is float else as_float(value) for value in values]
    except TypeError:
        return [nan] * AXES
    return vector if len(vector) == AXES else [nan] * AXES
