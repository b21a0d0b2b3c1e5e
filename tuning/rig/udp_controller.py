"""The controller as a process of its own: sensor packets in, position commands out, over UDP on loopback.

    python -I udp_controller.py [--port 0] [--record ticks.json] [--empty] ...

It runs from a bundle's folder with that bundle's `gains.json` and `jaxhil_runtime.py`; nothing else is
needed. Standard output says `port NUMBER` once it listens. Whoever plays the rig sends

    PREPARE  the mechanism is free: tare, then stand ready at the start of a run; repeated until READY
    RESET    as PREPARE, after a reset of a controller that has tripped
    TICK     what the sensors read at tick n = 0, 1, ... of the run; answered by the command for tick n + 1
    STOP     the session is over

and a silent rig (`--silence`) ends it too. This process holds the numerical model: M x'' = -F_c, integrated
once per period. Packets may be lost, late or out of order: one that is no newer than the last is dropped and
counted. Ticks that no packet came for are made up once the next one is there, from readings on the straight
line between, and answered with the fault `missed_tick`. Where more are missing than the gain file's limit
`missed_in_a_row` (without one, `MOST_MADE_UP`), the controller sees the gap in the rig's time and judges it,
and the model goes on under the last F_c: its time stays the rig's.

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
import struct
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
    from jaxhil_runtime import Controller  # pyright: ignore[reportMissingImports]
else:
    # Not in a bundle but in the source tree.
    if not __package__:
        sys.path.insert(0, str(HERE.parents[1]))
    from jaxhil.runtime import Controller

PREPARE, TICK, STOP, RESET = 1, 2, 3, 4  # kinds of packets from the rig
EVENTS = (PREPARE, TICK, STOP, RESET)
READY, TRIPPED, TARING, EMPTY = 1, 2, 4, 8  # flags of an answer
FLAGS = READY | TRIPPED | TARING | EMPTY

# Little-endian: mark, version, kind, sequence, run, tick; time [s], force [N], position [m], start [m, m/s].
READING = struct.Struct("<4sBBxxIIIxxxx5d")
# Mark, version, flags, sequence, run, tick; positions, velocity, forces; faults; words on a trip.
ANSWER = struct.Struct("<4sBBxxIII4xdddddQ96s")
MARK_IN, MARK_OUT, VERSION = b"JHrd", b"JHan", 1

APPROACH = 0.02  # s of free approach before a contact
MOST_MADE_UP = 10  # ticks in a row, without a limit in the gain file
MOST_PASSED = 10_000  # periods that the model goes on under the last force
MISSED_TICK, LAW_IN_DOUBT = 0x200, 0x200000  # the runtime's faults of these names

CPU_SHARE = 0.5  # of the period, that is the controller's
REPLAYS = 3
PRIORITY = 20  # of the real-time class, where asked for


class PacketError(ValueError):
    """Bytes that are no packet of this protocol."""


class Reading(NamedTuple):
    """From the rig: kind of packet, its number in the session, run, tick of the run; rig time [s]; measured
    force [N] and position [m]; position [m] and velocity [m/s] of the numerical model at the run's tick 0."""

    event: int
    sequence: int
    run: int
    tick: int
    time: float
    force: float
    position: float
    start_position: float
    start_velocity: float


class Answer(NamedTuple):
    """To the rig, about the reading of the same numbers: flags; position command [m] of the next tick (of
    tick 0, while preparing) and its rate [m/s]; the model's position [m] and velocity [m/s] at this tick, and
    the force F_c [N] it feels; the controller's faults; why it has tripped, if it has."""

    flags: int
    sequence: int
    run: int
    tick: int
    position_command: float
    command_rate: float
    position: float
    velocity: float
    force_command: float
    faults: int
    words: str


def encode_reading(reading: Reading) -> bytes:
    """The packet of a reading."""
    return READING.pack(MARK_IN, VERSION, *reading)


def decode_reading(packet: bytes | bytearray) -> Reading:
    """The reading in a packet; sensor values may be anything, NaN included. Raises PacketError."""
    if len(packet) != READING.size:
        raise PacketError(f"{len(packet)} bytes, allowed {READING.size}")
    mark, version, *fields = READING.unpack(packet)
    reading = Reading(*fields)
    if mark != MARK_IN or version != VERSION or reading.event not in EVENTS:
        raise PacketError("not a packet from the rig of this version")
    if not math.isfinite(reading.time):
        raise PacketError("a time that is not finite")
    return reading


def encode_answer(answer: Answer) -> bytes:
    """The packet of an answer; words are cut to 96 ASCII characters."""
    words = answer.words.encode("ascii", "replace")
    return ANSWER.pack(MARK_OUT, VERSION, *answer[:-1], words)


def decode_answer(packet: bytes) -> Answer:
    """The answer in a packet. Raises PacketError."""
    if len(packet) != ANSWER.size:
        raise PacketError(f"{len(packet)} bytes, allowed {ANSWER.size}")
    mark, version, *fields, words = ANSWER.unpack(packet)
    if mark != MARK_OUT or version != VERSION or fields[0] & ~FLAGS:
        raise PacketError("not an answer of this version")
    text = words.rstrip(b"\0")
    if not all(32 <= byte < 127 for byte in text):
        raise PacketError("words that are not printable")
    return Answer._make((*fields, text.decode("ascii")))


class NumericalModel:
    """M x'' = -F_c of the relative motion of two free bodies, once per control period.

    Mass [kg], period [s] and integrator are the mechanism's, which the gain file holds, and so is the first
    start: in uniform motion at x(0) = -v (0.02 s + phase T).
    """

    __slots__ = ("_integrator", "_mass", "_period", "acceleration", "position", "start", "velocity")

    def __init__(self, mechanism: dict[str, Any]) -> None:
        bodies, rig, approach = mechanism["bodies"], mechanism["rig"], mechanism["approach"]
        mass = bodies.get("equivalent_mass")
        if mass is None:
            chaser, target = bodies["chaser_mass"], bodies["target_mass"]
            mass = chaser * (target / (chaser + target))
        self._mass, self._period = float(mass), float(rig["control_period"])
        self._integrator = rig.get("integrator", "semi_implicit_euler")
        velocity = float(approach["velocity"])
        phase = float(approach.get("phase", 1.0 / 3.0))
        self.start = -velocity * (APPROACH + phase * self._period), velocity
        self.place(*self.start)

    def place(self, position: float, velocity: float) -> None:
        """Uniform motion: position [m], velocity [m/s]."""
        self.position, self.velocity, self.acceleration = position, velocity, 0.0

    def integrate(self, force: float) -> None:
        """One period under the force F_c [N]."""
        period, velocity = self._period, self.velocity
        acceleration = -force / self._mass
        self.velocity = velocity + period * acceleration
        self.acceleration = acceleration
        if self._integrator == "zoh":
            self.position += period * velocity + period * period * acceleration / 2.0
        elif self._integrator == "explicit_euler":
            self.position += period * velocity
        else:
            self.position += period * self.velocity


class ControllerTask:
    """What is done with one packet, without a network: readings in, answers out.

    `bridged`: how many missing ticks in a row are made up. Counts `made_up` and `stale`, packets of no
    use, and in `doubts` the contacts of which the law said that it did not know them, by what it said.
    """

    __slots__ = (
        *("_bridged", "_command", "_controller", "_force", "_last", "_model", "_period", "_run"),
        *("_sequence", "_tared", "_words", "_zeroed", "doubts", "made_up", "stale"),
    )

    def __init__(self, controller: Any, mechanism: dict[str, Any], bridged: float = MOST_MADE_UP) -> None:
        self._controller = controller
        self._model, self._bridged = NumericalModel(mechanism), min(bridged, MOST_MADE_UP)
        self._period = float(mechanism["rig"]["control_period"])
        sensor = mechanism["rig"].get("force_sensor", {})
        # Before tick 0 there is no force, though a noisy sensor reads some.
        self._zeroed = sensor.get("noise_std", 0.0) != 0.0 or sensor.get("bias", 0.0) != 0.0
        self._sequence, self._run, self._tared = -1, -1, False
        self._command = self._force = 0.0
        self._last: Reading | None = None
        self._words = ""
        self.stale = self.made_up = 0
        self.doubts: dict[str, int] = {}

    @property
    def period(self) -> float:
        """The control period [s]."""
        return self._period

    @property
    def status(self) -> str:
        """What the controller says of itself."""
        return str(self._controller.status)

    def answer(self, reading: Reading) -> Answer | None:
        """The answer to a reading, or None for one that comes too late to be of use."""
        if reading.sequence <= self._sequence or (reading.event == TICK and reading.run != self._run):
            self.stale += 1
            return None
        self._sequence = reading.sequence
        if reading.event == RESET and reading.run != self._run and self._controller.reset():
            self._words = ""
        return self._step(reading) if reading.event == TICK else self._prepare(reading)

    def _prepare(self, reading: Reading) -> Answer:
        model, faults = self._model, 0
        if reading.run != self._run:
            if not self._tared:
                self._tared = self._controller.tare(reading.force)
            if not self._tared:
                return self._reply(reading, TARING, 0.0, model.position, model.velocity, 0.0, 0)
            faults = self._begin(reading)
        return self._reply(reading, READY, model.velocity, model.position, model.velocity, 0.0, faults)

    def _begin(self, reading: Reading) -> int:
        """A fresh run; the faults of the last one's end."""
        model, faults = self._model, 0
        if math.isfinite(reading.start_position) and math.isfinite(reading.start_velocity):
            model.place(reading.start_position, reading.start_velocity)
        else:
            model.place(*model.start)
        if self._run >= 0 and not self._controller.tripped:
            self._controller.next_contact()
            faults = self._reported_faults()
        self._command = self._controller.position_command(model.position, model.velocity, model.acceleration)
        self._run, self._last, self._force = reading.run, None, 0.0
        return faults

    def _reported_faults(self) -> int:
        """The controller's faults now, a contact of which the law says that it did not know it counted."""
        controller = self._controller
        if controller.faults & LAW_IN_DOUBT:
            status = controller.last_contact.status
            self.doubts[status] = self.doubts.get(status, 0) + 1
        return controller.faults

    def _step(self, reading: Reading) -> Answer:
        model, last = self._model, self._last
        missed = reading.tick - (-1 if last is None else last.tick) - 1
        faults = 0
        if missed > 0:
            faults = MISSED_TICK
            if missed <= self._bridged:
                faults |= self._make_up(missed, reading)
            else:
                for _ in range(min(missed, MOST_PASSED)):
                    model.integrate(self._force)
        position, velocity, before = model.position, model.velocity, self._command
        faults |= self._tick(reading.tick, reading.force, reading.position, reading.time)
        self._last = reading
        # After a trip the command goes its own way.
        rate = (self._command - before) / self._period if self._controller.tripped else model.velocity
        return self._reply(reading, 0, rate, position, velocity, self._force, faults)

    def _make_up(self, missed: int, reading: Reading) -> int:
        """The ticks since the last reading, from readings on the line to this one; their faults."""
        self.made_up += missed
        faults = 0
        last = self._last
        before = reading if last is None else last
        for number in range(missed):
            share = (number + 1) / (missed + 1)
            force = before.force + share * (reading.force - before.force)
            position = before.position + share * (reading.position - before.position)
            tick = reading.tick - missed + number
            time_then = reading.time - (missed - number) * self._period
            faults |= self._tick(tick, force, position, time_then)
        return faults

    def _tick(self, tick: int, force: float, position: float, time: float) -> int:
        """Controller and numerical model, one period further; the tick's faults."""
        model, controller = self._model, self._controller
        force = controller.step(force, model.position, model.velocity, position, time)
        if self._zeroed and tick == 0:
            force = 0.0
        self._force = force
        model.integrate(force)
        self._command = controller.position_command(model.position, model.velocity, model.acceleration)
        return self._reported_faults()

    def _reply(
        self,
        reading: Reading,
        flags: int,
        rate: float,
        position: float,
        velocity: float,
        force: float,
        faults: int,
    ) -> Answer:
        if self._controller.tripped:
            flags |= TRIPPED
            self._words = self._words or self.status[:96]
        _, sequence, run, tick, *_ = reading
        return Answer(
            *(flags, sequence, run, tick, self._command, rate, position, velocity, force, faults),
            self._words,
        )


class Empty:
    """An empty loop: every packet is answered, nothing is computed."""

    stale = made_up = 0
    status = "ok"
    doubts: ClassVar[dict[str, int]] = {}

    def answer(self, reading: Reading) -> Answer:
        """Zeros, and the reading's own numbers."""
        _, sequence, run, tick, *_ = reading
        return Answer(EMPTY | READY, sequence, run, tick, 0.0, 0.0, 0.0, 0.0, 0.0, 0, "")


class TickRecord:
    """Sequence number, own time [ns] and CPU time [ns] of every tick, and the packets, in memory allocated
    beforehand. What does not fit is not kept."""

    def __init__(self, capacity: int) -> None:
        self.sequence, self.wall, self.cpu = (array("q", bytes(8 * capacity)) for _ in range(3))
        self._packets, self._size = bytearray(READING.size * capacity), READING.size
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

    def readings(self) -> Iterator[Reading]:
        """The readings of the packets kept."""
        for place in range(self.kept):
            yield decode_reading(bytes(self._packets[place * self._size : (place + 1) * self._size]))

    def above(self, limit: float) -> dict[int, int]:
        """CPU time [ns] of the ticks that took more than `limit` [ns], by their sequence number."""
        return {self.sequence[i]: self.cpu[i] for i in range(self.count) if self.cpu[i] > limit}

    def document(self) -> dict[str, list[int]]:
        """As JSON can express it."""
        return {name: list(getattr(self, name)[: self.count]) for name in ("sequence", "wall", "cpu")}


def replayed(make: Callable[[], ControllerTask], record: TickRecord, limit: float) -> dict[int, int]:
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


def serve(
    receiver: socket.socket, task: ControllerTask | Empty, record: TickRecord, wait: float, silence: float
) -> str:
    """Answer packets until the rig stops or has been silent; returns which. Times in s.

    Only the first peer that sends a packet of this protocol is answered.
    """
    packet = bytearray(READING.size + 1)
    now, cpu_now, add, keep = time.monotonic_ns, time.thread_time_ns, record.add, record.keep
    peer: Any = None
    while True:
        if not select.select([receiver], [], [], wait)[0]:
            return "silent"
        try:
            size, sender = receiver.recvfrom_into(packet)
        except OSError:
            # A refusal that an earlier answer met: its addressee is gone.
            continue
        begun, cpu_begun = now(), cpu_now()
        if peer is not None and sender != peer:
            continue
        try:
            reading = decode_reading(packet[:size])
        except PacketError:
            continue
        if peer is None:
            peer, wait = sender, silence
        if reading.event == STOP:
            return "stopped"
        answer = task.answer(reading)
        if answer is not None:
            try:
                receiver.sendto(encode_answer(answer), peer)
            except OSError:
                # The rig does not listen, or the network is full: a tick without an answer.
                answer = None
        took, cpu_took = now() - begun, cpu_now() - cpu_begun
        keep(packet[:size])
        if answer is not None and reading.event == TICK:
            add(reading.sequence, took, cpu_took)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The process's options."""
    parser = argparse.ArgumentParser(description="Answer a rig's sensor packets over UDP on loopback.")
    parser.add_argument("--gains", default=str(HERE / "gains.json"), help="gain file; by default beside this")
    parser.add_argument("--port", type=int, default=0, help="UDP port on 127.0.0.1; 0: any that is free")
    parser.add_argument("--record", default=None, help="file for the time of every tick, as JSON")
    parser.add_argument("--ticks", type=int, default=1_000_000, help="ticks to keep the time of")
    parser.add_argument("--wait", type=float, default=30.0, help="s to wait for the first packet")
    parser.add_argument("--silence", type=float, default=2.0, help="s without a packet that end the session")
    parser.add_argument("--realtime", action="store_true", help="ask for a real-time priority")
    parser.add_argument("--empty", action="store_true", help="answer at once, compute nothing")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Serve one session; 0 when it was ended by the rig, 1 by its silence, 2 for a file that does not fit."""
    options = parse(arguments)
    limit = math.inf
    try:
        if options.empty:
            task: ControllerTask | Empty = Empty()
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
            ended = "interrupted"
    again = replayed(lambda: load(options.gains), record, limit)
    document = {
        "ended": ended,
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
    return 0 if ended == "stopped" else 1


def load(path: str) -> ControllerTask:
    """The task of a gain file. Raises ValueError, OSError, KeyError, TypeError for one that does not fit."""
    controller = Controller.from_file(path)
    document = json.loads(Path(path).read_text(encoding="utf-8"))
    limit = document.get("limits", {}).get("missed_in_a_row", {}).get("value")
    return ControllerTask(controller, document["mechanism"], MOST_MADE_UP if limit is None else limit)


def realtime() -> None:
    """Ask for a real-time priority. Raises OSError where that is not to be had."""
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("this system has no real-time priorities")
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


if __name__ == "__main__":
    sys.exit(main())
