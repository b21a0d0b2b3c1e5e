"""Controller that the rig calls once per control period.

It checks the inputs (`inputs`), audits the energy of every contact (`watchdog`), computes the force with the
compensator that the gain file names, and limits the outputs (`outputs`). `faults` lists the faults that they
detect and the reactions. A trip is latched until `reset`: the force ramps to 0, the position command comes to
rest out of contact. After construction no method raises, and each takes bounded time.
"""

import os
from collections.abc import Mapping
from math import isfinite, nan
from typing import Any

from jaxhil.rig.clock import Clock
from jaxhil.rig.errors import format_value, make_gain_file_error
from jaxhil.rig.faults import (
    CLOCK,
    EMERGENCY_STOP,
    FORCE_NOT_FINITE,
    LAW_IN_DOUBT,
    MODEL_NOT_FINITE,
    POSITION_NOT_FINITE,
    RESTITUTION,
    TARE,
    UNUSABLE,
    fault_names,
)
from jaxhil.rig.gain_file import GainFile, check_gain_document, read_gain_document
from jaxhil.rig.inputs import InputGuard, Tare
from jaxhil.rig.law_status import STATUS_NAMES, UNSTATED, ContactCount, ContactRecord, contact_record
from jaxhil.rig.outputs import ForceGuard, PositionGuard
from jaxhil.rig.registry import COMPENSATORS, Compensator
from jaxhil.rig.types import Bits, Limits, Positive, SmallInt
from jaxhil.rig.watchdog import Watchdog


class Controller:
    """Compensator with its gains, its guards and its state.

    Attributes:
        faults: bits of the faults of this tick (`faults.FAULTS`).
        seen: bits of the faults of all ticks since `reset`.
        cause: bits of the faults that tripped the controller, 0 if none has.
    """

    __slots__ = (
        "_clock", "_detail", "_forces", "_inputs", "_law", "_period", "_positions", "_stopped", "_tare",
        "_watchdog", "cause", "faults", "seen",
    )  # fmt: skip
    cause: Bits
    faults: Bits
    seen: Bits
    _detail: str
    _law: Compensator

    def __init__(self, gain_file: GainFile, source: str = "gain document") -> None:
        law = COMPENSATORS[gain_file.compensator]
        period, clearance = gain_file.control_period, gain_file.clearance
        self._period = period
        try:
            self._law = law(gain_file.gains, period, clearance)
        except ValueError as error:
            raise make_gain_file_error(
                source, "gains", str(error), "gains that fit the control period"
            ) from None
        try:
            self._guard(gain_file.limits, period, clearance)
        except ValueError as error:
            raise make_gain_file_error(source, "limits.alignment", str(error), "a delay that fits") from None

    def _guard(self, limits: Limits, period: Positive, clearance: float) -> None:
        """Create the guards of inputs, contacts and outputs, and reset the controller."""
        self._clock = Clock(limits, period)
        self._tare = Tare(limits)
        self._inputs = InputGuard(limits, period, clearance)
        self._watchdog = Watchdog(limits, period, clearance, self._law.status != UNSTATED)
        self._forces = ForceGuard(limits, period)
        self._positions = PositionGuard(limits, period, clearance)
        self._stopped = False
        self.cause = 0
        self.reset()

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> "Controller":
        """Return the controller of a gain file.

        Args:
            path: path of the gain file.

        Raises:
            GainFileError: if the file is invalid.
        """
        source = os.fspath(path)
        return cls(check_gain_document(read_gain_document(source), source), source)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "Controller":
        """Return the controller of a gain document.

        Args:
            document: content of a gain file.

        Raises:
            GainFileError: if the document is invalid.

        Example:
            >>> from jaxhil.rig import Controller, digest
            >>> document = {
            ...     "schema": "jaxhil/gains/1",
            ...     "compensator": "none",
            ...     "gains": {},
            ...     "control_period": 0.001,
            ...     "mechanism": {"rig": {"control_period": 0.001}, "contact": {}},
            ... }
            >>> controller = Controller.from_dict(document | {"sha256": digest(document)})
            >>> controller.step(10.0, 0.001, -0.005, 0.0012)
            10.0
        """
        return cls(check_gain_document(document))

    @property
    def control_period(self) -> float:
        """Return the control period [s] for which the gains are valid."""
        return self._period

    @property
    def tripped(self) -> bool:
        """Return whether a fault has tripped the controller since the last `reset`."""
        return self.cause != 0

    @property
    def status(self) -> str:
        """Return `ok`, or `tripped: ` and the cause."""
        if not self.cause:
            return "ok"
        return f"tripped: {', '.join(fault_names(self.cause))}" + (
            f" ({self._detail})" if self._detail else ""
        )

    @property
    def at_rest(self) -> bool:
        """Return whether the position command has come to rest after a trip."""
        return self.tripped and self._positions.at_rest

    @property
    def bias(self) -> float:
        """Return the force sensor's bias [N] by the last successful tare."""
        return self._tare.bias

    @property
    def missed_ticks(self) -> int:
        """Return the number of missed ticks since `reset`, by the times passed to `step`."""
        return self._clock.missed

    @property
    def late_ticks(self) -> int:
        """Return the number of late ticks since `reset`, by the times passed to `step`."""
        return self._clock.late

    @property
    def identified(self) -> tuple[float, float]:
        """Return identified stiffness [N/m] and damping [N s/m]; (0, 0) if none are identified."""
        return self._law.identified

    @property
    def force_delay(self) -> float:
        """Return the estimated delay [s] of the force measurement; 0 if none is estimated."""
        return self._law.force_delay

    @property
    def law_status(self) -> str:
        """Return the compensator's status of the last command, a name in `law_status.STATUSES`."""
        return STATUS_NAMES[self._status()]

    def _status(self) -> SmallInt:
        """Return the number of the compensator's status of the last command."""
        return self._law.status

    @property
    def last_contact(self) -> ContactRecord:
        """Return the statuses of the last audited contact; its number is 0 before the first one.

        They remain until the next audit, even after `reset`.
        """
        return contact_record(self._last_count())

    def _last_count(self) -> ContactCount:
        """Return the statuses of the last audited contact, which remain even after `reset`."""
        return self._watchdog.record

    def tare(self, force_measured: float) -> bool:
        """Add one reading of the force sensor out of contact; return True once there are enough.

        Call it once per tick before a run. The mean of the readings is then subtracted from every reading
        until the next tare. Unusable readings trip the controller with the fault `tare`.

        Args:
            force_measured: force reading [N].
        """
        if self.cause:
            return True
        over = self._tare.take(force_measured if type(force_measured) is float else _float(force_measured))
        if self._tare.fatal:
            self._fail(TARE, f"reading {force_measured!r}")
        return over

    def step(
        self,
        force_measured: float,
        position_desired: float,
        velocity_desired: float,
        position_measured: float,
        time: float | None = None,
    ) -> float:
        """Return the force F_c [N] on the numerical model for this tick.

        After a trip the force ramps to 0 and stays there until `reset`.

        Args:
            force_measured: force reading [N].
            position_desired: position of the numerical model [m].
            velocity_desired: velocity of the numerical model [m/s].
            position_measured: position reading of the motion simulator [m].
            time: time of the tick [s]; without it, late and missed ticks are not detected.
        """
        forces, inputs = self._forces, self._inputs
        self.faults = 0
        # The rig passes floats: converting only other types saves time.
        measured = position_measured if type(position_measured) is float else _float(position_measured)
        inputs.locate(measured)
        if self.cause:
            forces.fade()
            return forces.output
        faults = fatal = 0
        if time is not None:
            faults = self._clock.tick(time if type(time) is float else _float(time))
            if self._clock.fatal:
                fatal = faults
        reading = force_measured if type(force_measured) is float else _float(force_measured)
        position = position_desired if type(position_desired) is float else _float(position_desired)
        velocity = velocity_desired if type(velocity_desired) is float else _float(velocity_desired)
        faults |= inputs.check(reading, position, velocity, measured, self._tare.bias)
        fatal |= inputs.fatal
        law, watchdog = self._law, self._watchdog
        if watchdog.on and not fatal:
            status = law.status
            alarm = watchdog.tick(forces.output, status, inputs.force, position, velocity, inputs.measured)
            faults |= alarm
            fatal = alarm & ~LAW_IN_DOUBT
        if not fatal:
            try:
                command = law.step(inputs.force, position, velocity, inputs.measured)
            except Exception:  # of any compensator: the rig always needs a command
                command = nan
            faults |= forces.limit(command)
            fatal = forces.fatal
        self.faults = faults
        self.seen |= faults
        if fatal:
            self._fail(fatal, _detail(fatal, watchdog, (
                time, force_measured, position_desired, velocity_desired, position_measured,
            )))  # fmt: skip
            forces.fade()
        return forces.output

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """Return the position [m] to command for the numerical model's motion after this tick's step.

        Two commands in a row differ by at most `velocity_limit` times the period. A run's first command
        differs as little from the measured position; out of contact, where moving drives lag behind, it may
        differ by `start_distance`. Before a run's first `step`, the model's position stands for the measured
        one if it is out of contact.

        After a trip the commands lead to rest out of contact. They begin at the last command; without one, at
        the last measured position; without either, at a position out of contact.

        Args:
            position: position of the numerical model [m].
            velocity: velocity of the numerical model [m/s].
            acceleration: acceleration of the numerical model [m/s^2].
        """
        positions, inputs = self._positions, self._inputs
        measured = inputs.located
        position = position if type(position) is float else _float(position)
        if not self.cause:
            velocity = velocity if type(velocity) is float else _float(velocity)
            acceleration = acceleration if type(acceleration) is float else _float(acceleration)
            command = self._sent(position, velocity, acceleration)
            faults = positions.limit(command, position, measured, inputs.is_located)
            self.faults |= faults
            self.seen |= faults
            if not positions.fatal:
                return positions.output
            self._fail(positions.fatal, "" if isfinite(command) else "the numerical model's motion")
        positions.retreat(measured, position)
        return positions.output

    def _sent(self, position: float, velocity: float, acceleration: float) -> float:
        """Return the compensator's position command [m], NaN if the motion is not finite or it raises."""
        if not (isfinite(position) and isfinite(velocity) and isfinite(acceleration)):
            return nan
        try:
            return self._law.position_command(position, velocity, acceleration)
        except Exception:  # of any compensator: the rig always needs a command
            return nan

    def emergency_stop(self, active: bool) -> None:
        """Set the state of the rig's emergency stop; an active stop trips the controller.

        Call it with True while the stop is active (once is enough). The force ramps to 0 and the position
        command comes to rest; then `at_rest` is True and the drives may be switched off. Call it with False
        after the stop is released. The trip stays latched until `reset`, which returns False before.

        Args:
            active: whether the stop is active.
        """
        self._stopped = bool(active)
        if active:
            self._fail(EMERGENCY_STOP, "")

    def reset(self) -> bool:
        """Restart everything but the tare; return False, without effect, while the emergency stop is active.

        Filters, identified parameters, trip and counts of ticks restart. Force and position command continue
        without a jump from their last values, within the limits. If the drives have been moved since by other
        means, call `next_contact` as well.
        """
        if self._stopped or self.cause & UNUSABLE:
            return False
        self._law.reset()
        self._clock.reset()
        self._tare.restart()
        self._inputs.restart()
        self._watchdog.restart()
        self._forces.restart()
        self._positions.restart()
        self.cause = 0
        self.faults = 0
        self.seen = 0
        self._detail = ""
        return True

    def next_contact(self) -> None:
        """Begin a new run for the next contact: restart filters, delay lines and covariance.

        Call it when the rig has been moved to the start of the run: the first position command continues from
        the measured position, not from the last command. Identified parameters remain, a trip stays latched,
        and the time until the next tick does not count as missed. A contact that is not over yet is audited
        first; its faults are in `faults` until the next `step`.
        """
        if self.cause:
            return
        faults = self._watchdog.conclude(self._forces.output, self._law.status)
        self.faults = faults
        self.seen |= faults
        fatal = faults & ~LAW_IN_DOUBT
        if fatal:
            self._fail(fatal, self._watchdog.detail() if fatal & RESTITUTION else "")
            return
        self._law.next_contact()
        self._clock.pause()
        self._inputs.restart()
        self._inputs.is_located = False
        self._watchdog.restart()
        self._positions.release()

    def _fail(self, cause: int, detail: str) -> None:
        # The first cause is the one to look at: later faults may be its consequences.
        if not self.cause:
            self.cause = cause
            self._detail = detail
        self.faults |= cause
        self.seen |= self.faults


def _float(value: Any) -> float:
    """Convert the value to a float; return NaN if it is no number."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return nan


READING_NAMES = "time", "force_measured", "position_desired", "velocity_desired", "position_measured"


def _detail(fatal: int, watchdog: Watchdog, values: tuple[Any, ...]) -> str:
    """Describe a cause by the watchdog's audit or by the values of `READING_NAMES` that are not finite."""
    if fatal & RESTITUTION:
        return watchdog.detail()
    if fatal & (FORCE_NOT_FINITE | POSITION_NOT_FINITE | MODEL_NOT_FINITE | CLOCK):
        items = (
            item
            for item in zip(READING_NAMES, values, strict=True)
            if item[1] is not None or item[0] != "time"
        )
        bad = (item for item in items if not isfinite(_float(item[1])))
        return ", ".join(f"{name} is {format_value(value)}" for name, value in bad)
    return ""
