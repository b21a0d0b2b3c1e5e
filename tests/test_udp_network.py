"""Network faults, causes of missed ticks, and a stalled rig."""

import math
import socket
import time

import numpy as np
import pytest
from rig_lock_step import a_reading, prepared

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from tuning.rig.contact_detector import RigContact
from tuning.rig.loop import EmptyTask, PacketTimes, answered_packet_number, run_loop
from tuning.rig.network import Injection, Network
from tuning.rig.one_axis_rig import ideal_restitutions
from tuning.rig.rig_task import MAX_COMMAND_AGE
from tuning.rig.session import (
    CAUSE_CONTROLLER,
    CAUSE_INJECTION,
    CAUSE_MACHINE,
    NOT_MISSED,
    SOURCE_FOLDER,
    LoopReport,
    SessionSettings,
    compute_quantiles,
    find_miss_causes,
)
from tuning.rig.session_report import is_stalled
from tuning.rig.udp_controller import TickRecord, replay_slow_ticks
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
    held_back = 1e-9 * np.array(network.injected_delay)[~lost]
    assert np.min(held_back) >= 0.002 and np.max(held_back) <= 0.006 + 1e-9
    assert np.mean(held_back) == pytest.approx(0.004, rel=0.05)


def test_missed_tick_is_attributed_to_network_or_computer():
    received = np.array([1, 0, 0, 0, 0, 1, 0, 0, 0], bool)
    overspent = np.array([1, 0, 0, 1, 0, 0, 0, 0, 0], bool)
    round_trip = np.array([1, 5, 0, 9, 9, 1, 3, 0, 6], float)
    held_back = np.array([0, 0, 0, 0, 0, 0, 2.5, 1, 2], float)
    lost = np.array([0, 0, 1, 0, 0, 0, 0, 0, 0], bool)
    expected = [
        NOT_MISSED,
        CAUSE_MACHINE,
        CAUSE_INJECTION,
        CAUSE_CONTROLLER,
        CAUSE_CONTROLLER,
        NOT_MISSED,
        CAUSE_INJECTION,
        CAUSE_INJECTION,
        CAUSE_MACHINE,
    ]
    assert list(find_miss_causes(received, overspent, round_trip, held_back, lost, 1.0)) == expected


def test_latency_quantiles_of_no_values_are_nan():
    assert all(math.isnan(value) for value in compute_quantiles(np.zeros(0)))
    assert compute_quantiles(np.arange(1001.0)) == (500.0, 999.0, 1000.0)


def test_overrunning_ticks_are_replayed_to_find_the_cause(varying):
    mechanism, _ = varying
    record = TickRecord(4)
    for tick, cpu in enumerate((10, 2_000_000_000, 30, 40)):
        record.store_packet(encode_reading(a_reading(tick), 3))
        record.add(tick + 10, cpu, cpu)
    record.store_packet(encode_reading(a_reading(5), 3))
    record.add(15, 1, 3_000_000_000)
    assert record.count == record.packet_count == 4  # rows that do not fit are dropped
    again = replay_slow_ticks(lambda: prepared(mechanism), record, 1e9)
    # In the replay, this tick no longer needs a second of CPU time.
    assert list(again) == [11] and 0 < again[11] < 1e9
    assert replay_slow_ticks(lambda: pytest.fail("nothing to go through"), record, 1e10) == {}


def test_ideal_restitutions_use_entries_of_mechanism_lists_in_turn():
    def over(number, speed):
        return RigContact(number, speed, 0.9, 1.0, 0.1, "ok", 3)

    for name, speed in (("varying", 0.005), ("layered", 0.01)):
        mechanism = load(name).mechanism
        result = ideal_restitutions(mechanism, [over(i, speed) for i in (2, 0, 1, 0)])
        assert result[1] == result[3]
        if name == "layered":
            assert result == pytest.approx([1.0] * 4, abs=1e-9)
        else:
            assert result == pytest.approx([0.91641, 0.93984, 0.96463, 0.93984], abs=1e-5)
    assert ideal_restitutions(mechanism, []) == []


def test_rehearsal_at_a_tenth_of_the_rate_sends_a_packet_every_ten_periods(varying):
    mechanism = varying[0]
    setup = SessionSettings(SOURCE_FOLDER, SOURCE_FOLDER, mechanism, ((-1,), (1,)), 1.0, 0.0, Injection(), 0)
    assert setup.tick_interval == mechanism.rig.control_period
    assert setup._replace(rate=0.1).tick_interval == 10 * mechanism.rig.control_period


def test_contacts_without_commands_due_to_a_stall_are_not_evaluated(varying):
    causes = np.full(100, NOT_MISSED)
    causes[20:40], causes[60] = CAUSE_MACHINE, CAUSE_CONTROLLER
    figures, times = None, None
    run = LoopReport(figures, times, causes, {})  # pyright: ignore[reportArgumentType]
    contact = RigContact(0, 0.005, 0.5, 1.0, 0.1, "ok", 3)
    setup = SessionSettings(SOURCE_FOLDER, SOURCE_FOLDER, varying[0], ((-1,), (1,)), 1.0, 0.0, Injection(), 0)
    old = {**contact._asdict(), "packets": (10, 50), "oldest_command": MAX_COMMAND_AGE + 1}
    assert is_stalled(old, setup, run)
    assert not is_stalled({**old, "oldest_command": MAX_COMMAND_AGE}, setup, run)
    assert not is_stalled({**old, "packets": (10, 60)}, setup, run)
    assert not is_stalled(old, setup._replace(injection=Injection(drops=0.1)), run)


class Sleepy(EmptyTask):
    """Rig that stalls once."""

    held = 0.03

    def advance(self):
        if self._sequence == 50:
            time.sleep(self.held)


@pytest.mark.slow
def test_udp_rig_schedule_is_shifted_after_a_stall():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
        nobody.bind(("127.0.0.1", 0))
        timing = PacketTimes(100)
        network = Network(nobody.getsockname(), Injection(), 0, 100, answered_packet_number)
        begun = time.monotonic()
        run_loop(Sleepy(), network, 0, 0.001, timing, lambda done: None)
        took = time.monotonic() - begun
        network.close()
    assert timing.ticks == 100 and not any(timing.answered_in_time)
    assert timing.clock_shift >= 0.9e9 * Sleepy.held
    assert timing.late[51] >= 0.9e9 * Sleepy.held
    assert took > 0.1 + Sleepy.held
