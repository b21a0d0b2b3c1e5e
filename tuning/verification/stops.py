"""Description of how a limit of a gain file stops a run: fault, value, limit, contact and time.

`RecordingController` is the rig's controller with a record of its inputs, which explains a stop. `find_stop`
replays a recorded run through this controller. `find_passing_limits` finds limits that do not stop the run.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from jaxhil.rig import Controller, faults
from jaxhil.rig.gain_file import GainFile
from jaxhil.rig.law_status import STATUSES
from jaxhil.rig.limits import LIMITS, NO_LIMITS
from jaxhil.rig.watchdog import Watchdog

if TYPE_CHECKING:  # This import needs JAX, which takes a second, and would delay early error messages.
    from jaxhil.simulation.recording import LaneRecord

WATCHDOG_FAULTS = faults.RESTITUTION | faults.ENERGY_BALANCE | faults.CONTACT_TOO_LONG
# Names of the limits whose violation raises each fault; two names are the lower and the upper limit.
FAULT_LIMITS: Mapping[int, tuple[str, ...]] = {
    faults.FORCE_OUT_OF_RANGE: ("force_range",),
    faults.POSITION_OUT_OF_RANGE: ("measured_lowest", "measured_highest"),
    faults.FORCE_STUCK: ("force_stuck_travel",),
    faults.POSITION_STUCK: ("position_stuck_travel",),
    faults.FORCE_IN_FLIGHT: ("free_force",),
    faults.FORCE_LIMIT: ("force_limit",),
    faults.FORCE_SLEW: ("force_slew",),
    faults.STROKE: ("command_lowest", "command_highest"),
    faults.VELOCITY_LIMIT: ("velocity_limit",),
    faults.RESTITUTION: ("restitution_margin",),
    faults.ENERGY_BALANCE: ("energy_balance",),
    faults.CONTACT_TOO_LONG: ("longest_contact",),
}
LIMIT_WIDENING = 1.25  # proposed limit, divided by the value that the run reaches [1]
MAX_LIMIT_CHANGES = 24  # largest number of limits that are widened, one after the other, until a run passes
STATUS_NUMBERS = {status.name: status.number for status in STATUSES}


class ControllerStop(msgspec.Struct, frozen=True, kw_only=True):
    """First fault to which the controller reacts in a run: it trips, or it changes a reading or command."""

    fault: str  # name of the fault, as in `jaxhil.rig.faults`
    by: str  # part of the controller that raises the fault: "watchdog" or "guard"
    tripped: bool  # True if the controller trips; False if it only replaces a reading or limits a command
    contact: int  # number, from 1, of the contact; for a trip by an audit, of the audited contact
    tick: int  # tick of the run, from 0
    time: float  # time since the start of the run [s]
    found: float | None  # value that is compared with the limit [`unit`]; None if there is no such number
    limit: str | None  # name of the limit; None if the fault has no limit
    allowed: float | None  # value of the limit [`unit`]
    unit: str | None  # unit of the limit
    text: str  # description with all fields above


class TickInputs(NamedTuple):
    """Inputs of the controller in one tick, and its force command in the previous tick."""

    begins: bool  # whether the next contact was announced before this tick
    command: float  # force command in the previous tick [N]
    status: int  # status of the compensator at this force command
    force: float  # measured force [N]
    position: float  # position of the numerical model [m]
    velocity: float  # velocity of the numerical model [m/s]
    measured: float  # measured position [m]


class RecordingController:
    """Rig's controller that records its inputs until the first fault on which it acts."""

    def __init__(self, gain_file: GainFile):
        self.controller = Controller(gain_file)
        self._gain_file = gain_file
        self._ticks: list[TickInputs] = []
        self._motions: dict[int, tuple[float, float, float]] = {}  # motion of the numerical model by tick
        self._force, self._sent = 0.0, math.nan
        self._begins = self._announced = False
        self._acting = 0

    @property
    def stopped(self) -> bool:
        """Return whether the controller has acted on a fault."""
        return self._acting != 0

    def next_contact(self) -> None:
        """Announce the next contact; this makes the watchdog audit the current contact."""
        self.controller.next_contact()
        if not self.stopped:
            self._begins = self._announced = True
        self._record_faults()

    def start(self, position: float, velocity: float) -> None:
        """Set position [m] and velocity [m/s] of the numerical model before the first tick of a run."""
        self.controller.position_command(position, velocity, 0.0)

    def step(self, force: float, position: float, velocity: float, measured: float) -> float:
        """Return the controller's force command [N] for one tick."""
        if not self.stopped:
            status = STATUS_NUMBERS[self.controller.law_status]
            self._ticks.append(
                TickInputs(self._begins, self._force, status, force, position, velocity, measured)
            )
            self._announced = self._begins = False
        self._force = self.controller.step(force, position, velocity, measured)
        self._record_faults()
        return self._force

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """Return the controller's position command [m] for one tick."""
        if not self.stopped:
            self._motions[len(self._ticks) - 1] = (position, velocity, acceleration)
        sent = self.controller.position_command(position, velocity, acceleration)
        self._record_faults()
        return sent

    def stop(self) -> ControllerStop | None:
        """Describe the first fault on which the controller acted; return None if there was no such fault."""
        if not self.stopped:
            return None
        fault = next(candidate for candidate in faults.FAULTS if self._acting & candidate.bit)
        watchdog = self._replay_watchdog()
        found, limit, description = self._describe_value(fault.bit, watchdog)
        allowed = None if limit is None else float(self._gain_file.limits[limit])
        audited = fault.bit & (faults.RESTITUTION | faults.ENERGY_BALANCE)
        contact = watchdog.contacts + (0 if audited else 1)
        tick = len(self._ticks) - 1
        time = tick * self._gain_file.control_period
        by = "watchdog" if fault.bit & WATCHDOG_FAULTS else "guard"
        tripped = self.controller.tripped
        unit = None if limit is None else LIMITS[limit].unit
        stated = "" if limit is None else f", {limit} {allowed:.4g}{'' if unit == '1' else f' {unit}'}"
        text = (
            f"{'stopped' if tripped else 'changed'} at {time:.4g} s (tick {tick}), "
            f"{'after' if audited else 'in or before'} contact {contact}, by the {by}'s check {fault.name}: "
            f"{description or fault.condition.removeprefix('watchdog: ')}{stated}"
        )
        return ControllerStop(
            fault=fault.name, by=by, tripped=tripped, contact=contact, tick=tick, time=time, found=found,
            limit=limit, allowed=allowed, unit=unit, text=text,
        )  # fmt: skip

    def _record_faults(self) -> None:
        """Store the first faults on which the controller acts; it does not act on `LAW_IN_DOUBT`."""
        if not self._acting:
            self._acting = self.controller.cause or self.controller.faults & ~faults.LAW_IN_DOUBT

    def _replay_watchdog(self) -> Watchdog:
        """Replay the recorded inputs through a new watchdog; return this watchdog."""
        file = self._gain_file
        stated = STATUS_NUMBERS[self.controller.law_status] != STATUS_NUMBERS["unstated"]
        watchdog = Watchdog(file.limits, file.control_period, file.clearance, stated)
        for tick in self._ticks:
            if tick.begins:
                watchdog.conclude(tick.command, tick.status)
                watchdog.restart()
            watchdog.tick(*tick[1:])
        if self._announced:
            watchdog.conclude(self._force, STATUS_NUMBERS[self.controller.law_status])
        return watchdog

    def _describe_value(self, fault: int, watchdog: Watchdog) -> tuple[float | None, str | None, str]:
        """Return the value that violates a fault's limit, the limit's name, and a description of the value.

        The value is None if it cannot be compared with the limit. If the fault has no limit, value and name
        are None, and the description is empty.
        """
        names = FAULT_LIMITS.get(fault)
        if not names:
            return None, None, ""
        if fault == faults.RESTITUTION:
            value = abs(watchdog.restitution - watchdog.expected)
            pair = f"restitution {watchdog.restitution:.4g} and expected {watchdog.expected:.4g}"
            return value, names[0], f"{pair} differ by {value:.2g}"
        if fault == faults.ENERGY_BALANCE:
            return None, names[0], f"the energy balance is {abs(watchdog.balance):.3g} J"
        if fault == faults.CONTACT_TOO_LONG:
            return (
                self._gain_file.limits[names[0]] + self._gain_file.control_period,
                names[0],
                "the contact has not ended",
            )
        if fault == faults.VELOCITY_LIMIT and math.isfinite(first := self._compute_start_distance()):
            return first, "start_distance", f"the first command is {first:.4g} m from the measured position"
        value = self._find_compared_value(fault)
        *lower, limit = names
        if lower and value < self._gain_file.limits[lower[0]]:
            limit = lower[0]
        unit = LIMITS[limit].unit
        return value, limit, f"{value:.4g} {unit}"

    def _find_compared_value(self, fault: int) -> float:
        """Return the value that a guard compares with the limit of `fault`, in the unit of this limit."""
        tick, period = self._ticks[-1], self._gain_file.control_period
        if fault in (faults.FORCE_OUT_OF_RANGE, faults.FORCE_IN_FLIGHT):
            return abs(tick.force)
        if fault == faults.POSITION_OUT_OF_RANGE:
            return tick.measured
        if fault == faults.FORCE_STUCK:
            return self._compute_travel("force", "measured", in_contact=True)
        if fault == faults.POSITION_STUCK:
            return self._compute_travel("measured", "position", in_contact=False)
        command, before, sent = self._compute_unlimited_commands()
        if fault == faults.FORCE_LIMIT:
            return abs(command)
        if fault == faults.FORCE_SLEW:
            return abs(command - tick.command) / period
        return sent if fault == faults.STROKE else abs(sent - before) / period

    def _compute_start_distance(self) -> float:
        """Return the distance [m] between measured position and position command at the first tick of a run.

        Return NaN if the last recorded tick is not the first tick of its run.
        """
        _, before, sent = self._compute_unlimited_commands()
        return math.nan if math.isfinite(before) else abs(sent - self._ticks[-1].measured)

    def _compute_travel(self, constant: str, moving: str, in_contact: bool) -> float:
        """Return the distance [m] that `moving` has travelled since the last change of the signal `constant`.

        With `in_contact`, the distance begins at the last tick without contact, if this is later.
        """
        travel, clearance = 0.0, self._gain_file.clearance
        for tick in range(len(self._ticks) - 1, 0, -1):
            now, before = self._ticks[tick], self._ticks[tick - 1]
            if getattr(now, constant) != getattr(before, constant) or now.begins:
                break
            if in_contact and -clearance <= now.measured <= 0.0:
                break
            travel += abs(getattr(now, moving) - getattr(before, moving))
        return travel

    def _compute_unlimited_commands(self) -> tuple[float, float, float]:
        """Return the commands that the same controller would have sent without limits.

        These are the force command [N] of the last recorded tick, and the last two position commands [m].
        """
        free = Controller(self._gain_file._replace(limits=NO_LIMITS))
        force, before, sent = 0.0, math.nan, math.nan
        for number, tick in enumerate(self._ticks):
            if tick.begins:
                free.next_contact()
                sent = math.nan
            force = free.step(*tick[3:])
            if number in self._motions:
                before, sent = sent, free.position_command(*self._motions[number])
        return force, before, sent


def find_stop(gain_file: GainFile, lane: "LaneRecord") -> ControllerStop | None:
    """Replay a recorded run; return the first fault on which the controller acts, or None.

    The watchdog audits the last contact at the end of the run.
    """
    controller = RecordingController(gain_file)
    readings = list(zip(*(leaf.tolist() for leaf in lane.signals), strict=True))
    for tick, (*signals, age) in enumerate(readings):
        if age == 0 and tick > 0:
            controller.next_contact()
        if not controller.stopped:
            controller.step(*signals)
        if not controller.stopped and tick + 1 < len(readings) and readings[tick + 1][4] == age + 1:
            position, velocity = readings[tick + 1][1:3]
            acceleration = (velocity - signals[2]) / gain_file.control_period
            controller.position_command(position, velocity, acceleration)
        if controller.stopped:
            return controller.stop()
    controller.next_contact()
    return controller.stop()


def find_passing_limits(gain_file: GainFile, lane: "LaneRecord") -> dict[str, float] | None:
    """Widen limits until the controller no longer acts on a fault in a recorded run.

    Return the changed limits by name, or None if no change of limits helps.
    """
    limits, changed = dict(gain_file.limits), {}
    for _ in range(MAX_LIMIT_CHANGES):
        stop = find_stop(gain_file._replace(limits=limits), lane)
        if stop is None:
            return changed
        if stop.limit is None or stop.found is None:
            return None
        limits[stop.limit] = changed[stop.limit] = _widen_limit(stop.limit, stop.found)
    return None


def describe_limit_changes(passing: Mapping[str, float] | None) -> str:
    """Describe to the user the limits `passing`, with which the controller does not stop a run."""
    if not passing:
        return "no change of limits prevents this"
    changes = " ".join(f"--set {name}={value:g}" for name, value in passing.items())
    return f"tune better gains, or use {changes}, which lets this run and similar runs pass"


def _widen_limit(name: str, found: float) -> float:
    """Return a limit beyond the value `found`, rounded outward to two significant digits."""
    outward = -1.0 if name.endswith("_lowest") else 1.0
    value = found + outward * (LIMIT_WIDENING - 1) * abs(found)
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 1) if value else 1.0
    rounded = outward * math.ceil(outward * value / unit) * unit
    limit = LIMITS[name]
    return min(max(float(f"{rounded:.2g}"), limit.lowest), limit.highest)
