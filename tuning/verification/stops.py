"""Stops of runs under the limits of a gain file: fault, value, limit, contact and time, in numbers and words.

`Witness` is the rig's controller together with all that it was given; asked for its stop, it goes through
that once more. `find_stop` feeds it a recorded run, `passing_limits` says with which limits that run passes.
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

if TYPE_CHECKING:  # it stands on JAX, which takes a second that an early refusal need not wait for
    from jaxhil.simulation.recording import Lane

WATCHDOG = faults.RESTITUTION | faults.ENERGY_BALANCE | faults.CONTACT_TOO_LONG
# The limit of each fault that has one, or two of them: the lower and the upper.
LIMITS_OF: Mapping[int, tuple[str, ...]] = {
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
WIDER = 1.25  # times what a run needs: the limit that is proposed for it
MOST_LIMITS = 24  # changes of limits, tried one after the other until a run passes
STATUS_NUMBERS = {status.name: status.number for status in STATUSES}


class Stop(msgspec.Struct, frozen=True, kw_only=True):
    """What stopped a run, or interfered with it first."""

    fault: str  # its name, as in `jaxhil.rig.faults`
    by: str  # "watchdog" or "guard"
    tripped: bool  # whether the controller tripped; else it only flagged a reading or cut a command
    contact: int  # under way, just audited, or ahead; from 1
    tick: int  # of the run, from 0
    time: float  # since the run began [s]
    found: float | None  # what was compared with the limit [its unit]; None if it is no number
    limit: str | None  # the limit's name; None if the fault has none
    allowed: float | None  # the limit's value
    unit: str | None  # the limit's unit
    text: str  # all of that in words


class Tick(NamedTuple):
    """What the controller was given and gave in a tick."""

    begins: bool  # whether the next contact was announced before it
    given: float  # force [N] that it gave on the tick before
    status: int  # what its law said of that
    force: float  # measured [N]
    position: float  # of the numerical model [m]
    velocity: float  # of the numerical model [m/s]
    measured: float  # position [m]


class Witness:
    """The rig's controller, and what it was given up to the first fault on which it acted."""

    def __init__(self, gain_file: GainFile):
        self.controller = Controller(gain_file)
        self._gain_file = gain_file
        self._ticks: list[Tick] = []
        self._motions: dict[int, tuple[float, float, float]] = {}  # of the numerical model, by tick
        self._force, self._sent = 0.0, math.nan
        self._begins = self._announced = False
        self._acting = 0

    @property
    def stopped(self) -> bool:
        """Whether the controller has acted on a fault."""
        return self._acting != 0

    def next_contact(self) -> None:
        """Announce the next contact; the one under way is audited."""
        self.controller.next_contact()
        if not self.stopped:
            self._begins = self._announced = True
        self._look()

    def start(self, position: float, velocity: float) -> None:
        """Tell the controller where a run begins, before its first tick."""
        self.controller.position_command(position, velocity, 0.0)

    def step(self, force: float, position: float, velocity: float, measured: float) -> float:
        """Return the controller's force [N] of a tick."""
        if not self.stopped:
            status = STATUS_NUMBERS[self.controller.law_status]
            self._ticks.append(Tick(self._begins, self._force, status, force, position, velocity, measured))
            self._announced = self._begins = False
        self._force = self.controller.step(force, position, velocity, measured)
        self._look()
        return self._force

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """Return the controller's position command [m] of a tick."""
        if not self.stopped:
            self._motions[len(self._ticks) - 1] = (position, velocity, acceleration)
        sent = self.controller.position_command(position, velocity, acceleration)
        self._look()
        return sent

    def stop(self) -> Stop | None:
        """Return what the controller acted on first; None if on nothing."""
        if not self.stopped:
            return None
        fault = next(one for one in faults.FAULTS if self._acting & one.bit)
        watchdog = self._audited()
        found, limit, words = self._found(fault.bit, watchdog)
        allowed = None if limit is None else float(self._gain_file.limits[limit])
        audited = fault.bit & (faults.RESTITUTION | faults.ENERGY_BALANCE)
        contact = watchdog.contacts + (0 if audited else 1)
        tick = len(self._ticks) - 1
        time = tick * self._gain_file.control_period
        by = "watchdog" if fault.bit & WATCHDOG else "guard"
        tripped = self.controller.tripped
        unit = None if limit is None else LIMITS[limit].unit
        stated = "" if limit is None else f", {limit} {allowed:.4g}{'' if unit == '1' else f' {unit}'}"
        text = (
            f"{'stopped' if tripped else 'interfered with'} at {time:.4g} s (tick {tick}), "
            f"{'after' if audited else 'in or before'} contact {contact}, by the {by}'s check {fault.name}: "
            f"{words or fault.condition.removeprefix('watchdog: ')}{stated}"
        )
        return Stop(
            fault=fault.name, by=by, tripped=tripped, contact=contact, tick=tick, time=time, found=found,
            limit=limit, allowed=allowed, unit=unit, text=text,
        )  # fmt: skip

    def _look(self) -> None:
        """Keep the first faults on which the controller acts; a law in doubt changes no command."""
        if not self._acting:
            self._acting = self.controller.cause or self.controller.faults & ~faults.LAW_IN_DOUBT

    def _audited(self) -> Watchdog:
        """Return a watchdog that was given the same, as it is after the last tick."""
        own = self._gain_file
        stated = STATUS_NUMBERS[self.controller.law_status] != STATUS_NUMBERS["unstated"]
        watchdog = Watchdog(own.limits, own.control_period, own.clearance, stated)
        for tick in self._ticks:
            if tick.begins:
                watchdog.conclude(tick.given, tick.status)
                watchdog.restart()
            watchdog.tick(*tick[1:])
        if self._announced:
            watchdog.conclude(self._force, STATUS_NUMBERS[self.controller.law_status])
        return watchdog

    def _found(self, fault: int, watchdog: Watchdog) -> tuple[float | None, str | None, str]:
        """Return what was compared with the fault's limit, that limit's name, and words for the former."""
        names = LIMITS_OF.get(fault)
        if not names:
            return None, None, ""
        if fault == faults.RESTITUTION:
            found = abs(watchdog.restitution - watchdog.expected)
            words = f"restitution {watchdog.restitution:.4g} and expected {watchdog.expected:.4g} differ by "
            return found, names[0], f"{words}{found:.2g}"
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
        found = self._compared(fault)
        *lower, limit = names
        if lower and found < self._gain_file.limits[lower[0]]:
            limit = lower[0]
        unit = LIMITS[limit].unit
        return found, limit, f"{found:.4g} {unit}"

    def _compared(self, fault: int) -> float:
        """Return what a guard compares with its limit."""
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
        """Return how far the last command is from where the drives read, if it is a run's first; else NaN."""
        _, before, sent = self._unlimited()
        return math.nan if math.isfinite(before) else abs(sent - self._ticks[-1].measured)

    def _travel(self, held: str, moving: str, in_contact: bool) -> float:
        """Return how far one signal has moved [m] since another one stays the same to the bit, which counts
        everywhere or, by the measured position, `in_contact`."""
        travel, clearance = 0.0, self._gain_file.clearance
        for place in range(len(self._ticks) - 1, 0, -1):
            now, before = self._ticks[place], self._ticks[place - 1]
            if getattr(now, held) != getattr(before, held) or now.begins:
                break
            if in_contact and -clearance <= now.measured <= 0.0:
                break
            travel += abs(getattr(now, moving) - getattr(before, moving))
        return travel

    def _unlimited(self) -> tuple[float, float, float]:
        """Return the force that the law commands in the last tick, and its last two position commands."""
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


def find_stop(gain_file: GainFile, lane: "Lane") -> Stop | None:
    """Return what the controller acts on in a recorded run, its last contact audited too; None if nothing."""
    witness = Witness(gain_file)
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


def passing_limits(gain_file: GainFile, lane: "Lane") -> dict[str, float] | None:
    """Return the limits to change, and their values, for a recorded run to pass; None if no limits do it."""
    limits, changed = dict(gain_file.limits), {}
    for _ in range(MOST_LIMITS):
        stop = find_stop(gain_file._replace(limits=limits), lane)
        if stop is None:
            return changed
        if stop.limit is None or stop.found is None:
            return None
        limits[stop.limit] = changed[stop.limit] = _widened(stop.limit, stop.found)
    return None


def advice(passing: Mapping[str, float] | None) -> str:
    """Return in words what lets a run pass."""
    if not passing:
        return "no other limits let it pass"
    changes = " ".join(f"--set {name}={value:g}" for name, value in passing.items())
    return f"tune better gains, or {changes} lets this run pass, and others like it"


def _widened(name: str, found: float) -> float:
    """Return a limit beyond what was found, in two digits."""
    outward = -1.0 if name.endswith("_lowest") else 1.0
    value = found + outward * (WIDER - 1) * abs(found)
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 1) if value else 1.0
    rounded = outward * math.ceil(outward * value / unit) * unit
    limit = LIMITS[name]
    return min(max(float(f"{rounded:.2g}"), limit.lowest), limit.highest)
