"""`jaxhil identify` on logs of a second simulator, which was written only from the user guide."""

from dataclasses import replace

import numpy as np
import pytest
from identify_study import evaluate, summarise
from independent_logs import KINDS, MIXTURE, write_campaign
from independent_prior import mechanism_file
from independent_rig import Rig, drive, ideal_restitution, restitution, touch
from independent_study import LIMIT, errors_of, evaluate_identification

CAMPAIGNS = 100  # number of campaigns of each kind in the study
WRONG = 0.01  # share of campaigns that may get a good verdict for a wrong file


def pass_on(force, position, velocity, measured):
    """Return the force command of a rig without compensation."""
    return force


def test_independent_simulator_has_ideal_restitution_of_damped_springs():
    rig = Rig(mass=300.0, stiffness=1.1e5)
    assert ideal_restitution(rig, 0.005) == pytest.approx(1, abs=1e-6)
    critical = 2 * np.sqrt(rig.stiffness * rig.mass)
    damped = Rig(mass=300.0, stiffness=1.1e5, damping=0.05 * critical)
    assert ideal_restitution(damped, 0.005) == pytest.approx(0.858758, abs=1e-5)


def test_independent_simulator_without_delays_conserves_energy():
    # A moving average over a very short time is a drive without lag.
    rig = Rig(period=0.0005, mass=300.0, stiffness=1.1e5, window=1e-9)
    real, *_ = touch(rig, np.array([-0.001]), np.array([0.005]), pass_on, 1200)[:, :, 0]
    duration = np.count_nonzero(real) * rig.period
    assert duration == pytest.approx(np.pi * np.sqrt(rig.mass / rig.stiffness), abs=2 * rig.period)
    assert restitution(rig, 0.005, pass_on) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(
    ("phase", "expected"), [pytest.param(0.1, 1.169561985550, marks=pytest.mark.slow), (0.4, 1.827809059189)]
)
def test_independent_simulator_gains_energy_from_force_delay(phase, expected):
    rig = Rig(period=0.00025, mass=300.0, stiffness=1.1e5, window=1e-9)
    delay = phase * np.sqrt(rig.mass / rig.stiffness)
    late = Rig(period=0.00025, mass=300.0, stiffness=1.1e5, window=1e-9, force_delay=delay)
    assert restitution(late, 0.005, pass_on) == pytest.approx(expected, rel=1e-3)


def test_independent_simulator_loses_energy_by_friction():
    rig = Rig(mass=300.0, stiffness=1.1e5, friction=2.0)
    omega, speed, offset = np.sqrt(rig.stiffness / rig.mass), 0.005, rig.friction / rig.stiffness
    depth = np.hypot(offset, speed / omega) - offset
    # Friction changes its sign at the deepest point; the force ends at the depth `offset`.
    assert ideal_restitution(rig, speed) == pytest.approx(omega * (depth - offset) / speed, abs=1e-4)


def test_independent_simulator_with_stiff_structure_equals_rigid_rig():
    rig = Rig(damping=400.0, drive_delay=0.002, force_delay=0.002)
    soft, stiff = replace(rig, mode=40.0), replace(rig, mode=400.0)
    assert ideal_restitution(stiff, 0.005) == pytest.approx(ideal_restitution(rig, 0.005), abs=1e-3)
    assert restitution(stiff, 0.005, pass_on) == pytest.approx(restitution(rig, 0.005, pass_on), abs=1e-3)
    assert abs(ideal_restitution(soft, 0.005) - ideal_restitution(rig, 0.005)) > 2e-3


def _second_order(frequency):
    ratio = frequency / 12.0
    return 1 / (1 - ratio**2 + 2j * 0.7 * ratio)


@pytest.mark.parametrize(
    ("window", "response"),
    [(0.0, _second_order), (0.04, lambda f: np.sinc(0.04 * f) * np.exp(-1j * np.pi * f * 0.04))],
)
def test_independent_simulator_drive_has_response_of_its_transfer_function(window, response):
    rig = Rig(frequency=12.0, ratio=0.7, window=window, drive_delay=0.0043, position_delay=0.0006)
    time = np.arange(4000) * rig.period
    omega = 2 * np.pi * 7.0
    *_, position = drive(rig, np.sin(omega * time))
    late = response(7.0) * np.exp(1j * omega * (time - 0.0049))
    assert position[2000:] == pytest.approx(np.imag(late)[2000:], abs=1e-3)


@pytest.mark.slow
def test_independent_study_finds_no_error_in_true_mechanism_file_and_large_error_in_prior(tmp_path):
    campaign = write_campaign("plain", 0, tmp_path)
    rig, file = campaign.rig, tmp_path / "truth.toml"
    text = mechanism_file(rig, campaign.speed, KINDS["plain"], np.ones(6))
    file.write_text(f"{text}\nrig.contact_plane = {rig.plane}\n")
    e, error, difference = errors_of(file, campaign)
    assert 0.3 < e < 1.5
    assert (error, difference) == pytest.approx((0, 0), abs=1e-5)
    _, error, difference = errors_of(campaign.prior, campaign)
    assert max(abs(error), abs(difference)) > LIMIT


@pytest.mark.slow
def test_identify_verdict_is_good_for_campaign_of_independent_simulator(tmp_path):
    outcome = evaluate_identification("plain", 4, tmp_path)
    assert (outcome.verdict, outcome.check, outcome.wrong, outcome.trouble) == ("good", "good", False, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed", "word"),
    [
        ("cut_dead_zone", 6050, "dead zone"),
        ("resampled_force", 6004, "interpolated"),
        ("butterworth_4", 8034, "with a filter of order"),
        ("butterworth_2", 8033, "with a filter of order"),
        ("butterworth_2", 9832, "with a filter of order"),
        ("butterworth_2_and_dead_zone", 12000, "with a filter of order"),
        ("butterworth_2_and_low_damping", 15000, "uncertain"),
        ("cut_dead_zone", 9845, "dead zone"),
    ],
)
def test_identify_names_defect_of_sensor_that_residuals_hardly_show(kind, seed, word, tmp_path):
    outcome = evaluate_identification(kind, seed, tmp_path)
    assert (outcome.verdict, outcome.check) == ("bad", "bad") and word in outcome.message


@pytest.mark.slow
@pytest.mark.parametrize("kind", (*KINDS, MIXTURE))
def test_identify_on_independent_simulator_never_calls_inaccurate_file_good(kind):
    outcomes = [evaluate(kind, seed) for seed in range(CAMPAIGNS)]
    print(summarise(kind, outcomes))
    assert not [outcome for outcome in outcomes if outcome.trouble]
    wrong = [outcome for outcome in outcomes if outcome.verdict == "good" and outcome.wrong]
    assert len(wrong) <= WRONG * CAMPAIGNS, wrong
