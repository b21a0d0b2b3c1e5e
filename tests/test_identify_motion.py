"""Motion simulator from free motion: spectra, hold, orders, and errors relative to Cramer-Rao bounds."""

from dataclasses import replace

import campaigns
import numpy as np
import pytest

from tuning.identification import free_motion, frf, hold, rational
from tuning.identification.motion import MotionResponse
from tuning.identification.moving_average_model import MOVING_AVERAGE
from tuning.identification.rational import STRUCTURES, MotionModel, SpectralLines, fit_structure
from tuning.identification.structure_choice import choose_structure

BY_NAME = {structure.name: structure for structure in STRUCTURES}
SECOND = MotionModel(BY_NAME["second_order"], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))
THIRD = MotionModel(BY_NAME["third_order"], np.array([np.log(0.008), np.log(110.0), np.log(0.5), 0.0031]))
AVERAGE = MOVING_AVERAGE.make_model(np.array([np.log(0.0373), 0.0043]))


def lines_of(model, hold="linear", latency=0, period=0.001, shift=0, std=5e-7):
    """Return exact spectra at 85 lines up to 45 Hz."""
    frequency = np.delete(np.arange(1, 226, 2), np.s_[3::4]) / 5.0
    rng = np.random.default_rng(0)
    command = 1e-4 * np.exp(2j * np.pi * rng.uniform(size=len(frequency)))
    empty = SpectralLines(
        frequency, command, command, np.full(len(frequency), std), period, hold, latency, shift
    )
    return SpectralLines(frequency, command, model.predict(empty), empty.std, period, hold, latency, shift)


@pytest.mark.parametrize("name", ("clean", "third_order", "resonance"))
def test_motion_model_matches_exactly_sampled_simulator(name):
    kind = campaigns.KINDS[name]
    T = kind.rig["control_period"]
    wave = campaigns.multisine(T)
    plant = campaigns.Plant(kind.rig)
    command = np.tile(wave, 3)
    response = campaigns._position(plant, command, kind.rig["simulator"]["delay"] / T)[-len(wave) :]
    U, Y = np.fft.rfft(wave), np.fft.rfft(response)
    number = np.flatnonzero(np.abs(U) > 1e-6 * np.abs(U).max())
    hold_of = kind.rig.get("command_hold", "linear"), kind.rig.get("command_latency", 0)
    lines = SpectralLines(number / (len(wave) * T), U[number], Y[number], np.ones(len(number)), T, *hold_of)
    result = fit_structure(BY_NAME[{"clean": "second_order"}.get(name, name)], lines)
    np.testing.assert_allclose(result.model.predict(lines), Y[number], rtol=2e-6)
    assert result.model.delay == pytest.approx(kind.rig["simulator"]["delay"], abs=2e-9)
    if name == "clean":
        np.testing.assert_allclose(np.exp(result.model.parameters[:2]), [2 * np.pi * 12.0, 0.8], rtol=1e-6)


@pytest.mark.parametrize("kind, latency, shift, periods", (
    ("linear", 0, 0, 0.0), ("zoh", 0, 0, -0.5), ("zoh", 1, 0, 0.5), ("linear", 1, 1, 2.0),
    ("linear", 0, -1, -1.0),
))  # fmt: skip
def test_command_hold_response_is_a_delay_of_whole_and_half_periods(kind, latency, shift, periods):
    frequency = np.array([0.1, 1.0, 10.0])
    response = hold.compute_hold_response(frequency, 0.002, kind, latency, shift)
    np.testing.assert_allclose(np.angle(response), -2.0 * np.pi * frequency * periods * 0.002, atol=1e-12)
    assert np.all(np.diff(np.abs(response)) < 0.0) and abs(response[0]) > 0.9999


@pytest.mark.parametrize("model", (SECOND, THIRD, AVERAGE), ids=("second", "third", "average"))
def test_motion_model_derivatives_match_finite_differences(model):
    s = 2j * np.pi * np.array([0.3, 3.0, 30.0])
    for i, slope in enumerate(model.slopes(s)):
        step = np.zeros(len(model.parameters))
        step[i] = 1e-6
        up, down = (
            np.log(model.structure.make_model(model.parameters + d).response(s)) for d in (step, -step)
        )
        np.testing.assert_allclose(slope, (up - down) / 2e-6, rtol=1e-6, atol=1e-8)


def test_motion_model_bandwidth_matches_closed_form():
    zeta = 0.8
    ratio = np.sqrt(1.0 - 2.0 * zeta**2 + np.sqrt((1.0 - 2.0 * zeta**2) ** 2 + 1.0))
    assert SECOND.bandwidth() == pytest.approx(12.0 * ratio, rel=1e-9)
    assert MotionModel(BY_NAME["ideal"], np.array([0.01])).bandwidth() == np.inf
    assert abs(AVERAGE.response(2j * np.pi * AVERAGE.bandwidth())) == pytest.approx(np.sqrt(0.5), rel=1e-6)


@pytest.mark.parametrize("hold_name", ("linear", "zoh"))
def test_window_of_moving_average_is_fitted_to_spectra(hold_name):
    lines = lines_of(AVERAGE, hold_name)
    for structure in (MOVING_AVERAGE, BY_NAME["second_order"]):
        result = fit_structure(structure, lines)
        explains = structure is MOVING_AVERAGE
        assert (result.chi2 < 1e-6) == explains
        assert not explains or result.model.parameters == pytest.approx(AVERAGE.parameters, rel=1e-9)


@pytest.mark.parametrize("hold_name", ("linear", "zoh"))
def test_motion_of_moving_average_is_the_mean_of_the_delayed_command(hold_name):
    campaign = campaigns.campaign("clean", 0, speeds=(0.006,), seconds=0, rest=0)
    (run,), delay, period = campaign.runs, 0.0031, campaign.timing.control_period
    motion = MotionResponse(AVERAGE, [run], replace(campaign.timing, command_hold=hold_name), 0.02)
    command, ticks = run.position_desired, np.arange(-100, len(run.position_desired))
    command = np.append(command[0] + (command[1] - command[0]) * ticks[:100], command)
    rows = np.arange(0, len(run.tick), 20)
    age = AVERAGE.delay + delay + AVERAGE.window * (np.arange(20_000) + 0.5) / 20_000
    times = rows[:, None] - age / period
    held_command = command[np.ceil(times).astype(int) + 100]
    values = held_command if hold_name == "zoh" else np.interp(times, ticks, command)
    position, velocity = motion.at(delay)
    np.testing.assert_allclose(position[rows, 0], values.mean(axis=1), rtol=0.0, atol=1e-9)
    later = (motion.at(delay - 1e-6)[0] - motion.at(delay + 1e-6)[0]) / 2e-6
    np.testing.assert_allclose(velocity[rows], later[rows], rtol=0.0, atol=2e-6)


@pytest.mark.parametrize("name", ("ideal", "first_order", "second_order", "third_order"))
def test_motion_model_selection_takes_lowest_order_that_explains_the_data(name):
    numbers = {"ideal": [], "first_order": [np.log(0.022)], "second_order": [np.log(75.0), np.log(0.8)],
               "third_order": [np.log(0.008), np.log(110.0), np.log(0.5)]}[name]  # fmt: skip
    exact = lines_of(MotionModel(BY_NAME[name], np.array([*numbers, 0.0044])))
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((2, len(exact))) * exact.std / np.sqrt(2.0)
    noisy = SpectralLines(
        exact.frequency, exact.command, exact.output + noise[0] + 1j * noise[1], exact.std, 0.001, "linear", 0
    )
    chosen, candidates = choose_structure(noisy)
    assert chosen.fit.model.structure.name == name
    assert chosen.fit.chi2 / chosen.fit.degrees_of_freedom == pytest.approx(1.0, abs=0.35)
    for larger in candidates:
        assert larger.fault or larger.criterion > chosen.criterion - 2.0


def errors(repeats):
    """Return normalised errors of frequency, damping ratio and delay, and the coverage of their intervals."""
    kind, T, scores = campaigns.KINDS["clean"], 0.001, []
    wave = campaigns.multisine(T)
    steady = campaigns._position(campaigns.Plant(kind.rig), np.tile(wave, 2), 4.3)[-len(wave) :]
    shape = 11, len(wave)
    for seed in range(repeats):
        noisy = steady + 5e-6 * np.random.default_rng(seed).standard_normal(shape)
        spectrum = frf.average_periods(np.broadcast_to(wave, shape), noisy, np.ones(shape, bool), T)
        lines = SpectralLines(
            spectrum.frequency, spectrum.command, spectrum.output, spectrum.std, T, "linear", 0
        )
        best = fit_structure(SECOND.structure, lines)
        scores.append((best.model.parameters - SECOND.parameters) / best.std)
    return np.sqrt(np.mean(np.square(scores), axis=0)), np.mean(np.abs(scores) < 1.96, axis=0)


def test_motion_fit_errors_reach_cramer_rao_bound():
    ratio, covered = errors(30)
    # The rms of 30 standard normal draws is below 1.4 in 999 of 1000 cases.
    assert np.all(ratio < 1.4) and np.all(ratio > 0.6) and np.all(covered > 0.8)


@pytest.mark.slow
def test_motion_fit_errors_reach_cramer_rao_bound_over_400_repeats():
    ratio, covered = errors(400)
    print("rms error / bound", ratio, "covered", covered)
    assert np.all(ratio < 1.1) and np.all(np.abs(covered - 0.95) < 0.03)


def test_local_polynomial_spectrum_estimates_response_from_chirp():
    kind, T = campaigns.KINDS["clean"], 0.001
    time = np.arange(20_000) * T
    command = 1e-3 * np.sin(2.0 * np.pi * (0.3 * time + (20.0 - 0.3) * time**2 / (2.0 * time[-1])))
    actual = campaigns._position(campaigns.Plant(kind.rig), command, 4.3)
    noisy = actual + 1e-6 * np.random.default_rng(0).standard_normal(len(actual))
    spectrum = frf.compute_spectrum(command, noisy, np.ones(len(command), bool), T, 500)
    assert spectrum.periods == 0 and spectrum.frequency.min() < 3.0 and spectrum.frequency.max() > 17.0
    lines = SpectralLines(spectrum.frequency, spectrum.command, spectrum.output, spectrum.std, T, "linear", 0)
    assert np.sqrt(np.mean(np.abs(SECOND.predict(lines) / spectrum.output - 1.0) ** 2)) < 4e-3
    best = fit_structure(BY_NAME["second_order"], lines).model
    assert best.delay == pytest.approx(0.0043, abs=2e-5)
    assert np.exp(best.parameters[0]) / (2.0 * np.pi) == pytest.approx(12.0, rel=3e-3)


def test_motion_model_fit_is_unbiased_if_log_rows_are_lost():
    campaign = campaigns.campaign("jitter", 2, speeds=(), rest=0)
    (run,) = campaign.runs
    assert 0.98 < run.valid.mean() < 1.0
    result = free_motion.fit_free_motion([run], campaign.timing)
    assert result.model.structure.name == "second_order" and result.reduced_chi_square < 1.5
    assert abs(result.model.delay - 0.0043) < 2e-5
    assert result.noise_std == pytest.approx(5e-6, rel=0.02)


def test_local_polynomial_spectrum_omits_only_rows_after_long_gaps():
    kind, T = campaigns.KINDS["clean"], 0.001
    time = np.arange(20_000) * T
    command = 1e-3 * np.sin(2.0 * np.pi * (0.3 * time + (20.0 - 0.3) * time**2 / (2.0 * time[-1])))
    rng = np.random.default_rng(0)
    output = campaigns._position(campaigns.Plant(kind.rig), command, 4.3)
    output += 1e-6 * rng.standard_normal(len(output))
    complete = frf.compute_spectrum(command, output, np.ones(len(command), bool), T, 500)
    valid = rng.random(len(command)) > 0.03
    spectrum = frf.compute_spectrum(command, np.where(valid, output, np.nan), valid, T, 500)
    np.testing.assert_array_equal(spectrum.frequency, complete.frequency)
    assert np.sqrt(np.mean(np.abs((spectrum.output - complete.output) / complete.std) ** 2)) < 0.5
    assert np.median(spectrum.std / complete.std) == pytest.approx(1.0, abs=0.1)
    valid[6000:6010] = False
    longest = frf.compute_spectrum(command, np.where(valid, output, np.nan), valid, T, 500)
    rows = slice(6010 + 500, None)
    part = frf.compute_spectrum(command[rows], output[rows], valid[rows], T, 500)
    assert abs(len(longest.frequency) - len(part.frequency)) <= 1


@pytest.mark.parametrize(("noise", "limit"), ((0.0, 2.0), (1e-6, 1.2)))
def test_spectrum_of_two_periods_interpolates_rows_that_both_lost(noise, limit):
    kind, T = campaigns.KINDS["clean"], 0.001
    command = np.tile(campaigns.multisine(T), 4) - 0.03
    output = campaigns._position(campaigns.Plant(kind.rig), command, 4.3)
    rng = np.random.default_rng(0)
    output = np.round(output + noise * rng.standard_normal(len(output)), 7)[5000:]
    valid = rng.random(len(output)) > 0.05
    assert np.any(~valid.reshape(3, -1)[1:].any(axis=0))
    spectrum = frf.compute_spectrum(command[5000:], np.where(valid, output, np.nan), valid, T, 500)
    assert spectrum.periods == 2
    lines = SpectralLines(spectrum.frequency, spectrum.command, spectrum.output, spectrum.std, T, "linear", 0)
    score = (SECOND.predict(lines) - spectrum.output) / spectrum.std
    assert np.sqrt(np.mean(np.abs(score) ** 2)) < limit


def test_spectrum_detects_nonlinearity_at_unexcited_frequencies():
    campaign = campaigns.campaign("clean", 3, speeds=(), rest=0)
    (run,) = campaign.runs
    depth = run.position_measured - run.position_measured.mean()
    for power, which in ((3, "odd"), (2, "even")):
        bent = run.position_measured + 0.02 * depth**power / np.std(depth) ** (power - 1)
        spectrum = frf.compute_spectrum(run.position_desired, bent, run.valid, 0.001, 500)
        flagged, other = (spectrum.excess[0], spectrum.excess[1]) if which == "odd" else spectrum.excess[::-1]
        assert flagged > 20.0 and other < 2.0


@pytest.mark.parametrize("logarithms", [(4.3, -0.2), (4.3, 1.1), (156.8, 153.0)])
def test_poles_of_motion_model_far_above_measured_frequencies_are_limited(logarithms):
    """A pole of 1e134 rad/s would make the motion overflow."""
    structure = rational.STRUCTURES[2]
    asked = np.array([*logarithms, 0.001])
    bounded = rational._limit_fast_poles(structure, asked, rational.MIN_TIME_CONSTANT)
    s = 2j * np.pi * np.array([0.5, 5.0, 50.0])
    responses = [rational.MotionModel(structure, values).response(s) for values in (bounded, asked)]
    np.testing.assert_allclose(*responses, rtol=1e-3)
    fastest = np.abs(np.roots(rational.MotionModel(structure, bounded).fraction[1])).max()
    assert fastest <= 1.001 / rational.MIN_TIME_CONSTANT


def test_limit_of_fast_poles_keeps_delay_at_low_frequencies():
    model = SECOND.structure.make_model(np.array([np.log(7e4), np.log(1.2), 0.0043]))
    limited = rational._limit_fast_poles(model.structure, model.parameters, 1.8e-5)
    s = 2j * np.pi * np.array([0.5, 5.0, 50.0])
    responses = [rational.MotionModel(model.structure, p).response(s) for p in (limited, model.parameters)]
    assert np.exp(limited[0]) < 1.001 / 1.8e-5
    np.testing.assert_allclose(*np.angle(responses), rtol=0, atol=1e-5)
