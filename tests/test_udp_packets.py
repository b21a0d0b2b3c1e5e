"""Packets between rig and controller: decoded as sent; any other bytes are rejected."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig_lock_step import ANY, FINITE, same

from tuning.rig.udp_protocol import (
    FLAGS,
    FORMATS,
    MAX_SEQUENCE_STEP,
    PREPARE,
    READY,
    RESET,
    STOP,
    TICK,
    AnswerPacket,
    PacketError,
    ReadingPacket,
    SequenceFilter,
    SessionNumbers,
    decode_answer,
    decode_opening,
    decode_reading,
    encode_answer,
    encode_reading,
    encode_session_request,
)

WORD = st.integers(0, 2**32 - 1)
AXES = st.sampled_from([FORMATS[1], FORMATS[6]])
EVENTS = st.sampled_from([PREPARE, TICK, STOP, RESET])


def numbers(count):
    return st.tuples(*[ANY] * count)


@given(
    AXES.flatmap(
        lambda form: st.builds(
            ReadingPacket, EVENTS, *[WORD] * 3, FINITE, *[numbers(form.axes)] * 2, numbers(form.start)
        )
    )
)
def test_reading_packets_survive_encoding_and_decoding(reading):
    assert same(decode_reading(encode_reading(reading, 7), 7), reading)


printable = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=96)


@given(
    AXES.flatmap(
        lambda form: st.builds(
            AnswerPacket,
            st.integers(0, FLAGS),
            *[WORD] * 3,
            *[numbers(form.axes)] * 5,
            numbers(form.bodies),
            st.integers(0, 2**64 - 1),
            printable,
        )
    )
)
def test_answer_packets_survive_encoding_and_decoding(answer):
    assert same(decode_answer(encode_answer(answer, 7), 7), answer)


SESSION = 2**64 - 2
READING = encode_reading(ReadingPacket(TICK, 1, 2, 3, 4.0, (5.0,), (6.0,), (7.0, 8.0)), SESSION)
ANSWER = encode_answer(AnswerPacket(READY, 1, 2, 3, *[(4.0,)] * 5, (), 5, "ok"), SESSION)
SIX_AXIS_READING = encode_reading(
    ReadingPacket(TICK, 1, 2, 3, 4.0, (5.0,) * 6, (6.0,) * 6, (7.0,) * 26), SESSION
)
SIX_AXIS_ANSWER = encode_answer(
    AnswerPacket(READY, 1, 2, 3, *[(4.0,) * 6] * 5, (1.0,) * 26, 5, "ok"), SESSION
)


def mutated(packet):
    """Return any bytes: random, truncated, extended, or a packet with a few bytes changed."""
    index = st.integers(0, len(packet) - 1)
    change = st.lists(st.tuples(index, st.integers(0, 255)), max_size=4)

    def changed(changes):
        made = bytearray(packet)
        for where, value in changes:
            made[where] = value
        return bytes(made)

    return st.one_of(
        st.binary(max_size=2 * len(packet)),
        st.integers(0, len(packet)).map(lambda length: packet[:length]),
        st.binary(min_size=1, max_size=8).map(lambda more: packet + more),
        change.map(changed),
    )


@given(st.one_of(mutated(READING), mutated(SIX_AXIS_READING)))
def test_arbitrary_bytes_are_rejected_or_decoded_as_reading_packet(packet):
    try:
        reading = decode_reading(packet, SESSION)
    except PacketError:
        return
    assert len(packet) == FORMATS[len(reading.force)].reading.size and math.isfinite(reading.time)
    assert same(decode_reading(encode_reading(reading, SESSION), SESSION), reading)


@given(st.one_of(mutated(ANSWER), mutated(SIX_AXIS_ANSWER)))
def test_arbitrary_bytes_are_rejected_or_decoded_as_answer_packet(packet):
    try:
        answer = decode_answer(packet, SESSION)
    except PacketError:
        return
    assert answer.trip_reason.isprintable()
    assert same(decode_answer(encode_answer(answer, SESSION), SESSION), answer)


def test_packets_of_another_session_are_rejected():
    packets = ((decode_reading, READING), (decode_answer, ANSWER))
    packets += ((decode_reading, SIX_AXIS_READING), (decode_answer, SIX_AXIS_ANSWER))
    for decode, packet in packets:
        assert decode(packet, SESSION) == decode(packet, None)
        for other in (0, SESSION + 1, SESSION - 1):
            with pytest.raises(PacketError, match="another session"):
                decode(packet, other)


def test_packets_for_another_number_of_axes_are_rejected():
    for decode, one, six in (
        (decode_reading, READING, SIX_AXIS_READING),
        (decode_answer, ANSWER, SIX_AXIS_ANSWER),
    ):
        for axes, packet, other in ((1, one, six), (6, six, one)):
            assert decode(packet, SESSION, axes) == decode(packet, SESSION)
            with pytest.raises(PacketError, match=f"expected {axes}"):
                decode(other, SESSION, axes)


def test_session_number_is_sent_to_requesting_address_and_differs_by_address():
    sessions, rig, number = SessionNumbers(), ("127.0.0.1", 4000), 2**63 + 5
    answer = sessions.answer(encode_session_request(number, 1), rig)
    assert answer is not None and len(answer) == len(encode_session_request(number, 1))
    assert decode_opening(answer, number) == (sessions.number(rig), 1)
    with pytest.raises(PacketError):
        decode_opening(answer, number + 1)
    six = SessionNumbers(6).answer(encode_session_request(number, 1), rig)
    assert six is not None and decode_opening(six, number).axes == 6
    others = [("127.0.0.1", 4001), ("127.0.0.2", 4000), ("127.0.0.1", 400)]
    assert len({sessions.number(one) for one in (rig, *others)}) == 4
    assert SessionNumbers().number(rig) != sessions.number(rig)


@given(st.one_of(st.binary(max_size=40), mutated(encode_session_request(3, 6)), mutated(READING)))
def test_session_is_opened_only_by_a_session_request(packet):
    answer = SessionNumbers().answer(packet, ("127.0.0.1", 4000))
    assert (answer is not None) == (len(packet) == 24 and packet[:5] == encode_session_request(3, 6)[:5])


def accept_numbers(sequence: SequenceFilter, *numbers: int) -> list[bool]:
    return [sequence.is_newer(number & 0xFFFFFFFF) for number in numbers]


@pytest.mark.parametrize("start", [0, 2**31 - 5, 2**32 - 5, 12345])
def test_packet_sequence_numbers_order_packets_across_wrap_around(start):
    sequence = SequenceFilter(start - 1)
    assert accept_numbers(sequence, start, start + 1, start + 4) == [True] * 3
    assert accept_numbers(sequence, start + 4, start + 3, start, start - 1) == [False] * 4
    assert (
        accept_numbers(sequence, start + 5, start + 5 + MAX_SEQUENCE_STEP, start + 10 + MAX_SEQUENCE_STEP)
        == [True] * 3
    )


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_packet_with_any_sequence_number_outdates_at_most_one_window_of_packets(newest, wild):
    sequence = SequenceFilter(newest)
    sequence.is_newer(wild)
    following = accept_numbers(sequence, *range(newest + 1, newest + MAX_SEQUENCE_STEP + 3))
    first = following.index(True)
    # The next packets are accepted: all of them or, if `wild` lies within the window, those from `wild` on.
    assert first <= MAX_SEQUENCE_STEP and all(following[first:])
    assert first in (0, (wild - newest) & 0xFFFFFFFF)


def test_first_packet_after_a_long_loss_is_also_dropped():
    for gap in (MAX_SEQUENCE_STEP + 1, 10**6, 2**31 - 10):
        sequence = SequenceFilter(5)
        assert accept_numbers(sequence, 5 + gap, 6 + gap, 7 + gap) == [False, True, True]
    # Arbitrary numbers that are not consecutive are dropped; the next regular number is accepted.
    assert accept_numbers(SequenceFilter(5), 2**30, 2**29, 2**28, 6) == [False, False, False, True]
    # An older number is never accepted, because it may be a replay of an earlier packet.
    assert not any(accept_numbers(SequenceFilter(2**31), *range(1000)))
