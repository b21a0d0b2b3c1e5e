"""The controller that the rig calls once per control period.

It checks what comes in (`inputs`), watches every contact's energy (`watchdog`), leaves the law to the
compensator that its gain file names, and limits what goes out (`outputs`). What each of them may find, and
what follows, is the table of `faults`. A trip is latched until `reset`: the force is led to 0, the position
command to rest out of contact. No method raises once the controller is made; each takes bounded time.
"""

import os
from collections.abc import Mapping
from math import isfinite, nan
from typing import Any

from jaxhil.rig.clock import Clock
from jaxhil.rig.errors import refusal, shown
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
    names,
)
from jaxhil.rig.gain_file import GainFile, check_gain_document, read_gain_document
from jaxhil.rig.inputs import InputGuard, Tare
from jaxhil.rig.law_status import STATUS_NAMES, UNSTATED, ContactCount, ContactRecord, contact_record
from jaxhil.rig.outputs import ForceGuard, PositionGuard
from jaxhil.rig.registry import COMPENSATORS, Compensator
from jaxhil.rig.types import Bits, Limits, Positive, SmallInt
from jaxhil.rig.watchdog import Watchdog


class Controller:
    """One compensator with its gains, its guards and its state.

    Attributes: `faults`, the bits of the faults of this tick; `seen`, of all ticks since `reset`; `cause`,
    the bits that tripped it, 0 if nothing has.
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
            raise refusal(source, "gains", str(error), "gains that fit the control period") from None
        try:
            self._guard(gain_file.limits, period, clearance)
        except ValueError as error:
            raise refusal(source, "limits.alignment", str(error), "a delay that fits") from None

    def _guard(self, limits: Limits, period: Positive, clearance: float) -> None:
        """Set up the guards about the law, and begin."""
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
        """The controller of a gain file. Raises GainFileError for a file that does not fit."""
        source = os.fspath(path)
        return cls(check_gain_document(read_gain_document(source), source), source)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "Controller":
        """The controller of a gain file's content. Raises GainFileError if it does not fit."""
        return cls(check_gain_document(document))

    @property
    def control_period(self) -> float:
        """The control period [s] for which the gains hold."""
        return self._period

    @property
    def tripped(self) -> bool:
        """Whether a fault has tripped the controller since the last `reset`."""
        return self.cause != 0

    @property
    def status(self) -> str:
        """`ok`, or `tripped: ` and the reason."""
        if not self.cause:
            return "ok"
        return f"tripped: {', '.join(names(self.cause))}" + (f" ({self._detail})" if self._detail else "")

    @property
    def at_rest(self) -> bool:
        """Whether, after a trip, the position command has come to rest."""
        return self.tripped and self._positions.at_rest

    @property
    def bias(self) -> float:
        """The force sensor's bias [N] that the last good tare found."""
        return self._tare.bias

    @property
    def missed_ticks(self) -> int:
        """The control periods since `reset` without a tick, as far as the times passed to `step` tell."""
        return self._clock.missed

    @property
    def late_ticks(self) -> int:
        """The ticks since `reset` that came late, as far as the times passed to `step` tell."""
        return self._clock.late

    @property
    def identified(self) -> tuple[float, float]:
        """Identified stiffness [N/m] and damping [N s/m]; (0, 0) if the law identifies none."""
        return self._law.identified

    @property
    def force_delay(self) -> float:
        """Estimated delay [s] of the force measurement; 0 if the law estimates none."""
        return self._law.force_delay

    @property
    def law_status(self) -> str:
        """What the law says of the last command (`law_status.STATUSES`); `unstated` if it says nothing."""
        return STATUS_NAMES[self._status()]

    def _status(self) -> SmallInt:
        """Return what the law says of the last command, by its number."""
        return self._law.status

    @property
    def last_contact(self) -> ContactRecord:
        """What the law said of the contact audited last, whatever follows, `reset` included, until the next
        one is; contact 0 before the first."""
        return contact_record(self._last_count())

    def _last_count(self) -> ContactCount:
        """Return what the law said of the contact audited last, whatever follows, `reset` included, until the
        next one is."""
        return self._watchdog.record

    def tare(self, force_measured: float) -> bool:
        """Take in one reading [N] of the force sensor out of contact; True once there are enough.

        To be called once a tick before a run. Their mean is then taken from every reading, until the next
        tare. Readings that will not do trip, with the fault `tare`.
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
        """The force F_c [N] that the numerical model is to feel this tick.

        Force in N, positions in m, velocity in m/s. With `time` [s], ticks that come late or were missed
        are seen. Once tripped, the force goes to 0 and stays there until `reset`.
        """
        forces = self._forces
        self.faults = 0
        # Only what is no float yet takes time to be made one: the rig's numbers are.
        measured = position_measured if type(position_measured) is float else _float(position_measured)
        inputs = self._inputs
        inputs.locate(measured)
        if self.cause:
            forces.fade()
            return forces.output
        faults = 0
        fatal = 0
        if time is not None:
            faults = self._clock.tick(time if type(time) is float else _float(time))
            if self._clock.fatal:
                fatal = faults
        reading = force_measured if type(force_measured) is float else _float(force_measured)
        position = position_desired if type(position_desired) is float else _float(position_desired)
        velocity = velocity_desired if type(velocity_desired) is float else _float(velocity_desired)
        faults |= inputs.check(reading, position, velocity, measured, self._tare.bias)
        fatal |= inputs.fatal
        law = self._law
        watchdog = self._watchdog
        if watchdog.on and not fatal:
            status = law.status
            found = watchdog.tick(forces.output, status, inputs.force, position, velocity, inputs.measured)
            faults |= found
            fatal = found & ~LAW_IN_DOUBT
        if not fatal:
            try:
                command = law.step(inputs.force, position, velocity, inputs.measured)
            except Exception:  # a law's; the rig must not be left without a command
                command = nan
            faults |= forces.limit(command)
            fatal = forces.fatal
        self.faults = faults
        self.seen |= faults
        if fatal:
            self._fail(
                fatal,
                _detail(
                    fatal,
                    watchdog,
                    (time, force_measured, position_desired, velocity_desired, position_measured),
                ),
            )
            forces.fade()
        return forces.output

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """The position [m] to command, from the numerical model's motion after this tick's step.

        Position in m, velocity in m/s, acceleration in m/s^2. Once tripped, the way to rest out of contact.

        Whatever it is given, it is at most `velocity_limit` times the period from the last command. A run's
        first command is as near to the measured position; out of contact, where drives in motion follow late,
        it may be within `start_distance` of it. Before a run's first `step`, the model's position, if it is
        out of contact, is taken for where the rig has been brought to. A trip leads away from the last
        command, without one from the position measured last, without either from a place out of contact.
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
        """The law's position command [m] for a motion; not a number if that has none."""
        if not (isfinite(position) and isfinite(velocity) and isfinite(acceleration)):
            return nan
        try:
            return self._law.position_command(position, velocity, acceleration)
        except Exception:  # a law's; the rig must not be left without a command
            return nan

    def emergency_stop(self, active: bool) -> None:
        """Tell the controller the state of the rig's emergency stop; active, it trips.

        Handshake: call with True for as long as the stop is active (once is enough); the force goes to 0 and
        the position command to rest, then `at_rest` is True and the drives may be switched off; call with
        False when the stop is released; the trip stays latched until `reset`, which is refused before.
        """
        self._stopped = bool(active)
        if active:
            self._fail(EMERGENCY_STOP, "")

    def reset(self) -> bool:
        """Restart everything but the tare: filters, identified parameters, a trip, the count of ticks.

        Without a bump: force and position command go on from the last ones, within their limits. If the
        drives have been moved since by other means, call `next_contact` as well. Refused, with False, while
        the emergency stop is active.
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
        """Begin a fresh run for the next contact: filters, delay lines and covariance restart.

        To be called when the rig has been brought to the start of the run: the first position command goes
        on from where the drives then read, not from the last command. Identified parameters carry over, a
        trip stays latched, and the time until the next tick does not count as missed. A contact still under
        way is audited first: what that finds is in `faults` until the next `step`.
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
        # The first cause is the one to look at: what follows a trip may follow from it.
        if not self.cause:
            self.cause = cause
            self._detail = detail
        self.faults |= cause
        self.seen |= self.faults


def _float(value: Any) -> float:
    """The value as a float; not a number if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return nan


READINGS = "time", "force_measured", "position_desired", "velocity_desired", "position_measured"


def _detail(fatal: int, watchdog: Watchdog, values: tuple[Any, ...]) -> str:
    """Describe a cause in words, by the values of `READINGS`."""
    if fatal & RESTITUTION:
        return watchdog.detail()
    if fatal & (FORCE_NOT_FINITE | POSITION_NOT_FINITE | MODEL_NOT_FINITE | CLOCK):
        given = (
            item for item in zip(READINGS, values, strict=True) if item[1] is not None or item[0] != "time"
        )
        bad = (item for item in given if not isfinite(_float(item[1])))
        return ", ".join(f"{name} is {shown(value)}" for name, value in bad)
    return ""
