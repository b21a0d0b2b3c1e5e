"""Work of the rig's process in each tick: send sensor readings and move the simulated hardware.

`RigTask` is independent of network and clock, which `loop` provides. `RigTask.reading` returns the packet of
a tick, `RigTask.take` accepts an answer of the controller, and `RigTask.advance` ends the tick. In a tick
without an answer, the newest position command is extrapolated at its rate. After `MAX_EXTRAPOLATED_PERIODS`
periods without an answer, the command is held.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

from jaxhil.errors import InputError, format_value
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from tuning.rig.udp_protocol import (
    PREPARE,
    READY,
    RESET,
    TICK,
    TRIPPED,
    AnswerPacket,
    Numbers,
    ReadingPacket,
)

MAX_EXTRAPOLATED_PERIODS = 10  # number of periods after which a command is held instead of extrapolated
MAX_COMMAND_AGE = 3  # age of a command beyond which its effects are not the controller's fault [periods]
# Reasons for a trip that an old command can cause.
TRIPS_BY_OLD_COMMANDS = ("tripped: restitution", "tripped: missed_tick")
PAUSE_TICKS = 5  # number of ticks between two runs
BEGIN_TICKS = 3  # minimum number of ticks between the start of a run, which may be slow, and its tick 0
STALLED = "stalled"  # status of a contact in which the computer delayed the commands too long


class SimulatedRig(Protocol):
    """Simulated rig with one axis or six axes; vectors have one number for each axis.

    A contact (for six axes, a run) has the method and the fields of `RehearsedRun`, except the field `state`.
    """

    axes: int  # number of axes
    error_name: str  # name of the error that decides the verdict, in the results of `evaluate`

    @property
    def good_statuses(self) -> Sequence[str]: ...  # statuses of contacts that ended normally
    def prepare(self, last: Any, /) -> Numbers: ...  # prepare the run after this contact; return its start
    def begin(self, command: Numbers) -> None: ...
    def read(self) -> tuple[Numbers, Numbers]: ...
    def advance(self, answer: AnswerPacket | None, command: Numbers) -> Any: ...
    def continues_after(self, contact: Any, /) -> bool: ...  # whether the same run has a further contact
    def cut(self, status: str) -> Any: ...
    def evaluate(self, contacts: Sequence[Any]) -> list[dict[str, Any]]: ...


def build_simulated_rig(mechanism: AnyMechanism, seed: int = 0) -> SimulatedRig:
    """Build the simulated rig of a mechanism; JAX is imported only for six axes.

    Args:
        mechanism: mechanism and rig to simulate.
        seed: seed of the sensor noise and of the random phases (instants of contact in a control period).
    """
    probability = mechanism.rig.missed_tick_probability
    if probability:
        raise InputError(
            f"rig.missed_tick_probability: found {format_value(probability)}, expected 0 for a rehearsal; "
            "lost packets (--drops) make the controller miss ticks"
        )
    if isinstance(mechanism, Mechanism):
        from tuning.rig.one_axis_rig import OneAxisRig

        return OneAxisRig(mechanism, seed)
    from tuning.rig.six_axis_rig import SixAxisRig

    return SixAxisRig(mechanism, seed)


class CommandRange(NamedTuple):
    """Extreme values of the commands that the controller has sent."""

    lowest: Numbers  # lowest position command of each axis [m, rad]
    highest: Numbers  # highest position command of each axis [m, rad]
    not_finite: int  # number of answers with NaN or infinite commands, which do not reach the drives
    beyond_limits: int  # number of position commands outside the drives' stroke, which are clipped
    largest_force: Numbers  # largest magnitude of the force command of each axis [N, N m]


class RigTask:
    """Endless series of runs on a simulated rig, without network and clock.

    Args:
        rig: simulated rig.
        period: control period [s].
        stroke: lowest and highest positions of the drives [m, rad]; None without limits.
        resets: whether to reset a controller that trips because of old commands. This applies if a command
            was older than `MAX_COMMAND_AGE` periods and `TRIPS_BY_OLD_COMMANDS` contains the trip's reason.

    Attributes:
        tripped: reason for the controller's trip; empty if it has not tripped.
    """

    def __init__(
        self,
        rig: SimulatedRig,
        period: float,
        stroke: tuple[Numbers, Numbers] | None = None,
        resets: bool = False,
    ) -> None:
        self._rig, self._period = rig, period
        low, high = (-math.inf,) * rig.axes, (math.inf,) * rig.axes
        self._stroke = (low, high) if stroke is None else stroke
        self._sequence, self._run = -1, 0
        self._contacts: list[Any] = []
        self._lowest, self._highest, self._largest = high, low, (0.0,) * rig.axes
        self._not_finite = self._beyond = 0
        self._newest: AnswerPacket | None = None
        self.tripped, self._first, self._oldest = "", 0, 0
        self._resets, self._reset_trips, self._requests_reset = resets, [], False
        self._next_run(None)

    @property
    def contacts(self) -> tuple[Any, ...]:
        """Return the contacts that have ended, in the order of time."""
        return tuple(self._contacts)

    @property
    def reset_trips(self) -> tuple[str, ...]:
        """Return the reasons for all trips that were caused by old commands and followed by a reset."""
        return tuple(self._reset_trips)

    @property
    def commanded(self) -> CommandRange:
        """Return the extreme values of the commands so far."""
        return CommandRange(self._lowest, self._highest, self._not_finite, self._beyond, self._largest)

    def reading(self) -> ReadingPacket:
        """Read the sensors; return the packet to send, with a new sequence number."""
        self._sequence += 1
        force, position = self._rig.read()
        time = self._sequence * self._period
        event = TICK if self._tick >= 0 else RESET if self._requests_reset else PREPARE
        tick = max(self._tick, 0)
        return ReadingPacket(event, self._sequence, self._run, tick, time, force, position, self._start)

    def take(self, answer: AnswerPacket) -> bool:
        """Accept an answer of the controller; return whether it answers the current tick's packet."""
        if answer.run != self._run or len(answer.position_command) != self._rig.axes:
            return False
        if answer.flags & TRIPPED:
            self.tripped = answer.trip_reason or "tripped"
        command = answer.position_command
        if self._tick < 0:
            if answer.flags & READY and _is_finite(command):
                self._newest = answer._replace(tick=-1)
            return answer.sequence == self._sequence
        if answer.flags & READY:
            return False
        if not all(map(_is_finite, (command, answer.command_rate, answer.force_command, answer.bodies))):
            self._not_finite += 1
        elif self._newest is None or answer.tick > self._newest.tick:
            self._newest = answer
            self._beyond += self._clip(command) != command
            self._lowest, self._highest = (
                _combine(min, self._lowest, command),
                _combine(max, self._highest, command),
            )
            self._largest = _combine(max, self._largest, map(abs, answer.force_command))
        return answer.tick == self._tick

    def advance(self) -> None:
        """End the tick: move the hardware for one period under the newest command, extrapolated if old."""
        caused_by_old_command = self._resets and self.tripped.startswith(TRIPS_BY_OLD_COMMANDS)
        if caused_by_old_command and self._largest_command_age() > MAX_COMMAND_AGE:
            self._reset()
        if self._tick < 0:
            self._pause_or_begin()
            return
        newest = self._newest
        assert newest is not None
        age = self._tick - newest.tick
        self._oldest = max(self._oldest, age)
        command = newest.position_command
        if age > 0:
            time = min(age, MAX_EXTRAPOLATED_PERIODS) * self._period
            rates = newest.command_rate
            command = tuple(value + time * rate for value, rate in zip(command, rates, strict=True))
        contact = self._rig.advance(newest if newest.tick >= 0 else None, self._clip(command))
        self._tick += 1
        if contact is not None:
            self._finish_contact(contact)

    def finish(self) -> None:
        """End the session; if the controller has tripped, store the current contact as "tripped"."""
        if self._tick >= 0 and self.tripped and all(c.status != "tripped" for c in self._contacts):
            aborted_contact = self._rig.cut("tripped")
            if aborted_contact is not None:
                self._contacts.append(aborted_contact)

    def _clip(self, command: Numbers) -> Numbers:
        """Return the position command within the drives' stroke."""
        low, high = self._stroke
        return _combine(min, _combine(max, command, low), high)

    def _largest_command_age(self) -> int:
        """Return the current contact's largest command age [periods]; between runs, the last contact's."""
        if self._tick < 0 and self._contacts:
            return self._contacts[-1].oldest_command
        return self._oldest

    def _reset(self) -> None:
        """Abort this run, prepare the next one, and request a reset of the controller."""
        self._reset_trips.append(self.tripped)
        self.tripped = ""
        aborted_contact = self._rig.cut(STALLED) if self._tick >= 0 else None
        if aborted_contact is not None:
            self._store(aborted_contact)
        self._next_run(aborted_contact)
        self._requests_reset = True

    def _pause_or_begin(self) -> None:
        """Count down the pause before a run; begin the run once the controller is ready."""
        self._pause -= 1
        newest = self._newest
        if newest is None or self.tripped:
            return
        if not self._has_begun:
            self._rig.begin(newest.position_command)
            self._has_begun, self._pause = True, max(self._pause, BEGIN_TICKS)
        elif self._pause <= 0:
            self._tick = 0

    def _finish_contact(self, contact: Any) -> None:
        """Store a contact that has ended and prepare the next one."""
        if self.tripped:
            # After a trip, the rig keeps moving, but its contacts are not used to evaluate the controller.
            if all(c.status != "tripped" for c in self._contacts):
                self._store(contact.as_tripped())
            return
        self._store(contact)
        if not self._rig.continues_after(contact):
            self._next_run(contact)

    def _store(self, contact: Any) -> None:
        self._contacts.append(
            contact._replace(packets=(self._first, self._sequence), oldest_command=self._oldest)
        )
        self._first, self._oldest = self._sequence + 1, 0

    def _next_run(self, last: Any) -> None:
        """Prepare the run after the contact `last`."""
        self._run += 1
        self._tick, self._pause, self._newest, self._has_begun = -1, PAUSE_TICKS, None, False
        self._oldest, self._requests_reset = 0, False
        self._start = self._rig.prepare(last)


def _is_finite(values: Numbers) -> bool:
    return all(map(math.isfinite, values))


def _combine(function: Any, left: Iterable[float], right: Iterable[float]) -> Numbers:
    """Apply a function of two numbers to the values of `left` and `right`, axis by axis."""
    return tuple(map(function, left, right))
