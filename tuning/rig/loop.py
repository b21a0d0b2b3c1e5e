"""Real-time loop of the rig's process, with absolute deadlines and one packet per control period.

At t_n the sensors' packet is sent to the controller's process. Its answer is in time within `ANSWER_SHARE` of
the period; the rig needs the rest. A tick without an answer by then is missed: the rig continues with the
newest command (`RigTask.advance`), and accepts the answer when it arrives. If the rig itself was delayed, it
plays all due ticks at once, as missed ones. Only after a delay of more than `MAX_CATCH_UP_PERIODS` periods
its clock is shifted, as if it had stopped.
"""

import gc
import time
from array import array
from collections.abc import Callable
from typing import Protocol

from tuning.rig.network import Network
from tuning.rig.udp_protocol import (
    EMPTY_LOOP,
    TICK,
    AnswerPacket,
    PacketError,
    ReadingPacket,
    decode_answer,
    encode_reading,
)

ANSWER_SHARE = 0.8  # share of a period within which the answer must arrive
MAX_CATCH_UP_PERIODS = 10  # largest delay [periods] for which the rig catches up
BUSY_WAIT_TIME = 100_000  # time before a tick [ns] in which the loop polls the clock without sleeping
START_DELAY = 50_000_000  # time until the first tick [ns]
TIME_AFTER_TRIP = 1.0  # time for which the rig continues after a trip [s]


class RealTimeTask(Protocol):
    """Rig's side of the loop without network and clock, such as `tuning.rig.rig_task.RigTask`."""

    @property
    def tripped(self) -> str: ...
    def reading(self) -> ReadingPacket: ...
    def take(self, answer: AnswerPacket) -> bool: ...
    def advance(self) -> None: ...


class EmptyTask:
    """Rig's side of an empty loop, which only exchanges packets."""

    tripped = ""

    def __init__(self) -> None:
        self._sequence = -1

    def reading(self) -> ReadingPacket:
        """Return a packet of zeros."""
        self._sequence += 1
        return ReadingPacket(
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

    def take(self, answer: AnswerPacket) -> bool:
        """Return whether it answers the last packet."""
        return bool(answer.flags & EMPTY_LOOP) and answer.sequence == self._sequence

    def advance(self) -> None:
        """Do nothing, since nothing moves."""


class PacketTimes:
    """Times of the packets, arrays by packet number.

    `late` is the delay of sending [ns], `round_trip` the time from sending to the answer [ns] (0 without an
    answer), and `met` whether both were in time. `ticks` is the number of played ticks, `stood` the time by
    which the rig's clock was shifted [ns].
    """

    def __init__(self, ticks: int) -> None:
        self.late, self.round_trip = (array("q", bytes(8 * ticks)) for _ in range(2))
        self.answered_in_time = array("b", bytes(ticks))
        self.ticks, self.clock_shift = 0, 0


def run_loop(
    task: RealTimeTask,
    network: Network,
    session: int,
    period: float,
    timing: PacketTimes,
    tell: Callable[[int], None],
) -> None:
    """Play `len(timing.met)` ticks of `period` [s] in the given session, or until 1 s after a trip.

    `tell` is called once a second with the number of completed ticks. After an interruption `timing` holds
    the ticks played so far.
    """
    step, total = round(1e9 * period), len(timing.answered_in_time)
    allowance, second = round(ANSWER_SHARE * step), max(1, round(1 / period))
    last = total
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        began = time.monotonic_ns() + START_DELAY
        left = array("q", bytes(8 * total))
        for number in range(total):
            due = began + timing.clock_shift + number * step
            _wait_until(network, due)
            packet = encode_reading(task.reading(), session)
            left[number] = time.monotonic_ns()
            network.send(number, packet)
            late = timing.late[number] = left[number] - due
            if late > MAX_CATCH_UP_PERIODS * step:
                timing.clock_shift += late
                due += late
            is_answered = _await_answer(task, network, session, due + allowance, left, timing)
            timing.answered_in_time[number] = is_answered and late <= step
            task.advance()
            timing.ticks = number + 1
            if number % second == 0:
                tell(number)
            if task.tripped and last == total:
                last = number + round(TIME_AFTER_TRIP / period)
            if number >= last:
                break
    finally:
        gc.enable()
        gc.unfreeze()


def _await_answer(
    task: RealTimeTask, network: Network, session: int, deadline: int, left: array, timing: PacketTimes
) -> bool:
    """Receive packets until this tick's answer arrives or the deadline [ns] passes; return if it arrived."""
    while True:
        is_answered = False
        for arrived, packet in network.receive():
            try:
                answer = decode_answer(packet, session)
            except PacketError:
                continue
            number = answer.sequence
            if number < len(left) and left[number] and not timing.round_trip[number]:
                timing.round_trip[number] = arrived - left[number]
            is_answered = task.take(answer) or is_answered
        if is_answered:
            return True
        if time.monotonic_ns() >= deadline:
            return False
        network.wait(deadline)


def _wait_until(network: Network, due: int) -> None:
    """Wait until `due` [ns] and send delayed packets, without sleep in the last `BUSY_WAIT_TIME` ns."""
    while time.monotonic_ns() < due - BUSY_WAIT_TIME:
        network.wait(due - BUSY_WAIT_TIME, for_arrivals=False)
    while time.monotonic_ns() < due:
        pass


def answered_packet_number(packet: bytes) -> int | None:
    """Return the number of the packet that this one answers; None if it is no answer."""
    try:
        return decode_answer(packet, None).sequence
    except PacketError:
        return None
