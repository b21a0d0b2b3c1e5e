"""The controller as a process of its own: sensor packets in, position commands out, over UDP on loopback.

    python -I udp_controller.py [--port 0] [--record ticks.json] [--empty] ...

It runs from a bundle's folder with that bundle's `gains.json`, `jaxhil_runtime.py` and `udp_protocol.py`,
which says what is in a packet; nothing else is needed. Standard output says `port NUMBER` once it listens.
Whoever plays the rig asks for a session (`ask_for_session`) until the answer is there, then sends

    PREPARE  the mechanism is free: tare, then stand ready at the start of a run; repeated until READY
    RESET    as PREPARE, after a reset of a controller that has tripped
    TICK     what the sensors read at tick n = 0, 1, ... of the run; answered by the command for tick n + 1
    STOP     the session is over

and a silent rig (`--silence`) ends it too. This process serves one session, which belongs to the address and
port that its first packet came from. Packets from elsewhere or without the session's number are ignored and
counted; neither they nor packets that came before break the silence. A rig that begins anew starts another
process. This one holds the numerical model: M x'' = -F_c, integrated once per period.

Its own time per tick (from the return of recv to that of send) and the CPU time in it are kept in arrays
allocated beforehand and written at the end. Where a tick took more CPU time than its share of the period, all
packets are gone through again at the end: the same work takes as long again, what an interrupt or another
machine on the same processor took does not. With `--empty` it answers at once and computes nothing.
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

HERE = Path(__file__).resolve().parent
# An isolated interpreter (-I) does not look beside the script.
if (HERE / "jaxhil_runtime.py").is_file():
    sys.path.insert(0, str(HERE))
    # A bundle stays as it is.
    sys.dont_write_bytecode = True
    import udp_protocol as udp  # pyright: ignore[reportMissingImports]
    from jaxhil_runtime import Controller  # pyright: ignore[reportMissingImports]
else:
    # Not in a bundle but in the source tree.
    if not __package__:
        sys.path.insert(0, str(HERE.parents[1]))
    from jaxhil.rig import Controller
    from tuning.rig import udp_protocol as udp

CPU_SHARE = 0.5  # of the period, that is the controller's
REPLAYS = 3
PRIORITY = 20  # of the real-time class, where asked for


class Empty:
    """An empty loop: every packet is answered, nothing is computed."""

    stale = made_up = 0
    status = "ok"
    doubts: ClassVar[dict[str, int]] = {}

    def answer(self, reading: udp.Reading) -> udp.Answer:
        """Zeros, and the reading's own numbers."""
        _, sequence, run, tick, *_ = reading
        return udp.Answer(udp.EMPTY | udp.READY, sequence, run, tick, 0.0, 0.0, 0.0, 0.0, 0.0, 0, "")


class TickRecord:
    """Sequence number, own time [ns] and CPU time [ns] of every tick, and the packets, in memory allocated
    beforehand. What does not fit is not kept."""

    def __init__(self, capacity: int) -> None:
        self.sequence, self.wall, self.cpu = (array("q", bytes(8 * capacity)) for _ in range(3))
        self._packets, self._size = bytearray(udp.READING.size * capacity), udp.READING.size
        self.count = self.kept = 0
        self.capacity = capacity

    def keep(self, packet: bytes | bytearray) -> None:
        """Keep a packet, of whatever kind."""
        kept = self.kept
        if kept < self.capacity:
            self._packets[kept * self._size : (kept + 1) * self._size] = packet
            self.kept = kept + 1

    def add(self, sequence: int, wall: int, cpu: int) -> None:
        """Keep the times of one tick."""
        count = self.count
        if count < self.capacity:
            self.sequence[count], self.wall[count], self.cpu[count] = sequence, wall, cpu
            self.count = count + 1

    def readings(self) -> Iterator[udp.Reading]:
        """The readings of the packets kept."""
        for place in range(self.kept):
            packet = self._packets[place * self._size : (place + 1) * self._size]
            yield udp.decode_reading(packet, None)

    def above(self, limit: float) -> dict[int, int]:
        """CPU time [ns] of the ticks that took more than `limit` [ns], by their sequence number."""
        return {self.sequence[i]: self.cpu[i] for i in range(self.count) if self.cpu[i] > limit}

    def document(self) -> dict[str, list[int]]:
        """As JSON can express it."""
        return {name: list(getattr(self, name)[: self.count]) for name in ("sequence", "wall", "cpu")}


def replayed(make: Callable[[], udp.ControllerTask], record: TickRecord, limit: float) -> dict[int, int]:
    """CPU time [ns], the least of a few replays, of the ticks that took more than `limit` [ns] when live."""
    found, cpu_now = record.above(limit), time.thread_time_ns
    for _ in range(REPLAYS if found else 0):
        task = make()
        for reading in record.readings():
            begun = cpu_now()
            task.answer(reading)
            took = cpu_now() - begun
            if reading.sequence in found:
                found[reading.sequence] = min(found[reading.sequence], took)
    return found


class Ended(NamedTuple):
    """How a session ended."""

    why: str  # "stopped", "silent" or "interrupted"
    ignored: int  # packets that were not of it


def serve(
    receiver: socket.socket, task: udp.ControllerTask | Empty, record: TickRecord, wait: float, silence: float
) -> Ended:
    """Answer the packets of one session until the rig stops it, or `silence` [s] have passed without one;
    `wait` [s] for its first."""
    packet = bytearray(udp.READING.size + 1)
    now, cpu_now, clock = time.monotonic_ns, time.thread_time_ns, time.monotonic
    sessions, peer, session, ignored = udp.Sessions(), None, 0, 0
    until = clock() + wait
    while True:
        # Not the time since the last packet: anyone may send some.
        left = until - clock()
        if left <= 0.0 or not select.select([receiver], [], [], left)[0]:
            return Ended("silent", ignored)
        try:
            size, sender = receiver.recvfrom_into(packet)
        except OSError:
            # A refusal that an earlier answer met: its addressee is gone.
            continue
        begun, cpu_begun = now(), cpu_now()
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
            return Ended("stopped", ignored)
        answer, sent = task.answer(reading), False
        if answer is not None:
            until = clock() + silence
            sent = _send(receiver, udp.encode_answer(answer, session), peer)
        took, cpu_took = now() - begun, cpu_now() - cpu_begun
        record.keep(packet[:size])
        if sent and reading.event == udp.TICK:
            record.add(reading.sequence, took, cpu_took)


def _send(receiver: socket.socket, packet: bytes, peer: Any) -> bool:
    """Whether a packet left: not where the rig does not listen, or the network is full."""
    try:
        receiver.sendto(packet, peer)
    except OSError:
        return False
    return True


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The process's options."""
    parser = argparse.ArgumentParser(description="Answer a rig's sensor packets over UDP on loopback.")
    parser.add_argument("--gains", default=str(HERE / "gains.json"), help="gain file; by default beside this")
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
    """Serve one session; 0 when it was ended by the rig, 1 by its silence, 2 for a file that does not fit."""
    options = parse(arguments)
    limit = math.inf
    try:
        if options.empty:
            task: udp.ControllerTask | Empty = Empty()
        else:
            task = load(options.gains)
            limit = CPU_SHARE * task.period * 1e9
        if options.realtime:
            realtime()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        print(f"udp_controller: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    record = TickRecord(max(options.ticks, 0))
    # From here on nothing is made that a collector would have to look for.
    gc.collect()
    gc.freeze()
    gc.disable()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", options.port))
        print(f"port {receiver.getsockname()[1]}", flush=True)
        try:
            ended = serve(receiver, task, record, options.wait, options.silence)
        except KeyboardInterrupt:
            ended = Ended("interrupted", 0)
    again = replayed(lambda: load(options.gains), record, limit)
    document = {
        "ended": ended.why,
        "ignored": ended.ignored,
        "status": task.status,
        "stale": task.stale,
        "made_up": task.made_up,
        "doubts": task.doubts,
        "jax": "jax" in sys.modules,
        "ticks": record.document(),
        "replayed": {"sequence": list(again), "cpu": list(again.values())},
    }
    if options.record is not None:
        Path(options.record).write_text(json.dumps(document), encoding="utf-8")
    return 0 if ended.why == "stopped" else 1


def load(path: str) -> udp.ControllerTask:
    """The task of a gain file. Raises ValueError, OSError, KeyError, TypeError for one that does not fit."""
    controller = Controller.from_file(path)
    document = json.loads(Path(path).read_text(encoding="utf-8"))
    limit = document.get("limits", {}).get("missed_in_a_row", {}).get("value")
    return udp.ControllerTask(controller, document["mechanism"], udp.MOST_MADE_UP if limit is None else limit)


def realtime() -> None:
    """Ask for a real-time priority. Raises OSError where that is not to be had."""
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("this system has no real-time priorities")
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


if __name__ == "__main__":
    sys.exit(main())
