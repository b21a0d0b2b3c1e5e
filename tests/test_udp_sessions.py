"""Sessions of the controller process: their rig, packets of other senders, and their end."""

import json
import socket
import time
from contextlib import ExitStack, contextmanager

import pytest
from gain_documents import gain_document
from rig_lock_step import a_reading

from tuning.rig.session import SOURCE_FOLDER, read_listening_port, start_controller
from tuning.rig.udp_protocol import (
    PREPARE,
    READY,
    STOP,
    VERSION,
    PacketError,
    decode_answer,
    decode_opening,
    encode_reading,
    encode_session_request,
)

SILENCE = 0.5  # s


class Rig:
    """Rig that sends packets to the process at `address`."""

    def __init__(self, stack, address, number=1):
        self.socket = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self.socket.settimeout(10)
        self.socket.bind(("127.0.0.1", 0))
        self.address, self.session, self.number = address, 0, number

    def send(self, packet):
        self.socket.sendto(packet, self.address)

    def open(self):
        self.send(encode_session_request(self.number, 1))
        self.session = decode_opening(self.socket.recv(1000), self.number).session

    def tell(self, reading):
        self.send(encode_reading(reading, self.session))

    def ask(self, reading):
        self.tell(reading)
        return decode_answer(self.socket.recv(1000), self.session)

    def prepare(self):
        self.open()
        assert self.ask(a_reading(0, 1, event=PREPARE)).flags == READY

    def hears_nothing(self):
        self.socket.settimeout(0.1)
        with pytest.raises(TimeoutError):
            self.socket.recv(1000)
        self.socket.settimeout(10)
        return True


class Process:
    """Controller process, its final record, and rigs for it."""

    def __init__(self, folder, stack, *options):
        gains, self._record = folder / "gains.json", folder / "ticks.json"
        gains.write_text(json.dumps(gain_document("none")))
        arguments = ["--gains", str(gains), "--record", str(self._record), "--ticks", "100"]
        self._process, self._stack = start_controller(SOURCE_FOLDER, [*arguments, *options]), stack
        self._address = ("127.0.0.1", read_listening_port(self._process))

    def rig(self):
        return Rig(self._stack, self._address)

    def ended(self):
        """Return exit code and record."""
        code = self._process.wait(20)
        return code, json.loads(self._record.read_text())

    def close(self):
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


@pytest.fixture
def process(tmp_path):
    """Return `process(*options)`, which starts a controller process."""
    with ExitStack() as stack:

        def made(*options):
            one = Process(tmp_path, stack, *options)
            stack.callback(one.close)
            return one

        yield made


@contextmanager
def flood(*senders):
    """Provide a function that sends the packet of each sender once, and then waits 20 ms."""

    def once():
        for rig, packet in senders:
            rig.send(packet)
        time.sleep(0.02)

    yield once


def test_controller_process_answers_only_the_rig_of_its_session(process):
    served = process()
    rig, stranger, guesser = served.rig(), served.rig(), served.rig()
    rig.send(b"no packet at all")
    stranger.open()  # the requesting sender has no session yet
    rig.prepare()
    stranger.tell(a_reading(50))
    # One packet with the largest number and the rig's session number, but from another address.
    guesser.session = rig.session
    guesser.tell(a_reading(0, 2**32 - 1))
    guesser.tell(a_reading(0, 99, event=STOP))
    guesser.send(encode_session_request(5, 1))
    for tick in range(5):
        answer = rig.ask(a_reading(tick))
        assert (answer.tick, answer.sequence, answer.trip_reason) == (tick, tick + 10, "")
    assert stranger.hears_nothing() and guesser.hears_nothing()
    rig.tell(a_reading(0, 99, event=STOP))
    code, result = served.ended()
    assert code == 0 and result["ended"] == "stopped" and result["jax"] is False
    assert result["made_up"] == result["stale"] == 0 and result["ignored"] == 5
    ticks = result["ticks"]
    assert ticks["sequence"] == [10, 11, 12, 13, 14]
    assert all(value > 0 for value in ticks["wall"] + ticks["cpu"])


def test_packet_from_rig_address_without_session_number_is_ignored(process):
    """Such packets are possible for a sender that forges the rig's address."""
    served = process()
    rig = served.rig()
    rig.prepare()
    session, rig.session = rig.session, rig.session ^ 1
    rig.tell(a_reading(0, 99, event=STOP))
    rig.tell(a_reading(0, 2**31 - 1))
    rig.session = session
    assert rig.ask(a_reading(0)).tick == 0
    rig.tell(a_reading(0, 99, event=STOP))
    code, result = served.ended()
    assert code == 0 and result["ignored"] == 2 and result["stale"] == 0


def test_packet_with_arbitrary_sequence_number_does_not_block_the_controller(process):
    served = process()
    rig = served.rig()
    rig.prepare()
    for number in (2**32 - 1, 2**31, 2**31 - 1, 5000, 0):
        rig.tell(a_reading(0, number))
    assert [rig.ask(a_reading(tick)).tick for tick in range(3)] == [0, 1, 2]
    # After a long loss, one more packet is lost.
    rig.tell(a_reading(3, 5000))
    assert rig.ask(a_reading(4, 5001)).tick == 4
    rig.tell(a_reading(0, 99, event=STOP))
    code, result = served.ended()
    assert code == 0 and result["stale"] == 6


def test_replayed_packet_is_dropped(process):
    served = process("--silence", str(SILENCE))
    rig = served.rig()
    rig.prepare()
    before = [rig.ask(a_reading(tick)) for tick in range(4)]
    for tick in range(4):
        rig.tell(a_reading(tick))
    assert rig.hears_nothing()
    assert rig.ask(a_reading(4)).position > before[-1].position
    # Such packets also do not keep the session open.
    begun = time.monotonic()
    with flood((rig, encode_reading(a_reading(4), rig.session))) as once:
        while time.monotonic() < begun + 2 * SILENCE:
            once()
    code, result = served.ended()
    assert code == 1 and result["ended"] == "silent" and result["stale"] > 10


def test_packets_from_other_addresses_do_not_keep_a_session_open(process):
    served = process("--silence", str(SILENCE))
    rig, stranger = served.rig(), served.rig()
    rig.prepare()
    begun = time.monotonic()
    garbage = ((stranger, b"garbage"), (stranger, encode_session_request(3, 1)), (rig, b"garbage"))
    with flood(*garbage, (stranger, encode_reading(a_reading(1), rig.session))) as once:
        while time.monotonic() < begun + 2 * SILENCE:
            once()
    code, result = served.ended()
    assert code == 1 and result["ended"] == "silent" and result["ignored"] > 40


@pytest.mark.parametrize("opened", [False, True])
def test_controller_process_without_session_ends_despite_session_requests(process, opened):
    served = process("--wait", "0.3")
    rig = served.rig()
    begun = time.monotonic()
    while time.monotonic() < begun + 0.6:
        rig.send(encode_session_request(3, 1) if opened else b"garbage")
        time.sleep(0.02)
    code, result = served.ended()
    assert code == 1 and result["ended"] == "silent"


def test_controller_loop_ends_if_rig_sends_no_packet(process):
    served = process("--empty", "--silence", "0.1")
    rig = served.rig()
    rig.open()
    assert rig.ask(a_reading(0, 1)).sequence == 1
    code, result = served.ended()
    assert code == 1 and result["ended"] == "silent"


def test_restarted_rig_does_not_continue_the_old_session(process):
    served = process("--silence", str(SILENCE))
    rig = served.rig()
    rig.prepare()
    assert rig.ask(a_reading(0)).tick == 0
    again = served.rig()
    for one in (again, rig):  # from another port, then from the same port
        one.send(encode_session_request(77, 1))
        assert one.hears_nothing()
    code, result = served.ended()
    assert code == 1 and result["ended"] == "silent" and result["ignored"] == 2


def test_lost_session_request_or_answer_is_sent_again(process):
    served = process()
    rig = served.rig()
    rig.send(encode_session_request(1, 1)[:-1])
    rig.send(encode_session_request(1, 1))  # the rig does not wait for the answer
    first = rig.socket.recv(1000)
    rig.prepare()
    assert decode_opening(first, 1).session == rig.session
    with pytest.raises(PacketError):
        decode_opening(first, 2)
    rig.tell(a_reading(0, 99, event=STOP))
    code, result = served.ended()
    assert code == 0 and result["ignored"] == 1


def test_rig_of_another_version_is_ignored(process):
    served = process()
    rig = served.rig()
    packet = bytearray(encode_session_request(1, 1))
    packet[4] = VERSION - 1
    rig.send(bytes(packet))
    assert rig.hears_nothing()
    rig.prepare()
    rig.tell(a_reading(0, 99, event=STOP))
    assert served.ended()[1]["ignored"] == 1
