"""Controller of a six-axis rig: sensor, guards, limits, retreat, and hostile inputs."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from six_axis_documents import LIMITS, six_axis_document
from six_axis_flights import PERIOD, START, TWIST, ZERO, along, controller, fly, names

from jaxhil.mechanism.file import load_any
from jaxhil.rig.faults import fault_names
from jaxhil.rig.six_axes import Controller6
from jaxhil.rig.six_axes.faults import SIX_AXIS_FAULTS
from jaxhil.rig.six_axes.limits import SIX_AXIS_LIMITS


def test_changing_a_returned_list_does_not_change_six_axis_controller():
    rig = controller("none")
    first = rig.step([1.0, 0, 0, 0, 0, 0], START, TWIST, START)
    first[0] = 1e9
    assert rig.step([1.0, 0, 0, 0, 0, 0], START, TWIST, START)[0] == 1.0
    pose = rig.pose_command(START, TWIST, ZERO)
    pose[0] = 1e9
    assert rig.pose_command(START, TWIST, ZERO)[0] == START[0]


# Tests of the force sensor's conversion.


def test_six_axis_sensor_reading_is_converted_to_wrench_about_target():
    """Compare a reading of a known contact and tool with the contact's wrench, with SciPy's rotations."""
    rng, tool = np.random.default_rng(4), load_any("probe-drogue").mechanism.rig.force_sensor.tool
    weight, rig = tool.mass * np.array([0.0, 0.0, -9.80665]), controller()
    for angle in (0.0, 1e-9, 0.03, 1.0, 3.0):
        pose, force, moment = rng.normal(size=6), *(100 * rng.normal(size=(2, 3)))
        pose[3:] *= angle / np.linalg.norm(pose[3:])
        turn = Rotation.from_rotvec(pose[3:])
        at_chaser = moment - np.cross(pose[:3], force) + np.cross(turn.apply(tool.com), weight)
        reading = np.concatenate(turn.inv().apply([force + weight, at_chaser]))
        wrench = rig.from_sensor(reading, pose)
        np.testing.assert_allclose(wrench, [*force, *moment], rtol=0, atol=1e-10)
    assert all(map(math.isnan, rig.from_sensor([1.0] * 5, pose)))


def test_six_axis_sensor_on_target_side_reads_reaction_force():
    rig = Controller6.from_dict(six_axis_document("none", "ring-capture"))
    assert rig.from_sensor([1.0, -2.0, 3.0, -4.0, 5.0, -6.0], START) == [-1.0, 2.0, -3.0, 4.0, -5.0, 6.0]


# Guards


@pytest.mark.parametrize("channel", range(6))
@pytest.mark.parametrize(
    "value, fault",
    [(math.nan, "force_not_finite"), (math.inf, "force_not_finite"), (2e4, "force_out_of_range")],
)
def test_bad_wrench_reading_is_replaced_and_trips_controller_if_it_persists(channel, value, fault):
    rig = controller()
    fly(rig, 20)
    wrench = list(ZERO)
    wrench[channel] = value
    fly(rig, 3, 20, wrench)
    assert rig.status == "ok" and rig.channels == 1 << channel
    assert fault_names(rig.faults, SIX_AXIS_FAULTS) == [fault]
    fly(rig, 1, 23, wrench)
    name = ("fx", "fy", "fz", "mx", "my", "mz")[channel]
    assert rig.status == f"tripped: {fault} ({name})"


@pytest.mark.parametrize("channel", range(6))
@pytest.mark.parametrize("value, fault", [(math.nan, "position_not_finite"), (0.6, "position_out_of_range")])
def test_bad_pose_reading_is_replaced_and_trips_controller_if_it_persists(channel, value, fault):
    rig = controller()
    fly(rig, 20)
    for tick in range(20, 24):
        now = along(tick)
        read = list(now)
        read[channel] = value
        assert not rig.tripped
        rig.step(ZERO, now, TWIST, read)
    assert names(rig) == [fault] and rig.channels == 64 << channel
    # On a run's first tick there is no earlier reading that could replace a bad one.
    other = controller()
    other.step(ZERO, START, TWIST, read)
    assert names(other) == [fault]


@pytest.mark.parametrize("channel", range(6))
def test_stuck_wrench_channel_trips_controller_while_hardware_moves(channel):
    rig = controller("none")
    wrench = [0.0] * 6
    wrench[channel] = 1.5
    fly(rig, 40, wrench=wrench)
    assert rig.status == "ok"
    fly(rig, 20, 40, wrench)
    assert names(rig) == ["force_stuck"]
    # A reading of 0 may stay unchanged.
    free = controller("none")
    fly(free, 300)
    assert free.status == "ok"


def test_stuck_pose_reading_trips_controller_while_model_moves():
    rig = controller("none")
    for tick in range(60):
        rig.step(ZERO, along(tick), TWIST, START)
    assert names(rig) == ["position_stuck"] and "z" in rig.status


def test_nonfinite_model_motion_trips_six_axis_controller():
    rig = controller()
    rig.step(ZERO, [math.nan, *START[1:]], TWIST, START)
    assert names(rig) == ["model_not_finite"]
    other = controller()
    fly(other, 5)
    other.pose_command([math.inf, *START[1:]], TWIST, ZERO)
    assert names(other) == ["model_not_finite"]


def test_six_axis_controller_counts_missed_ticks_and_trips_if_too_many():
    rig = controller()
    fly(rig, 5, timed=True)
    now = along(5)
    rig.step(ZERO, now, TWIST, now, 8 * PERIOD)
    assert fault_names(rig.faults, SIX_AXIS_FAULTS) == ["missed_tick"] and rig.missed_ticks == 3
    rig.step(ZERO, now, TWIST, now, 1.0)
    assert names(rig) == ["missed_tick"]


def test_invalid_arguments_trip_six_axis_controller_without_exception():
    for wrong in (None, [1.0], ["a"] * 6, 5.0, [None] * 6):
        rig = controller()
        assert rig.step(ZERO, wrong, TWIST, START) == ZERO
        assert names(rig) == ["model_not_finite"]
        assert len(rig.pose_command(wrong, wrong, None)) == 6


def test_six_axis_tare_removes_sensor_bias():
    rig = controller("none")
    reading = [3.0, -2.0, 5.0, 0.5, 0.25, -0.125]
    assert [rig.tare(reading) for _ in range(3)] == [False, False, True]
    assert rig.bias == reading
    assert rig.step(reading, START, TWIST, START) == ZERO
    other = controller("none")
    other.tare(ZERO)
    other.tare([9.0, *ZERO[1:]])
    assert other.tare(ZERO) and names(other) == ["tare"]


def test_six_axis_emergency_stop_is_latched_until_reset():
    rig = controller()
    fly(rig, 10)
    rig.emergency_stop(True)
    assert names(rig) == ["emergency_stop"] and rig.reset() is False
    rig.emergency_stop(False)
    assert rig.tripped and rig.reset() is True and rig.status == "ok"


def test_six_axis_trip_keeps_its_first_cause():
    rig = controller()
    fly(rig, 10)
    rig.pose_command([float("nan")] * 6, TWIST)
    first = names(rig)
    rig.emergency_stop(True)
    assert rig.tripped and names(rig) == first != ["emergency_stop"]


# Outputs


def test_wrench_command_ramps_to_zero_after_force_limit_trip():
    rig = controller("none", limited_in_a_row=1000.0)
    for tick in range(20):
        rig.step([0, 0, 900.0, 0, 0, 0], along(tick), TWIST, along(tick))
    last = rig.step([0, 0, 1001.0, 0, 0, 0], along(20), TWIST, along(20))
    assert names(rig) == ["force_limit"] and last[2] == 800.0
    values = [rig.step(ZERO, along(20), TWIST, along(20))[2] for _ in range(10)]
    np.testing.assert_allclose(values[:8], [700, 600, 500, 400, 300, 200, 100, 0], atol=1e-9)


def test_pose_command_outside_stroke_trips_controller():
    rig = controller()
    fly(rig, 10)
    rig.pose_command([0.41, *START[1:]], TWIST, ZERO)
    assert names(rig) == ["stroke"]


def test_six_axis_retreat_retraces_approach_within_speed_limits():
    """Follow a curved approach, stop, and compare the retreat with the approach."""
    rig = controller()
    angle = np.linspace(0, 1.5, 600)
    way = np.zeros((600, 6))
    way[:, 0], way[:, 2] = 0.03 * np.sin(angle), 0.03 * np.cos(angle)
    way[:, 4] = 0.05 * angle
    twist = np.gradient(way, PERIOD, axis=0)
    for at, rate in zip(way.tolist(), twist.tolist(), strict=True):
        rig.step(ZERO, at, rate, at)
        sent = [rig.pose_command(at, rate, ZERO)]
    assert rig.status == "ok"
    rig.emergency_stop(True)
    while not rig.at_rest and len(sent) < 5000:
        rig.step(ZERO, at, rate, at)
        sent.append(rig.pose_command(at, rate, ZERO))
    sent = np.array(sent)
    steps = np.diff(sent, axis=0)
    moved, turned = np.linalg.norm(steps[:, :3], axis=1), np.linalg.norm(steps[:, 3:], axis=1)
    braking = int(np.argmin(moved > 1e-12))
    speed = np.linalg.norm(twist[-1][:3])
    assert braking > 10 and np.max(moved[:braking]) <= speed * PERIOD * (1 + 1e-6)
    assert np.max(moved[braking:]) <= 0.02 * PERIOD * (1 + 1e-9)
    assert np.max(turned[braking:]) <= 0.04 * PERIOD * (1 + 1e-9)
    assert np.sum(moved[braking:]) == pytest.approx(0.01, abs=2e-5)
    # Each point of the retreat is near the path of approach and braking.
    all_points = np.concatenate([way, sent[: braking + 1]])
    distance = [np.min(np.linalg.norm(all_points[:, :3] - point[:3], axis=1)) for point in sent[braking:]]
    assert max(distance) < 5e-5
    # The retreat starts and stops within the limit of the deceleration.
    change = np.linalg.norm(np.diff(steps[:, :3], axis=0), axis=1)
    assert np.max(change[: braking - 1]) <= 0.5 * PERIOD**2 * (1 + 1e-6)


def test_six_axis_retreat_by_rotation_has_specified_length():
    """Check the length of a retreat by rotation, in which 1 rad counts as 0.02/0.04 m."""
    rig = controller()
    twist = [0.0, 0.0, 0.0, 0.0, 0.05, 0.0]
    for tick in range(1000):
        at = along(tick, ZERO, twist)
        rig.step(ZERO, at, twist, at)
        sent = rig.pose_command(at, twist, ZERO)
    rig.emergency_stop(True)
    angles = [sent[4]]
    while not rig.at_rest and len(angles) < 5000:
        rig.step(ZERO, at, twist, at)
        angles.append(rig.pose_command(at, twist, ZERO)[4])
    assert angles[-1] == pytest.approx(max(angles) - 0.01 / 0.5, abs=1e-4)
    assert np.max(np.abs(np.diff(angles))) <= 0.05 * PERIOD * (1 + 1e-6)


def test_first_pose_command_of_a_run_starts_at_measured_pose():
    rig = controller("none")
    far = [at + 0.05 for at in START]
    rig.step(ZERO, far, ZERO, START)
    first = rig.pose_command(far, ZERO, ZERO)
    assert np.linalg.norm(np.subtract(first, START)[:3]) <= 0.1 * PERIOD * (1 + 1e-9)
    near = controller("none")
    beside = [at + 0.001 for at in START]
    near.step(ZERO, beside, ZERO, START)
    assert near.pose_command(beside, ZERO, ZERO) == beside


# Tests with hostile inputs.

hostile = st.floats(allow_nan=True, allow_infinity=True) | st.sampled_from(
    [0.0, -0.0, 1e308, 5e-324, math.nan, 0.05, -0.05, 0.3]
)
vectors = st.lists(hostile, min_size=6, max_size=6) | st.lists(st.floats(-0.05, 0.05), min_size=6, max_size=6)
calls = st.lists(
    st.tuples(
        st.sampled_from(["step"] * 3 + ["timed", "pose", "pose", "pose"] + ["tare", "next", "reset"])
        | st.sampled_from(["stop", "release"]),
        st.tuples(vectors, vectors, vectors, vectors),
        hostile,
    ),
    max_size=60,
)


@settings(max_examples=200, deadline=None)
@given(calls=calls, name=st.sampled_from(["none", "phase_lead", "response_error", "impulse_ledger"]))
def test_six_axis_controller_outputs_are_finite_and_within_limits_for_any_inputs(calls, name):
    rig = controller(name)
    wrench, sent, measured = np.zeros(6), None, None
    most = np.array([100.0] * 3 + [30.0] * 3)
    for call, values, number in calls:
        if call in ("step", "timed"):
            new = np.array(rig.step(*values, number if call == "timed" else None))
            assert np.all(np.abs(new) <= [1000.0] * 3 + [300.0] * 3)
            assert np.all(np.abs(new - wrench) <= most * (1 + 1e-12))
            wrench = new
            if np.all(np.abs(values[3]) <= 0.5):
                measured = np.array(values[3])
        elif call == "pose":
            new = np.array(rig.pose_command(*values[:3]))
            assert np.all(np.isfinite(new))
            if sent is not None:
                # If a run begins outside the stroke, the commands never move farther out.
                assert np.all((np.minimum(-0.4, sent) <= new) & (new <= np.maximum(0.4, sent)))
                step = new - sent
                assert np.linalg.norm(step[:3]) <= 1e-4 * (1 + 1e-9) + 1e-14
                assert np.linalg.norm(step[3:]) <= 2e-4 * (1 + 1e-9) + 1e-14
            elif measured is not None:
                # The first command of a run is near the measured pose.
                assert np.linalg.norm((new - measured)[:3]) <= 0.002 + 1e-12
                assert np.linalg.norm((new - measured)[3:]) <= 0.002 + 1e-12
            sent = new
        elif call == "tare":
            rig.tare(values[0])
        elif call == "next":
            if not rig.tripped:
                # If the audit of an open contact trips, no new run begins.
                rig.next_contact()
                if not rig.tripped:
                    sent = measured = None
            else:
                rig.next_contact()
        elif call == "reset":
            rig.reset()
        else:
            rig.emergency_stop(call == "stop")
        assert rig.tripped is (rig.status != "ok")
        assert "\n" not in rig.status


def test_six_axis_test_documents_set_every_limit():
    assert {*LIMITS} | {"late_fraction"} == {*SIX_AXIS_LIMITS}
