"""UDP protocol between a rig and the controller's process, and computation of the controller's answers.

The rig sends a `ReadingPacket` with the sensor readings of a tick. The controller's process returns an
`AnswerPacket` with the command for the next tick. Both packets have a fixed size. `ControllerTask` computes
the answer to a reading, with the controller and the numerical model of the docking. It uses no network and no
clock.

First the rig requests a session: it sends a random number until it receives an answer with this number. The
answer also contains the session number, which all later packets contain. Only a receiver at the rig's
address and port can know the session number (`SessionNumbers`). The session starts with the first packet from
this address that contains the session number.

Packets can be lost, late or out of order. A packet that is not newer than the previous one is dropped and
counted (`SequenceFilter`). When a packet arrives after missing ticks, the controller executes these ticks
with linearly interpolated readings. The answer reports the fault `missed_tick`. If more ticks are missing
than the limit `missed_in_a_row` of the gain file (default `MAX_INTERPOLATED_TICKS`), the controller skips
these ticks and detects the gap in the rig's time. The numerical model continues under the last force command.
"""

import hmac
import math
import secrets
import struct
from typing import Any, NamedTuple

PREPARE, TICK, STOP, RESET = 1, 2, 3, 4  # events, the kinds of packets from the rig
EVENTS = (PREPARE, TICK, STOP, RESET)
READY, TRIPPED, TARING, EMPTY_LOOP = 1, 2, 4, 8  # bits of an answer's flags
FLAGS = READY | TRIPPED | TARING | EMPTY_LOOP

# Reading, little-endian: mark, version, event, session number, sequence number, run, tick, time [s],
# force [N], position [m], start position [m], start velocity [m/s].
READING_FORMAT = struct.Struct("<4sBBxxQIIIxxxx5d")
# Answer, little-endian: mark, version, flags, session number, sequence number, run, tick, position command
# [m], command rate [m/s], position [m], velocity [m/s], force command [N], faults, reason for a trip.
ANSWER_FORMAT = struct.Struct("<4sBBxxQIII4xdddddQ96s")
# Request and its answer, little-endian: mark, version, random number of the rig, session number (0 in the
# request).
OPENING_FORMAT = struct.Struct("<4sBxxxQQ")
READING_MARK, ANSWER_MARK, VERSION = b"JHrd", b"JHan", 2
REQUEST_MARK, OPENING_MARK = b"JHas", b"JHop"

MAX_PACKET_NUMBER = 0xFFFFFFFF  # largest sequence number; the next one is 0
MAX_SEQUENCE_STEP = 100  # largest increase of the sequence number that one packet alone can cause
APPROACH_TIME = 0.02  # time from the start of a run to the contact [s]
MAX_INTERPOLATED_TICKS = 10  # default limit on the number of successive missing ticks that are interpolated
MAX_COASTED_PERIODS = 10_000  # longest time that the model continues under the last force command [periods]
MISSED_TICK, LAW_IN_DOUBT = 0x200, 0x200000  # bits of two of the controller's faults (`jaxhil.rig`)


class PacketError(ValueError):
    """Error that is raised if received bytes are not a valid packet of this protocol."""


class ReadingPacket(NamedTuple):
    """Packet that the rig sends in every tick, with the sensor readings."""

    event: int  # kind of packet, one of `EVENTS`
    sequence: int  # sequence number of the packet in the session
    run: int  # number of the run in the session
    tick: int  # number of the tick in the run
    time: float  # time of the rig's clock [s]
    force: float  # measured force [N]
    position: float  # measured position [m]
    start_position: float  # position of the numerical model at the run's tick 0 [m]
    start_velocity: float  # velocity of the numerical model at the run's tick 0 [m/s]


class AnswerPacket(NamedTuple):
    """Packet that the controller's process sends to the rig, in answer to one reading."""

    flags: int  # bits READY, TRIPPED, TARING and EMPTY_LOOP
    sequence: int  # sequence number of the reading
    run: int  # run of the reading
    tick: int  # tick of the reading
    position_command: float  # position command of the next tick, or of tick 0 before a run [m]
    command_rate: float  # rate of the position command [m/s]
    position: float  # position of the numerical model at this tick [m]
    velocity: float  # velocity of the numerical model at this tick [m/s]
    force_command: float  # force command F_c, which acts on the numerical model [N]
    faults: int  # bits of the controller's faults at this tick
    trip_reason: str  # reason for the controller's trip; empty if it has not tripped


def encode_reading(reading: ReadingPacket, session: int) -> bytes:
    """Encode a reading as a packet of the given session."""
    return READING_FORMAT.pack(READING_MARK, VERSION, reading.event, session, *reading[1:])


def decode_reading(packet: bytes | bytearray, session: int | None) -> ReadingPacket:
    """Decode a packet from the rig; sensor readings may be NaN.

    Raise PacketError if it is not a valid packet of the session with number `session`. With None, a packet of
    any session is valid.
    """
    if len(packet) != READING_FORMAT.size:
        raise PacketError(f"{len(packet)} bytes, expected {READING_FORMAT.size}")
    mark, version, event, packet_session, *fields = READING_FORMAT.unpack(packet)
    reading = ReadingPacket(event, *fields)
    if mark != READING_MARK or version != VERSION or event not in EVENTS:
        raise PacketError("not a reading packet of this protocol version")
    if session is not None and packet_session != session:
        raise PacketError("reading packet of another session")
    if not math.isfinite(reading.time):
        raise PacketError("the rig's time is not finite")
    return reading


def encode_answer(answer: AnswerPacket, session: int) -> bytes:
    """Encode an answer as a packet of the given session; only 96 characters of the trip reason are sent."""
    trip_reason = answer.trip_reason.encode("ascii", "replace")
    return ANSWER_FORMAT.pack(ANSWER_MARK, VERSION, answer.flags, session, *answer[1:-1], trip_reason)


def decode_answer(packet: bytes, session: int | None) -> AnswerPacket:
    """Decode a packet from the controller's process.

    Raise PacketError if it is not a valid packet of the session with number `session`. With None, a packet of
    any session is valid.
    """
    if len(packet) != ANSWER_FORMAT.size:
        raise PacketError(f"{len(packet)} bytes, expected {ANSWER_FORMAT.size}")
    mark, version, flags, packet_session, *fields, trip_reason = ANSWER_FORMAT.unpack(packet)
    if mark != ANSWER_MARK or version != VERSION or flags & ~FLAGS:
        raise PacketError("not an answer packet of this protocol version")
    if session is not None and packet_session != session:
        raise PacketError("answer packet of another session")
    text = trip_reason.rstrip(b"\0")
    if not all(32 <= byte < 127 for byte in text):
        raise PacketError("the reason for the trip has characters that are not printable")
    return AnswerPacket._make((flags, *fields, text.decode("ascii")))


def encode_session_request(number: int) -> bytes:
    """Encode the rig's request for a session; `number` is a random number of 64 bits."""
    return OPENING_FORMAT.pack(REQUEST_MARK, VERSION, number, 0)


def decode_session(packet: bytes, number: int) -> int:
    """Decode the session number from the answer to a request; `number` is the random number of the request.

    Raise PacketError if the packet is not an answer to this request.
    """
    if len(packet) == OPENING_FORMAT.size:
        mark, version, requested, session = OPENING_FORMAT.unpack(packet)
        if (mark, version, requested) == (OPENING_MARK, VERSION, number):
            return session
    raise PacketError("not an answer to this request for a session")


class SessionNumbers:
    """Generator of session numbers, computed from address and port by a keyed hash.

    Only a receiver at an address can know the session number of this address. Requests need no memory, and
    an answer is not longer than its request, so that forged requests cannot exhaust memory or network.
    """

    def __init__(self) -> None:
        self._secret = secrets.token_bytes(32)

    def number(self, sender: tuple[str, int]) -> int:
        """Return the session number of the address and port `sender`."""
        code = hmac.digest(self._secret, repr(sender).encode(), "sha256")
        return int.from_bytes(code[:8], "little")

    def answer(self, packet: bytes | bytearray, sender: tuple[str, int]) -> bytes | None:
        """Return the answer packet to a request for a session, or None if `packet` is not a request."""
        if len(packet) != OPENING_FORMAT.size:
            return None
        mark, version, requested, _ = OPENING_FORMAT.unpack(packet)
        if mark != REQUEST_MARK or version != VERSION:
            return None
        return OPENING_FORMAT.pack(OPENING_MARK, VERSION, requested, self.number(sender))


class SequenceFilter:
    """Filter that accepts a packet only if it is newer than all previous packets.

    It compares sequence numbers of 32 bits, which wrap around (RFC 1982). One packet with a wrong number must
    not make all later packets old. Therefore a jump by more than `MAX_SEQUENCE_STEP` is accepted only when a
    second packet continues from the new number (RFC 3550, A.1).
    """

    __slots__ = ("_awaited", "_newest")

    def __init__(self, newest: int = -1) -> None:
        self._newest = newest & MAX_PACKET_NUMBER
        self._awaited: int | None = None

    def is_newer(self, number: int) -> bool:
        """Return whether the sequence number is newer than all previous ones; if so, store it."""
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
    """Numerical model M x'' = -F_c of the relative motion of two free bodies.

    Mass, control period and integrator come from the gain file's mechanism. The model advances by one step in
    each control period.

    Attributes:
        start: default position [m] and velocity v [m/s] at the start of a run. The motion reaches a surface
            after 0.02 s + `approach.phase` T at the earliest (T: control period).
        position: relative position of the bodies [m].
        velocity: relative velocity [m/s].
        acceleration: relative acceleration in the last period [m/s^2].
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
        """Set position [m] and velocity [m/s]; the acceleration becomes 0."""
        self.position, self.velocity, self.acceleration = position, velocity, 0.0

    def integrate(self, force: float) -> None:
        """Integrate the motion for one control period, with the force command F_c [N]."""
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
    """Controller and numerical model, which compute the answers to readings, independent of the network.

    Args:
        controller: controller of the gain file.
        mechanism: mechanism of the gain file.
        max_interpolated: largest number of successive missing ticks that are interpolated.

    Attributes:
        period: control period [s].
        interpolated: number of interpolated ticks.
        stale: number of packets that were dropped because they were old or their run was not prepared.
        quality_flags: numbers of contacts with the fault `law_in_doubt`, by the compensator's status.
    """

    __slots__ = (
        *("_command", "_controller", "_force", "_has_noise_or_bias", "_last", "_max_interpolated", "_model"),
        *("_run", "_sequence", "_tared", "_trip_reason", "interpolated", "period", "quality_flags", "stale"),
    )

    def __init__(
        self, controller: Any, mechanism: dict[str, Any], max_interpolated: float = MAX_INTERPOLATED_TICKS
    ) -> None:
        self._controller = controller
        self._model = NumericalModel(mechanism)
        self._max_interpolated = min(max_interpolated, MAX_INTERPOLATED_TICKS)
        self.period = float(mechanism["rig"]["control_period"])
        sensor = mechanism["rig"].get("force_sensor", {})
        # At tick 0 the mechanism is free. Noise or bias of the sensor must not act on the numerical model.
        self._has_noise_or_bias = sensor.get("noise_std", 0.0) != 0.0 or sensor.get("bias", 0.0) != 0.0
        self._sequence, self._run, self._tared = SequenceFilter(), -1, False
        self._command = self._force = 0.0
        self._last: ReadingPacket | None = None
        self._trip_reason = ""
        self.stale = self.interpolated = 0
        self.quality_flags: dict[str, int] = {}

    @property
    def status(self) -> str:
        """Return the controller's status, such as "ok" or "tripped: ..."."""
        return str(self._controller.status)

    def answer(self, reading: ReadingPacket) -> AnswerPacket | None:
        """Return the answer to a reading, or None if the reading is old or its run was not prepared."""
        unprepared = reading.event == TICK and reading.run != self._run
        if unprepared or not self._sequence.is_newer(reading.sequence):
            self.stale += 1
            return None
        if reading.event == RESET and reading.run != self._run and self._controller.reset():
            self._trip_reason = ""
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
        """Begin a new run; return the faults that the controller reports at the end of the previous run."""
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
        """Return the controller's current faults; count the contact if they include `law_in_doubt`."""
        controller = self._controller
        if controller.faults & LAW_IN_DOUBT:
            status = controller.last_contact.status
            self.quality_flags[status] = self.quality_flags.get(status, 0) + 1
        return controller.faults

    def _step(self, reading: ReadingPacket) -> AnswerPacket:
        model, last = self._model, self._last
        missed = reading.tick - (-1 if last is None else last.tick) - 1
        faults = 0
        if missed > 0:
            faults = MISSED_TICK
            if missed <= self._max_interpolated:
                faults |= self._interpolate(missed, reading)
            else:
                for _ in range(min(missed, MAX_COASTED_PERIODS)):
                    model.integrate(self._force)
        position, velocity, before = model.position, model.velocity, self._command
        faults |= self._tick(reading.tick, reading.force, reading.position, reading.time)
        self._last = reading
        # After a trip, the position command no longer follows the numerical model.
        rate = (self._command - before) / self.period if self._controller.tripped else model.velocity
        return self._reply(reading, 0, rate, position, velocity, self._force, faults)

    def _interpolate(self, missed: int, reading: ReadingPacket) -> int:
        """Execute the ticks of missing packets with interpolated readings; return all their faults."""
        self.interpolated += missed
        faults = 0
        last = self._last
        before = reading if last is None else last
        for number in range(missed):
            weight = (number + 1) / (missed + 1)
            force = before.force + weight * (reading.force - before.force)
            position = before.position + weight * (reading.position - before.position)
            tick = reading.tick - missed + number
            time = reading.time - (missed - number) * self.period
            faults |= self._tick(tick, force, position, time)
        return faults

    def _tick(self, tick: int, force: float, position: float, time: float) -> int:
        """Advance controller and numerical model by one period; return the controller's faults."""
        model, controller = self._model, self._controller
        force = controller.step(force, model.position, model.velocity, position, time)
        if self._has_noise_or_bias and tick == 0:
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
            self._trip_reason = self._trip_reason or self.status[:96]
        _, sequence, run, tick, *_ = reading
        return AnswerPacket(
            flags=flags,
            sequence=sequence,
            run=run,
            tick=tick,
            position_command=self._command,
            command_rate=rate,
            position=position,
            velocity=velocity,
            force_command=force,
            faults=faults,
            trip_reason=self._trip_reason,
        )
