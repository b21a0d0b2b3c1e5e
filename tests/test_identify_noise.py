"""Sensors at rest: noise, bias and resolution with standard errors, coloured noise, dead zone."""

import numpy as np
import pytest
from scipy.signal import lfilter

from tuning.identification.estimates import make_estimates
from tuning.identification.logs.contact_detection import detect_contacts
from tuning.identification.noise import (
    detect_quantum,
    estimate_noise,
    fit_whitening_filter,
    recognise_noise_free_readings,
)


@pytest.mark.parametrize("quantum", (0.0, 0.5, 3.0, 8.0))
def test_noise_and_bias_at_rest_lie_within_stated_errors_for_any_resolution(quantum):
    scores = []
    for seed in range(20):
        signal = 1.3 + 2.67 * np.random.default_rng(seed).standard_normal(3000)
        readings = quantum * np.round(signal / quantum) if quantum else signal
        result = estimate_noise(readings)
        assert result.quantum == pytest.approx(quantum, rel=1e-12)
        scores.append([(result.mean - 1.3) / result.mean_std, (result.std - 2.67) / result.std_std])
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    # With 20 degrees of freedom, 99.9 % of the ratios are between 0.5 and 1.5; rounding adds to the error of
    # the mean.
    assert np.all(rms < 1.6) and np.all(rms > 0.5)


def test_noise_smaller_than_sensor_resolution_is_estimated_at_rest():
    """Without a correction, a standard deviation of 0.3 quantisation steps would be estimated as 0.42."""
    readings = 0.5 * np.round((0.21 + 0.15 * np.random.default_rng(0).standard_normal(20_000)) / 0.5)
    result = estimate_noise(readings)
    assert result.std == pytest.approx(0.15, rel=0.03) and result.mean == pytest.approx(0.21, abs=0.01)


def test_coloured_noise_at_rest_is_whitened():
    rng, scores = np.random.default_rng(1), []
    for _ in range(20):
        drive = rng.standard_normal(6000) * np.sqrt(1.0 - 0.6**2)
        result = estimate_noise(0.5 * lfilter([1.0], [1.0, -0.6], drive)[1000:])
        scores.append([result.mean / result.mean_std, (result.std - 0.5) / result.std_std])
        assert result.pole == pytest.approx(0.6, abs=0.1)
        assert result.innovation == pytest.approx(0.5 * 0.8, rel=0.05)
    assert np.all(np.sqrt(np.mean(np.square(scores), axis=0)) < 1.6)
    assert fit_whitening_filter(rng.standard_normal(5000)) == (1.0,)


def test_sensor_resolution_is_detected_with_and_without_dead_zone():
    force = 0.5 * np.round(20.0 * np.random.default_rng(0).standard_normal(4000))
    dead = np.sign(force) * np.maximum(0.0, np.abs(force) - 3.7)
    assert detect_quantum(force) == pytest.approx(0.5) and detect_quantum(dead) == pytest.approx(0.5)
    assert detect_quantum(np.random.default_rng(0).standard_normal(4000)) == 0.0
    assert detect_quantum(np.zeros(100)) == 0.0


def test_noise_at_rest_is_unknown_for_mostly_zero_readings():
    signal = 0.5 * np.random.default_rng(0).standard_normal(1000)
    dead = np.sign(signal) * np.maximum(0.0, np.abs(signal) - 4.0)
    result = estimate_noise(dead)
    assert result.silent and result.std_std == np.inf and result.filter == (1.0,)
    assert not estimate_noise(signal).silent


def test_single_reading_beyond_dead_zone_shows_no_rounding_but_many_equal_ones_do():
    readings = np.zeros(2500)
    readings[1000] = -2.0
    result = estimate_noise(readings)
    assert result.silent and result.quantum == 0.0
    readings[::20] = -2.0
    assert estimate_noise(readings).quantum == 2.0


@pytest.mark.parametrize(("quantum", "noise"), [(0.0, 0.0), (0.1, 0.0), (0.0, 0.3), (0.1, 0.3)])
def test_readings_in_contact_distinguish_missing_noise_from_dead_zone(quantum, noise):
    force = 80.0 * np.sin(np.linspace(0.0, np.pi, 200)) + noise * np.random.default_rng(0).normal(size=200)
    contacts = [quantum * np.round(force / quantum) if quantum else force] * 9
    constant = estimate_noise(np.full(1000, 0.1))
    assert (constant.std, constant.filter, constant.silent) == (0.0, (1.0,), False)
    result = recognise_noise_free_readings(estimate_noise(np.zeros(1000)), contacts)
    assert result.silent == (noise > 0.0)
    assert noise > 0.0 or (result.quantum == pytest.approx(quantum) and 0.0 < result.mean_std < 0.05)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.04, 0.3, 1.0])
@pytest.mark.parametrize("key", ["contact.damping.0", "rig.force_sensor.delay", "contact.stiffness.0"])
def test_interval_includes_estimate_for_draws_that_accumulate_at_zero(share, key):
    rng = np.random.default_rng(0)
    damping = np.where(rng.uniform(size=1000) < share, rng.exponential(size=1000), 0.0)
    draws = {"contact.damping.0": damping}
    draws[key] = damping**3
    for estimate in make_estimates(draws, None, None, None, None, {}):
        assert estimate.low <= estimate.value <= estimate.high


@pytest.mark.parametrize("peak", [0.0, 15.0, 40.0, 400.0])
def test_contact_of_small_force_is_detected_in_noise(peak):
    force = 1.0 + 2.7 * np.random.default_rng(4).standard_normal(420)
    force[100:220] += peak * np.sin(np.linspace(0.0, np.pi, 120))
    force[::50] = np.nan
    contacts = detect_contacts(force, 0.001)
    assert len(contacts) == (peak > 0.0)
    assert all(abs(first - 100) < 30 and abs(last - 220) < 30 for first, last in contacts)


def test_weak_contact_near_the_beginning_of_a_short_log_is_detected():
    force = 2.7 * np.random.default_rng(4).standard_normal(273)
    force[65:120] += 35.0 * np.sin(np.linspace(0.0, np.pi, 55))
    ((first, last),) = detect_contacts(force, 0.004)
    assert abs(first - 65) < 12 and abs(last - 120) < 12
