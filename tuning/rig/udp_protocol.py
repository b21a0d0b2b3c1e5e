"""UDP protocol between a rig and the controller's process, and the controller's side without a network.

The rig sends a `ReadingPacket` with the sensors' readings at a tick; the controller's process returns an
`AnswerPacket` with the command for the next tick. Both are packets of fixed size. `ControllerTask` computes
the answer from the reading: it holds the controller and the numerical model of the docking, but no network or
clock.

First the rig requests a session with a random number until it gets an answer with that number and the
session's number, which every later packet in either direction contains. Only a receiver at the rig's address
and port can know the session's number. The session begins with the first packet from there with that number
(`SessionNumbers`).

Packets may be lost, late or out of order. A packet that is not newer than the last one is dropped and counted
(`SequenceFilter`). Missing ticks are computed when the next packet arrives, from linearly interpolated
readings, and answered with the fault `missed_tick`. If more ticks are missing than the gain file's limit
`missed_in_a_row` (by default `MAX_INTERPOLATED_TICKS`), they are not interpolated: the controller detects the
gap in the rig's time, and the model continues under the last F_c, so that its time remains the rig's.
"""

import hmac
import math
import secrets
import struct
from typing import Any, NamedTuple

PREPARE, TICK, STOP, RESET = 1, 2, 3, 4  # kinds of packets from the rig
EVENTS = (PREPARE, TICK, STOP, RESET)
READY, TRIPPED, TARING, EMPTY_LOOP = 1, 2, 4, 8  # flags of an answer
FLAGS = READY | TRIPPED | TARING | EMPTY_LOOP

# Little-endian: mark, version, kind, session, sequence, run, tick; time [s], force [N], position [m],
# start [m, m/s].
READING_FORMAT = struct.Struct("<4sBBxxQIIIxxxx5d")
# Mark, version, flags, session, sequence, run, tick; position command, rate, position, velocity, force;
# faults; reason of a trip.
ANSWER_FORMAT = struct.Struct("<4sBBxxQIII4xdddddQ96s")
# Mark, version, the rig's number, the session's number, which is 0 in the request.
OPENING_FORMAT = struct.Struct("<4sBxxxQQ")
READING_MARK, ANSWER_MARK, VERSION = b"JHrd", b"JHan", 2
REQUEST_MARK, OPENING_MARK = b"JHas", b"JHop"

MAX_PACKET_NUMBER = 0xFFFFFFFF  # largest number of a packet, which is followed by 0
MAX_SEQUENCE_STEP = 100  # largest step of the packet number that is accepted at once
APPROACH_TIME = 0.02  # time of free approach before a contact [s]
MAX_INTERPOLATED_TICKS = 10  # largest number of missing ticks in a row that are interpolated, by default
MAX_COASTED_PERIODS = 10_000  # largest number of periods that the model continues under the last force
MISSED_TICK, LAW_IN_DOUBT = 0x200, 0x200000  # bits of the runtime's faults with these names


class PacketError(ValueError):
    """Error for bytes that are no packet of this protocol."""


class ReadingPacket(NamedTuple):
    """Packet from the rig at one tick."""

    event: int  # kind of packet, one of `EVENTS`
    sequence: int  # number of the packet in the session
    run: int  # number of the run
    tick: int  # tick of the run
    time: float  # rig's time [s]
    force: float  # measured force [N]
    position: float  # measured position [m]
    start_position: float  # position of the numerical model at the run's tick 0 [m]
    start_velocity: float  # velocity of the numerical model at the run's tick 0 [m/s]


class AnswerPacket(NamedTuple):
    """Packet to the rig in answer to one reading."""

    flags: int  # any of `FLAGS`
    sequence: int  # number of the reading
    run: int  # run of the reading
    tick: int  # tick of the reading
    position_command: float  # position command of the next tick [m]; while preparing, of tick 0
    command_rate: float  # rate of the position command [m/s]
    position: float  # position of the numerical model at this tick [m]
    velocity: float  # velocity of the numerical model at this tick [m/s]
    force_command: float  # force F_c on the numerical model [N]
    faults: int  # bits of the controller's faults
    words: str  # reason of the controller's trip; empty without one


def encode_reading(reading: ReadingPacket, session: int) -> bytes:
    """Return the packet of a reading."""
    return READING_FORMAT.pack(READING_MARK, VERSION, reading.event, session, *reading[1:])


def decode_reading(packet: bytes | bytearray, session: int | None) -> ReadingPacket:
    """Decode the reading in a packet of the session (None: any); sensor values may be NaN.

    Raise PacketError for any other packet.
    """
    if len(packet) != READING_FORMAT.size:
        raise PacketError(f"{len(packet)} bytes, expected {READING_FORMAT.size}")
    mark, version, event, packet_session, *fields = READING_FORMAT.unpack(packet)
    reading = ReadingPacket(event, *fields)
    if mark != READING_MARK or version != VERSION or event not in EVENTS:
        raise PacketError("not a packet from the rig of this version")
    if session is not None and packet_session != session:
        raise PacketError("a packet of another session")
    if not math.isfinite(reading.time):
        raise PacketError("a time that is not finite")
    return reading


def encode_answer(answer: AnswerPacket, session: int) -> bytes:
    """Return the packet of an answer; its words are cut to 96 ASCII characters."""
    words = answer.words.encode("ascii", "replace")
    return ANSWER_FORMAT.pack(ANSWER_MARK, VERSION, answer.flags, session, *answer[1:-1], words)


def decode_answer(packet: bytes, session: int | None) -> AnswerPacket:
    """Decode the answer in a packet of the session (None: any); raise PacketError for any other packet."""
    if len(packet) != ANSWER_FORMAT.size:
        raise PacketError(f"{len(packet)} bytes, expected {ANSWER_FORMAT.size}")
    mark, version, flags, packet_session, *fields, words = ANSWER_FORMAT.unpack(packet)
    if mark != ANSWER_MARK or version != VERSION or flags & ~FLAGS:
        raise PacketError("not an answer of this version")
    if session is not None and packet_session != session:
        raise PacketError("an answer of another session")
    text = words.rstrip(b"\0")
    if not all(32 <= byte < 127 for byte in text):
        raise PacketError("words that are not printable")
    return AnswerPacket._make((flags, *fields, text.decode("ascii")))


def encode_session_request(number: int) -> bytes:
    """Return the rig's request for a session, with a random number of 64 bits."""
    return OPENING_FORMAT.pack(REQUEST_MARK, VERSION, number, 0)


def decode_session(packet: bytes, number: int) -> int:
    """Decode the session's number in the answer to request `number`; raise PacketError if it is none."""
    if len(packet) == OPENING_FORMAT.size:
        mark, version, requested, session = OPENING_FORMAT.unpack(packet)
        if (mark, version, requested) == (OPENING_MARK, VERSION, number):
            return session
    raise PacketError("not the answer to that question for a session")


class SessionNumbers:
    """Session numbers, computed from address and port by a keyed hash.

    Requests need no memory, and an answer is not longer than the request. Only a receiver at an address can
    know its number.
    """

    def __init__(self) -> None:
        self._secret = secrets.token_bytes(32)

    def number(self, sender: tuple[str, int]) -> int:
        """Return the session's number of an address and port."""
        code = hmac.digest(self._secret, repr(sender).encode(), "sha256")
        return int.from_bytes(code[:8], "little")

    def answer(self, packet: bytes | bytearray, sender: tuple[str, int]) -> bytes | None:
        """Return the answer to a request for a session; None for any other packet."""
        if len(packet) != OPENING_FORMAT.size:
            return None
        mark, version, requested, _ = OPENING_FORMAT.unpack(packet)
        if mark != REQUEST_MARK or version != VERSION:
            return None
        return OPENING_FORMAT.pack(OPENING_MARK, VERSION, requested, self.number(sender))


class SequenceFilter:
    """Filter for packets that are newer than all before, by numbers of 32 bits (RFC 1982).

    One packet with a wrong number must not make all later packets old. So a number more than
    `MAX_SEQUENCE_STEP` ahead counts only after a second packet that follows it (as in RFC 3550, A.1).
    """

    __slots__ = ("_awaited", "_newest")

    def __init__(self, newest: int = -1) -> None:
        self._newest = newest & MAX_PACKET_NUMBER
        self._awaited: int | None = None

    def is_newer(self, number: int) -> bool:
        """Return whether a packet is newer; if so, it becomes the newest one."""
        ahead = number - self._newest & MAX_PACKET_NUMBER
        if not 0 < ahead <= MAX_PACKET_NUMBER // 2:
            return False
        awaited = self._awaited
        if ahead > MAX_SEQUENCE_STEP and (
            awaited is None or number - awaited & MAX_PACKET_NUMBER > MAX_SEQUENCE_STEP
        ):
            self._awaited = number + 1 & MAX_PACKET_NUMBER
            return False
        self._newest, self._awaited = number, None
        return True


class NumericalModel:
    """Numerical model M x'' = -F_c of the relative motion of two free bodies, one step per control period.

    Mass [kg], period [s] and integrator are those of the gain file's mechanism, and so is the first `start`,
    in uniform motion at x(0) = min(plane, 0) - v (0.02 s + phase T).
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
        self.start = nearer - velocity * (APPROACH_TIME + phase * self._period), velocity
        self.place(*self.start)

    def place(self, position: float, velocity: float) -> None:
        """Set a uniform motion with this position [m] and velocity [m/s]."""
        self.position, self.velocity, self.acceleration = position, velocity, 0.0

    def integrate(self, force: float) -> None:
        """Integrate one period under the force F_c [N]."""
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
    """Controller and numerical model, which answer readings without a network.

    `bridged` is the largest number of missing ticks in a row that are interpolated, `period` the control
    period [s]. `made_up` counts interpolated ticks, `stale` unusable packets, and `doubts`, by the law's
    status, contacts with the fault `law_in_doubt`.
    """

    __slots__ = (
        *("_bridged", "_command", "_controller", "_force", "_last", "_model", "_run"),
        *("_sequence", "_tared", "_words", "_zeroed", "doubts", "made_up", "period", "stale"),
    )

    def __init__(
        self, controller: Any, mechanism: dict[str, Any], bridged: float = MAX_INTERPOLATED_TICKS
    ) -> None:
        self._controller = controller
        self._model, self._bridged = NumericalModel(mechanism), min(bridged, MAX_INTERPOLATED_TICKS)
        self.period = float(mechanism["rig"]["control_period"])
        sensor = mechanism["rig"].get("force_sensor", {})
        # Before tick 0 there is no force, although a noisy sensor reads one.
        self._zeroed = sensor.get("noise_std", 0.0) != 0.0 or sensor.get("bias", 0.0) != 0.0
        self._sequence, self._run, self._tared = SequenceFilter(), -1, False
        self._command = self._force = 0.0
        self._last: ReadingPacket | None = None
        self._words = ""
        self.stale = self.made_up = 0
        self.doubts: dict[str, int] = {}

    @property
    def status(self) -> str:
        """Return the status of the controller."""
        return str(self._controller.status)

    def answer(self, reading: ReadingPacket) -> AnswerPacket | None:
        """Return the answer to a reading; None if it is not newer than the last or its run is unprepared."""
        unprepared = reading.event == TICK and reading.run != self._run
        if unprepared or not self._sequence.is_newer(reading.sequence):
            self.stale += 1
            return None
        if reading.event == RESET and reading.run != self._run and self._controller.reset():
            self._words = ""
        return self._step(reading) if reading.event == TICK else self._prepare(reading)

    def _prepare(self, reading: ReadingPacket) -> AnswerPacket:
        model, faults = self._model, 0
        if reading.run != self._run:
            if not self._tared:
                self._tared = self._controller.tare(reading.force)
            if not self._tared:
                return self._reply(reading, TARING, 0.0, model.position, model.velocity, 0.0, 0)
            faults = self._begin(reading)
        return self._reply(reading, READY, model.velocity, model.position, model.velocity, 0.0, faults)

    def _begin(self, reading: ReadingPacket) -> int:
        """Begin a new run; return the faults at the end of the last one."""
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
        """Return the controller's current faults; count a contact with the fault `law_in_doubt`."""
        controller = self._controller
        if controller.faults & LAW_IN_DOUBT:
            status = controller.last_contact.status
            self.doubts[status] = self.doubts.get(status, 0) + 1
        return controller.faults

    def _step(self, reading: ReadingPacket) -> AnswerPacket:
        model, last = self._model, self._last
        missed = reading.tick - (-1 if last is None else last.tick) - 1
        faults = 0
        if missed > 0:
            faults = MISSED_TICK
            if missed <= self._bridged:
                faults |= self._make_up(missed, reading)
            else:
                for _ in range(min(missed, MAX_COASTED_PERIODS)):
                    model.integrate(self._force)
        position, velocity, before = model.position, model.velocity, self._command
        faults |= self._tick(reading.tick, reading.force, reading.position, reading.time)
        self._last = reading
        # After a trip the position command does not follow the numerical model.
        rate = (self._command - before) / self.period if self._controller.tripped else model.velocity
        return self._reply(reading, 0, rate, position, velocity, self._force, faults)

    def _make_up(self, missed: int, reading: ReadingPacket) -> int:
        """Compute the missing ticks from interpolated readings; return their faults."""
        self.made_up += missed
        faults = 0
        last = self._last
        before = reading if last is None else last
        for number in range(missed):
            share = (number + 1) / (missed + 1)
            force = before.force + share * (reading.force - before.force)
            position = before.position + share * (reading.position - before.position)
            tick = reading.tick - missed + number
            time = reading.time - (missed - number) * self.period
            faults |= self._tick(tick, force, position, time)
        return faults

    def _tick(self, tick: int, force: float, position: float, time: float) -> int:
        """Advance controller and numerical model by one period; return the tick's faults."""
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
        reading: ReadingPacket,
        flags: int,
        rate: float,
        position: float,
        velocity: float,
        force: float,
        faults: int,
    ) -> AnswerPacket:
        if self._controller.tripped:
            flags |= TRIPPED
            self._words = self._words or self.status[:96]
        _, sequence, run, tick, *_ = reading
        return AnswerPacket(
            *(flags, sequence, run, tick, self._command, rate, position, velocity, force, faults), self._words
        )
