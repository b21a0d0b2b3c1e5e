"""Contact parameters from forces at known motion: exact without noise, with correct intervals with noise."""

from dataclasses import replace
from types import SimpleNamespace

import campaign_kinds
import campaigns
import numpy as np
import pytest
from scipy.linalg import expm

from jaxhil.contact.laws import find_contact_law
from tuning.identification import contact_profile
from tuning.identification.contact_laws import kelvin_voigt
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_profile import compute_posterior
from tuning.identification.contact_runs import exclude_rows_after_gaps, split_long_run
from tuning.identification.force_readings import ForceReadings
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.law_choice import choose_contact_law, search_coarsely
from tuning.identification.motion import MotionResponse, compute_matrix_exponential
from tuning.identification.rational import STRUCTURES, MotionModel
from tuning.identification.sensor_filter import compute_lag_weights, compute_onset_weights

HERTZ = find_contact_law("hunt_crossley").regression(SimpleNamespace(exponent=1.5))
SECOND = MotionModel(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))


def problem(name, law, noise=0.5, speeds=campaigns.SPEEDS, seed=0, plane=None, time_constant=0.0):
    """Return the readings of a kind of campaign with the motion of the true motion simulator."""
    kind = campaigns.KINDS[name]
    sensor = {**kind.rig["force_sensor"], "noise_std": noise}
    kind = replace(kind, rig={**kind.rig, "force_sensor": sensor})
    runs = campaigns._touch_runs(kind, np.random.default_rng(seed), speeds)
    timing = campaigns.campaign(name, 0, speeds=(), seconds=0, rest=0).timing
    sensor_delay = kind.rig["position_sensor"].get("delay", 0.0)
    model = MotionModel(SECOND.structure, SECOND.parameters + np.array([0.0, 0.0, sensor_delay]))
    readings = ForceReadings.of(runs, noise or 0.5)
    return ContactProblem(MotionResponse(model, runs, timing, 0.022), readings, law, plane, time_constant)


@pytest.mark.parametrize("name, law, plane, expected", (
    ("clean", kelvin_voigt(), 0.0, [1.2e5, 650.0, 0.0]),
    ("stiffnesses", kelvin_voigt(), 2e-4, [1.2e5, 2.4e5, 7e4, 650.0, 0.0]),
    ("hertz", HERTZ, 0.0, [6e6, 1.2e7, 0.0]),
))  # fmt: skip
def test_contact_parameter_fit_is_exact_without_noise(name, law, plane, expected):
    exact = problem(name, law, noise=0.0, speeds=(0.006, 0.012, 0.006))
    inner = exact.at(0.0037, plane)
    np.testing.assert_allclose(inner.coefficients, expected, rtol=1e-7, atol=1e-6)
    assert inner.misfit < 1e-5
    assert min(exact.at(0.0038, plane).misfit, exact.at(0.0037, plane + 1e-6).misfit) > 1e3 * inner.misfit
    np.testing.assert_allclose(
        exact.force(0.0037, plane, inner.coefficients), exact.readings.force, rtol=0, atol=1e-6
    )


def test_contact_fit_is_exact_with_force_sensor_lag():
    """The delay of the position sensor adds to the motion delay and is subtracted from the force delay."""
    lagging = problem("lagging", kelvin_voigt(), 0.0, (0.006, 0.012), 0, 0.0, 0.0016)
    inner = lagging.at(0.0037 - 0.0012, 0.0)
    np.testing.assert_allclose(inner.coefficients, [1.2e5, 650.0, 0.0], rtol=2e-4, atol=0.01)
    assert np.abs(lagging.force(0.0025, 0.0, inner.coefficients) - lagging.readings.force).max() < 0.06


def test_lag_filter_weights_are_exact_for_quadratic_force():
    rate = 0.7
    pole, weights = compute_lag_weights(rate)
    t = np.linspace(0.0, 1.0, 200_001)
    kernel = rate * np.exp(-(1.0 - t) * rate)
    for power in (0, 1, 2):
        exact = np.trapezoid(kernel * t**power, t)
        assert np.dot(weights, np.array([1.0, 0.5, 0.0]) ** power) == pytest.approx(exact, rel=1e-9)
    assert pole == pytest.approx(np.exp(-rate)) and sum(weights) == pytest.approx(1.0 - pole)


def test_lag_filter_weights_are_exact_for_contact_onset_within_a_period():
    rate, remaining = 0.7, np.array([0.03, 0.4, 1.0])
    after, end = compute_onset_weights(rate, remaining)
    for share, begin_weight, end_weight in zip(remaining, after, end, strict=True):
        t = np.linspace(1.0 - share, 1.0, 200_001)
        line = 3.0 + 2.0 * (t - t[0]) / share
        exact = np.trapezoid(rate * np.exp(-(1.0 - t) * rate) * line, t)
        assert begin_weight * 3.0 + end_weight * 5.0 == pytest.approx(exact, rel=1e-9)


def test_contact_fit_is_equal_with_and_without_noise_filter_for_white_noise():
    plain = problem("stiffnesses", kelvin_voigt(), speeds=(0.006, 0.012, 0.003))
    filtered = ContactProblem(plain.motion, plain.readings, plain.law, None)
    filtered.is_unfiltered = False
    filtered.entry = plain.readings.entry.ravel()
    for delay in (0.0031, 0.0037):
        direct, reference = plain.at(delay, 2e-4), filtered.at(delay, 2e-4)
        np.testing.assert_allclose(direct.coefficients, reference.coefficients, rtol=1e-8, atol=1e-9)
        for name in ("misfit", "evidence", "slope", "curvature"):
            assert getattr(direct, name) == pytest.approx(getattr(reference, name), rel=1e-6), name


def test_matrix_exponential_matches_scipy():
    matrix = np.random.default_rng(0).standard_normal((5, 5)) * 3.0
    np.testing.assert_allclose(compute_matrix_exponential(matrix), expm(matrix), rtol=1e-11)


def test_contact_posterior_covers_true_values_and_is_narrowest_for_apparent_damping():
    posterior = compute_posterior(problem("clean", kelvin_voigt(), seed=4))
    values = dict(zip(posterior.names, posterior.draws.T, strict=True))
    for name, truth in (("delay", 0.0037), ("plane", 0.0), ("stiffness.0", 1.2e5), ("damping", 650.0)):
        # 99.99 % of normal draws lie within 4 standard deviations.
        assert abs(values[name].mean() - truth) < 4.0 * values[name].std(), name
    apparent = values["damping"] - values["stiffness.0"] * values["delay"]
    assert abs(apparent.mean() - (650.0 - 1.2e5 * 0.0037)) < 4.0 * apparent.std()
    assert apparent.std() < 3.0 < 1e5 * values["delay"].std() + values["damping"].std()
    assert values["delay"].std() < 1e-4 and values["damping"].min() >= 0.0
    assert np.corrcoef(values["delay"], values["damping"])[0, 1] > 0.5


def test_contact_fit_of_press_run_in_chunks_is_exact():
    kind = campaigns.KINDS["clean"]
    silent = {
        sensor: {**kind.rig[sensor], "noise_std": 0.0} for sensor in ("force_sensor", "position_sensor")
    }
    run = campaigns._press_run(replace(kind, rig={**kind.rig, **silent}), np.random.default_rng(0), 10.0)
    cut = split_long_run(run, 0.001)
    assert sum(int(piece.valid.sum()) for piece in cut) == len(run.tick) - 500
    timing = campaigns.campaign("clean", 0, speeds=(), seconds=0, rest=0).timing
    law = kelvin_voigt()
    inner = ContactProblem(
        MotionResponse(SECOND, cut, timing, 0.022), ForceReadings.of(cut, 0.5), law, 0.0
    ).at(0.0037, 0.0)
    np.testing.assert_allclose(inner.coefficients, [1.2e5, 650.0, 0.0], rtol=1e-5, atol=1e-3)


def test_contact_fit_skips_rows_after_gap_until_transient_has_decayed():
    """Remove 30 rows at the turning point; the missing commands affect the later motion."""
    kind = campaigns.KINDS["clean"]
    silent = {"force_sensor": {**kind.rig["force_sensor"], "noise_std": 0.0}}
    runs = campaigns._touch_runs(
        replace(kind, rig={**kind.rig, **silent}), np.random.default_rng(0), (0.006, 0.012)
    )
    timing = campaigns.campaign("clean", 0, speeds=(), seconds=0, rest=0).timing
    names = ("tick", "position_desired", "position_measured", "force_measured", "velocity_desired", "valid",
             "force_command", "contact_index")  # fmt: skip
    halves = [
        replace(run, **{name: getattr(run, name)[part] for name in names})
        for run in runs
        for part in (slice(0, 120), slice(150, None))
    ]
    usable = exclude_rows_after_gaps(halves, SECOND, 0.001)
    assert [int(run.valid.sum()) for run in usable] == [120, 79, 120, 79]
    assert exclude_rows_after_gaps(runs, SECOND, 0.001)[0].valid.all()
    worst = []
    for cut in (usable, halves):
        motion = MotionResponse(SECOND, cut, timing, 0.022)
        inner = ContactProblem(motion, ForceReadings.of(cut, 0.5), kelvin_voigt(), 0.0).at(0.0037, 0.0)
        worst.append(np.max(np.abs(inner.coefficients - [1.2e5, 650.0, 0.0]) / [1.2e5, 650.0, 1.0]))
    assert worst[0] < 1e-3 < 1e-2 < worst[1]


def test_contact_fit_of_undamped_contact_has_no_negative_damping():
    kind = campaigns.KINDS["clean"]
    soft = replace(kind, contact={**kind.contact, "damping": [0.0]})
    runs = campaigns._touch_runs(soft, np.random.default_rng(0), (0.003, 0.006, 0.012))
    timing = campaigns.campaign("clean", 0, speeds=(), seconds=0, rest=0).timing
    undamped = ContactProblem(
        MotionResponse(SECOND, runs, timing, 0.022), ForceReadings.of(runs, 0.5), kelvin_voigt(), 0.0
    )
    posterior = compute_posterior(undamped, size=(21, 5))
    damping = posterior.draws[:, posterior.names.index("damping")]
    assert damping.min() >= 0.0 and damping.mean() < 4.0 * damping.std()
    assert posterior.mean[0] == pytest.approx(0.0037, abs=4.0 * posterior.draws[:, 0].std())


@pytest.mark.parametrize("name, law", (("clean", "kelvin_voigt"), ("hertz", "hunt_crossley")))
def test_contact_law_selection_selects_the_true_law(name, law):
    readings_problem = problem(name, kelvin_voigt(), speeds=(0.003, 0.006, 0.012) * 2)
    candidates = choose_contact_law(
        readings_problem.motion, readings_problem.readings, None, ("linear", "kelvin_voigt", "hunt_crossley")
    )
    assert candidates[0].law.name == law and not candidates[0].law.pulls
    assert all(
        other.likelihood_deficit[0] > 2.0 * other.likelihood_deficit[1]
        for other in candidates[1:]
        if other.law.name != law
    )
    if name == "hertz":
        assert candidates[0].law.shape == {"exponent": 1.5}


def test_grid_of_delay_profile_is_divided_where_contact_onsets_cross_ticks():
    at = np.array([0.1, 0.15, 0.7])
    np.testing.assert_allclose(
        contact_profile.divide_into_cells(0.0, 1.0, at, 6), [0.0, 0.1, 0.15, 0.425, 0.7, 0.85, 1.0]
    )
    np.testing.assert_allclose(contact_profile.divide_into_cells(0.0, 1.0, at, 3), [0.0, 0.15, 0.7, 1.0])
    np.testing.assert_allclose(
        contact_profile.divide_into_cells(0.0, 1.0, at[:0], 4), [0.0, 0.25, 0.5, 0.75, 1.0]
    )
    exact = problem("clean", kelvin_voigt(), speeds=(0.006, 0.012, 0.003), seed=3)
    (plane, *_) = exact.onsets_between(0.0037, -3e-6, 3e-6)
    inside = [exact.motion.at(0.0037)[0] > surface for surface in (plane - 1e-9, plane + 1e-9)]
    assert np.sum(inside[0] != inside[1]) == 1


def test_quick_delay_search_stays_within_longest_delay():
    clean = problem("clean", kelvin_voigt(), speeds=(0.006, 0.012))
    late = replace(clean.readings, force=np.roll(clean.readings.force, 40, axis=0))
    late = ContactProblem(clean.motion, late, clean.law, clean.plane)
    delay, *_ = search_coarsely(late, (MAX_FORCE_DELAY + 0.002, 0.0, np.inf))
    assert delay <= MAX_FORCE_DELAY


@pytest.mark.parametrize(("lag", "seed"), [(0.0, 0), (0.0, 1), (0.0018, 3)])
def test_identify_finds_best_of_many_local_optima_of_stiff_damped_contact(monkeypatch, lag, seed):
    """A jump of the force by up to 30 times the noise makes the misfit a staircase."""
    simulator = {
        "model": "second_order",
        "natural_frequency": 40.0,
        "damping_ratio": 0.7,
        "delay": 0.0009,
    }
    rig = campaign_kinds.rig(noise=3.3, simulator=simulator, force_sensor__time_constant=lag)
    contact = campaign_kinds.voigt((1.2e6,), (4760.0,))
    kind = campaign_kinds.Kind(rig, contact, colour=0.85, mass=1140.0)
    monkeypatch.setitem(campaigns.KINDS, "stiff", kind)
    campaign = campaigns.campaign("stiff", seed, seconds=10.0)
    result = identify(campaign, options=IdentificationOptions(law="kelvin_voigt", hold_out=0.0))
    age = result["delay and lag of force" if lag else "rig.force_sensor.delay"]
    for estimate, true in (
        (age, 0.0037 + lag),
        (result["contact.damping.0"], 4760.0),
        (result["contact.stiffness.0"], 1.2e6),
        (result["rig.contact_plane"], 0.0),
    ):
        assert abs(estimate.value - true) < 3.5 * estimate.std


@pytest.mark.parametrize("seed", (0, 4))
def test_contact_posterior_finds_best_fit_if_force_jumps_by_400_times_the_noise(seed):
    """Only a surface within some nanometres fits; it does not change linearly with the delay."""
    quiet = problem("clean", kelvin_voigt(), noise=0.02, seed=seed)
    posterior = compute_posterior(quiet)
    rows = len(quiet.used_rows)
    assert abs(posterior.best[2].misfit - rows) < 5.0 * np.sqrt(2.0 * rows)
    deviations = posterior.mean[:4] - [0.0037, 0.0, 1.2e5, 650.0]
    assert np.all(np.abs(deviations) < 4.0 * posterior.draws.std(axis=0)[:4])


def test_contact_posterior_does_not_depend_on_an_approximate_delay(monkeypatch):
    """A grid of delays that begins at the smallest possible delay has a shorter first step."""
    rig = campaign_kinds.rig(force_sensor__delay=0.0019)
    kind = campaign_kinds.Kind(rig, campaign_kinds.voigt(damping=(0.0,)))
    monkeypatch.setitem(campaigns.KINDS, "undamped", kind)
    undamped = problem("undamped", kelvin_voigt(), noise=0.02, seed=2)
    undamped.min_delay = -0.0005
    usual = compute_posterior(undamped)
    near = compute_posterior(undamped, near=(0.001875, usual.best[1]))
    np.testing.assert_allclose(near.mean[0], usual.mean[0], atol=0.1 * usual.draws[:, 0].std())


@pytest.mark.parametrize("lag", (0.0, 0.0018))
def test_contact_intervals_include_uncertainty_of_motion_simulator(monkeypatch, lag):
    """Forces are precise and positions are not: the noise of the force alone is the smaller part."""
    rig = campaign_kinds.rig(noise=0.02, position_noise=5e-5, force_sensor__time_constant=lag)
    monkeypatch.setitem(campaigns.KINDS, "imprecise", campaign_kinds.Kind(rig, campaign_kinds.voigt()))
    age = "delay and lag of force" if lag else "rig.force_sensor.delay"
    true = {
        age: 0.0037 + lag,
        "contact.damping.0": 650.0,
        "contact.stiffness.0": 1.2e5,
        "rig.contact_plane": 0.0,
    }
    scores = []
    for seed in range(5):
        campaign = campaigns.campaign("imprecise", seed, seconds=20.0)
        result = identify(campaign, options=IdentificationOptions(law="kelvin_voigt", hold_out=0.0))
        scores.append([(result[key].value - value) / result[key].std for key, value in true.items()])
    assert np.all(np.sqrt(np.mean(np.square(scores), axis=0)) < 2.0)
    assert np.sqrt(np.mean(np.square(scores))) > 0.6


def test_motion_is_known_before_the_time_of_a_row():
    """A negative sensor delay needs commands of later rows."""
    runs = campaigns._touch_runs(campaigns.KINDS["clean"], np.random.default_rng(0), (0.006,))
    timing = campaigns.campaign("clean", 0, speeds=(), seconds=0, rest=0).timing
    early, late = (replace(SECOND, parameters=np.append(SECOND.parameters[:2], d)) for d in (-0.004, 0.001))
    motion = MotionResponse(late, runs, timing, 0.022, shortest=-0.006)
    np.testing.assert_allclose(
        motion.at(-0.005), MotionResponse(early, runs, timing, 0.022).at(0.0), atol=1e-12
    )
