"""Controller of a six-axis rig in contact: commands of recorded runs, and faults of the watchdog."""

import numpy as np
import pytest
from gain_documents import sign
from six_axis_documents import LIMITS, six_axis_document
from six_axis_flights import PERIOD, ZERO, controller, names
from six_axis_ranges import NOISE, POSE_NOISE
from six_axis_records import recorded

from jaxhil.mechanism.file import load_any
from jaxhil.rig.six_axes import Controller6
from jaxhil.rig.six_axes.gain_file import check_six_axis_document
from jaxhil.sixdof.controller_record import ControllerRecord
from tuning.watchdog.six_axes import audit_limits


@pytest.fixture(scope="module")
def records():
    changes = {"rig.force_sensor.noise_std": NOISE, "rig.position_sensor.noise_std": POSE_NOISE}
    return recorded(load_any("probe-drogue", changes).mechanism, "impulse_ledger", 3)


def replay(rig, record, change=lambda tick, inputs: inputs):
    """Run a controller with a record's inputs; return its wrench and pose commands."""
    commands, sent = [], []
    rows = list(zip(*(column.tolist() for column in record[:4]), strict=True))
    for tick, row in enumerate(rows):
        inputs = change(tick, [list(vector) for vector in row])
        commands.append(rig.step(*inputs, tick * PERIOD))
        if tick + 1 < len(rows):
            sent.append(rig.pose_command(rows[tick + 1][1], rows[tick + 1][2], ZERO))
        if rig.tripped:
            break
    return np.array(commands), np.array(sent)


def of_records(records, **limits):
    document = six_axis_document(limits={**LIMITS, **limits}, **records.gains)
    # The document's gain bounds are those of the mechanism without noise.
    return Controller6.from_dict(document)


def test_six_axis_controller_reproduces_recorded_commands(records):
    for record in records.lanes:
        rig = of_records(records)
        commands, sent = replay(rig, record)
        assert rig.status == "ok" and rig.seen == 0
        span = np.ptp(record.command)
        np.testing.assert_allclose(commands, record.command, rtol=0, atol=1e-9 * span)
        np.testing.assert_allclose(sent, record.sent[:-1], rtol=0, atol=1e-13)
        assert 0 < rig.unpaid_impulse < 0.1 and 0.02 < rig.loop_delay < 0.035
        rig.next_contact()
        contact = rig.last_contact
        assert contact.number >= 1 and contact.status == "identified" and not contact.in_doubt
        assert rig.unpaid_impulse == rig.loop_delay == 0.0


def test_six_axis_watchdog_trips_on_model_with_wrong_mass(records):
    document = six_axis_document(limits=LIMITS, **records.gains)
    document["constants"]["mass_matrix"] = (1.2 * np.array(document["constants"]["mass_matrix"])).tolist()
    document["constants"]["inverse_mass"] = (np.array(document["constants"]["inverse_mass"]) / 1.2).tolist()
    rig = Controller6.from_dict(sign(document))
    replay(rig, records.lanes[0])
    rig.next_contact()
    assert "momentum" in names(rig)


def test_six_axis_watchdog_trips_on_wrong_sign_of_wrench(records):
    """Replay wrenches with the wrong sign; the recorded motion then contradicts the commands."""
    rig = of_records(records, unpaid_impulse=1e9)

    def turned(tick, inputs):
        inputs[0] = [-value for value in inputs[0]]
        return inputs

    replay(rig, records.lanes[0], turned)
    rig.next_contact()
    assert {"momentum", "energy_gain"} & {*names(rig)}


def test_six_axis_watchdog_trips_on_lag_out_of_range(records):
    rig = of_records(records, lag_highest=0.02)
    replay(rig, records.lanes[0])
    assert names(rig) == ["lag"]


def test_six_axis_watchdog_trips_on_unpaid_impulse(records):
    rig = of_records(records, unpaid_impulse=1e-6)
    replay(rig, records.lanes[0])
    rig.next_contact()
    assert names(rig) == ["unpaid_impulse"] and "unpaid impulse" in rig.status


def pushed(rig, force, ticks, factor=1.0):
    """Push a model that moves at 5 mm/s with a force [N] for some ticks, and return the controller.

    The model accelerates as if its mass were smaller by `factor`.
    """
    inverse = np.array(six_axis_document()["constants"]["inverse_mass"])
    twist, wrench = np.array([0, 0, -0.005, 0, 0, 0]), np.array([0, 0, force, 0, 0, 0])
    at = np.array([0, 0, 0.05, 0, 0, 0])
    rig.step(ZERO, at.tolist(), twist.tolist(), at.tolist())
    for tick in range(ticks + 40):
        felt = wrench if tick < ticks else 0 * wrench
        command = np.array(rig.step(felt.tolist(), at.tolist(), twist.tolist(), at.tolist()))
        # The force along z has no lever arm at this pose, which hardly changes.
        twist = twist + factor * PERIOD * inverse @ command
        at = at + PERIOD * twist
        at[:2] = 0
    return rig


def test_six_axis_watchdog_trips_on_contact_that_releases_energy():
    limits = {"force_stuck_travel": 1.0, "fading": 1.0}
    assert pushed(controller("none", **limits), 30.0, 100).status == "ok"
    rig = pushed(controller("none", **limits), 30.0, 150)
    assert names(rig) == ["energy_gain"] and "energy released" in rig.status


def test_six_axis_watchdog_trips_if_momentum_differs_from_impulse():
    limits = {"force_stuck_travel": 1.0, "fading": 1.0, "energy_gain": 1e9}
    assert pushed(controller("none", **limits), 30.0, 100, 1.03).status == "ok"
    assert names(pushed(controller("none", **limits), 30.0, 100, 1.1)) == ["momentum"]


def test_six_axis_watchdog_trips_on_contact_that_lasts_too_long():
    limits = {"force_stuck_travel": 1.0, "fading": 1.0, "longest_contact": 0.1}
    assert names(pushed(controller("none", **limits), 10.0, 120)) == ["contact_too_long"]


@pytest.mark.parametrize("after", [[], [0.0] * 40 + [-5.0] * 5 + [0.0] * 40], ids=["open", "ended"])
def test_calibration_audits_every_contact_of_a_run(after):
    """A push releases energy; the run ends in this contact, or after a second one that absorbs energy."""
    gain_file = check_six_axis_document(six_axis_document("none"))
    mass, inverse = (np.array(getattr(gain_file.constants, name)) for name in ("mass_matrix", "inverse_mass"))
    push = [0.0] + [30.0] * 150
    wrench = np.array(push + after)[:, None] * np.array([0, 0, 1, 0, 0, 0])
    twist = np.array([0, 0, -0.005, 0, 0, 0]) + PERIOD * np.cumsum(wrench @ inverse, axis=0)
    twist = np.vstack([[0, 0, -0.005, 0, 0, 0], twist])  # the last row follows the last wrench
    pose = np.zeros_like(wrench)
    record = ControllerRecord(wrench, pose, twist[:-1], pose, wrench, pose)
    before, then = (motion @ mass @ motion for motion in (twist[0], twist[len(push)]))
    limits = audit_limits(gain_file, [record], fading=1.0)
    assert limits["energy_gain"] == pytest.approx(1.5 * (then / before - 1)) and then > 2 * before
    assert limits["momentum_error"] == 0.05
