"""The rig's loop in real time: absolute deadlines on the monotonic clock, one packet per control period.

This is the clock of the rig's process. At t_n the sensors' packet leaves for the controller's process; the
answer counts if it is there within `ANSWER_SHARE` of the period, the rest of which is the rig's own. A tick
without an answer by then is a missed one: the rig goes on with what it has (`RigTask.advance`), and takes the
answer in when it comes. A rig that was itself held up catches up: every tick whose time has passed is played
at once, and missed. Only where it was held up for more than `MOST_BEHIND` periods has its clock stood still:
nothing of it went on meanwhile.
"""

import gc
import time
from array import array
from collections.abc import Callable
from typing import Protocol

from tuning.rig.network import Network
from tuning.rig.udp_protocol import EMPTY, TICK, Answer, PacketError, Reading, decode_answer, encode_reading

ANSWER_SHARE = 0.8  # of a period, within which the answer has to be there
MOST_BEHIND = 10  # periods that the rig catches up with
SPIN = 100_000  # ns before a tick from which the clock is watched without sleeping
AHEAD = 50_000_000  # ns before the first tick
AFTER_TRIP = 1.0  # s for which the rig plays on after a trip


class RealTimeTask(Protocol):
    """The rig's side, without network and clock: see `tuning.rig.hardware.RigTask`."""

    @property
    def tripped(self) -> str: ...
    def reading(self) -> Reading: ...
    def take(self, answer: Answer) -> bool: ...
    def advance(self) -> None: ...


class EmptyTask:
    """The rig's side of an empty loop: packets, and nothing else."""

    tripped = ""

    def __init__(self) -> None:
        self._sequence = -1

    def reading(self) -> Reading:
        """A packet of zeros."""
        self._sequence += 1
        return Reading(
            event=TICK,
            sequence=self._sequence,
            run=0,
            tick=self._sequence & 0xFFFF,
            time=0.0,
            force=0.0,
            position=0.0,
            start_position=0.0,
            start_velocity=0.0,
        )

    def take(self, answer: Answer) -> bool:
        """Whether it answers the last packet."""
        return bool(answer.flags & EMPTY) and answer.sequence == self._sequence

    def advance(self) -> None:
        """Nothing moves."""


class Timing:
    """By the number of the packet: how late it left [ns], when its answer arrived after it left [ns; 0 if it
    never did], and whether both were in time. `ticks` were played; `stood` is for how long the clock of the
    rig has stood still [ns]."""

    def __init__(self, ticks: int) -> None:
        self.late, self.round_trip = (array("q", bytes(8 * ticks)) for _ in range(2))
        self.met = array("b", bytes(ticks))
        self.ticks, self.stood = 0, 0


def play(
    task: RealTimeTask,
    network: Network,
    session: int,
    period: float,
    timing: Timing,
    tell: Callable[[int], None],
) -> None:
    """Play `len(timing.met)` ticks of `period` [s] in the session of that number, or until 1 s after a trip.

    `tell` is called once a second with how many are done.

    Interrupted, `timing` holds what was played until then.
    """
    step, total = round(1e9 * period), len(timing.met)
    allowance, second = round(ANSWER_SHARE * step), max(1, round(1 / period))
    last = total
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        began = time.monotonic_ns() + AHEAD
        left = array("q", bytes(8 * total))
        for number in range(total):
            due = began + timing.stood + number * step
            _until(network, due)
            packet = encode_reading(task.reading(), session)
            left[number] = time.monotonic_ns()
            network.send(number, packet)
            late = timing.late[number] = left[number] - due
            if late > MOST_BEHIND * step:
                timing.stood += late
                due += late
            met = _answered(task, network, session, due + allowance, left, timing)
            timing.met[number] = met and late <= step
            task.advance()
            timing.ticks = number + 1
            if number % second == 0:
                tell(number)
            if task.tripped and last == total:
                last = number + round(AFTER_TRIP / period)
            if number >= last:
                break
    finally:
        gc.enable()
        gc.unfreeze()


def _answered(
    task: RealTimeTask, network: Network, session: int, deadline: int, left: array, timing: Timing
) -> bool:
    """Take in what arrives, until this tick's answer does or the deadline has passed."""
    while True:
        met = False
        for arrived, packet in network.receive():
            try:
                answer = decode_answer(packet, session)
            except PacketError:
                continue
            number = answer.sequence
            if number < len(left) and left[number] and not timing.round_trip[number]:
                timing.round_trip[number] = arrived - left[number]
            met = task.take(answer) or met
        if met:
            return True
        if time.monotonic_ns() >= deadline:
            return False
        network.wait(deadline)


def _until(network: Network, due: int) -> None:
    """Wait until `due` [ns], sending what was held back; the last of it awake."""
    while time.monotonic_ns() < due - SPIN:
        network.wait(due - SPIN, for_arrivals=False)
    while time.monotonic_ns() < due:
        pass


def answered_by(packet: bytes) -> int | None:
    """The number of the packet that this one answers; None if it answers none."""
    try:
        return decode_answer(packet, None).sequence
    except PacketError:
        return None
