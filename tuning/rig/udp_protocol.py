"""UDP protocol between a rig with one axis or six axes and the controller's process.

The rig sends a `ReadingPacket` with the sensor readings of a tick. The controller's process returns an
`AnswerPacket` with the command for the next tick. The number of axes determines the size of both packets.
`udp_task` computes the answers.

First the rig requests a session: it sends a random number until it receives an answer with this number. The
answer also contains the session number, which all later packets contain, and the controller's number of axes.
Only a receiver at the rig's address and port can know the session number (`SessionNumbers`). The session
starts with the first packet from this address that contains the session number.

Packets can be lost, late or out of order. A packet that is not newer than the previous one is dropped and
counted (`SequenceFilter`).
"""

import hmac
import math
import secrets
import struct
from typing import NamedTuple

PREPARE, TICK, STOP, RESET = 1, 2, 3, 4  # events, the kinds of packets from the rig
EVENTS = (PREPARE, TICK, STOP, RESET)
READY, TRIPPED, TARING, EMPTY_LOOP = 1, 2, 4, 8  # bits of an answer's flags
FLAGS = READY | TRIPPED | TARING | EMPTY_LOOP

READING_MARK, ANSWER_MARK, VERSION = b"JHrd", b"JHan", 3
REQUEST_MARK, OPENING_MARK = b"JHas", b"JHop"
# Request and its answer, little-endian: mark, version, number of axes, random number of the rig, session
# number (0 in the request).
OPENING_FORMAT = struct.Struct("<4sBBxxQQ")

MAX_PACKET_NUMBER = 0xFFFFFFFF  # largest sequence number; the next one is 0
MAX_SEQUENCE_STEP = 100  # largest increase of the sequence number that one packet alone can cause

Numbers = tuple[float, ...]


class PacketError(ValueError):
    """Error that is raised if received bytes are not a valid packet of this protocol."""


class PacketFormat:
    """Layout of the packets for a number of axes.

    Attributes:
        axes: number of axes.
        start: number of values that specify the start of a run.
        bodies: number of values that specify the states of both bodies; 0 for one axis.
        reading: little-endian format of a reading packet: mark, version, event, number of axes, session
            number, sequence number, run, tick, then `ReadingPacket.time` and all later fields.
        answer: little-endian format of an answer packet: mark, version, flags, number of axes, session
            number, sequence number, run, tick, then `AnswerPacket.position_command` and all later fields.
    """

    __slots__ = ("answer", "axes", "bodies", "reading", "start")

    def __init__(self, axes: int, start: int, bodies: int) -> None:
        self.axes, self.start, self.bodies = axes, start, bodies
        self.reading = struct.Struct(f"<4sBBBxQIIIxxxx{1 + 2 * axes + start}d")
        self.answer = struct.Struct(f"<4sBBBxQIII4x{5 * axes + bodies}dQ96s")


# One axis: a start has a position and a velocity. Six axes: position, velocity, quaternion and angular
# momentum of each body.
FORMATS = {1: PacketFormat(axes=1, start=2, bodies=0), 6: PacketFormat(axes=6, start=26, bodies=26)}


class ReadingPacket(NamedTuple):
    """Packet that the rig sends in every tick, with the sensor readings of all axes."""

    event: int  # kind of packet, one of `EVENTS`
    sequence: int  # sequence number of the packet in the session
    run: int  # number of the run in the session
    tick: int  # number of the tick in the run
    time: float  # time of the rig's clock [s]
    force: Numbers  # measured force [N]; for six axes the wrench about T's origin, in T axes [N, N m]
    position: Numbers  # measured position [m]; for six axes the pose of C relative to T [m, rad]
    # Numerical model at the run's tick 0. One axis: position [m] and velocity [m/s]. Six axes: states of both
    # bodies, see `numerical_model_six_axes`.
    start: Numbers


class AnswerPacket(NamedTuple):
    """Packet that the controller's process sends to the rig, in answer to one reading."""

    flags: int  # bits READY, TRIPPED, TARING and EMPTY_LOOP
    sequence: int  # sequence number of the reading
    run: int  # run of the reading
    tick: int  # tick of the reading
    position_command: Numbers  # position command of the next tick, or of tick 0 before a run [m, rad]
    command_rate: Numbers  # rate of the position command [m/s, rad/s]
    position: Numbers  # position of the numerical model at this tick [m, rad]
    velocity: Numbers  # velocity of the numerical model at this tick; for six axes the twist [m/s, rad/s]
    force_command: Numbers  # force command, which acts on the numerical model [N, N m]
    bodies: Numbers  # six axes: states of both bodies of the numerical model after this tick
    faults: int  # bits of the controller's faults at this tick
    trip_reason: str  # reason for the controller's trip; empty if it has not tripped


def encode_reading(reading: ReadingPacket, session: int) -> bytes:
    """Encode a reading as a packet of the given session."""
    event, *numbers, time, force, position, start = reading
    layout = FORMATS[len(force)]
    return layout.reading.pack(
        READING_MARK, VERSION, event, layout.axes, session, *numbers, time, *force, *position, *start
    )


def decode_reading(
    packet: bytes | bytearray, session: int | None = None, axes: int | None = None
) -> ReadingPacket:
    """Decode a packet from the rig; sensor readings may be NaN.

    Raise PacketError if it is not a valid packet of the session with number `session` for this number of
    axes. If `session` or `axes` is None, any session or any number of axes is valid.
    """
    layout = _format_of(packet, axes)
    if len(packet) != layout.reading.size:
        raise PacketError(f"{len(packet)} bytes, expected {layout.reading.size}")
    mark, version, event, _, packet_session, sequence, run, tick, time, *values = layout.reading.unpack(
        packet
    )
    if mark != READING_MARK or version != VERSION or event not in EVENTS:
        raise PacketError("not a reading packet of this protocol version")
    if session is not None and packet_session != session:
        raise PacketError("a packet with readings belongs to another session")
    if not math.isfinite(time):
        raise PacketError("the rig's time is not finite")
    force, position, start = _split(values, layout.axes, layout.axes, layout.start)
    return ReadingPacket(event, sequence, run, tick, time, force, position, start)


def encode_answer(answer: AnswerPacket, session: int) -> bytes:
    """Encode an answer as a packet of the given session; only 96 characters of the trip reason are sent."""
    flags, sequence, run, tick, *vectors, faults, trip_reason = answer
    layout = FORMATS[len(answer.position_command)]
    return layout.answer.pack(
        *(ANSWER_MARK, VERSION, flags, layout.axes, session, sequence, run, tick),
        *(value for vector in vectors for value in vector),
        *(faults, trip_reason.encode("ascii", "replace")),
    )


def decode_answer(packet: bytes, session: int | None, axes: int | None = None) -> AnswerPacket:
    """Decode a packet from the controller's process.

    Raise PacketError if it is not a valid packet of the session with number `session` for this number of
    axes. If `session` or `axes` is None, any session or any number of axes is valid.
    """
    layout = _format_of(packet, axes)
    if len(packet) != layout.answer.size:
        raise PacketError(f"{len(packet)} bytes, expected {layout.answer.size}")
    mark, version, flags, _, packet_session, *fields = layout.answer.unpack(packet)
    sequence, run, tick, *values, faults, trip_reason = fields
    if mark != ANSWER_MARK or version != VERSION or flags & ~FLAGS:
        raise PacketError("not an answer packet of this protocol version")
    if session is not None and packet_session != session:
        raise PacketError("an answer packet belongs to another session")
    text = trip_reason.rstrip(b"\0")
    if not all(32 <= byte < 127 for byte in text):
        raise PacketError("the reason for the trip has characters that are not printable")
    vectors = _split(values, *[layout.axes] * 5, layout.bodies)
    return AnswerPacket._make((flags, sequence, run, tick, *vectors, faults, text.decode("ascii")))


def _format_of(packet: bytes | bytearray, axes: int | None) -> PacketFormat:
    """Return the layout for a packet's number of axes, which must equal `axes` unless `axes` is None."""
    number = packet[6] if len(packet) > 6 else 0
    if number not in FORMATS or axes not in (None, number):
        raise PacketError(f"packet for {number} axes, expected {axes or 'one or six'}")
    return FORMATS[number]


def _split(values: list[float], *sizes: int) -> list[Numbers]:
    """Split a list of values into tuples; `sizes` are their lengths."""
    parts, begin = [], 0
    for size in sizes:
        parts.append(tuple(values[begin : begin + size]))
        begin += size
    return parts


class Opening(NamedTuple):
    """Answer to a request for a session."""

    session: int  # number of the session
    axes: int  # number of axes of the controller


def encode_session_request(number: int, axes: int) -> bytes:
    """Encode the request of a rig for a session; `number` is a random number of 64 bits."""
    return OPENING_FORMAT.pack(REQUEST_MARK, VERSION, axes, number, 0)


def decode_opening(packet: bytes, number: int) -> Opening:
    """Decode the answer to a request for a session; `number` is the random number of the request.

    Raise PacketError if the packet is not an answer to this request.
    """
    if len(packet) == OPENING_FORMAT.size:
        mark, version, axes, requested, session = OPENING_FORMAT.unpack(packet)
        if (mark, version, requested) == (OPENING_MARK, VERSION, number):
            return Opening(session, axes)
    raise PacketError("not an answer to this request for a session")


class SessionNumbers:
    """Generator of session numbers, computed from address and port by a keyed hash.

    Only a program that receives at an address can know the session number of this address. Requests need no
    memory, and an answer is not longer than its request. So forged requests cannot exhaust memory or network.

    Args:
        axes: number of axes in the answers; None to repeat the number of axes that the request states.
    """

    def __init__(self, axes: int | None = None) -> None:
        self._secret, self._axes = secrets.token_bytes(32), axes

    def number(self, sender: tuple[str, int]) -> int:
        """Return the session number of the address and port `sender`."""
        code = hmac.digest(self._secret, repr(sender).encode(), "sha256")
        return int.from_bytes(code[:8], "little")

    def answer(self, packet: bytes | bytearray, sender: tuple[str, int]) -> bytes | None:
        """Return the answer packet to a request for a session, or None if `packet` is not a request."""
        if len(packet) != OPENING_FORMAT.size:
            return None
        mark, version, axes, requested, _ = OPENING_FORMAT.unpack(packet)
        if mark != REQUEST_MARK or version != VERSION:
            return None
        stated = axes if self._axes is None else self._axes
        return OPENING_FORMAT.pack(OPENING_MARK, VERSION, stated, requested, self.number(sender))


class SequenceFilter:
    """Filter that accepts a packet only if it is newer than all previous packets.

    The filter compares sequence numbers of 32 bits, which wrap around (RFC 1982). One packet with a wrong
    number must not make all later packets old. Therefore a jump by more than `MAX_SEQUENCE_STEP` is accepted
    only when a second packet continues from the new number (RFC 3550, A.1).
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
