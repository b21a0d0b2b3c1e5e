"""What a rig and a controller's process say to each other over UDP, and what the controller's side answers.

The rig sends a `Reading`, what its sensors read at a tick; the controller's process sends back an `Answer`,
the command for the next one. Both are packets of fixed size. `ControllerTask` makes the one of the other: it
holds the controller and the numerical model of the docking, and knows nothing of networks and clocks.

First the rig asks for a session, with a number drawn at random, until it is answered: by that number and the
session's, which every later packet carries, either way. It is one that only who receives at the rig's address
and port can know, and begins with the first packet from there that has it (`Sessions`).

Packets may be lost, late or out of order: one that is not newer than the last is dropped and counted
(`Sequence`). Ticks that no packet came for are made up once the next one is there, from readings on the
straight line between, and answered with the fault `missed_tick`. Where more are missing than the gain file's
limit `missed_in_a_row` (without one, `MOST_MADE_UP`), the controller sees the gap in the rig's time and
judges it, and the model goes on under the last F_c: its time stays the rig's.
"""

import hmac
import math
import secrets
import struct
from typing import Any, NamedTuple

PREPARE, TICK, STOP, RESET = 1, 2, 3, 4  # kinds of packets from the rig
EVENTS = (PREPARE, TICK, STOP, RESET)
READY, TRIPPED, TARING, EMPTY = 1, 2, 4, 8  # flags of an answer
FLAGS = READY | TRIPPED | TARING | EMPTY

# Little-endian: mark, version, kind, session, sequence, run, tick; time [s], force [N], position [m],
# start [m, m/s].
READING = struct.Struct("<4sBBxxQIIIxxxx5d")
# Mark, version, flags, session, sequence, run, tick; positions, velocity, forces; faults; words on a trip.
ANSWER = struct.Struct("<4sBBxxQIII4xdddddQ96s")
# Mark, version, the rig's number, the session's: 0 in the question.
OPENING = struct.Struct("<4sBxxxQQ")
MARK_IN, MARK_OUT, VERSION = b"JHrd", b"JHan", 2
MARK_ASK, MARK_OPEN = b"JHas", b"JHop"

NUMBERS = 0xFFFFFFFF  # the largest number of a packet: 0 follows it
WINDOW = 100  # packets in a row that may be lost without costing one more
APPROACH = 0.02  # s of free approach before a contact
MOST_MADE_UP = 10  # ticks in a row, without a limit in the gain file
MOST_PASSED = 10_000  # periods that the model goes on under the last force
MISSED_TICK, LAW_IN_DOUBT = 0x200, 0x200000  # the runtime's faults of these names


class PacketError(ValueError):
    """Bytes that are no packet of this protocol."""


class Reading(NamedTuple):
    """From the rig, at one tick."""

    event: int  # the kind of packet, one of `EVENTS`
    sequence: int  # its number in the session
    run: int  # the number of the run
    tick: int  # the tick of the run
    time: float  # the rig's time [s]
    force: float  # measured force [N]
    position: float  # measured position [m]
    start_position: float  # position [m] of the numerical model at the run's tick 0
    start_velocity: float  # its velocity [m/s] there


class Answer(NamedTuple):
    """To the rig, about one reading."""

    flags: int  # any of `FLAGS`
    sequence: int  # the reading's
    run: int  # the reading's
    tick: int  # the reading's
    position_command: float  # position [m] to command at the next tick; while preparing, at tick 0
    command_rate: float  # its rate [m/s]
    position: float  # the numerical model's position [m] at this tick
    velocity: float  # its velocity [m/s]
    force_command: float  # the force F_c [N] that it feels
    faults: int  # the bits of the controller's faults
    words: str  # why the controller has tripped; empty if it has not


def encode_reading(reading: Reading, session: int) -> bytes:
    """The packet of a reading."""
    return READING.pack(MARK_IN, VERSION, reading.event, session, *reading[1:])


def decode_reading(packet: bytes | bytearray, session: int | None) -> Reading:
    """The reading in a packet of the session, or of any; sensor values may be anything, NaN included.

    Raises PacketError.
    """
    if len(packet) != READING.size:
        raise PacketError(f"{len(packet)} bytes, allowed {READING.size}")
    mark, version, event, own, *fields = READING.unpack(packet)
    reading = Reading(event, *fields)
    if mark != MARK_IN or version != VERSION or event not in EVENTS:
        raise PacketError("not a packet from the rig of this version")
    if session is not None and own != session:
        raise PacketError("a packet of another session")
    if not math.isfinite(reading.time):
        raise PacketError("a time that is not finite")
    return reading


def encode_answer(answer: Answer, session: int) -> bytes:
    """The packet of an answer; words are cut to 96 ASCII characters."""
    words = answer.words.encode("ascii", "replace")
    return ANSWER.pack(MARK_OUT, VERSION, answer.flags, session, *answer[1:-1], words)


def decode_answer(packet: bytes, session: int | None) -> Answer:
    """The answer in a packet of the session, or of any. Raises PacketError."""
    if len(packet) != ANSWER.size:
        raise PacketError(f"{len(packet)} bytes, allowed {ANSWER.size}")
    mark, version, flags, own, *fields, words = ANSWER.unpack(packet)
    if mark != MARK_OUT or version != VERSION or flags & ~FLAGS:
        raise PacketError("not an answer of this version")
    if session is not None and own != session:
        raise PacketError("an answer of another session")
    text = words.rstrip(b"\0")
    if not all(32 <= byte < 127 for byte in text):
        raise PacketError("words that are not printable")
    return Answer._make((flags, *fields, text.decode("ascii")))


def ask_for_session(number: int) -> bytes:
    """The rig's question for a session, with a number of 64 bits drawn at random."""
    return OPENING.pack(MARK_ASK, VERSION, number, 0)


def decode_session(packet: bytes, number: int) -> int:
    """The session's number, from the answer to the question with this number. Raises PacketError."""
    if len(packet) == OPENING.size:
        mark, version, asked, session = OPENING.unpack(packet)
        if (mark, version, asked) == (MARK_OPEN, VERSION, number):
            return session
    raise PacketError("not the answer to that question for a session")


class Sessions:
    """Session numbers, for each address and port its own: what a secret hash makes of them.

    Nothing is kept of those who ask, so that asking costs nothing, and the answer is no longer than the
    question. Who cannot receive at an address cannot know its number.
    """

    def __init__(self) -> None:
        self._secret = secrets.token_bytes(32)

    def number(self, sender: tuple[str, int]) -> int:
        """The session's number of an address and port."""
        code = hmac.digest(self._secret, repr(sender).encode(), "sha256")
        return int.from_bytes(code[:8], "little")

    def answer(self, packet: bytes | bytearray, sender: tuple[str, int]) -> bytes | None:
        """The answer to who asks for a session; None for any other packet."""
        if len(packet) != OPENING.size:
            return None
        mark, version, asked, _ = OPENING.unpack(packet)
        if mark != MARK_ASK or version != VERSION:
            return None
        return OPENING.pack(MARK_OPEN, VERSION, asked, self.number(sender))


class Sequence:
    """Which packets are newer than all before, by their numbers of 32 bits (RFC 1982).

    One packet with a wild number must not make all that follow it old: a number further ahead than `WINDOW`
    counts only once another one has come that follows it (as RFC 3550, A.1).
    """

    __slots__ = ("_awaited", "_newest")

    def __init__(self, newest: int = -1) -> None:
        self._newest = newest & NUMBERS
        self._awaited: int | None = None

    def is_newer(self, number: int) -> bool:
        """Whether a packet is; the newest then."""
        ahead = number - self._newest & NUMBERS
        if not 0 < ahead <= NUMBERS // 2:
            return False
        awaited = self._awaited
        if ahead > WINDOW and (awaited is None or number - awaited & NUMBERS > WINDOW):
            self._awaited = number + 1 & NUMBERS
            return False
        self._newest, self._awaited = number, None
        return True


class NumericalModel:
    """M x'' = -F_c of the relative motion of two free bodies, once per control period.

    Mass [kg], period [s] and integrator are the mechanism's, which the gain file holds, and so is the first
    start: in uniform motion at x(0) = min(plane, 0) - v (0.02 s + phase T).
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
        nearer = min(float(rig.get("contact_plane", 0.0)), 0.0)
        self.start = nearer - velocity * (APPROACH + phase * self._period), velocity
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
    `period` is the control period [s].
    """

    __slots__ = (
        *("_bridged", "_command", "_controller", "_force", "_last", "_model", "_run"),
        *("_sequence", "_tared", "_words", "_zeroed", "doubts", "made_up", "period", "stale"),
    )

    def __init__(self, controller: Any, mechanism: dict[str, Any], bridged: float = MOST_MADE_UP) -> None:
        self._controller = controller
        self._model, self._bridged = NumericalModel(mechanism), min(bridged, MOST_MADE_UP)
        self.period = float(mechanism["rig"]["control_period"])
        sensor = mechanism["rig"].get("force_sensor", {})
        # Before tick 0 there is no force, though a noisy sensor reads some.
        self._zeroed = sensor.get("noise_std", 0.0) != 0.0 or sensor.get("bias", 0.0) != 0.0
        self._sequence, self._run, self._tared = Sequence(), -1, False
        self._command = self._force = 0.0
        self._last: Reading | None = None
        self._words = ""
        self.stale = self.made_up = 0
        self.doubts: dict[str, int] = {}

    @property
    def status(self) -> str:
        """What the controller says of itself."""
        return str(self._controller.status)

    def answer(self, reading: Reading) -> Answer | None:
        """The answer to a reading, or None for one that is of no use: not newer than the last, or of a run
        that was not prepared."""
        unknown = reading.event == TICK and reading.run != self._run
        if unknown or not self._sequence.is_newer(reading.sequence):
            self.stale += 1
            return None
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
        rate = (self._command - before) / self.period if self._controller.tripped else model.velocity
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
            time_then = reading.time - (missed - number) * self.period
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
            *(flags, sequence, run, tick, self._command, rate, position, velocity, force, faults), self._words
        )
