"""Controller's process: it answers sensor packets with position commands, via UDP on the loopback device.

    python -I udp_controller.py [--port 0] [--record ticks.json] [--empty] ...

This program runs in a bundle's folder and needs only these files of the bundle: `gains.json`,
`jaxhil_runtime.py`, `udp_protocol.py` (packets), `udp_task.py` (answers), and `numerical_model.py` or, for
six axes, `numerical_model_six_axes.py`. When it listens, it prints `port NUMBER` to standard output. The rig
requests a session until it gets an answer. Then the rig sends these packets:

    PREPARE  the mechanism is free: tare, then prepare the start of a run; repeated until the answer is READY
    RESET    reset a controller that has tripped, then do the same as for PREPARE
    TICK     readings of the sensors at tick n = 0, 1, ... of the run; the answer is the command of tick n + 1
    STOP     end the session

The process also ends the session if the rig sends no valid packet for the time `--silence`. It serves one
session, with the address and port of the first valid packet. It ignores and counts packets from other
addresses or with another session number. A new session needs a new process. The process also integrates the
numerical model of the docking, once per period.

The process records the time of each tick, from the arrival of the packet to the answer, and its CPU time. It
writes both at the end. If a tick used too much CPU time (`MAX_CPU_SHARE`), the process replays all packets at
the end. If the controller was the cause, the tick is slow again in the replay. If an interrupt or another
virtual machine was the cause, the tick is fast. With `--empty`, the process answers at once and computes
nothing.
"""

import argparse
import gc
import importlib
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
# An isolated interpreter (-I) does not search the script's folder for modules.
if (SCRIPT_FOLDER / "jaxhil_runtime.py").is_file():
    sys.path.insert(0, str(SCRIPT_FOLDER))
    # Bytecode files would change the content of the bundle.
    sys.dont_write_bytecode = True
    import jaxhil_runtime as runtime  # pyright: ignore[reportMissingImports]
    import udp_protocol as udp  # pyright: ignore[reportMissingImports]
    from udp_task import MAX_INTERPOLATED_TICKS, ControllerTask  # pyright: ignore[reportMissingImports]

    MODEL_PACKAGE = ""
else:
    # The script is in the source tree, not in a bundle.
    if not __package__:
        sys.path.insert(0, str(SCRIPT_FOLDER.parents[1]))
    import jaxhil.rig as runtime
    from tuning.rig import udp_protocol as udp
    from tuning.rig.udp_task import MAX_INTERPOLATED_TICKS, ControllerTask

    MODEL_PACKAGE = "tuning.rig."

# Class of the controller, and module and class of the numerical model, by number of axes; a bundle contains
# only the modules for its number of axes.
MODELS = {
    1: ("Controller", "numerical_model", "OneAxisModelInLoop"),
    6: ("Controller6", "numerical_model_six_axes", "SixAxisModelInLoop"),
}
MAX_CPU_SHARE = 0.5  # largest CPU time of the controller for a tick [periods]
REPLAY_COUNT = 3  # number of replays; the shortest CPU time of a tick counts
MAX_READING_BYTES = max(form.reading.size for form in udp.FORMATS.values())
REAL_TIME_PRIORITY = 20  # priority requested from the operating system, in the class SCHED_FIFO [1 to 99]


class EmptyControllerTask:
    """Task for an empty loop: it answers every packet and computes nothing."""

    axes = None  # any number
    stale = interpolated = 0
    executed = 1
    status = "ok"
    quality_flags: ClassVar[dict[str, int]] = {}

    def answer(self, reading: udp.ReadingPacket) -> udp.AnswerPacket:
        """Return an answer to this reading in which all commands are zero."""
        _, sequence, run, tick, *_ = reading
        form = udp.FORMATS[len(reading.force)]
        zero, bodies = (0.0,) * form.axes, (0.0,) * form.bodies
        fields = udp.EMPTY_LOOP | udp.READY, sequence, run, tick, *[zero] * 5, bodies, 0, ""
        return udp.AnswerPacket._make(fields)


class TickRecord:
    """Record of all packets from the rig, and of the times of all ticks in preallocated arrays.

    Args:
        capacity: largest number of ticks and of packets; later ones are not recorded.

    Attributes:
        sequence: sequence number of each tick's packet.
        wall: time from each packet to its answer [ns].
        cpu: CPU time of each answer [ns].
        executed: number of ticks that each answer required; above 1 after missing packets.
        count: number of recorded ticks.
        packet_count: number of recorded packets.
    """

    def __init__(self, capacity: int) -> None:
        columns = (array("q", bytes(8 * capacity)) for _ in range(4))
        self.sequence, self.wall, self.cpu, self.executed = columns
        self._packets: list[bytes] = []
        self.count = 0
        self.capacity = capacity

    @property
    def packet_count(self) -> int:
        """Return the number of stored packets."""
        return len(self._packets)

    def store_packet(self, packet: bytes | bytearray) -> None:
        """Store a packet from the rig, for a replay."""
        if self.packet_count < self.capacity:
            self._packets.append(bytes(packet))

    def add(self, sequence: int, wall: int, cpu: int, executed: int = 1) -> None:
        """Store the time and the CPU time [ns] of an answer, which required `executed` ticks."""
        count = self.count
        if count < self.capacity:
            self.sequence[count], self.wall[count], self.cpu[count] = sequence, wall, cpu
            self.executed[count] = executed
            self.count = count + 1

    def readings(self) -> Iterator[udp.ReadingPacket]:
        """Decode and yield the stored packets in the order of arrival."""
        return map(udp.decode_reading, self._packets)

    def above(self, limit: float) -> dict[int, int]:
        """Return each CPU time per executed tick above `limit` (both in ns), by sequence number."""
        times = {self.sequence[i]: self.cpu[i] // self.executed[i] for i in range(self.count)}
        return {sequence: cpu for sequence, cpu in times.items() if cpu > limit}

    def document(self) -> dict[str, list[int]]:
        """Return sequence numbers and times of the ticks as JSON data."""
        return {name: list(getattr(self, name)[: self.count]) for name in ("sequence", "wall", "cpu")}


def replay_slow_ticks(
    make_task: Callable[[], ControllerTask], record: TickRecord, limit: float
) -> dict[int, int]:
    """Replay all packets if a tick used more CPU time than `limit` [ns].

    Return, by sequence number, each slow tick's shortest CPU time [ns] in the session and the replays. If an
    answer also executes the ticks of missing packets, its time is divided by the number of executed ticks.
    `make_task` returns a new task of the same controller for each replay.
    """
    times, cpu_now = record.above(limit), time.thread_time_ns
    for _ in range(REPLAY_COUNT if times else 0):
        task = make_task()
        for reading in record.readings():
            start = cpu_now()
            task.answer(reading)
            duration = (cpu_now() - start) // task.executed
            if reading.sequence in times:
                times[reading.sequence] = min(times[reading.sequence], duration)
    return times


class SessionEnd(NamedTuple):
    """Reason for the end of a session, and number of ignored packets."""

    reason: str  # "stopped", "silent" or "interrupted"
    ignored: int  # number of packets from other senders or with another session number


def serve(
    receiver: socket.socket,
    task: ControllerTask | EmptyControllerTask,
    record: TickRecord,
    wait: float,
    silence: float,
) -> SessionEnd:
    """Answer the packets of one session until the rig stops it or sends nothing.

    Args:
        receiver: socket that listens.
        task: task that computes the answers.
        record: record of times and packets, which this function fills.
        wait: longest time until the first packet [s].
        silence: longest time between two valid packets [s].
    """
    packet = bytearray(MAX_READING_BYTES + 1)
    now, cpu_now, clock = time.monotonic_ns, time.thread_time_ns, time.monotonic
    sessions, peer, session, ignored = udp.SessionNumbers(task.axes), None, 0, 0
    until = clock() + wait
    while True:
        # Only valid packets of the session extend this deadline, because any process can send other packets.
        remaining = until - clock()
        if remaining <= 0.0 or not select.select([receiver], [], [], remaining)[0]:
            return SessionEnd("silent", ignored)
        try:
            size, sender = receiver.recvfrom_into(packet)
        except OSError:
            # The receiver of an earlier answer no longer exists, and the system reports this error only now.
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
                reading = udp.decode_reading(packet[:size], session, task.axes)
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
        record.store_packet(packet[:size])
        if sent and reading.event == udp.TICK:
            record.add(reading.sequence, wall, cpu, task.executed)


def _send(receiver: socket.socket, packet: bytes, peer: Any) -> bool:
    """Send a packet; return whether the system accepted it (the rig listens and the buffer is not full)."""
    try:
        receiver.sendto(packet, peer)
    except OSError:
        return False
    return True


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the command-line options."""
    parser = argparse.ArgumentParser(description="Answer a rig's sensor packets over UDP on loopback.")
    parser.add_argument(
        "--gains",
        default=str(SCRIPT_FOLDER / "gains.json"),
        help="gain file; default: gains.json in this script's folder",
    )
    parser.add_argument("--port", type=int, default=0, help="UDP port on 127.0.0.1; 0: any free port")
    parser.add_argument("--record", default=None, help="output file for the time of every tick, as JSON")
    parser.add_argument("--ticks", type=int, default=1_000_000, help="largest number of recorded ticks")
    parser.add_argument("--wait", type=float, default=30.0, help="longest time until the first packet [s]")
    parser.add_argument(
        "--silence", type=float, default=2.0, help="time without a new packet that ends the session [s]"
    )
    parser.add_argument("--realtime", action="store_true", help="request a real-time priority")
    parser.add_argument("--empty", action="store_true", help="answer at once and compute nothing")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Serve one session; return the exit code.

    The exit code is 0 if the rig stopped the session, 2 if the gain file is invalid or the real-time priority
    is rejected, and 1 if the rig was silent or the user interrupted the session.
    """
    options = parse(arguments)
    limit = math.inf
    try:
        if options.empty:
            task: ControllerTask | EmptyControllerTask = EmptyControllerTask()
        else:
            task = load_task(options.gains)
            limit = MAX_CPU_SHARE * task.period * 1e9
        if options.realtime:
            request_real_time_priority()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        print(f"udp_controller: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    record = TickRecord(max(options.ticks, 0))
    # Garbage collection would delay ticks, and the loop creates no reference cycles.
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
        "ended": ended.reason,
        "ignored": ended.ignored,
        "status": task.status,
        "stale": task.stale,
        "made_up": task.interpolated,
        "doubts": task.quality_flags,
        "jax": "jax" in sys.modules,
        "ticks": record.document(),
        "replayed": {"sequence": list(replay), "cpu": list(replay.values())},
    }
    if options.record is not None:
        Path(options.record).write_text(json.dumps(document), encoding="utf-8")
    return 0 if ended.reason == "stopped" else 1


def load_task(path: str) -> ControllerTask:
    """Return the task that answers readings with the controller and the mechanism of a gain file.

    Raise ValueError, OSError, KeyError, TypeError or AttributeError if the file is invalid.
    """
    document = json.loads(Path(path).read_text(encoding="utf-8"))
    axes = document.get("axes", 1)
    name, module, model = MODELS.get(axes, ("", "", ""))
    controller_class = getattr(runtime, name, None)
    if controller_class is None:
        expected = " or ".join(str(number) for number, (name, *_) in MODELS.items() if hasattr(runtime, name))
        raise ValueError(f"{path}: axes: found {axes!r}, expected {expected}")
    controller = controller_class.from_file(path)
    model_class = getattr(importlib.import_module(MODEL_PACKAGE + module), model)
    limit = document.get("limits", {}).get("missed_in_a_row", {}).get("value")
    return ControllerTask(
        controller,
        model_class(controller, document["mechanism"]),
        MAX_INTERPOLATED_TICKS if limit is None else limit,
    )


def request_real_time_priority() -> None:
    """Request a real-time priority for this thread; raise OSError if the operating system denies it."""
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("this system has no real-time priorities")
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME_PRIORITY))


if __name__ == "__main__":
    sys.exit(main())
