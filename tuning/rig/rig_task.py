"""Work of the rig's process in each tick: send sensor readings and move the simulated hardware.

`RigTask` is independent of network and clock, which `loop` provides. `RigTask.reading` returns the packet of
a tick, `RigTask.take` accepts an answer of the controller, and `RigTask.advance` ends the tick. In a tick
without an answer, the newest position command is extrapolated at its rate. After `MAX_EXTRAPOLATED_PERIODS`
periods without an answer, the command is held.
"""

import math
from random import Random
from typing import NamedTuple

from jaxhil.mechanism.structs import Mechanism
from tuning.rig.contact_detector import ContactDetector, RigContact
from tuning.rig.plant import RigHardware
from tuning.rig.udp_protocol import (
    APPROACH_TIME,
    PREPARE,
    READY,
    RESET,
    TICK,
    TRIPPED,
    AnswerPacket,
    ReadingPacket,
)

MAX_EXTRAPOLATED_PERIODS = 10  # number of periods after which a command is held instead of extrapolated
MAX_COMMAND_AGE = 3  # [periods]; if a command is older, its effects are not the controller's fault
# Reasons for a trip that an old command can cause.
TRIPS_BY_OLD_COMMANDS = ("tripped: restitution", "tripped: missed_tick")
PAUSE_TICKS = 5  # number of ticks between two runs
STALLED = "stalled"  # status of a contact in which the computer delayed the commands too long


class CommandRange(NamedTuple):
    """Extreme values of the commands that the controller has sent."""

    lowest: float  # lowest position command [m]
    highest: float  # highest position command [m]
    not_finite: int  # number of answers with NaN or infinite commands, which do not reach the drives
    beyond_limits: int  # number of position commands outside the drives' stroke, which are clipped
    largest_force: float  # largest magnitude of the force command F_c [N]


class RigTask:
    """Endless series of runs of one mechanism, without network and clock.

    If the mechanism has one surface, every run has one contact and starts at the nominal approach speed. If
    the mechanism has two surfaces, every run has `approach.contacts` contacts. The runs cycle through the
    lists of stiffness and damping. From the second cycle on, the phase of each run is random.

    Args:
        mechanism: mechanism and rig to simulate.
        seed: seed of the sensor noise and of the phases.
        stroke: lowest and highest position of the drives [m].
        resets: whether to reset a controller that trips because of old commands. This applies if a command
            was older than `MAX_COMMAND_AGE` periods and `TRIPS_BY_OLD_COMMANDS` contains the trip's reason.

    Attributes:
        tripped: reason for the controller's trip; empty if it has not tripped.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        seed: int = 0,
        stroke: tuple[float, float] = (-math.inf, math.inf),
        resets: bool = False,
    ) -> None:
        self._mechanism, self._period = mechanism, mechanism.rig.control_period
        self._two_sided = math.isfinite(mechanism.contact.clearance)
        self._plant, self._detector = RigHardware(mechanism, seed), ContactDetector(mechanism)
        self._phases = Random(seed + 1)
        self._sequence, self._run = -1, 0
        self._contacts: list[RigContact] = []
        self._lowest, self._highest, self._largest = math.inf, -math.inf, 0.0
        self._not_finite = self._beyond = 0
        self._stroke = stroke
        self._newest: AnswerPacket | None = None
        self._force = 0.0
        self.tripped, self._first, self._oldest = "", 0, 0
        self._resets, self._reset_trips, self._requests_reset = resets, [], False
        self._next_run(0)

    @property
    def contacts(self) -> tuple[RigContact, ...]:
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
        self._force, position = self._plant.read()
        time = self._sequence * self._period
        event = TICK if self._tick >= 0 else RESET if self._requests_reset else PREPARE
        tick = max(self._tick, 0)
        return ReadingPacket(
            event, self._sequence, self._run, tick, time, self._force, position, *self._start
        )

    def take(self, answer: AnswerPacket) -> bool:
        """Accept an answer of the controller; return whether it answers the current tick's packet."""
        if answer.run != self._run:
            return False
        if answer.flags & TRIPPED:
            self.tripped = answer.trip_reason or "tripped"
        if self._tick < 0:
            if answer.flags & READY and math.isfinite(answer.position_command):
                self._newest = answer._replace(tick=-1)
            return answer.sequence == self._sequence
        if answer.flags & READY:
            return False
        command, (low, high) = answer.position_command, self._stroke
        if not all(map(math.isfinite, (command, answer.command_rate, answer.force_command))):
            self._not_finite += 1
        elif self._newest is None or answer.tick > self._newest.tick:
            self._newest = answer
            self._beyond += not low <= command <= high
            self._lowest, self._highest = min(self._lowest, command), max(self._highest, command)
            self._largest = max(self._largest, abs(answer.force_command))
        return answer.tick == self._tick

    def advance(self) -> None:
        """End the tick: move the hardware by one period with the newest or the extrapolated command."""
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
            command += min(age, MAX_EXTRAPOLATED_PERIODS) * self._period * newest.command_rate
        command = min(max(command, self._stroke[0]), self._stroke[1])
        plant, detector = self._plant, self._detector
        if newest.tick >= 0:
            model = newest.position, newest.velocity, newest.force_command
        else:
            model = *self._start, 0.0
        contact = detector.observe(*model, plant.force, self._force)
        plant.move(command)
        self._tick += 1
        if contact is not None:
            self._finish_contact(contact)

    def finish(self) -> None:
        """End the session; if the controller has tripped, store the current contact as "tripped"."""
        if self._tick >= 0 and self.tripped and all(c.status != "tripped" for c in self._contacts):
            aborted_contact = self._detector.cut("tripped")
            if aborted_contact is not None:
                self._contacts.append(aborted_contact)

    def _largest_command_age(self) -> int:
        """Return the largest command age [periods] in the current (between runs: in the last) contact."""
        if self._tick < 0 and self._contacts:
            return self._contacts[-1].oldest_command
        return self._oldest

    def _reset(self) -> None:
        """Abort this run, prepare the next one, and request a reset of the controller."""
        self._reset_trips.append(self.tripped)
        self.tripped = ""
        number = self._number
        if self._tick >= 0:
            aborted_contact = self._detector.cut(STALLED)
            if aborted_contact is not None:
                self._store(aborted_contact)
                following = (aborted_contact.number + 1) % self._mechanism.approach.contacts
                number = 0 if self._two_sided else following
        self._next_run(number)
        self._requests_reset = True

    def _pause_or_begin(self) -> None:
        """Count down the pause before a run; begin the run once the controller is ready."""
        self._pause -= 1
        newest = self._newest
        if newest is None or self._pause > 0 or self.tripped:
            return
        self._plant.begin(*self._start, newest.position_command, self._number)
        self._detector.begin(self._number)
        self._tick = 0

    def _finish_contact(self, contact: RigContact) -> None:
        """Store a contact that has ended and prepare the next one."""
        if self.tripped:
            # After a trip, the rig keeps moving, but its contacts are not used to evaluate the controller.
            if all(c.status != "tripped" for c in self._contacts):
                self._store(contact._replace(status="tripped", restitution=math.nan))
            return
        self._store(contact)
        following = contact.number + 1
        if self._two_sided and contact.status == "ok" and following < self._mechanism.approach.contacts:
            self._plant.expect(following)
            return
        self._next_run(0 if self._two_sided else following % self._mechanism.approach.contacts)

    def _store(self, contact: RigContact) -> None:
        self._contacts.append(
            contact._replace(packets=(self._first, self._sequence), oldest_command=self._oldest)
        )
        self._first, self._oldest = self._sequence + 1, 0

    def _next_run(self, number: int) -> None:
        approach = self._mechanism.approach
        self._run += 1
        is_first_cycle = self._run <= (1 if self._two_sided else approach.contacts)
        phase = approach.phase if is_first_cycle else self._phases.random()
        nearer = min(self._mechanism.rig.contact_plane, 0.0)
        position = nearer - approach.velocity * (APPROACH_TIME + phase * self._period)
        self._start, self._number = (position, approach.velocity), number
        self._tick, self._pause, self._newest = -1, PAUSE_TICKS, None
        self._oldest, self._requests_reset = 0, False
        # During the pause before the run, the mechanism is free and at rest.
        self._plant.begin(position, 0.0, position, number)
