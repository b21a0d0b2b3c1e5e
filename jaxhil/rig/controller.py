"""Controller that the rig calls once per control period.

The controller checks the inputs (`inputs`), audits the energy of every contact (`watchdog`), computes the
force with the compensator that the gain file names, and limits the outputs (`outputs`). `faults` lists all
faults and reactions. A trip is latched until `reset`: the force ramps to 0 and the position command comes to
rest out of contact. After construction no method raises, and each method takes bounded time.
"""

from math import isfinite, nan
from typing import Any

from jaxhil.rig.clock import Clock
from jaxhil.rig.controller_base import ControllerBase
from jaxhil.rig.conversion import as_float
from jaxhil.rig.errors import format_value, make_gain_file_error
from jaxhil.rig.faults import (
    CLOCK,
    FAULTS,
    FORCE_NOT_FINITE,
    LAW_IN_DOUBT,
    MODEL_NOT_FINITE,
    POSITION_NOT_FINITE,
    RESTITUTION,
    TARE,
    UNUSABLE,
)
from jaxhil.rig.gain_file import GainFile, check_gain_document
from jaxhil.rig.inputs import InputGuard, Tare
from jaxhil.rig.law_status import UNSTATED
from jaxhil.rig.outputs import ForceGuard, PositionGuard
from jaxhil.rig.registry import COMPENSATORS, Compensator
from jaxhil.rig.types import Limits, Positive
from jaxhil.rig.watchdog import Watchdog


class Controller(ControllerBase):
    """Controller of the rig: a compensator with checks of its inputs, outputs and contacts.

    Attributes:
        faults: bits of the present tick's faults (`faults.FAULTS`).
        seen: bits of all faults since `reset`.
        cause: bits of the faults that tripped the controller; 0 if it is not tripped.
    """

    __slots__ = (
        "_clock", "_detail", "_forces", "_inputs", "_law", "_period", "_positions", "_stopped", "_tare",
        "_watchdog", "cause", "faults", "seen",
    )  # fmt: skip
    fault_table = FAULTS
    _check = staticmethod(check_gain_document)
    _law: Compensator
    _watchdog: Watchdog

    def __init__(self, gain_file: GainFile, source: str = "gain document") -> None:
        law = COMPENSATORS[gain_file.compensator]
        period, clearance = gain_file.control_period, gain_file.clearance
        self._period = period
        try:
            self._law = law(gain_file.gains, period, clearance)
        except ValueError as error:
            raise make_gain_file_error(
                source, "gains", str(error), "gains suitable for the control period"
            ) from None
        try:
            self._guard(gain_file.limits, period, clearance)
        except ValueError as error:
            raise make_gain_file_error(source, "limits.alignment", str(error), "a shorter delay") from None

    def _guard(self, limits: Limits, period: Positive, clearance: float) -> None:
        """Create the checks of tick times, inputs, contacts and outputs, and reset the controller."""
        self._clock = Clock(limits, period)
        self._tare = Tare(limits)
        self._inputs = InputGuard(limits, period, clearance)
        self._watchdog = Watchdog(limits, period, clearance, self._law.status != UNSTATED)
        self._forces = ForceGuard(limits, period)
        self._positions = PositionGuard(limits, period, clearance)
        self._stopped = False
        self.cause = 0
        self.reset()

    @property
    def at_rest(self) -> bool:
        """Return whether the position command has come to rest after a trip."""
        return self.tripped and self._positions.at_rest

    @property
    def bias(self) -> float:
        """Return the force sensor's bias [N] from the last successful tare; 0 before a tare."""
        return self._tare.bias

    @property
    def identified(self) -> tuple[float, float]:
        """Return the identified stiffness [N/m] and damping [N s/m]; (0, 0) if nothing is identified."""
        return self._law.identified

    @property
    def force_delay(self) -> float:
        """Return the estimated delay [s] of the force measurement; 0 if none is estimated."""
        return self._law.force_delay

    def tare(self, force_measured: float) -> bool:
        """Add a reading to the tare, which averages force readings out of contact; return True at its end.

        Call this method once per tick before a run, until it returns True. The controller then subtracts the
        mean (the bias) from every reading until the next tare. Unusable readings trip the controller with the
        fault `tare`.

        Args:
            force_measured: force reading [N].
        """
        if self.cause:
            return True
        over = self._tare.take(force_measured if type(force_measured) is float else as_float(force_measured))
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
            time: time of the tick [s]; if None, the controller does not detect late and missed ticks.
        """
        forces, inputs = self._forces, self._inputs
        self.faults = 0
        # The rig usually passes floats: to skip their conversion saves time.
        measured = position_measured if type(position_measured) is float else as_float(position_measured)
        inputs.locate(measured)
        if self.cause:
            forces.fade()
            return forces.output
        faults = fatal = 0
        if time is not None:
            faults = self._clock.tick(time if type(time) is float else as_float(time))
            if self._clock.fatal:
                fatal = faults
        reading = force_measured if type(force_measured) is float else as_float(force_measured)
        position = position_desired if type(position_desired) is float else as_float(position_desired)
        velocity = velocity_desired if type(velocity_desired) is float else as_float(velocity_desired)
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
            except Exception:  # whatever a compensator raises, the rig needs a command
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

        Two successive commands differ by at most `velocity_limit` times the period. The same limit applies
        between the measured position and a run's first command. If the model is out of contact, the first
        command may be up to `start_distance` from the measured position, because moving drives lag behind
        their commands. Without a measured position, the model's position replaces it.

        After a trip, the commands move to rest out of contact. The commands start from the last command or,
        if there is none, from the last measured position. If there is neither, they start from a position out
        of contact.

        Args:
            position: position of the numerical model [m].
            velocity: velocity of the numerical model [m/s].
            acceleration: acceleration of the numerical model [m/s^2].
        """
        positions, inputs = self._positions, self._inputs
        measured = inputs.located
        position = position if type(position) is float else as_float(position)
        if not self.cause:
            velocity = velocity if type(velocity) is float else as_float(velocity)
            acceleration = acceleration if type(acceleration) is float else as_float(acceleration)
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
        """Return the compensator's position command [m]; NaN if it raises or an argument is not finite."""
        if not (isfinite(position) and isfinite(velocity) and isfinite(acceleration)):
            return nan
        try:
            return self._law.position_command(position, velocity, acceleration)
        except Exception:  # whatever a compensator raises, the rig needs a command
            return nan

    def reset(self) -> bool:
        """Clear the trip and restart everything except the force sensor's bias; return True.

        While the emergency stop is active, do nothing and return False. Filters, identified parameters and
        tick counts restart. Force and position command continue from their last values without a jump. If
        the drives have moved without these commands since the trip, also call `next_contact`.
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
        """Begin a new run: restart filters, delay lines and the covariance of the identified parameters.

        Call this method after the rig has moved to the start of the run: the first position command continues
        from the measured position, not from the last command. Identified parameters remain, and the gap
        before the next tick counts no missed ticks. If a contact has not ended, it is audited first, and
        `faults` contains the faults of this audit until the next `step`. After a trip, do nothing.
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


READING_NAMES = "time", "force_measured", "position_desired", "velocity_desired", "position_measured"


def _detail(fatal: int, watchdog: Watchdog, values: tuple[Any, ...]) -> str:
    """Describe what tripped the controller: a contact's audit, or arguments of `step` that are not finite."""
    if fatal & RESTITUTION:
        return watchdog.detail()
    if fatal & (FORCE_NOT_FINITE | POSITION_NOT_FINITE | MODEL_NOT_FINITE | CLOCK):
        items = (
            item
            for item in zip(READING_NAMES, values, strict=True)
            if item[1] is not None or item[0] != "time"
        )
        invalid = (item for item in items if not isfinite(as_float(item[1])))
        return ", ".join(f"{name} is {format_value(value)}" for name, value in invalid)
    return ""
