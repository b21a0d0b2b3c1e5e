"""Process of the controller, which answers sensor packets with position commands over UDP on loopback.

    python -I udp_controller.py [--port 0] [--record ticks.json] [--empty] ...

It runs in a bundle's folder and needs only that bundle's `gains.json`, `jaxhil_runtime.py` and
`udp_protocol.py`, which defines the packets. It prints `port NUMBER` to standard output when it listens. The
rig requests a session (`ask_for_session`) until it gets an answer, then sends

    PREPARE  the mechanism is free: tare, then prepare the start of a run; repeated until READY
    RESET    as PREPARE, after a reset of a controller that has tripped
    TICK     readings of the sensors at tick n = 0, 1, ... of the run; the answer is the command of tick n + 1
    STOP     the end of the session

The session also ends if the rig is silent (`--silence`). This process serves one session, with the address
and port of its first packet. Packets from other addresses, or without the session's number, are ignored and
counted; neither these nor old packets end the silence. A new session needs another process.
This process holds the numerical model M x'' = -F_c, integrated once per period.

The time per tick (from the return of recv to that of send) and its CPU time are stored in preallocated arrays
and written at the end. If a tick took more CPU time than its share of the period, all packets are replayed at
the end. The controller's work takes equally long again, whereas an interrupt or another virtual machine on
the processor does not occur again. With `--empty` the process answers at once and computes nothing.
"""

import argparse
import gc
import json
import math
import os
import select
import socket
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

SCRIPT_FOLDER = Path(__file__).resolve().parent
# An isolated interpreter (-I) does not search the script's folder.
if (SCRIPT_FOLDER / "jaxhil_runtime.py").is_file():
    sys.path.insert(0, str(SCRIPT_FOLDER))
    # No files may be added to a bundle.
    sys.dont_write_bytecode = True
    import udp_protocol as udp  # pyright: ignore[reportMissingImports]
    from jaxhil_runtime import Controller  # pyright: ignore[reportMissingImports]
else:
    # The script is in the source tree, not in a bundle.
    if not __package__:
        sys.path.insert(0, str(SCRIPT_FOLDER.parents[1]))
    from jaxhil.rig import Controller
    from tuning.rig import udp_protocol as udp

MAX_CPU_SHARE = 0.5  # share of the period that the controller may use as CPU time
REPLAY_COUNT = 3  # number of replays, of which the least time counts
REAL_TIME_PRIORITY = 20  # requested priority of the real-time class


class EmptyControllerTask:
    """Task of an empty loop, which answers every packet and computes nothing."""

    stale = made_up = 0
    status = "ok"
    doubts: ClassVar[dict[str, int]] = {}

    def answer(self, reading: udp.ReadingPacket) -> udp.AnswerPacket:
        """Return an answer with the reading's numbers and zeros."""
        _, sequence, run, tick, *_ = reading
        return udp.AnswerPacket(
            udp.EMPTY_LOOP | udp.READY, sequence, run, tick, 0.0, 0.0, 0.0, 0.0, 0.0, 0, ""
        )


class TickRecord:
    """Record of every tick in preallocated memory: sequence number, time [ns], CPU time [ns] and packet.

    Ticks and packets beyond the capacity are not recorded.
    """

    def __init__(self, capacity: int) -> None:
        self.sequence, self.wall, self.cpu = (array("q", bytes(8 * capacity)) for _ in range(3))
        self._packets, self._size = bytearray(udp.READING_FORMAT.size * capacity), udp.READING_FORMAT.size
        self.count = self.kept = 0
        self.capacity = capacity

    def keep(self, packet: bytes | bytearray) -> None:
        """Store a packet of any kind."""
        count = self.kept
        if count < self.capacity:
            self._packets[count * self._size : (count + 1) * self._size] = packet
            self.kept = count + 1

    def add(self, sequence: int, wall: int, cpu: int) -> None:
        """Store the times of one tick."""
        count = self.count
        if count < self.capacity:
            self.sequence[count], self.wall[count], self.cpu[count] = sequence, wall, cpu
            self.count = count + 1

    def readings(self) -> Iterator[udp.ReadingPacket]:
        """Yield the readings of the stored packets."""
        for index in range(self.kept):
            packet = self._packets[index * self._size : (index + 1) * self._size]
            yield udp.decode_reading(packet, None)

    def above(self, limit: float) -> dict[int, int]:
        """Return the CPU time [ns] of the ticks above `limit` [ns] by sequence number."""
        return {self.sequence[i]: self.cpu[i] for i in range(self.count) if self.cpu[i] > limit}

    def document(self) -> dict[str, list[int]]:
        """Return the times as JSON data."""
        return {name: list(getattr(self, name)[: self.count]) for name in ("sequence", "wall", "cpu")}


def replay_slow_ticks(
    make: Callable[[], udp.ControllerTask], record: TickRecord, limit: float
) -> dict[int, int]:
    """Return the least CPU time [ns] in live run and replays of the ticks above `limit` [ns] when live."""
    times, cpu_now = record.above(limit), time.thread_time_ns
    for _ in range(REPLAY_COUNT if times else 0):
        task = make()
        for reading in record.readings():
            start = cpu_now()
            task.answer(reading)
            duration = cpu_now() - start
            if reading.sequence in times:
                times[reading.sequence] = min(times[reading.sequence], duration)
    return times


class SessionEnd(NamedTuple):
    """End of a session."""

    why: str  # "stopped", "silent" or "interrupted"
    ignored: int  # number of ignored packets


def serve(
    receiver: socket.socket,
    task: udp.ControllerTask | EmptyControllerTask,
    record: TickRecord,
    wait: float,
    silence: float,
) -> SessionEnd:
    """Answer the packets of one session until the rig stops it or is silent for `silence` [s].

    `wait` [s] is the longest time until the first packet.
    """
    packet = bytearray(udp.READING_FORMAT.size + 1)
    now, cpu_now, clock = time.monotonic_ns, time.thread_time_ns, time.monotonic
    sessions, peer, session, ignored = udp.SessionNumbers(), None, 0, 0
    until = clock() + wait
    while True:
        # Only packets of the session extend this deadline, since others can come from any process.
        left = until - clock()
        if left <= 0.0 or not select.select([receiver], [], [], left)[0]:
            return SessionEnd("silent", ignored)
        try:
            size, sender = receiver.recvfrom_into(packet)
        except OSError:
            # An earlier answer was refused, since its receiver no longer exists.
            continue
        start, cpu_start = now(), cpu_now()
        if peer is None:
            session = sessions.number(sender)
            opening = sessions.answer(packet[:size], sender)
            if opening is not None:
                _send(receiver, opening, sender)
                continue
        reading = None
        if peer is None or sender == peer:
            try:
                reading = udp.decode_reading(packet[:size], session)
            except udp.PacketError:
                pass
        if reading is None:
            ignored += 1
            continue
        if peer is None:
            peer, until = sender, clock() + silence
        if reading.event == udp.STOP:
            return SessionEnd("stopped", ignored)
        answer, sent = task.answer(reading), False
        if answer is not None:
            until = clock() + silence
            sent = _send(receiver, udp.encode_answer(answer, session), peer)
        wall, cpu = now() - start, cpu_now() - cpu_start
        record.keep(packet[:size])
        if sent and reading.event == udp.TICK:
            record.add(reading.sequence, wall, cpu)


def _send(receiver: socket.socket, packet: bytes, peer: Any) -> bool:
    """Send a packet; return False if the rig does not listen or the network's buffer is full."""
    try:
        receiver.sendto(packet, peer)
    except OSError:
        return False
    return True


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the process's options."""
    parser = argparse.ArgumentParser(description="Answer a rig's sensor packets over UDP on loopback.")
    parser.add_argument(
        "--gains", default=str(SCRIPT_FOLDER / "gains.json"), help="gain file; by default beside this"
    )
    parser.add_argument("--port", type=int, default=0, help="UDP port on 127.0.0.1; 0: any that is free")
    parser.add_argument("--record", default=None, help="file for the time of every tick, as JSON")
    parser.add_argument("--ticks", type=int, default=1_000_000, help="ticks to keep the time of")
    parser.add_argument("--wait", type=float, default=30.0, help="s to wait for the first packet")
    parser.add_argument(
        "--silence", type=float, default=2.0, help="s without a new packet that end the session"
    )
    parser.add_argument("--realtime", action="store_true", help="ask for a real-time priority")
    parser.add_argument("--empty", action="store_true", help="answer at once, compute nothing")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Serve one session; return 0 if the rig stopped it, 2 for an invalid gain file or option, else 1."""
    options = parse(arguments)
    limit = math.inf
    try:
        if options.empty:
            task: udp.ControllerTask | EmptyControllerTask = EmptyControllerTask()
        else:
            task = load_task(options.gains)
            limit = MAX_CPU_SHARE * task.period * 1e9
        if options.realtime:
            request_real_time_priority()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        print(f"udp_controller: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    record = TickRecord(max(options.ticks, 0))
    # Collections would delay ticks, and the loop creates no reference cycles.
    gc.collect()
    gc.freeze()
    gc.disable()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", options.port))
        print(f"port {receiver.getsockname()[1]}", flush=True)
        try:
            ended = serve(receiver, task, record, options.wait, options.silence)
        except KeyboardInterrupt:
            ended = SessionEnd("interrupted", 0)
    replay = replay_slow_ticks(lambda: load_task(options.gains), record, limit)
    document = {
        "ended": ended.why,
        "ignored": ended.ignored,
        "status": task.status,
        "stale": task.stale,
        "made_up": task.made_up,
        "doubts": task.doubts,
        "jax": "jax" in sys.modules,
        "ticks": record.document(),
        "replayed": {"sequence": list(replay), "cpu": list(replay.values())},
    }
    if options.record is not None:
        Path(options.record).write_text(json.dumps(document), encoding="utf-8")
    return 0 if ended.why == "stopped" else 1


def load_task(path: str) -> udp.ControllerTask:
    """Load the task of a gain file; raise ValueError, OSError, KeyError or TypeError if it is invalid."""
    controller = Controller.from_file(path)
    document = json.loads(Path(path).read_text(encoding="utf-8"))
    limit = document.get("limits", {}).get("missed_in_a_row", {}).get("value")
    return udp.ControllerTask(
        controller, document["mechanism"], udp.MAX_INTERPOLATED_TICKS if limit is None else limit
    )


def request_real_time_priority() -> None:
    """Request a real-time priority; raise OSError if it is refused."""
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("this system has no real-time priorities")
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME_PRIORITY))


if __name__ == "__main__":
    sys.exit(main())
