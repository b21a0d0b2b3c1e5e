"""Sensors at rest: noise, bias and quantum with their errors, colour, dead zone."""

import numpy as np
import pytest
from scipy.signal import lfilter

from tuning.identification.noise import at_rest, autoregression, steps


@pytest.mark.parametrize("quantum", (0.0, 0.5, 3.0, 8.0))
def test_noise_and_bias_are_within_their_errors_whatever_the_quantum(quantum):
    scores = []
    for seed in range(20):
        signal = 1.3 + 2.67 * np.random.default_rng(seed).standard_normal(3000)
        readings = quantum * np.round(signal / quantum) if quantum else signal
        found = at_rest(readings)
        assert found.quantum == pytest.approx(quantum, rel=1e-12)
        scores.append([(found.mean - 1.3) / found.mean_std, (found.std - 2.67) / found.std_std])
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    # Chi-squared of 20: 99.9 % are between 0.5 and 1.5; a rounded mean is a little less certain than stated.
    assert np.all(rms < 1.6) and np.all(rms > 0.5)


def test_the_noise_is_found_where_it_is_smaller_than_the_quantum():
    """Rounding alone would make 0.3 of a quantum into 0.42."""
    readings = 0.5 * np.round((0.21 + 0.15 * np.random.default_rng(0).standard_normal(20_000)) / 0.5)
    found = at_rest(readings)
    assert found.std == pytest.approx(0.15, rel=0.03) and found.mean == pytest.approx(0.21, abs=0.01)


def test_coloured_noise_is_whitened_and_its_mean_less_certain():
    rng, scores = np.random.default_rng(1), []
    for _ in range(20):
        drive = rng.standard_normal(6000) * np.sqrt(1.0 - 0.6**2)
        found = at_rest(0.5 * lfilter([1.0], [1.0, -0.6], drive)[1000:])
        scores.append([found.mean / found.mean_std, (found.std - 0.5) / found.std_std])
        assert found.pole == pytest.approx(0.6, abs=0.1)
        assert found.innovation == pytest.approx(0.5 * 0.8, rel=0.05)
    assert np.all(np.sqrt(np.mean(np.square(scores), axis=0)) < 1.6)
    assert autoregression(rng.standard_normal(5000)) == (1.0,)


def test_steps_are_the_readings_quantum_even_on_both_sides_of_a_dead_zone():
    force = 0.5 * np.round(20.0 * np.random.default_rng(0).standard_normal(4000))
    dead = np.sign(force) * np.maximum(0.0, np.abs(force) - 3.7)
    assert steps(force) == pytest.approx(0.5) and steps(dead) == pytest.approx(0.5)
    assert steps(np.random.default_rng(0).standard_normal(4000)) == 0.0
    assert steps(np.zeros(100)) == 0.0


def test_a_reading_that_is_exactly_zero_most_of_the_time_says_nothing_of_the_noise():
    signal = 0.5 * np.random.default_rng(0).standard_normal(1000)
    dead = np.sign(signal) * np.maximum(0.0, np.abs(signal) - 4.0)
    found = at_rest(dead)
    assert found.silent and found.std_std == np.inf and found.filter == (1.0,)
    assert not at_rest(signal).silent
