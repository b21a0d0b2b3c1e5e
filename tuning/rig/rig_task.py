"""Rig's side of the loop: readings for every tick, and the effect of the answers on the hardware.

It simulates drives, contact and sensors in the rig's process, whose clock is `loop`. `RigTask` is independent
of network and clock: `reading` returns the packet of a tick, `take` accepts an answer, in time or late, and
`advance` ends the tick. Without an answer the newest command is extrapolated at its rate for up to
`MAX_EXTRAPOLATED_PERIODS` periods, and then held.
"""

import math
from random import Random
from typing import NamedTuple

from jaxhil.mechanism.structs import Mechanism
from tuning.rig.contact_watch import ContactWatch, RigContact
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

MAX_EXTRAPOLATED_PERIODS = 10  # periods for which a command is extrapolated at its rate
MAX_COMMAND_AGE = 3  # age of a command [periods] beyond which its effects are not the controller's fault
TRIPS_BY_OLD_COMMANDS = (
    "tripped: restitution",
    "tripped: missed_tick",
)  # trips that an old command may cause
PAUSE_TICKS = 5  # ticks between two runs
STALLED = "stalled"  # status of a contact for which the machine delayed the commands too long


class CommandRange(NamedTuple):
    """Range of the controller's commands."""

    lowest: float  # lowest position command [m]
    highest: float  # highest position command [m]
    not_finite: int  # number of non-finite commands, which do not reach the drives
    beyond_limits: int  # number of position commands beyond the drives' stroke, which are clipped
    largest_force: float  # largest |F_c| [N]


class RigTask:
    """Endless series of runs of a mechanism's contacts, without network and clock.

    With one surface every contact is a run at the nominal approach speed; between two surfaces a run has the
    mechanism's number of contacts. The lists of stiffness and damping are repeated; after the first cycle
    each run has a random phase. `stroke` is the lowest and highest position [m] of the drives. With `resets`,
    a controller that trips by one of the faults `TRIPS_BY_OLD_COMMANDS` after a command was older than
    `MAX_COMMAND_AGE` periods is reset, and the session continues. `tripped` is the reason of a trip, empty
    without one.
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
        self._plant, self._watch = RigHardware(mechanism, seed), ContactWatch(mechanism)
        self._phases = Random(seed + 1)
        self._sequence, self._run = -1, 0
        self._contacts: list[RigContact] = []
        self._lowest, self._highest, self._largest = math.inf, -math.inf, 0.0
        self._not_finite = self._beyond = 0
        self._stroke = stroke
        self._newest: AnswerPacket | None = None
        self._force = 0.0
        self.tripped, self._first, self._oldest = "", 0, 0
        self._resets, self._forgiven, self._resetting = resets, [], False
        self._next_run(0)

    @property
    def contacts(self) -> tuple[RigContact, ...]:
        """Return the contacts that have ended."""
        return tuple(self._contacts)

    @property
    def forgiven(self) -> tuple[str, ...]:
        """Return the reasons of trips after which the controller was reset, since commands were old."""
        return tuple(self._forgiven)

    @property
    def commanded(self) -> CommandRange:
        """Return the range of the commands so far."""
        return CommandRange(self._lowest, self._highest, self._not_finite, self._beyond, self._largest)

    def reading(self) -> ReadingPacket:
        """Return the next packet to send; each call has a new sequence number."""
        self._sequence += 1
        self._force, position = self._plant.read()
        time = self._sequence * self._period
        event = TICK if self._tick >= 0 else RESET if self._resetting else PREPARE
        tick = max(self._tick, 0)
        return ReadingPacket(
            event, self._sequence, self._run, tick, time, self._force, position, *self._start
        )

    def take(self, answer: AnswerPacket) -> bool:
        """Accept an answer; return whether it belongs to this tick."""
        if answer.run != self._run:
            return False
        if answer.flags & TRIPPED:
            self.tripped = answer.words or "tripped"
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
        """End the tick and move the rig one period by its command or the extrapolated one."""
        explained = self._resets and self.tripped.startswith(TRIPS_BY_OLD_COMMANDS)
        if explained and self._last_oldest() > MAX_COMMAND_AGE:
            self._reset()
        if self._tick < 0:
            self._wait()
            return
        newest = self._newest
        assert newest is not None
        late = self._tick - newest.tick
        self._oldest = max(self._oldest, late)
        command = newest.position_command
        if late > 0:
            command += min(late, MAX_EXTRAPOLATED_PERIODS) * self._period * newest.command_rate
        command = min(max(command, self._stroke[0]), self._stroke[1])
        plant, watch = self._plant, self._watch
        if newest.tick >= 0:
            model = newest.position, newest.velocity, newest.force_command
        else:
            model = *self._start, 0.0
        contact = watch.observe(*model, plant.force, self._force)
        plant.move(command)
        self._tick += 1
        if contact is not None:
            self._ended(contact)

    def finish(self) -> None:
        """End the session; the current contact is added to the contacts if the controller has tripped."""
        if self._tick >= 0 and self.tripped and all(c.status != "tripped" for c in self._contacts):
            cut = self._watch.cut("tripped")
            if cut is not None:
                self._contacts.append(cut)

    def _last_oldest(self) -> int:
        """Return the age [periods] of the oldest command of the current or, between runs, last contact."""
        if self._tick < 0 and self._contacts:
            return self._contacts[-1].oldest_command
        return self._oldest

    def _reset(self) -> None:
        """Start another run instead of this one, and request a reset of the controller."""
        self._forgiven.append(self.tripped)
        self.tripped = ""
        number = self._number
        if self._tick >= 0:
            cut = self._watch.cut(STALLED)
            if cut is not None:
                self._store(cut)
                number = 0 if self._two_sided else (cut.number + 1) % self._mechanism.approach.contacts
        self._next_run(number)
        self._resetting = True

    def _wait(self) -> None:
        """Hold the mechanism at the start of the next run until the controller is ready."""
        self._pause -= 1
        newest = self._newest
        if newest is None or self._pause > 0 or self.tripped:
            return
        self._plant.begin(*self._start, newest.position_command, self._number)
        self._watch.begin(self._number)
        self._tick = 0

    def _ended(self, contact: RigContact) -> None:
        """Store a contact that has ended and prepare the next one."""
        if self.tripped:
            # After a trip the rig continues, but the contact's result has no meaning.
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
        first_round = self._run <= (1 if self._two_sided else approach.contacts)
        phase = approach.phase if first_round else self._phases.random()
        nearer = min(self._mechanism.rig.contact_plane, 0.0)
        position = nearer - approach.velocity * (APPROACH_TIME + phase * self._period)
        self._start, self._number = (position, approach.velocity), number
        self._tick, self._pause, self._newest = -1, PAUSE_TICKS, None
        self._oldest, self._resetting = 0, False
        # Before the run the mechanism is free and at rest.
        self._plant.begin(position, 0.0, position, number)
