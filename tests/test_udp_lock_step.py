"""Rig and controller in lock-step over UDP: contacts of the closed loop, and lost packets."""

import math
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig_lock_step import ANY, FINITE, a_reading, closed_loop, controller, packets, prepared, same, task_of

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.rig import faults
from tuning.rig.udp_protocol import (
    PREPARE,
    READY,
    RESET,
    TICK,
    ReadingPacket,
    decode_answer,
    encode_answer,
)
from tuning.rig.udp_task import LAW_IN_DOUBT, MAX_INTERPOLATED_TICKS, MISSED_TICK


@pytest.fixture(scope="module")
def varying():
    mechanism = load("varying").mechanism
    return mechanism, literature_gains(mechanism, "response_error")


@pytest.mark.parametrize("name", ["varying", "layered", "rattling"])
def test_udp_lock_step_contacts_equal_contacts_of_closed_loop(name):
    mechanism = load(name).mechanism
    gains = literature_gains(mechanism, "response_error")
    contacts, _ = closed_loop(mechanism, "response_error", gains)
    wanted = contacts if name == "rattling" else contacts[:1]
    rig, _, _ = packets(mechanism, controller(mechanism, "response_error", gains), 2500)
    result = rig.contacts[: len(wanted)]
    assert [one.restitution for one in result] == [one.restitution for one in wanted]
    assert [one.onset_tick for one in result] == [one.onset_tick for one in wanted]
    # Each run uses the next entries of the mechanism's lists at the nominal speed.
    numbers = [contact.number for contact in rig.contacts]
    assert len(numbers) > len(wanted)
    assert numbers == [i % mechanism.approach.contacts for i in range(len(numbers))]
    firsts = rig.contacts if name != "rattling" else rig.contacts[:: mechanism.approach.contacts]
    assert all(one.approach_velocity == mechanism.approach.velocity for one in firsts)


class Unreliable:
    """Network that loses packets with a given probability, and delays the others by up to some ticks."""

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
def test_udp_rig_compensates_for_lost_and_late_packets(varying, drops, ticks):
    mechanism, gains = varying
    law = controller(mechanism, "response_error", gains)
    whole, _, _ = packets(mechanism, controller(mechanism, "response_error", gains), 2500)
    rig, task, answers = packets(mechanism, law, 2500, Unreliable(drops, ticks, seed=1))
    assert not rig.tripped and task.interpolated > (10 if drops else 0)
    assert (task.stale > 0) == (ticks > 0)
    assert all(math.isfinite(*answer.position_command) for answer in answers)
    assert len(rig.contacts) >= 5
    for result, expected in zip(rig.contacts, whole.contacts, strict=False):
        assert result.status == "ok"
        assert result.restitution == pytest.approx(expected.restitution, abs=0.006)
    assert rig.commanded.not_finite == rig.commanded.beyond_limits == 0


def test_udp_controller_counts_contacts_without_status_identified():
    mechanism = load("suite-fast", ["contact.stiffness=[884316.0]"]).mechanism
    gains = literature_gains(mechanism, "impulse_ledger")
    rig, task, answers = packets(mechanism, controller(mechanism, "impulse_ledger", gains), 900)
    assert LAW_IN_DOUBT == faults.LAW_IN_DOUBT and MISSED_TICK == faults.MISSED_TICK
    reported = [answer for answer in answers if answer.faults & faults.LAW_IN_DOUBT]
    assert len(rig.contacts) >= 3 and not rig.tripped
    assert task.quality_flags == {"too_short": len(reported)} and len(reported) in (
        len(rig.contacts),
        len(rig.contacts) + 1,
    )


def test_readings_of_a_missing_tick_are_interpolated_linearly(varying):
    mechanism, _ = varying
    whole, gappy = prepared(mechanism), prepared(mechanism)
    for tick, force in enumerate((0.0, 10.0, 20.0, 30.0, 40.0)):
        expected = whole.answer(a_reading(tick, force=force))
    for tick in (0, 1, 4):
        result = gappy.answer(a_reading(tick, force=10.0 * tick))
    assert result == expected._replace(faults=MISSED_TICK)
    assert gappy.interpolated == 2 and gappy.stale == 0


def test_readings_of_a_long_gap_are_not_interpolated(varying):
    mechanism, _ = varying
    task = prepared(mechanism, missed_in_a_row=20.0)
    first = task.answer(a_reading(0, force=7.0))
    gap = MAX_INTERPOLATED_TICKS + 1
    answer = task.answer(a_reading(1 + gap, force=7.0))
    assert task.interpolated == 0 and not answer.trip_reason and answer.faults & MISSED_TICK
    # The model continued during the gap under the last force.
    mass, period = mechanism.bodies.equivalent_mass, mechanism.rig.control_period
    expected = first.velocity[0] - (gap + 1) * period * 7.0 / mass
    assert answer.velocity == pytest.approx((expected,), rel=1e-12)
    tripped = task.answer(a_reading(60, force=7.0))
    assert "missed_tick" in tripped.trip_reason and tripped.force_command == (0.0,)
    assert math.isfinite(*tripped.position_command) and math.isfinite(*tripped.command_rate)


@pytest.mark.parametrize(
    ("velocity_limit", "limited_in_a_row", "missed", "trips"),
    [
        (0.0076, 0.0, MAX_INTERPOLATED_TICKS, False),
        (0.0076, 0.0, MAX_INTERPOLATED_TICKS + 1, True),
        (0.1001, 0.0, 19, False),
        (0.1001, 0.0, 20, True),
        (0.0301, 3.0, 20, False),
        (0.0301, 3.0, 21, True),
    ],
)
def test_velocity_limit_trips_after_a_gap_that_the_drives_cannot_follow(
    varying, velocity_limit, limited_in_a_row, missed, trips
):
    """Expect a trip if (n + m) v > m V for n missing ticks at the speed v = 5 mm/s, with m limited ticks."""
    task = prepared(varying[0], velocity_limit=velocity_limit, limited_in_a_row=limited_in_a_row)
    ticks = (0, 1, 2, *range(3 + missed, 11 + missed))
    answers = [task.answer(a_reading(tick)) for tick in ticks]
    assert answers[-1].trip_reason == ("tripped: velocity_limit" if trips else "")


def test_outdated_packets_are_dropped_and_counted(varying):
    task = prepared(varying[0])
    assert task.answer(a_reading(3)) is not None
    assert task.answer(a_reading(2)) is None  # overtaken
    assert task.answer(a_reading(3)) is None  # twice
    assert task.answer(a_reading(4, run=9)) is None  # a run that was not prepared
    assert task.stale == 3
    assert task.answer(a_reading(4)) is not None


SMALL = st.integers(0, 40)


@given(
    st.lists(
        st.builds(
            ReadingPacket,
            st.sampled_from([PREPARE, TICK, RESET]),
            SMALL,
            st.integers(0, 3),
            SMALL,
            FINITE,
            *[st.tuples(ANY)] * 2,
            st.tuples(ANY, ANY),
        ),
        max_size=30,
    ),
    st.sampled_from(["none", "response_error"]),
)
def test_any_packets_of_a_rig_are_answered_with_finite_commands(varying, readings, compensator):
    mechanism, gains = varying
    law = controller(mechanism, compensator, gains if compensator == "response_error" else {})
    task = task_of(law, mechanism)
    for number, reading in enumerate(readings):
        answer = task.answer(reading._replace(sequence=reading.sequence + 2 * number))
        if answer is not None:
            assert math.isfinite(*answer.position_command) and math.isfinite(*answer.force_command)
            assert same(decode_answer(encode_answer(answer, 1), 1), answer)


@pytest.mark.parametrize("resets", [False, True])
def test_trip_caused_by_a_stall_of_the_computer_is_reset_and_reported(varying, resets):
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
        assert "missed_tick" in rig.tripped and rig.reset_trips == () and len(rig.contacts) == 1
        return
    assert not rig.tripped and task.status == "ok"
    assert len(rig.reset_trips) == 2 and all("missed_tick" in words for words in rig.reset_trips)
    statuses = [contact.status for contact in rig.contacts]
    assert statuses.count("stalled") == 2 and statuses.count("ok") == len(statuses) - 2 > 6
    assert all(contact.oldest_command > 3 for contact in rig.contacts if contact.status == "stalled")
    assert all(abs(contact.restitution - 0.94) < 0.05 for contact in rig.contacts if contact.status == "ok")


def test_trip_not_caused_by_a_stall_of_the_computer_is_not_reset(varying):
    mechanism, gains = varying
    law = controller(mechanism, "response_error", gains, force_limit=20.0, missed_in_a_row=1e9)
    count = 0

    def stalled_once(way, packet):
        nonlocal count
        count += way == "there"
        return [] if 20 <= count < 25 else [packet]

    rig, _, _ = packets(mechanism, law, 1000, stalled_once, resets=True)
    rig.finish()
    assert "force_limit" in rig.tripped and rig.reset_trips == ()


def test_failed_sensor_trips_the_controller_and_rig_stays_safe(varying):
    mechanism, gains = varying
    limits = {"held_readings": 3.0, "retreat_velocity": 0.01, "deceleration": 0.5, "velocity_limit": 0.1}
    law = controller(mechanism, "response_error", gains, **limits)
    count = 0

    def broken(way, packet):
        nonlocal count
        if way == "there":
            count += 1
            if count > 60:
                packet = packet._replace(force=(math.nan,))
        return [packet]

    rig, _, answers = packets(mechanism, law, 1500, broken)
    rig.finish()
    assert "force_not_finite" in rig.tripped
    assert [contact.status for contact in rig.contacts] == ["tripped"]
    assert all(math.isfinite(*one.position_command) for one in answers) and rig.commanded.not_finite == 0
    last = answers[-1]
    assert last.position_command < (0.0,) and last.command_rate == last.force_command == (0.0,)
    steps = np.diff([one.position_command[0] for one in answers[60:]])
    assert np.max(np.abs(steps)) <= 0.1 * mechanism.rig.control_period * (1 + 1e-9)


def test_udp_rig_tares_force_sensor_before_the_first_run():
    mechanism = load("rig-300kg", ("rig.force_sensor.bias=3.0",)).mechanism
    law = controller(mechanism, "none", {}, tare_ticks=50.0, bias_limit=5.0)
    rig, _, answers = packets(mechanism, law, 600)
    assert law.bias == pytest.approx(3.0, abs=1e-12)
    assert next(i for i, one in enumerate(answers) if one.flags & READY) == 49
    assert rig.contacts and rig.contacts[0].status == "ok"
    # A remaining bias would push the model during its whole approach.
    quiet = load("rig-300kg").mechanism
    expected = packets(quiet, controller(quiet, "none", {}), 600)[0].contacts[0]
    assert rig.contacts[0].restitution == pytest.approx(expected.restitution, abs=1e-6)
