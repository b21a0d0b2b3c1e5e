"""Faults of the network, the cause of a missed tick, and a rig that was held up."""

import math
import socket
import time

import numpy as np
import pytest
from rig_lock_step import a_reading, prepared

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from tuning.rig.contact_watch import ContactResult
from tuning.rig.hardware import BRIDGED
from tuning.rig.loop import EmptyTask, Timing, answered_by, play
from tuning.rig.network import Injection, Network
from tuning.rig.report import reference_restitutions, stalled
from tuning.rig.session import (
    CONTROLLER,
    INJECTED,
    MACHINE,
    MET,
    SOURCE,
    LoopReport,
    Setup,
    attribute,
    quantiles,
)
from tuning.rig.udp_controller import TickRecord, replayed
from tuning.rig.udp_protocol import (
    encode_reading,
)


@pytest.fixture(scope="module")
def varying():
    mechanism = load("varying").mechanism
    return mechanism, literature_gains(mechanism, "response_error")


def test_injected_network_faults_have_the_stated_rates():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as echo:
        echo.bind(("127.0.0.1", 0))
        echo.setblocking(False)
        number = 2000
        injection = Injection(drops=0.1, jitter=0.002, delay=0.001)
        network = Network(echo.getsockname(), injection, 5, number, lambda packet: int(packet))
        arrived = []
        for i in range(number + 1):
            if i < number:
                network.send(i, b"%d" % i)
            until = time.monotonic() + (0.1 if i == number else 0.0)
            going_on = True
            while going_on:
                going_on = time.monotonic() < until
                network.wait(time.monotonic_ns() + 20_000)
                while True:
                    try:
                        packet, sender = echo.recvfrom(100)
                    except BlockingIOError:
                        break
                    echo.sendto(packet, sender)
                arrived += [int(packet) for _, packet in network.receive()]
        network.close()
    lost = np.array(network.lost, bool)
    assert np.mean(lost) == pytest.approx(1 - 0.9**2, abs=0.04)
    assert sorted(arrived) == sorted(set(np.flatnonzero(~lost)))
    assert arrived != sorted(arrived)
    held_back = 1e-9 * np.array(network.held_back)[~lost]
    assert np.min(held_back) >= 0.002 and np.max(held_back) <= 0.006 + 1e-9
    assert np.mean(held_back) == pytest.approx(0.004, rel=0.05)


def test_missed_tick_is_attributed_to_its_cause():
    received = np.array([1, 0, 0, 0, 0, 1, 0, 0, 0], bool)
    overspent = np.array([1, 0, 0, 1, 0, 0, 0, 0, 0], bool)
    round_trip = np.array([1, 5, 0, 9, 9, 1, 3, 0, 6], float)
    held_back = np.array([0, 0, 0, 0, 0, 0, 2.5, 1, 2], float)
    lost = np.array([0, 0, 1, 0, 0, 0, 0, 0, 0], bool)
    expected = [MET, MACHINE, INJECTED, CONTROLLER, CONTROLLER, MET, INJECTED, INJECTED, MACHINE]
    assert list(attribute(received, overspent, round_trip, held_back, lost, 1.0)) == expected


def test_quantiles_of_no_values_are_nan():
    assert all(math.isnan(value) for value in quantiles(np.zeros(0)))
    assert quantiles(np.arange(1001.0)) == (500.0, 999.0, 1000.0)


def test_ticks_that_took_too_long_are_replayed(varying):
    mechanism, _ = varying
    record = TickRecord(4)
    for tick, cpu in enumerate((10, 2_000_000_000, 30, 40)):
        record.keep(encode_reading(a_reading(tick), 3))
        record.add(tick + 10, cpu, cpu)
    record.keep(encode_reading(a_reading(5), 3))
    record.add(15, 1, 3_000_000_000)
    assert record.count == record.kept == 4  # rows that do not fit are dropped
    again = replayed(lambda: prepared(mechanism), record, 1e9)
    # The machine's second is not needed again.
    assert list(again) == [11] and 0 < again[11] < 1e9
    assert replayed(lambda: pytest.fail("nothing to go through"), record, 1e10) == {}


def test_ideal_restitutions_are_those_of_the_mechanisms_lists():
    def over(number, speed):
        return ContactResult(number, speed, 0.9, 1.0, 0.1, "ok", 3)

    for name, speed in (("varying", 0.005), ("layered", 0.01)):
        mechanism = load(name).mechanism
        result = reference_restitutions(mechanism, [over(i, speed) for i in (2, 0, 1, 0)])
        assert result[1] == result[3]
        if name == "layered":
            assert result == pytest.approx([1.0] * 4, abs=1e-9)
        else:
            assert result == pytest.approx([0.91641, 0.93984, 0.96463, 0.93984], abs=1e-5)
    assert reference_restitutions(mechanism, []) == []


def test_contacts_without_commands_because_of_the_machine_are_not_evaluated(varying):
    causes = np.full(100, MET)
    causes[20:40], causes[60] = MACHINE, CONTROLLER
    figures, times = None, None
    run = LoopReport(figures, times, causes, {})  # pyright: ignore[reportArgumentType]
    contact = ContactResult(0, 0.005, 0.5, 1.0, 0.1, "ok", 3)
    setup = Setup(SOURCE, SOURCE, varying[0], (-1, 1), 1.0, 0.0, Injection(), 0)
    old = contact._replace(packets=(10, 50), oldest_command=BRIDGED + 1)
    assert stalled(old, setup, run)
    assert not stalled(old._replace(oldest_command=BRIDGED), setup, run)
    assert not stalled(old._replace(packets=(10, 60)), setup, run)
    assert not stalled(old, setup._replace(injection=Injection(drops=0.1)), run)


class Sleepy(EmptyTask):
    """Rig that is held up once."""

    held = 0.03

    def advance(self):
        if self._sequence == 50:
            time.sleep(self.held)


def test_rig_that_was_held_up_continues_from_there():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
        nobody.bind(("127.0.0.1", 0))
        timing = Timing(100)
        network = Network(nobody.getsockname(), Injection(), 0, 100, answered_by)
        begun = time.monotonic()
        play(Sleepy(), network, 0, 0.001, timing, lambda done: None)
        took = time.monotonic() - begun
        network.close()
    assert timing.ticks == 100 and not any(timing.met)
    assert timing.stood >= 0.9e9 * Sleepy.held
    assert timing.late[51] >= 0.9e9 * Sleepy.held
    assert took > 0.1 + Sleepy.held
