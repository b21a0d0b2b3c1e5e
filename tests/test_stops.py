"""Causes that stop a run on the rig: fault, value, limit, contact and time, and sufficient limits."""

import numpy as np
import pytest

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.rig import digest
from jaxhil.rig.gain_file import check_gain_document
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.recording import nominal_and_draws, record_lanes
from tuning.api.export import export
from tuning.bundle.bundle import build_bundle, build_limits_section
from tuning.gain_file import build_document
from tuning.verification.runtime_replay import verify
from tuning.verification.stops import describe_limit_changes, find_passing_limits, find_stop

LAW = "phase_lead"
AUDIT = {
    "equivalent_mass": 350.0,
    "settling": 0.0115,
    "alignment": 0.004,
    "fading": 1e-5,
    "reference_stiffness": 124355.0,
    "reference_velocity": 0.005,
}


@pytest.fixture(scope="module")
def loaded():
    """Return gains with which every contact of `varying` diverges by several percent."""
    parsed = load("varying").mechanism
    gains = literature_gains(parsed, LAW)
    return check_document(build_document(LAW, gains, parsed, "0" * 64, {}, {}, 0, {}))


@pytest.fixture(scope="module")
def recorded(loaded):
    """Return metrics and record of the nominal run."""
    metrics, lanes = record_lanes(loaded, nominal_and_draws(loaded.mechanism, 1, 0))
    return metrics, lanes[0]


def limited(loaded, **limits):
    """Return the gain document with these limits."""
    document = {**loaded.document, "limits": build_limits_section(limits)}
    return {**document, "sha256": digest(document)}


def stop_of(loaded, lane, **limits):
    gain_file = check_gain_document(limited(loaded, **limits))
    return gain_file, find_stop(gain_file, lane)


def test_run_without_limits_is_not_stopped(loaded, recorded):
    gain_file, stop = stop_of(loaded, recorded[1])
    assert stop is None and find_passing_limits(gain_file, recorded[1]) == {}


def reaches(lane):
    """Return the value that the nominal run reaches for every guard limit, computed from its record alone."""
    signals, period = lane.signals, 1e-3
    same = np.asarray(signals.age)[1:] > 0
    sent = np.asarray(lane.sent)
    return {
        "force_range": np.max(np.abs(signals.force_measured)),
        "measured_highest": np.max(signals.position_measured),
        "measured_lowest": np.min(signals.position_measured),
        "force_limit": np.max(np.abs(lane.command)),
        "force_slew": np.max(np.abs(np.diff(lane.command, prepend=0.0))) / period,
        "command_highest": np.nanmax(sent[:-1]),
        "velocity_limit": np.max(np.abs(np.diff(sent))[:-1][same[:-1]]) / period,
    }


FAULT_OF = {
    "force_range": "force_out_of_range",
    "measured_highest": "position_out_of_range",
    "measured_lowest": "position_out_of_range",
    "force_limit": "force_limit",
    "force_slew": "force_slew",
    "command_highest": "stroke",
    "velocity_limit": "velocity_limit",
}


@pytest.mark.parametrize("limit", FAULT_OF)
def test_fault_that_stops_a_run_is_reported_with_value_and_limit(loaded, recorded, limit):
    most = reaches(recorded[1])[limit]
    start = {"start_distance": 1e-3}
    assert stop_of(loaded, recorded[1], **start, **{limit: 1.001 * most})[1] is None
    gain_file, stop = stop_of(loaded, recorded[1], **start, **{limit: 0.9 * most})
    assert stop.fault == FAULT_OF[limit] and stop.limit == limit and stop.by == "guard"
    assert stop.allowed == 0.9 * most and 0.9 < stop.found / most <= 1 + 1e-9
    assert stop.time == pytest.approx(1e-3 * stop.tick) and 1 <= stop.contact <= 3
    for part in (stop.fault, f"{limit} {stop.allowed:.4g}", f"{stop.found:.4g}", f"contact {stop.contact}"):
        assert part in stop.text, stop.text
    passing = find_passing_limits(gain_file, recorded[1])
    assert list(passing) == [limit] and abs(passing[limit]) >= abs(most)
    assert stop_of(loaded, recorded[1], **start, **passing)[1] is None
    assert f"--set {limit}=" in describe_limit_changes(passing)


def test_first_command_far_from_drive_position_is_reported_with_distance(loaded, recorded):
    speed = 1.001 * reaches(recorded[1])["velocity_limit"]
    gain_file, stop = stop_of(loaded, recorded[1], velocity_limit=speed)
    assert (stop.fault, stop.limit, stop.tick) == ("velocity_limit", "start_distance", 0)
    first = recorded[1].signals.position_desired[1] - recorded[1].signals.position_measured[0]
    assert stop.found == pytest.approx(abs(first), rel=1e-9)
    passing = find_passing_limits(gain_file, recorded[1])
    assert list(passing) == ["start_distance"]
    assert stop_of(loaded, recorded[1], velocity_limit=speed, **passing)[1] is None


def test_stuck_sensors_are_reported_with_distance_travelled(loaded, recorded):
    lane = recorded[1]
    measured, force = np.array(lane.signals.position_measured), np.array(lane.signals.force_measured)
    inside = np.flatnonzero(measured > 0)[:40]
    force[inside] = force[inside[0] - 1]
    stuck = lane._replace(signals=lane.signals._replace(force_measured=force))
    travel = 2e-5
    _, stop = stop_of(loaded, stuck, force_stuck_travel=travel)
    assert stop.fault == "force_stuck" and stop.limit == "force_stuck_travel"
    assert stop.found == pytest.approx(
        np.sum(np.abs(np.diff(measured[inside[0] - 1 : stop.tick + 1]))), rel=1e-12
    )
    assert travel < stop.found < 2 * travel


def test_watchdog_stop_reports_restitution_expected_value_and_contact(loaded, recorded):
    metrics, lane = recorded
    restitution = metrics.restitution[:, 0]
    for margin, expected in ((0.05, 1.0), (0.02, 0.9)):
        _, stop = stop_of(loaded, lane, **AUDIT, expected_1=expected, restitution_margin=margin)
        first = int(np.argmax(np.abs(restitution[:3] - expected) > margin))
        assert (stop.fault, stop.by, stop.limit) == ("restitution", "watchdog", "restitution_margin")
        assert stop.contact == first + 1 and stop.tripped
        assert stop.found == pytest.approx(abs(restitution[first] - expected), abs=1e-4)
        assert (
            f"after contact {first + 1}" in stop.text and f"restitution {restitution[first]:.3f}" in stop.text
        )


def test_last_contact_of_a_run_is_audited(loaded, recorded):
    metrics, lane = recorded
    one = int(np.flatnonzero(np.asarray(lane.signals.age) == 0)[1])
    first = lane._replace(
        signals=type(lane.signals)(*(leaf[:one] for leaf in lane.signals)),
        command=lane.command[:one],
        sent=None if lane.sent is None else lane.sent[:one],
    )
    _, stop = stop_of(loaded, first, **AUDIT, restitution_margin=0.01)
    assert stop.fault == "restitution" and stop.contact == 1
    assert stop.found == pytest.approx(abs(metrics.restitution[0, 0] - 1.0), abs=1e-4)


def test_contact_that_lasts_too_long_is_reported(loaded, recorded):
    gain_file, stop = stop_of(loaded, recorded[1], **AUDIT, longest_contact=0.05)
    assert (stop.fault, stop.by, stop.contact) == ("contact_too_long", "watchdog", 1)
    assert list(find_passing_limits(gain_file, recorded[1])) == ["longest_contact"]


def test_verify_reports_the_fault_that_stopped_the_closed_loop(loaded):
    limits = {**AUDIT, "restitution_margin": 0.05}
    report = verify(check_document(limited(loaded, **limits)), scenarios=1)
    assert not report.verdict and report.stop.fault == "restitution" and report.stop.contact == 1
    # Contacts that are not reached because of the stop have no separate line.
    assert len(report.reasons) == 1 and report.reasons[0] == f"closed loop: {report.stop.text}"
    assert [one.status for one in report.closed_loop] == ["ok", "not reached", "not reached"]
    assert verify(loaded, scenarios=1).stop is None


def test_bundle_reports_limits_that_stop_its_own_nominal_run(loaded):
    limits = {**AUDIT, "restitution_margin": 0.05}
    bundle = build_bundle(loaded.document, ["csv"], limits)
    assert bundle.stop.fault == "restitution" and bundle.stop.limit == "restitution_margin"
    again = build_bundle(loaded.document, ["csv"], {**limits, **bundle.passing})
    assert again.stop is None and again.passing is None and again.ended[0] is None


@pytest.mark.slow
def test_export_reports_the_limit_that_stopped_a_run_and_a_sufficient_value(loaded, tmp_path):
    path = tmp_path / "gains.json"
    result = export(_saved(path, loaded), tmp_path / "bundle", limits={"force_limit": 5.0})
    assert result.verdict == "bad" and result.document["stop"]["limit"] == "force_limit"
    (reason,) = [one for one in result.reasons if one.startswith("the nominal run is stopped at ")]
    assert "force_limit 5 N" in reason and "--set force_limit=" in reason


def _saved(path, loaded):
    from tuning.gain_file import write_gain_file

    write_gain_file(path, loaded.document)
    return path
