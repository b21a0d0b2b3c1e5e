"""Real-time loop of the rig's process, with absolute deadlines and one packet per control period.

At the start of each period, the rig sends a packet with the sensor readings to the controller's process. The
answer is in time if it arrives within the fraction `ANSWER_SHARE` of the period; the rig needs the remaining
time. A tick without an answer in time is a missed tick: the rig continues with the newest command
(`RigTask.advance`), and accepts the late answer when it arrives. If the rig itself is late, it executes all
due ticks at once and counts them as missed. If it is late by more than `MAX_CATCH_UP_PERIODS` periods, it
shifts its clock by this delay instead.
"""

import gc
import time
from array import array
from collections.abc import Callable
from typing import Protocol

from tuning.rig.network import Network
from tuning.rig.udp_protocol import (
    EMPTY_LOOP,
    FORMATS,
    TICK,
    AnswerPacket,
    PacketError,
    ReadingPacket,
    decode_answer,
    encode_reading,
)

ANSWER_SHARE = 0.8  # longest time until an answer [periods]; the rig needs the remaining time
MAX_CATCH_UP_PERIODS = 10  # if the rig is later than this [periods], it skips the missed ticks
BUSY_WAIT_TIME = 100_000  # time before a tick [ns] in which the loop polls the clock; a sleep may be too long
START_DELAY = 50_000_000  # time from the start of the loop to the first tick [ns]
MAX_SILENCE = 2.0  # time without an answer after which the loop ends: the controller has ended or hangs [s]
# smallest number of ticks without an answer after which the loop ends; `MAX_SILENCE` must also have passed
MAX_UNANSWERED_TICKS = 100
TIME_AFTER_TRIP = 1.0  # time for which the rig continues after the controller has tripped [s]


class RealTimeTask(Protocol):
    """Interface of the task that `run_loop` executes in each tick, such as `tuning.rig.rig_task.RigTask`."""

    @property
    def tripped(self) -> str: ...
    def reading(self) -> ReadingPacket: ...
    def take(self, answer: AnswerPacket) -> bool: ...
    def advance(self) -> None: ...


class EmptyTask:
    """Task that simulates no rig: it sends packets of zeros, to measure the loop alone."""

    tripped = ""

    def __init__(self, axes: int = 1) -> None:
        self._axes, self._sequence = axes, -1

    def reading(self) -> ReadingPacket:
        """Return a packet with sensor readings of zero."""
        self._sequence += 1
        return build_empty_reading(self._axes, TICK, self._sequence)

    def take(self, answer: AnswerPacket) -> bool:
        """Return whether the answer belongs to the newest packet."""
        return bool(answer.flags & EMPTY_LOOP) and answer.sequence == self._sequence

    def advance(self) -> None:
        """Do nothing, since there is no hardware to move."""


def build_empty_reading(axes: int, event: int, sequence: int) -> ReadingPacket:
    """Return a packet with sensor readings of zero for a number of axes."""
    zero, start = (0.0,) * axes, (0.0,) * FORMATS[axes].start
    return ReadingPacket(event, sequence, 0, sequence & 0xFFFF, 0.0, zero, zero, start)


class PacketTimes:
    """Measured times of all packets of a loop.

    Attributes:
        late: delay of each packet after its due time [ns], (ticks,).
        round_trip: time from each packet to its answer [ns], 0 without an answer, (ticks,).
        answered_in_time: 1 if the packet and its answer were in time, else 0, (ticks,).
        ticks: number of executed ticks.
        newest_answer: number of the latest packet that was answered, -1 without any answer.
        clock_shift: total time by which the rig's clock was shifted [ns].
    """

    def __init__(self, ticks: int) -> None:
        self.late, self.round_trip = (array("q", bytes(8 * ticks)) for _ in range(2))
        self.answered_in_time = array("b", bytes(ticks))
        self.ticks, self.clock_shift, self.newest_answer = 0, 0, -1


def run_loop(
    task: RealTimeTask,
    network: Network,
    session: int,
    period: float,
    timing: PacketTimes,
    tell: Callable[[int], None],
) -> None:
    """Execute ticks in real time until `timing` is full, or until 1 s after the controller has tripped.

    The loop also ends if the controller's process sends no answer for more than `MAX_UNANSWERED_TICKS` ticks
    and more than `MAX_SILENCE` seconds. After an interruption, `timing` holds the ticks executed so far.

    Args:
        task: work of the rig in each tick.
        network: connection to the controller's process.
        session: number of the session.
        period: real time from one tick to the next [s].
        timing: record of the packet times, which this function fills.
        tell: callback, called once a second with the number of completed ticks.
    """
    step, total = round(1e9 * period), len(timing.answered_in_time)
    allowance, second = round(ANSWER_SHARE * step), max(1, round(1 / period))
    last = total
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        start_time = time.monotonic_ns() + START_DELAY
        send_times = array("q", bytes(8 * total))
        for number in range(total):
            due = start_time + timing.clock_shift + number * step
            _wait_until(network, due)
            packet = encode_reading(task.reading(), session)
            send_times[number] = time.monotonic_ns()
            network.send(number, packet)
            late = timing.late[number] = send_times[number] - due
            if late > MAX_CATCH_UP_PERIODS * step:
                timing.clock_shift += late
                due += late
            is_answered = _await_answer(task, network, session, due + allowance, send_times, timing)
            timing.answered_in_time[number] = is_answered and late <= step
            task.advance()
            timing.ticks = number + 1
            if number % second == 0:
                tell(number)
            if number - timing.newest_answer > max(MAX_SILENCE / period, MAX_UNANSWERED_TICKS):
                break
            if task.tripped and last == total:
                last = number + round(TIME_AFTER_TRIP / period)
            if number >= last:
                break
    finally:
        gc.enable()
        gc.unfreeze()


def _await_answer(
    task: RealTimeTask, network: Network, session: int, deadline: int, send_times: array, timing: PacketTimes
) -> bool:
    """Receive packets until this tick's answer arrives (True) or the `deadline` [ns] passes (False)."""
    while True:
        is_answered = False
        for arrived, packet in network.receive():
            try:
                answer = decode_answer(packet, session)
            except PacketError:
                continue
            number = answer.sequence
            timing.newest_answer = max(timing.newest_answer, number)
            if number < len(send_times) and send_times[number] and not timing.round_trip[number]:
                timing.round_trip[number] = arrived - send_times[number]
            is_answered = task.take(answer) or is_answered
        if is_answered:
            return True
        if time.monotonic_ns() >= deadline:
            return False
        network.wait(deadline)


def _wait_until(network: Network, due: int) -> None:
    """Wait until the time `due` [ns]; send delayed packets until `BUSY_WAIT_TIME` before it."""
    while time.monotonic_ns() < due - BUSY_WAIT_TIME:
        network.wait(due - BUSY_WAIT_TIME, for_arrivals=False)
    while time.monotonic_ns() < due:
        pass


def answered_packet_number(packet: bytes) -> int | None:
    """Return the number of the packet that `packet` answers; None if `packet` is not an answer."""
    try:
        return decode_answer(packet, None).sequence
    except PacketError:
        return None
