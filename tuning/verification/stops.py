"""Stops of runs by the limits of a gain file: fault, value, limit, contact and time, in numbers and words.

`RecordingController` is the rig's controller with a record of its inputs, from which it determines its stop.
`find_stop` runs it on a recorded run, and `find_passing_limits` returns limits under which that run passes.
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

if TYPE_CHECKING:  # It imports JAX, which takes a second; an early error need not wait for that.
    from jaxhil.simulation.recording import LaneRecord

WATCHDOG_FAULTS = faults.RESTITUTION | faults.ENERGY_BALANCE | faults.CONTACT_TOO_LONG
# Name of the limit of each fault that has one; two names are the lower and the upper limit.
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
LIMIT_WIDENING = 1.25  # proposed limit over the value that the run needs
MAX_LIMIT_CHANGES = 24  # largest number of changes of limits that are tried until a run passes
STATUS_NUMBERS = {status.name: status.number for status in STATUSES}


class ControllerStop(msgspec.Struct, frozen=True, kw_only=True):
    """First stop of a run, or first other action of the controller on a fault."""

    fault: str  # name of the fault, as in `jaxhil.rig.faults`
    by: str  # "watchdog" or "guard"
    tripped: bool  # whether the controller tripped; otherwise it only flagged a reading or limited a command
    contact: int  # number of the current, just audited or next contact, from 1
    tick: int  # tick of the run, from 0
    time: float  # time since the run began [s]
    found: float | None  # value compared with the limit [its unit]; None if it is no number
    limit: str | None  # name of the limit; None if the fault has none
    allowed: float | None  # value of the limit
    unit: str | None  # unit of the limit
    text: str  # description with all of the above


class TickInputs(NamedTuple):
    """Inputs of the controller at a tick, and its command of the tick before."""

    begins: bool  # whether the next contact was announced before the tick
    given: float  # force command [N] of the tick before
    status: int  # status of the law at that command
    force: float  # measured force [N]
    position: float  # position of the numerical model [m]
    velocity: float  # velocity of the numerical model [m/s]
    measured: float  # measured position [m]


class RecordingController:
    """Controller of the rig with a record of its inputs up to the first fault on which it acted."""

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
        """Announce the next contact, at which the watchdog audits the current one."""
        self.controller.next_contact()
        if not self.stopped:
            self._begins = self._announced = True
        self._record_faults()

    def start(self, position: float, velocity: float) -> None:
        """Set the controller's position and velocity at the start of a run, before its first tick."""
        self.controller.position_command(position, velocity, 0.0)

    def step(self, force: float, position: float, velocity: float, measured: float) -> float:
        """Return the controller's force [N] of a tick."""
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
        """Return the controller's position command [m] of a tick."""
        if not self.stopped:
            self._motions[len(self._ticks) - 1] = (position, velocity, acceleration)
        sent = self.controller.position_command(position, velocity, acceleration)
        self._record_faults()
        return sent

    def stop(self) -> ControllerStop | None:
        """Return the first stop or other action of the controller on a fault; None if there was none."""
        if not self.stopped:
            return None
        fault = next(candidate for candidate in faults.FAULTS if self._acting & candidate.bit)
        watchdog = self._audited()
        found, limit, words = self._measured(fault.bit, watchdog)
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
            f"{'stopped' if tripped else 'interfered with'} at {time:.4g} s (tick {tick}), "
            f"{'after' if audited else 'in or before'} contact {contact}, by the {by}'s check {fault.name}: "
            f"{words or fault.condition.removeprefix('watchdog: ')}{stated}"
        )
        return ControllerStop(
            fault=fault.name, by=by, tripped=tripped, contact=contact, tick=tick, time=time, found=found,
            limit=limit, allowed=allowed, unit=unit, text=text,
        )  # fmt: skip

    def _record_faults(self) -> None:
        """Store the first faults on which the controller acts; `LAW_IN_DOUBT` changes no command."""
        if not self._acting:
            self._acting = self.controller.cause or self.controller.faults & ~faults.LAW_IN_DOUBT

    def _audited(self) -> Watchdog:
        """Return a watchdog in its state after the recorded inputs."""
        file = self._gain_file
        stated = STATUS_NUMBERS[self.controller.law_status] != STATUS_NUMBERS["unstated"]
        watchdog = Watchdog(file.limits, file.control_period, file.clearance, stated)
        for tick in self._ticks:
            if tick.begins:
                watchdog.conclude(tick.given, tick.status)
                watchdog.restart()
            watchdog.tick(*tick[1:])
        if self._announced:
            watchdog.conclude(self._force, STATUS_NUMBERS[self.controller.law_status])
        return watchdog

    def _measured(self, fault: int, watchdog: Watchdog) -> tuple[float | None, str | None, str]:
        """Return the value compared with the fault's limit, that limit's name, and the value as text."""
        names = FAULT_LIMITS.get(fault)
        if not names:
            return None, None, ""
        if fault == faults.RESTITUTION:
            value = abs(watchdog.restitution - watchdog.expected)
            words = f"restitution {watchdog.restitution:.4g} and expected {watchdog.expected:.4g} differ by "
            return value, names[0], f"{words}{value:.2g}"
        if fault == faults.ENERGY_BALANCE:
            return None, names[0], f"{abs(watchdog.balance):.3g} J are out of balance"
        if fault == faults.CONTACT_TOO_LONG:
            return (
                self._gain_file.limits[names[0]] + self._gain_file.control_period,
                names[0],
                "it is not over",
            )
        if fault == faults.VELOCITY_LIMIT and math.isfinite(first := self._first_distance()):
            return first, "start_distance", f"{first:.4g} m from where the drives read"
        value = self._compared(fault)
        *lower, limit = names
        if lower and value < self._gain_file.limits[lower[0]]:
            limit = lower[0]
        unit = LIMITS[limit].unit
        return value, limit, f"{value:.4g} {unit}"

    def _compared(self, fault: int) -> float:
        """Return the value that a guard compares with its limit."""
        tick, period = self._ticks[-1], self._gain_file.control_period
        if fault in (faults.FORCE_OUT_OF_RANGE, faults.FORCE_IN_FLIGHT):
            return abs(tick.force)
        if fault == faults.POSITION_OUT_OF_RANGE:
            return tick.measured
        if fault == faults.FORCE_STUCK:
            return self._travel("force", "measured", in_contact=True)
        if fault == faults.POSITION_STUCK:
            return self._travel("measured", "position", in_contact=False)
        command, before, sent = self._unlimited()
        if fault == faults.FORCE_LIMIT:
            return abs(command)
        if fault == faults.FORCE_SLEW:
            return abs(command - tick.given) / period
        return sent if fault == faults.STROKE else abs(sent - before) / period

    def _first_distance(self) -> float:
        """Return |last position command - measured position| [m] if it is a run's first command; else NaN."""
        _, before, sent = self._unlimited()
        return math.nan if math.isfinite(before) else abs(sent - self._ticks[-1].measured)

    def _travel(self, constant: str, moving: str, in_contact: bool) -> float:
        """Return the travel [m] of the signal `moving` since the signal `constant` last changed.

        With `in_contact`, it counts from the last tick at which the measured position was out of contact.
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

    def _unlimited(self) -> tuple[float, float, float]:
        """Return the law's force command [N] at the last tick, and its last two position commands [m]."""
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
    """Return the first stop in a recorded run, whose last contact is audited too; None if there is none."""
    witness = RecordingController(gain_file)
    readings = list(zip(*(leaf.tolist() for leaf in lane.signals), strict=True))
    for tick, (*signals, age) in enumerate(readings):
        if age == 0 and tick > 0:
            witness.next_contact()
        if not witness.stopped:
            witness.step(*signals)
        if not witness.stopped and tick + 1 < len(readings) and readings[tick + 1][4] == age + 1:
            position, velocity = readings[tick + 1][1:3]
            acceleration = (velocity - signals[2]) / gain_file.control_period
            witness.position_command(position, velocity, acceleration)
        if witness.stopped:
            return witness.stop()
    witness.next_contact()
    return witness.stop()


def find_passing_limits(gain_file: GainFile, lane: "LaneRecord") -> dict[str, float] | None:
    """Return names and values of limits with which a recorded run passes; None if it cannot pass."""
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
    """Return a text with the changes of limits with which a run passes."""
    if not passing:
        return "no other limits let it pass"
    changes = " ".join(f"--set {name}={value:g}" for name, value in passing.items())
    return f"tune better gains, or {changes} lets this run pass, and others like it"


def _widen_limit(name: str, found: float) -> float:
    """Return a limit beyond the found value, rounded outward to two digits."""
    outward = -1.0 if name.endswith("_lowest") else 1.0
    value = found + outward * (LIMIT_WIDENING - 1) * abs(found)
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 1) if value else 1.0
    rounded = outward * math.ceil(outward * value / unit) * unit
    limit = LIMITS[name]
    return min(max(float(f"{rounded:.2g}"), limit.lowest), limit.highest)
