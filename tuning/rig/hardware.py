"""The rig's side of the loop: what it sends at every tick, and what it does with the answers.

It stands for the drives, the contact and the sensors of a rig, in the rig's process, whose clock is `loop`.
`RigTask` knows nothing of networks and clocks: `reading` is what to send at a tick, `take` an answer that
came in time or late, `advance` ends the tick. Ticks that no answer came for go on at the rate of the newest
command for up to `EXTRAPOLATED` periods, and hold it from then on.
"""

import math
from random import Random
from typing import NamedTuple

from jaxhil.mechanism.structs import Mechanism
from tuning.rig.contact_watch import ContactResult, ContactWatch
from tuning.rig.plant import Plant
from tuning.rig.udp_protocol import APPROACH, PREPARE, READY, RESET, TICK, TRIPPED, Answer, Reading

EXTRAPOLATED = 10  # periods for which a command goes on at its rate
BRIDGED = 3  # periods: what follows from an older command is not the controller's doing
EXPLAINED = ("tripped: restitution", "tripped: missed_tick")  # what may follow from one
PAUSE = 5  # ticks between two runs
STALLED = "stalled"  # a contact that the machine left without new commands


class Commanded(NamedTuple):
    """What the controller has commanded."""

    lowest: float  # position command [m]
    highest: float  # likewise [m]
    not_finite: int  # how many were not finite; these do not reach the drives
    beyond_limits: int  # how many were beyond the drives' stroke; neither do these
    largest_force: float  # the largest |F_c| [N]


class RigTask:
    """Run after run of a mechanism's contacts, until the controller says that it is enough.

    One-sided, every contact is a run of its own at the nominal approach speed; between two surfaces a run has
    as many contacts as the mechanism asks for. The lists of stiffness and damping are gone through again and
    again; after the first round, each run meets its first surface at a phase of its own. `stroke`: the lowest
    and highest position [m] that the drives take. With `resets`, a controller that trips by one of the
    faults `EXPLAINED` where a command was older than `BRIDGED` periods is reset, and the session goes on.
    `tripped` says why the controller has; it is empty as long as it has not.
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
        self._plant, self._watch = Plant(mechanism, seed), ContactWatch(mechanism)
        self._phases = Random(seed + 1)
        self._sequence, self._run = -1, 0
        self._contacts: list[ContactResult] = []
        self._lowest, self._highest, self._largest = math.inf, -math.inf, 0.0
        self._not_finite = self._beyond = 0
        self._stroke = stroke
        self._newest: Answer | None = None
        self._force = 0.0
        self.tripped, self._first, self._oldest = "", 0, 0
        self._resets, self._forgiven, self._resetting = resets, [], False
        self._next_run(0)

    @property
    def contacts(self) -> tuple[ContactResult, ...]:
        """Contacts that are over."""
        return tuple(self._contacts)

    @property
    def forgiven(self) -> tuple[str, ...]:
        """Why the controller has tripped where the machine had left the rig with old commands."""
        return tuple(self._forgiven)

    @property
    def commanded(self) -> Commanded:
        """What has been commanded so far."""
        return Commanded(self._lowest, self._highest, self._not_finite, self._beyond, self._largest)

    def reading(self) -> Reading:
        """What to send at this tick; every call is another packet."""
        self._sequence += 1
        self._force, position = self._plant.read()
        time = self._sequence * self._period
        event = TICK if self._tick >= 0 else RESET if self._resetting else PREPARE
        tick = max(self._tick, 0)
        return Reading(event, self._sequence, self._run, tick, time, self._force, position, *self._start)

    def take(self, answer: Answer) -> bool:
        """Take in an answer; whether it is the one to this tick."""
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
        """The tick is over: its command, or what stands for it, moves the rig one period."""
        explained = self._resets and self.tripped.startswith(EXPLAINED)
        if explained and self._last_oldest() > BRIDGED:
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
            command += min(late, EXTRAPOLATED) * self._period * newest.command_rate
        command = min(max(command, self._stroke[0]), self._stroke[1])
        plant, watch = self._plant, self._watch
        if newest.tick >= 0:
            felt = newest.position, newest.velocity, newest.force_command
        else:
            felt = *self._start, 0.0
        over = watch.observe(*felt, plant.force, self._force)
        plant.move(command)
        self._tick += 1
        if over is not None:
            self._over(over)

    def finish(self) -> None:
        """No tick follows. A contact that a trip has cut short is one of the contacts."""
        if self._tick >= 0 and self.tripped and all(one.status != "tripped" for one in self._contacts):
            cut = self._watch.cut("tripped")
            if cut is not None:
                self._contacts.append(cut)

    def _last_oldest(self) -> int:
        """The age [periods] of the oldest command of the contact under way or, between runs, of the last."""
        if self._tick < 0 and self._contacts:
            return self._contacts[-1].oldest_command
        return self._oldest

    def _reset(self) -> None:
        """Another run instead of this one, with a controller that starts anew."""
        self._forgiven.append(self.tripped)
        self.tripped = ""
        number = self._number
        if self._tick >= 0:
            cut = self._watch.cut(STALLED)
            if cut is not None:
                self._keep(cut)
                number = 0 if self._two_sided else (cut.number + 1) % self._mechanism.approach.contacts
        self._next_run(number)
        self._resetting = True

    def _wait(self) -> None:
        """Between runs the mechanism is held, free, at the start of the next one."""
        self._pause -= 1
        newest = self._newest
        if newest is None or self._pause > 0 or self.tripped:
            return
        self._plant.begin(*self._start, newest.position_command, self._number)
        self._watch.begin(self._number)
        self._tick = 0

    def _over(self, over: ContactResult) -> None:
        if self.tripped:
            # Once tripped, the rig plays on, and what becomes of the contact says nothing.
            if all(one.status != "tripped" for one in self._contacts):
                self._keep(over._replace(status="tripped", restitution=math.nan))
            return
        self._keep(over)
        following = over.number + 1
        if self._two_sided and over.status == "ok" and following < self._mechanism.approach.contacts:
            self._plant.expect(following)
            return
        self._next_run(0 if self._two_sided else following % self._mechanism.approach.contacts)

    def _keep(self, over: ContactResult) -> None:
        self._contacts.append(
            over._replace(packets=(self._first, self._sequence), oldest_command=self._oldest)
        )
        self._first, self._oldest = self._sequence + 1, 0

    def _next_run(self, number: int) -> None:
        approach = self._mechanism.approach
        self._run += 1
        first_round = self._run <= (1 if self._two_sided else approach.contacts)
        phase = approach.phase if first_round else self._phases.random()
        nearer = min(self._mechanism.rig.contact_plane, 0.0)
        position = nearer - approach.velocity * (APPROACH + phase * self._period)
        self._start, self._number = (position, approach.velocity), number
        self._tick, self._pause, self._newest = -1, PAUSE, None
        self._oldest, self._resetting = 0, False
        # Until the run begins, the sensors see the mechanism free and at rest.
        self._plant.begin(position, 0.0, position, number)
