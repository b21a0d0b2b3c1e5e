"""The loop over UDP: packets, what is done about lost ones, whose fault a missed tick is, short runs."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from random import Random

import numpy as np
import pytest
from gain_documents import gain_document, sign
from hypothesis import given
from hypothesis import strategies as st
from rig_lock_step import closed_loop, controller, packets

from jaxhil.compensators import literature_gains
from jaxhil.mechanism.file import load, to_builtins
from jaxhil.runtime import faults
from tuning.gain_file import build_document, write_gain_file
from tuning.rig import udp_controller, udp_protocol
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
    PROCESS,
    SOURCE,
    LoopReport,
    Setup,
    attribute,
    listening_port,
    quantiles,
    start_controller,
)
from tuning.rig.udp_controller import TickRecord, replayed
from tuning.rig.udp_protocol import (
    FLAGS,
    MISSED_TICK,
    MOST_MADE_UP,
    PREPARE,
    READY,
    RESET,
    STOP,
    TICK,
    Answer,
    ControllerTask,
    PacketError,
    Reading,
    decode_answer,
    decode_reading,
    encode_answer,
    encode_reading,
)

ROOT = Path(__file__).parents[1]
WORD = st.integers(0, 2**32 - 1)
ANY = st.floats(width=64)
FINITE = st.floats(allow_nan=False, allow_infinity=False)


# Packets


def same(one, other):
    return all(a == b or (a != a and b != b) for a, b in zip(one, other, strict=True))


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


# What is done with packets, in lock-step


@pytest.fixture(scope="module")
def varying():
    mechanism = load("varying").mechanism
    return mechanism, literature_gains(mechanism, "response_error")


@pytest.mark.parametrize("name", ["varying", "layered", "rattling"])
def test_first_contacts_as_in_the_closed_loop(name):
    mechanism = load(name).mechanism
    gains = literature_gains(mechanism, "response_error")
    contacts, _ = closed_loop(mechanism, "response_error", gains)
    wanted = contacts if name == "rattling" else contacts[:1]
    rig, _, _ = packets(mechanism, controller(mechanism, "response_error", gains), 2500)
    found = rig.contacts[: len(wanted)]
    assert [one.restitution for one in found] == [one.restitution for one in wanted]
    assert [one.begun for one in found] == [one.begun for one in wanted]
    # Run after run, through the lists of the mechanism again and again, at the nominal speed.
    numbers = [one.number for one in rig.contacts]
    assert len(numbers) > len(wanted)
    assert numbers == [i % mechanism.approach.contacts for i in range(len(numbers))]
    firsts = rig.contacts if name != "rattling" else rig.contacts[:: mechanism.approach.contacts]
    assert all(one.approach_velocity == mechanism.approach.velocity for one in firsts)


class Unreliable:
    """Packets lost with a probability, or held back by up to so many ticks."""

    def __init__(self, drops, ticks, seed):
        self.random, self.drops, self.ticks = Random(seed), drops, ticks
        self.queues = {way: [[] for _ in range(ticks + 1)] for way in ("there", "back")}

    def __call__(self, way, packet):
        queue = self.queues[way]
        if self.random.random() >= self.drops:
            queue[self.random.randint(0, self.ticks)].append(packet)
        arrived = queue.pop(0)
        queue.append([])
        return arrived


@pytest.mark.parametrize("drops, ticks", [(0.01, 0), (0.05, 0), (0.0, 2), (0.01, 2)])
def test_lost_and_late_packets_are_made_up_for(varying, drops, ticks):
    mechanism, gains = varying
    law = controller(mechanism, "response_error", gains)
    whole, _, _ = packets(mechanism, controller(mechanism, "response_error", gains), 2500)
    rig, task, answers = packets(mechanism, law, 2500, Unreliable(drops, ticks, seed=1))
    assert not rig.tripped and task.made_up > (10 if drops else 0)
    assert (task.stale > 0) == (ticks > 0)
    assert all(math.isfinite(answer.position_command) for answer in answers)
    assert len(rig.contacts) >= 5
    for found, expected in zip(rig.contacts, whole.contacts, strict=False):
        assert found.status == "ok"
        assert found.restitution == pytest.approx(expected.restitution, abs=0.006)
    assert rig.commanded.not_finite == rig.commanded.beyond_limits == 0


def test_contacts_that_the_law_did_not_know_are_counted():
    """Too short ones, each reported once by an answer; the process says how many."""
    mechanism = load("suite-fast", ["contact.stiffness=[884316.0]"]).mechanism
    gains = literature_gains(mechanism, "retrospective_reference")
    rig, task, answers = packets(mechanism, controller(mechanism, "retrospective_reference", gains), 900)
    assert udp_protocol.LAW_IN_DOUBT == faults.LAW_IN_DOUBT and MISSED_TICK == faults.MISSED_TICK
    reported = [answer for answer in answers if answer.faults & faults.LAW_IN_DOUBT]
    assert len(rig.contacts) >= 3 and not rig.tripped
    assert task.doubts == {"too_short": len(reported)} and len(reported) in (
        len(rig.contacts),
        len(rig.contacts) + 1,
    )


def a_reading(tick, sequence=None, force=0.0, position=-1.0, event=TICK, run=1):
    sequence = tick + 10 if sequence is None else sequence
    return Reading(event, sequence, run, tick, 0.001 * sequence, force, position, -1.0, 0.005)


def prepared(mechanism, **limits):
    law = controller(mechanism, "none", {}, **limits)
    task = ControllerTask(law, to_builtins(mechanism))
    assert task.answer(a_reading(0, 1, event=PREPARE)).flags == READY
    return task


def test_a_tick_made_up_is_the_tick_on_the_line_between(varying):
    mechanism, _ = varying
    whole, gappy = prepared(mechanism), prepared(mechanism)
    for tick, force in enumerate((0.0, 10.0, 20.0, 30.0, 40.0)):
        expected = whole.answer(a_reading(tick, force=force))
    for tick in (0, 1, 4):
        found = gappy.answer(a_reading(tick, force=10.0 * tick))
    assert found == expected._replace(faults=MISSED_TICK)
    assert gappy.made_up == 2 and gappy.stale == 0


def test_a_long_gap_is_the_controllers_to_judge(varying):
    mechanism, _ = varying
    task = prepared(mechanism, missed_in_a_row=20.0)
    first = task.answer(a_reading(0, force=7.0))
    gap = MOST_MADE_UP + 1
    answer = task.answer(a_reading(1 + gap, force=7.0))
    assert task.made_up == 0 and not answer.words and answer.faults & MISSED_TICK
    # Model time is rig time: it went on under the last force.
    mass, period = mechanism.bodies.equivalent_mass, mechanism.rig.control_period
    assert answer.velocity == pytest.approx(first.velocity - (gap + 1) * period * 7.0 / mass, rel=1e-12)
    tripped = task.answer(a_reading(60, force=7.0))
    assert "missed_tick" in tripped.words and tripped.force_command == 0.0
    assert math.isfinite(tripped.position_command) and math.isfinite(tripped.command_rate)


def test_stale_packets_are_dropped_and_counted(varying):
    task = prepared(varying[0])
    assert task.answer(a_reading(3)) is not None
    assert task.answer(a_reading(2)) is None  # overtaken
    assert task.answer(a_reading(3)) is None  # twice
    assert task.answer(a_reading(4, run=9)) is None  # a run that was never prepared
    assert task.stale == 3
    assert task.answer(a_reading(4)) is not None


SMALL = st.integers(0, 40)


@given(
    st.lists(
        st.builds(
            Reading,
            st.sampled_from([PREPARE, TICK, RESET]),
            SMALL,
            st.integers(0, 3),
            SMALL,
            FINITE,
            *[ANY] * 4,
        ),
        max_size=30,
    ),
    st.sampled_from(["none", "response_error"]),
)
def test_whatever_a_rig_sends_is_answered_with_finite_commands(varying, readings, compensator):
    mechanism, gains = varying
    law = controller(mechanism, compensator, gains if compensator == "response_error" else {})
    task = ControllerTask(law, to_builtins(mechanism))
    for number, reading in enumerate(readings):
        answer = task.answer(reading._replace(sequence=reading.sequence + 2 * number))
        if answer is not None:
            assert math.isfinite(answer.position_command) and math.isfinite(answer.force_command)
            assert same(decode_answer(encode_answer(answer)), answer)


@pytest.mark.parametrize("resets", [False, True])
def test_a_trip_over_a_stall_of_the_machine_is_reset_and_reported(varying, resets):
    mechanism, gains = varying
    law = controller(mechanism, "response_error", gains, missed_in_a_row=3.0)
    count = 0

    def stalled_twice(way, packet):
        nonlocal count
        count += way == "there"
        return [] if 100 <= count < 130 or 900 <= count < 930 else [packet]

    rig, task, _ = packets(mechanism, law, 3000, stalled_twice, resets=resets)
    rig.finish()
    if not resets:
        assert "missed_tick" in rig.tripped and rig.forgiven == () and len(rig.contacts) == 1
        return
    assert not rig.tripped and task.status == "ok"
    assert len(rig.forgiven) == 2 and all("missed_tick" in words for words in rig.forgiven)
    statuses = [one.status for one in rig.contacts]
    assert statuses.count("stalled") == 2 and statuses.count("ok") == len(statuses) - 2 > 6
    assert all(one.oldest_command > 3 for one in rig.contacts if one.status == "stalled")
    assert all(abs(one.restitution - 0.94) < 0.05 for one in rig.contacts if one.status == "ok")


def test_a_trip_that_no_stall_explains_is_not_reset(varying):
    mechanism, gains = varying
    law = controller(mechanism, "response_error", gains, force_limit=20.0, missed_in_a_row=1e9)
    count = 0

    def stalled_once(way, packet):
        nonlocal count
        count += way == "there"
        return [] if 20 <= count < 25 else [packet]

    rig, _, _ = packets(mechanism, law, 1000, stalled_once, resets=True)
    rig.finish()
    assert "force_limit" in rig.tripped and rig.forgiven == ()


def test_a_sensor_that_fails_trips_and_the_rig_is_safe(varying):
    mechanism, gains = varying
    limits = {"held_readings": 3.0, "retreat_velocity": 0.01, "deceleration": 0.5, "velocity_limit": 0.1}
    law = controller(mechanism, "response_error", gains, **limits)
    count = 0

    def broken(way, packet):
        nonlocal count
        if way == "there":
            count += 1
            if count > 60:
                packet = packet._replace(force=math.nan)
        return [packet]

    rig, _, answers = packets(mechanism, law, 1500, broken)
    rig.finish()
    assert "force_not_finite" in rig.tripped
    assert [one.status for one in rig.contacts] == ["tripped"]
    assert all(math.isfinite(one.position_command) for one in answers) and rig.commanded.not_finite == 0
    last = answers[-1]
    assert last.position_command < 0.0 and last.command_rate == 0.0 and last.force_command == 0.0
    steps = np.diff([one.position_command for one in answers[60:]])
    assert np.max(np.abs(steps)) <= 0.1 * mechanism.rig.control_period * (1 + 1e-9)


def test_tare_comes_before_the_first_run():
    mechanism = load("rig-300kg", ("rig.force_sensor.bias=3.0",)).mechanism
    law = controller(mechanism, "none", {}, tare_ticks=50.0, bias_limit=5.0)
    rig, _, answers = packets(mechanism, law, 600)
    assert law.bias == pytest.approx(3.0, abs=1e-12)
    assert next(i for i, one in enumerate(answers) if one.flags & READY) == 49
    assert rig.contacts and rig.contacts[0].status == "ok"
    # What is left of the bias would push the model all the way through its approach.
    quiet = load("rig-300kg").mechanism
    expected = packets(quiet, controller(quiet, "none", {}), 600)[0].contacts[0]
    assert rig.contacts[0].restitution == pytest.approx(expected.restitution, abs=1e-6)


# Network, attribution, times


def test_injected_faults_of_the_network():
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
    held = 1e-9 * np.array(network.held_back)[~lost]
    assert np.min(held) >= 0.002 and np.max(held) <= 0.006 + 1e-9
    assert np.mean(held) == pytest.approx(0.004, rel=0.05)


def test_whose_fault_a_missed_tick_is():
    met = np.array([1, 0, 0, 0, 0, 1, 0, 0, 0], bool)
    overspent = np.array([1, 0, 0, 1, 0, 0, 0, 0, 0], bool)
    round_trip = np.array([1, 5, 0, 9, 9, 1, 3, 0, 6], float)
    held = np.array([0, 0, 0, 0, 0, 0, 2.5, 1, 2], float)
    lost = np.array([0, 0, 1, 0, 0, 0, 0, 0, 0], bool)
    expected = [MET, MACHINE, INJECTED, CONTROLLER, CONTROLLER, MET, INJECTED, INJECTED, MACHINE]
    assert list(attribute(met, overspent, round_trip, held, lost, 1.0)) == expected


def test_quantiles_of_nothing():
    assert all(math.isnan(value) for value in quantiles(np.zeros(0)))
    assert quantiles(np.arange(1001.0)) == (500.0, 999.0, 1000.0)


def test_ticks_that_overspent_are_gone_through_again(varying):
    mechanism, _ = varying
    record = TickRecord(4)
    for tick, cpu in enumerate((10, 2_000_000_000, 30, 40)):
        record.keep(encode_reading(a_reading(tick)))
        record.add(tick + 10, cpu, cpu)
    record.keep(encode_reading(a_reading(5)))
    record.add(15, 1, 3_000_000_000)
    assert record.count == record.kept == 4  # what does not fit is not kept
    again = replayed(lambda: prepared(mechanism), record, 1e9)
    # The machine's second is not needed a second time.
    assert list(again) == [11] and 0 < again[11] < 1e9
    assert replayed(lambda: pytest.fail("nothing to go through"), record, 1e10) == {}


def test_references_are_those_of_the_lists():
    def over(number, speed):
        return ContactResult(number, speed, 0.9, 1.0, 0.1, "ok", 3)

    for name, speed in (("varying", 0.005), ("layered", 0.01)):
        mechanism = load(name).mechanism
        found = reference_restitutions(mechanism, [over(i, speed) for i in (2, 0, 1, 0)])
        assert found[1] == found[3]
        if name == "layered":
            assert found == pytest.approx([1.0] * 4, abs=1e-9)
        else:
            assert found == pytest.approx([0.91641, 0.93984, 0.96463, 0.93984], abs=1e-5)
    assert reference_restitutions(mechanism, []) == []


def test_contacts_that_the_machine_left_without_commands_are_not_judged(varying):
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
    """A rig that is held up once."""

    held = 0.03

    def advance(self):
        if self._sequence == 50:
            time.sleep(self.held)


def test_a_rig_that_was_held_up_goes_on_from_there():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
        nobody.bind(("127.0.0.1", 0))
        timing = Timing(100)
        network = Network(nobody.getsockname(), Injection(), 0, 100, answered_by)
        begun = time.monotonic()
        play(Sleepy(), network, 0.001, timing, lambda done: None)
        took = time.monotonic() - begun
        network.close()
    assert timing.ticks == 100 and not any(timing.met)
    assert timing.stood >= 0.9e9 * Sleepy.held
    assert timing.late[51] >= 0.9e9 * Sleepy.held
    assert took > 0.1 + Sleepy.held


# Two processes


def gain_file(folder, compensator="response_error", limits=None, **values):
    document = gain_document(compensator, **values)
    if limits is not None:
        from jaxhil.runtime.limits import LIMITS

        document["limits"] = {name: {"value": v, "unit": LIMITS[name].unit} for name, v in limits.items()}
    path = folder / "gains.json"
    path.write_text(json.dumps(sign(document)))
    return path


def test_the_controllers_process_answers_its_rig_and_nobody_else(tmp_path):
    record = tmp_path / "ticks.json"
    arguments = ["--gains", str(gain_file(tmp_path)), "--record", str(record), "--ticks", "100"]
    process = start_controller(SOURCE, arguments)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rig:
        address = ("127.0.0.1", listening_port(process))
        rig.settimeout(10)

        def ask(reading):
            rig.sendto(encode_reading(reading), address)
            return decode_answer(rig.recv(1000))

        rig.sendto(b"no packet at all", address)
        assert ask(a_reading(0, 1, event=PREPARE)).flags == READY
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(encode_reading(a_reading(50)), address)
        for tick in range(5):
            answer = ask(a_reading(tick))
            assert (answer.tick, answer.sequence, answer.words) == (tick, tick + 10, "")
        rig.sendto(encode_reading(a_reading(0, 99, event=STOP)), address)
    assert process.wait(20) == 0
    process.stdout.close()
    found = json.loads(record.read_text())
    assert found["ended"] == "stopped" and found["jax"] is False and found["made_up"] == found["stale"] == 0
    ticks = found["ticks"]
    assert ticks["sequence"] == [10, 11, 12, 13, 14]
    assert all(value > 0 for value in ticks["wall"] + ticks["cpu"])


def test_the_controllers_process_of_a_bundle_runs_the_bundles_runtime(jaxhil, tmp_path):
    gain_file(tmp_path)
    for name in PROCESS:
        (tmp_path / name).write_bytes((SOURCE / name).read_bytes())
    stand_in = (
        "import sys\n"
        f"open({str(tmp_path / 'used')!r}, 'w').write(str(sys.flags.isolated))\n"
        f"sys.path.insert(0, {str(ROOT)!r})\n"
        "from jaxhil.runtime import Controller\n"
    )
    (tmp_path / "jaxhil_runtime.py").write_text(stand_in)
    ran = jaxhil("rig", tmp_path, "--duration", 0.5, "--json", "--limit", "inf")
    assert ran.document["run"]["ticks"] == 500
    assert (tmp_path / "used").read_text() == "1"
    assert not (tmp_path / "__pycache__").exists()


@pytest.mark.parametrize("options", [("--wait", "0.1"), ("--wait", "20", "--silence", "0.1")])
def test_a_silent_rig_ends_the_controllers_process(tmp_path, options):
    record = tmp_path / "ticks.json"
    process = start_controller(SOURCE, ["--empty", "--record", str(record), *options])
    port = listening_port(process)
    if "20" in options:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rig:
            rig.settimeout(10)
            rig.sendto(READING, ("127.0.0.1", port))
            assert decode_answer(rig.recv(1000)).sequence == 1
            assert process.wait(20) == 1
    assert process.wait(20) == 1
    process.stdout.close()
    assert json.loads(record.read_text())["ended"] == "silent"


def test_a_controllers_process_without_a_gain_file(capfd):
    assert udp_controller.main(["--gains", "nowhere.json"]) == 2
    error = capfd.readouterr().err
    assert "nowhere.json" in error and error.count("\n") == 1


def test_rig_reports_a_short_run(jaxhil, tmp_path):
    path = gain_file(tmp_path)
    # One contact of this gain file's takes most of a second.
    ran = jaxhil("rig", path, "--duration", 2, "--limit", "inf", "--json", "--plot", tmp_path / "rig.png")
    found = ran.document
    assert found["empty_loop"]["ticks"] == 400 and found["run"]["ticks"] == 2000
    assert (tmp_path / "rig.png").stat().st_size > 10_000
    for loop in (found["empty_loop"], found["run"]):
        missed = [loop[f"missed_by_{cause}"] for cause in ("controller", "injection", "machine")]
        assert sum(missed) == loop["missed"] and missed[1] == 0
        assert loop["controller"]["ended"] == "stopped" and loop["controller"]["jax"] is False
        for name in ("tick_time", "tick_cpu", "round_trip", "lateness"):
            assert 0 < loop[name]["median"] <= loop[name]["p999"] <= loop[name]["maximum"]
    assert found["contacts"] and not found["tripped"] and not found["interrupted"]
    assert found["commanded"]["not_finite"] == found["commanded"]["beyond_limits"] == 0
    for contact in found["contacts"]:
        assert contact["reference_restitution"] == pytest.approx(1.0, abs=1e-9)
        assert contact["error"] == contact["restitution"] - contact["reference_restitution"]
    assert ran.code == (0 if found["verdict"] == "good" else 1)


def test_rig_under_injected_faults_ends_safely(jaxhil, tmp_path):
    limits = {"command_lowest": -0.01, "command_highest": 0.01, "velocity_limit": 0.05, "deceleration": 1.0}
    limits |= {"held_readings": 3.0, "missed_in_a_row": 5.0, "retreat_velocity": 0.01}
    limits |= {"limited_in_a_row": 5.0, "force_limit": 200.0}
    path = gain_file(tmp_path, limits=limits)
    ran = jaxhil("rig", path, "--duration", 1, "--drops", 0.01, "--jitter", 0.002, "--limit", "inf")
    assert "injected" in ran.out and "missed" in ran.out
    ran = jaxhil("rig", path, "--duration", 1, "--drops", 0.2, "--delay", 0.003, "--limit", "inf", "--json")
    found = ran.document
    assert found["run"]["missed_by_injection"] > 100
    assert found["stroke"] == [-0.01, 0.01]
    assert -0.01 <= found["commanded"]["lowest"] <= found["commanded"]["highest"] <= 0.01
    assert found["commanded"]["not_finite"] == found["commanded"]["beyond_limits"] == 0


def test_rig_trips_without_injection_and_is_bad(jaxhil, tmp_path):
    limits = {"force_limit": 5.0, "retreat_velocity": 0.01, "deceleration": 1.0}
    path = gain_file(tmp_path, limits=limits)
    ran = jaxhil("rig", path.parent, "--duration", 5, "--limit", "inf")
    assert ran.code == 1
    assert "tripped: force_limit" in ran.out and "though no faults were injected" in ran.out


def test_rig_interrupted_says_what_it_measured(tmp_path):
    path = gain_file(tmp_path)
    # A shell's background jobs ignore interrupts, and hand that on.
    heeding = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from tuning.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", heeding, "rig", str(path), "--duration", "60", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    seen = deque(maxlen=10)
    for line in process.stderr:
        seen.append(line)
        if "empty loop" in line:
            break
    # While the empty loop lasts: the run is never reached.
    time.sleep(2.0)
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=60)
    assert process.returncode == 130, (seen, error)
    found = json.loads(out)
    assert found["interrupted"] and found["run"] is None
    assert 0 < found["empty_loop"]["ticks"] < 12_000
    assert "Traceback" not in error


@pytest.mark.parametrize(
    "options, words",
    [
        (("nowhere.json",), "nowhere.json"),
        (("GAINS", "--drops", "1"), "--drops: found 1, allowed a probability"),
        (("GAINS", "--jitter", "-1"), "--jitter: found -1"),
        (("GAINS", "--delay", "nan"), "--delay: found nan"),
        (("GAINS", "--duration", "0"), "--duration: found 0, allowed 0.001 to 2000 s"),
        (("BROKEN",), "sha256"),
    ],
)
def test_unusable_input_of_rig(jaxhil, tmp_path, options, words):
    good = gain_file(tmp_path)
    broken = tmp_path / "broken.json"
    broken.write_text(good.read_text().replace("0.005", "0.006"))
    names = {"GAINS": good, "BROKEN": broken}
    ran = jaxhil("rig", *(names.get(option, option) for option in options))
    assert ran.code == 2 and words in ran.err and ran.out == ""
    assert ran.err.strip().count("\n") == 0


def test_a_priority_that_is_not_to_be_had(jaxhil, tmp_path, monkeypatch):
    def refuse(*arguments):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    ran = jaxhil("rig", gain_file(tmp_path), "--realtime")
    assert ran.code == 2 and "--realtime: found no such priority (Operation not permitted)" in ran.err


def test_help_of_rig_has_an_example(jaxhil):
    ran = jaxhil("rig", "--help")
    assert ran.code == 0 and "Example: jaxhil rig" in ran.out


def test_the_loop_runs_without_jax():
    program = (
        "import sys, tuning.cli.commands.rig as command, tuning.rig.session, tuning.rig.report\n"
        "assert 'jax' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


@pytest.mark.benchmark
def test_ten_minutes_at_1_khz(jaxhil, tmp_path):
    mechanism, sha256, _ = load("varying")
    gains = literature_gains(mechanism, "response_error")
    path = tmp_path / "gains.json"
    write_gain_file(path, build_document("response_error", gains, mechanism, sha256, {}, {}, 0, {}))
    assert mechanism.rig.control_period == 1e-3
    ran = jaxhil("rig", path, "--duration", 600)
    print(ran.out)
    assert ran.code == 0
