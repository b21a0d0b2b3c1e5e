"""Packets between rig and controller: what is sent comes back, and any other bytes are refused."""

import math

from hypothesis import given
from hypothesis import strategies as st
from rig_lock_step import ANY, FINITE, same

from tuning.rig.udp_protocol import (
    FLAGS,
    PREPARE,
    READY,
    RESET,
    STOP,
    TICK,
    Answer,
    PacketError,
    Reading,
    decode_answer,
    decode_reading,
    encode_answer,
    encode_reading,
)

WORD = st.integers(0, 2**32 - 1)


@given(
    st.builds(Reading, st.sampled_from([PREPARE, TICK, STOP, RESET]), WORD, WORD, WORD, FINITE, *[ANY] * 4)
)
def test_readings_come_back(reading):
    assert same(decode_reading(encode_reading(reading)), reading)


printable = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=96)


@given(
    st.builds(Answer, st.integers(0, FLAGS), *[WORD] * 3, *[ANY] * 5, st.integers(0, 2**64 - 1), printable)
)
def test_answers_come_back(answer):
    assert same(decode_answer(encode_answer(answer)), answer)


READING = encode_reading(Reading(TICK, 1, 2, 3, 4.0, 5.0, 6.0, 7.0, 8.0))
ANSWER = encode_answer(Answer(READY, 1, 2, 3, *[4.0] * 5, 5, "ok"))


def mutated(packet):
    """Bytes of any kind: none like a packet, cut, lengthened, or with a few bytes changed."""
    place = st.integers(0, len(packet) - 1)
    change = st.lists(st.tuples(place, st.integers(0, 255)), max_size=4)

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


@given(mutated(READING))
def test_any_bytes_are_refused_or_a_reading(packet):
    try:
        reading = decode_reading(packet)
    except PacketError:
        return
    assert len(packet) == len(READING) and math.isfinite(reading.time)
    assert same(decode_reading(encode_reading(reading)), reading)


@given(mutated(ANSWER))
def test_any_bytes_are_refused_or_an_answer(packet):
    try:
        answer = decode_answer(packet)
    except PacketError:
        return
    assert answer.words.isprintable() and same(decode_answer(encode_answer(answer)), answer)
