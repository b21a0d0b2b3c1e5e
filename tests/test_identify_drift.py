"""Identification of rigs whose force sensor has a random walk of its bias."""

from dataclasses import replace

import campaign_kinds
import campaigns
import numpy as np
import pytest
from independent_study import evaluate_identification
from scipy.signal import lfilter

from tuning.identification.drifting_noise import (
    LONG_FILTER,
    estimate_drifting_noise,
    estimate_force_noise,
    subtract_weighted_mean,
)
from tuning.identification.identify import IdentificationOptions, identify

PERIOD, NOISE, WALK, BIAS = 1e-3, 0.3, 0.7, 0.2


def rest(seed, walk=WALK, number=5000):
    """Return readings at rest."""
    random = np.random.default_rng(seed)
    steps = walk * PERIOD**0.5 * random.normal(size=number)
    steps[0] = 0.0
    return BIAS + np.cumsum(steps) + NOISE * random.normal(size=number)


def test_noise_at_rest_separates_random_walk_from_white_noise():
    estimates = [estimate_drifting_noise(rest(seed), PERIOD, 1.3 * WALK) for seed in range(20)]
    walks = np.array([noise.walk for noise in estimates])
    z = (walks[:, 0] - WALK) / walks[:, 1]
    assert abs(z.mean()) < 4 / 20**0.5 and 0.5 < z.std() < 1.6
    stds = [noise.std for noise in estimates]
    assert np.mean(stds) == pytest.approx(NOISE, rel=5 / (2 * 5000 * 20) ** 0.5)
    biases = np.array([(noise.mean - BIAS) / noise.mean_std for noise in estimates])
    assert abs(biases.mean()) < 4 / 20**0.5 and 0.5 < biases.std() < 1.6


def test_filter_of_drifting_noise_whitens_readings_and_removes_bias():
    readings = rest(3, number=40_000)
    noise = estimate_drifting_noise(readings, PERIOD, WALK)
    assert len(noise.filter) > LONG_FILTER and abs(sum(noise.filter)) < 0.006
    expected = np.asarray(lfilter(noise.filter, [1.0], readings))
    white = subtract_weighted_mean(readings, noise.filter)
    np.testing.assert_allclose(white, expected, rtol=0, atol=1e-12)
    white = white[len(noise.filter) :]
    assert white.std() == pytest.approx(noise.innovation, rel=0.02)
    for lag in (1, 10, 50):
        assert abs(np.mean(white[lag:] * white[:-lag])) < 5 * white.var() / len(white) ** 0.5


def test_filter_of_drifting_noise_skips_lost_readings():
    readings, random = rest(3, number=40_000), np.random.default_rng(0)
    noise = estimate_drifting_noise(readings, PERIOD, WALK)
    lost = random.random(len(readings)) < 0.03
    white = subtract_weighted_mean(np.where(lost, 1e6, readings), noise.filter, lost)
    assert np.all(white[lost] == 0.0)
    white = white[~lost][len(noise.filter) :]
    assert white.std() == pytest.approx(noise.innovation, rel=0.02)
    for lag in (1, 10, 50):
        assert abs(np.mean(white[lag:] * white[:-lag])) < 5 * white.var() / len(white) ** 0.5
    lanes = np.stack([lost, np.zeros_like(lost)])
    both = subtract_weighted_mean(np.stack([readings, readings]), noise.filter, lanes)
    np.testing.assert_array_equal(both[0], subtract_weighted_mean(readings, noise.filter, lost))
    np.testing.assert_array_equal(both[1], subtract_weighted_mean(readings, noise.filter))


def test_readings_without_noise_have_no_random_walk():
    noise = estimate_drifting_noise(np.full(500, 0.2), PERIOD, WALK)
    assert (noise.mean, noise.std, noise.walk, noise.bias_step) == (0.2, 0.0, None, 0.0)


def test_random_walk_that_is_not_stated_is_estimated_from_readings_at_rest():
    for seed in range(5):
        walk, error = estimate_force_noise(rest(seed), PERIOD, 0.0).walk
        assert abs(walk - WALK) < 4 * error


@pytest.mark.parametrize("noise", ["white", "30 Hz", "linear drift", "small walk"])
def test_other_noise_is_not_taken_for_random_walk(noise):
    for seed in range(5):
        readings = rest(seed, walk=0.05 if noise == "small walk" else 0.0)
        if noise == "30 Hz":
            pole = np.exp(-2 * np.pi * 30 * PERIOD)
            white = np.random.default_rng(seed + 5).normal(size=len(readings))
            readings += np.asarray(lfilter([2 * np.sqrt(1 - pole**2)], [1, -pole], white))
        elif noise == "linear drift":
            readings += np.linspace(0.0, 2.0, len(readings))
        assert estimate_force_noise(readings, PERIOD, 0.0).walk is None


def test_readings_that_begin_late_have_no_random_walk():
    readings = np.where(np.arange(5000) < 100, 0.0, 0.2)
    assert estimate_force_noise(readings, PERIOD, 0.0).walk is None


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bias_walk_stated", "bias_walk"])
@pytest.mark.parametrize("seed", [8000, 8001])
def test_identify_verdict_is_good_for_campaign_with_random_walk(kind, seed, tmp_path):
    """The seed 8001 has a press run, in which the bias drifts by several newtons."""
    outcome = evaluate_identification(kind, seed, tmp_path)
    assert (outcome.verdict, outcome.check, outcome.wrong, outcome.trouble) == ("good", "good", False, "")
    assert "random walk of 0." in outcome.message


def test_identify_uses_contacts_with_random_walk_and_lost_rows(monkeypatch):
    """Its filter combines 200 readings; one of 30 is lost."""
    kind = campaign_kinds.Kind(campaign_kinds.rig(), campaign_kinds.voigt(), lost=0.03)
    monkeypatch.setitem(campaigns.KINDS, "lossy", kind)
    campaign = campaigns.campaign("lossy", 0, seconds=10.0)
    rng, runs = np.random.default_rng(0), []
    for run in campaign.runs:
        if run.force_measured is not None:
            walk = WALK * PERIOD**0.5 * np.cumsum(rng.normal(size=len(run.tick)))
            run = replace(run, force_measured=run.force_measured + walk)
        runs.append(run)
    campaign = replace(campaign, runs=tuple(runs))
    result = identify(campaign, options=IdentificationOptions(law="kelvin_voigt", hold_out=0.0))
    assert any("random walk" in note for note in result.notes)
    assert result.contact.degrees_of_freedom > 0.3 * sum(run.valid.sum() for run in runs[2:])
    for key, true in (("contact.damping.0", 650.0), ("rig.force_sensor.delay", 0.0037)):
        assert abs(result[key].value - true) < 3.5 * result[key].std
