"""Verification that runtime and simulation agree: agreement passes, differences are reported."""

import jax
import msgspec
import numpy as np
import pytest

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Signals
from jaxhil.mechanism.file import load
from jaxhil.rig import COMPENSATORS as ON_THE_RIG
from jaxhil.rig import Controller
from jaxhil.rig.gain_file import GainFile, check_gain_document
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.recording import LaneRecord, nominal_and_draws, record_lanes
from tuning.gain_file import build_document
from tuning.verification.runtime_replay import (
    compute_runtime_commands,
    find_threshold_ticks,
    replay_lane,
    verify,
)

pytestmark = pytest.mark.users_options


def loaded_gains(mechanism_name, compensator, overrides=(), **changes):
    mechanism, sha256, _ = load(mechanism_name, overrides)
    gains = {gain.name: gain.nominal(mechanism) for gain in COMPENSATORS[compensator].gains}
    gains.update(changes)
    return check_document(build_document(compensator, gains, mechanism, sha256, {}, {}, 0, {}))


# Noisy, biased rig with coarse readings; the simulation has no force on the first tick.
ROUGH = (
    "rig.force_sensor.noise_std=0.5",
    "rig.force_sensor.bias=0.3",
    "rig.force_sensor.quantum=0.25",
    "rig.position_sensor.quantum=1e-6",
    "rig.command_latency=1",
    "approach.contacts=2",
)
CASES = {
    "varying": ("varying", "response_error", ()),
    "rattling": ("rattling", "none", ("approach.contacts=2",)),
    "rough": ("claw-350kg", "phase_lead", ROUGH),
}


@pytest.fixture(scope="module")
def varying():
    return loaded_gains(*CASES["varying"])


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow if case == "rattling" else ()) for case in CASES]
)
def test_verification_passes_if_controllers_agree(case):
    loaded = loaded_gains(*CASES[case])
    messages = []
    report = verify(loaded, scenarios=4, seed=1, progress=messages.append)
    assert report.verdict and report.reasons == (), report.reasons
    assert len(report.replay) == 4 and len(messages) == 3
    for lane in report.replay:
        assert lane.status == "ok" and lane.compared == lane.ticks > 150 and lane.command_range > 1
        assert lane.difference <= 1e-13
    assert len(report.closed_loop) == loaded.mechanism.approach.contacts
    for contact in report.closed_loop:
        assert contact.status == contact.simulated_status == "ok"
        assert contact.restitution is not None and contact.simulated_restitution is not None
        assert abs(contact.restitution - contact.simulated_restitution) <= 1e-12
    assert report.closed_loop[0].restitution != 1.0
    assert msgspec.convert(msgspec.json.decode(msgspec.json.encode(report)), type(report)) == report


def test_record_for_verification_equals_rollout(varying):
    batch = nominal_and_draws(varying.mechanism, 4, seed=1)
    metrics, lanes = record_lanes(varying, batch)
    assert np.all(metrics.status[:3] == OK)
    peaks = [np.max(np.abs(lane.command)) for lane in lanes]
    np.testing.assert_allclose(peaks, np.max(metrics.peak_command[:3], axis=0), rtol=1e-12)
    runs = [int(np.sum(lane.signals.age == 0)) for lane in lanes]
    assert runs == [3, 3, 3, 3]


def test_verification_with_the_same_seed_gives_the_same_report(varying):
    assert verify(varying, 4, seed=1) == verify(varying, 4, seed=1)


class Late(ON_THE_RIG["response_error"]):
    """Runtime that loses its identified parameters when the next contact begins."""

    def next_contact(self):
        self.reset()


class Loose(ON_THE_RIG["response_error"]):
    """Runtime that rounds to single precision."""

    def step(self, *signals):
        return float(np.float32(super().step(*signals)))


class Leading(ON_THE_RIG["response_error"]):
    """Runtime that commands a position ahead of the numerical model."""

    def position_command(self, position, velocity, acceleration):
        return position + 1e-6 * velocity


class Failing(ON_THE_RIG["response_error"]):
    """Runtime that divides by zero at high force."""

    def step(self, force, *others):
        return super().step(force / (force < 20.0), *others)


@pytest.mark.parametrize(
    ("runtime", "start"),
    [
        (Late, "the nominal run, tick "),
        (Loose, "the nominal run, tick "),
        (Leading, "the nominal run: position commands differ by "),
        (Failing, "the nominal run: the runtime's controller tripped: command_not_finite"),
    ],
)
def test_verification_reports_a_wrong_runtime(varying, monkeypatch, runtime, start):
    monkeypatch.setitem(ON_THE_RIG, "response_error", runtime)
    report = verify(varying, 4, seed=1)
    assert not report.verdict
    assert report.reasons[0].startswith(start), report.reasons
    assert all(reason.isprintable() for reason in report.reasons)
    if runtime is Loose:
        assert "of the command's range" in report.reasons[0] and report.reasons[0].endswith("1e-11 or less")
        worst = report.replay[0]
        assert 1e-9 < worst.difference < 1e-7 and worst.found != worst.expected
    if runtime is Failing:
        assert report.stop is not None and report.stop.contact == 1 and report.stop.limit is None
        assert f"closed loop: {report.stop.text}" in report.reasons
        assert "by the guard's check command_not_finite: the compensated force is not a" in report.stop.text
    if runtime is Leading:
        assert all(lane.difference <= 1e-13 for lane in report.replay)
        in_the_loop = [one for one in report.reasons if one.startswith("closed loop, contact 1: restitution")]
        assert len(in_the_loop) == 1 and in_the_loop[0].endswith("1e-09 or less")


def test_verification_rejects_single_precision(varying):
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="jax_enable_x64"):
        verify(varying)


def lane_of(measured, force, gain_file):
    """Return a lane with the runtime's own commands for these readings."""
    ticks = len(measured)
    signals = Signals(
        np.array(force, float),
        np.linspace(-1e-3, 1e-3, ticks),
        np.full(ticks, 5e-3),
        np.array(measured, float),
        np.arange(ticks, dtype=np.int32),
    )
    lane = LaneRecord(signals, np.zeros(ticks), None, False)
    command, _, stiffness, damping = compute_runtime_commands(Controller(gain_file), lane)
    return lane._replace(command=command, identified=(stiffness, damping))


@pytest.fixture
def gain_file(varying):
    file = check_gain_document(varying.document)
    gains = {**file.gains, "identification_delay": 0.002, "contact_threshold": 10.0}
    return file._replace(gains=gains)


def test_verification_reports_number_of_ticks_near_a_threshold(gain_file):
    measured = np.arange(-20, 20) * 5e-6
    measured[20] = 3e-18  # instead of 0: in contact by less than rounding
    force = np.where(measured > 0, 1e5 * measured, 0.0)
    force[30] = 10.0 * (1 + 1e-12)
    force[3] = 10.0  # not in contact, so this force affects no decision
    lane = lane_of(measured, force, gain_file)
    assert np.nonzero(find_threshold_ticks(lane.signals, gain_file))[0].tolist() == [22, 30]
    seen = replay_lane(lane, gain_file)
    assert (seen.ticks, seen.compared, seen.near, seen.parted) == (40, 40, 2, None)
    assert seen.difference == seen.near_difference == 0.0
    # Second surface at -9e-5 m: the force of tick 3 and the position of tick 4 affect decisions.
    two_sided = gain_file._replace(clearance=9e-5)
    assert np.nonzero(find_threshold_ticks(lane.signals, two_sided))[0].tolist() == [3, 4, 22, 30]


def test_verification_comparison_ends_at_first_different_threshold_decision(gain_file):
    measured = np.arange(-20, 20) * 5e-6
    measured[20:23] = -3e-18, 3e-18, 6e-18  # at rest on the surface, where rounding decides
    force = np.where(np.arange(40) > 17, 50.0, 0.0)
    lane = lane_of(measured, force, gain_file)
    # The other controller considered the second of these ticks out of contact.
    measured[21] = -3e-18
    other = lane_of(measured, force, gain_file)
    parted = replay_lane(lane._replace(command=other.command, identified=other.identified), gain_file)
    assert (parted.parted, parted.compared, parted.ticks, parted.near) == (23, 23, 40, 3)
    assert parted.difference <= 1e-13


def test_verification_ignores_onset_that_differs_by_rounding(gain_file):
    measured = np.arange(-20, 20) * 5e-6
    measured[20] = 3e-18
    force = np.where(np.arange(40) > 17, 50.0, 0.0)
    lane = lane_of(measured, force, gain_file)
    measured[20] = -3e-18
    other = lane_of(measured, force, gain_file)
    seen = replay_lane(lane._replace(command=other.command, identified=other.identified), gain_file)
    assert (seen.parted, seen.compared, seen.near) == (None, 40, 1)
    assert seen.difference <= 1e-11 and seen.near_difference <= 1e-11


def test_verification_reports_differences_away_from_thresholds(gain_file):
    measured = np.arange(-20, 20) * 5e-6
    measured[20] = 3e-18
    lane = lane_of(measured, np.where(np.arange(40) > 17, 50.0, 0.0), gain_file)
    command = lane.command.copy()
    command[19:] += 1e-9 * np.ptp(command)
    seen = replay_lane(lane._replace(command=command), gain_file)
    assert seen.parted is None and seen.compared == 40
    assert seen.difference == pytest.approx(1e-9, rel=1e-3) and seen.worst_tick >= 19


def test_verification_of_zero_commands_requires_exact_equality():
    ticks = np.zeros(5)
    signals = Signals(ticks, ticks, ticks, ticks, np.arange(5, dtype=np.int32))
    gain_file = GainFile("none", {}, 0.001, np.inf)
    assert replay_lane(LaneRecord(signals, ticks, None, False), gain_file).difference == 0.0
    signals = signals._replace(force_measured=ticks + 1e-300)
    assert replay_lane(LaneRecord(signals, ticks, None, False), gain_file).difference == np.inf
