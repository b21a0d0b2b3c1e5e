"""The contact from forces over known motion: exact where there is no noise, honest where there is."""

from dataclasses import replace
from types import SimpleNamespace

import campaigns
import numpy as np
import pytest
from scipy.linalg import expm

from jaxhil.contact.laws import contact_law
from tuning.identification import contact_profile
from tuning.identification.contact import after_gaps, pieces
from tuning.identification.contact_laws import kelvin_voigt
from tuning.identification.contact_problem import LONGEST, Problem, Readings
from tuning.identification.contact_profile import profile
from tuning.identification.law_choice import judge, quick
from tuning.identification.motion import Motion, exponential
from tuning.identification.rational import STRUCTURES, Model
from tuning.identification.sensor_filter import lag_weights, onset_weights

HERTZ = contact_law("hunt_crossley").regression(SimpleNamespace(exponent=1.5))
SECOND = Model(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))


def problem(name, law, noise=0.5, speeds=campaigns.SPEEDS, seed=0, plane=None, time_constant=0.0):
    """Readings of a kind of campaign over the motion of the true motion simulator."""
    kind = campaigns.KINDS[name]
    sensor = {**kind.rig["force_sensor"], "noise_std": noise}
    kind = replace(kind, rig={**kind.rig, "force_sensor": sensor})
    runs = campaigns._touch_runs(kind, np.random.default_rng(seed), speeds)
    timing = campaigns.campaign(name, 0, speeds=(), seconds=0, rest=0).timing
    sensor_delay = kind.rig["position_sensor"].get("delay", 0.0)
    model = Model(SECOND.structure, SECOND.parameters + np.array([0.0, 0.0, sensor_delay]))
    readings = Readings.of(runs, noise or 0.5)
    return Problem(Motion(model, runs, timing, 0.022), readings, law, plane, time_constant)


@pytest.mark.parametrize("name, law, plane, expected", (
    ("clean", kelvin_voigt(), 0.0, [1.2e5, 650.0, 0.0]),
    ("stiffnesses", kelvin_voigt(), 2e-4, [1.2e5, 2.4e5, 7e4, 650.0, 0.0]),
    ("hertz", HERTZ, 0.0, [6e6, 1.2e7, 0.0]),
))  # fmt: skip
def test_without_noise_the_numbers_are_exact_at_the_true_delay_and_plane(name, law, plane, expected):
    exact = problem(name, law, noise=0.0, speeds=(0.006, 0.012, 0.006))
    inner = exact.at(0.0037, plane)
    np.testing.assert_allclose(inner.coefficients, expected, rtol=1e-7, atol=1e-6)
    assert inner.misfit < 1e-5
    assert min(exact.at(0.0038, plane).misfit, exact.at(0.0037, plane + 1e-6).misfit) > 1e3 * inner.misfit
    np.testing.assert_allclose(
        exact.force(0.0037, plane, inner.coefficients), exact.readings.force, rtol=0, atol=1e-6
    )


def test_with_a_lag_too():
    """The position sensor's delay is the motion's here, and less of the force's."""
    lagging = problem("lagging", kelvin_voigt(), 0.0, (0.006, 0.012), 0, 0.0, 0.0016)
    inner = lagging.at(0.0037 - 0.0012, 0.0)
    np.testing.assert_allclose(inner.coefficients, [1.2e5, 650.0, 0.0], rtol=2e-4, atol=0.01)
    assert np.abs(lagging.force(0.0025, 0.0, inner.coefficients) - lagging.readings.force).max() < 0.06


def test_a_lag_is_exact_on_a_parabola():
    rate = 0.7
    pole, weights = lag_weights(rate)
    t = np.linspace(0.0, 1.0, 200_001)
    kernel = rate * np.exp(-(1.0 - t) * rate)
    for power in (0, 1, 2):
        exact = np.trapezoid(kernel * t**power, t)
        assert np.dot(weights, np.array([1.0, 0.5, 0.0]) ** power) == pytest.approx(exact, rel=1e-9)
    assert pole == pytest.approx(np.exp(-rate)) and sum(weights) == pytest.approx(1.0 - pole)


def test_a_lag_is_exact_where_contact_begins_within_the_period():
    rate, left = 0.7, np.array([0.03, 0.4, 1.0])
    after, end = onset_weights(rate, left)
    for share, one, other in zip(left, after, end, strict=True):
        t = np.linspace(1.0 - share, 1.0, 200_001)
        line = 3.0 + 2.0 * (t - t[0]) / share
        exact = np.trapezoid(rate * np.exp(-(1.0 - t) * rate) * line, t)
        assert one * 3.0 + other * 5.0 == pytest.approx(exact, rel=1e-9)


def test_white_noise_and_its_sums_give_what_the_filtered_path_gives():
    plain = problem("stiffnesses", kelvin_voigt(), speeds=(0.006, 0.012, 0.003))
    filtered = Problem(plain.motion, plain.readings, plain.law, None)
    filtered.plain, filtered.where = False, np.arange(plain.readings.counts.size)
    filtered.entry = plain.readings.entry.ravel()
    for delay in (0.0031, 0.0037):
        one, other = plain.at(delay, 2e-4), filtered.at(delay, 2e-4)
        np.testing.assert_allclose(one.coefficients, other.coefficients, rtol=1e-8, atol=1e-9)
        for name in ("misfit", "evidence", "slope", "curvature"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-6), name


def test_the_exponential_is_that_of_scipy():
    matrix = np.random.default_rng(0).standard_normal((5, 5)) * 3.0
    np.testing.assert_allclose(exponential(matrix), expm(matrix), rtol=1e-11)


def test_the_posterior_covers_the_truth_and_knows_the_apparent_damping_best():
    found = profile(problem("clean", kelvin_voigt(), seed=4))
    values = dict(zip(found.names, found.draws.T, strict=True))
    for name, truth in (("delay", 0.0037), ("plane", 0.0), ("stiffness.0", 1.2e5), ("damping", 650.0)):
        # 99.99 % of a normal number's draws.
        assert abs(values[name].mean() - truth) < 4.0 * values[name].std(), name
    apparent = values["damping"] - values["stiffness.0"] * values["delay"]
    assert abs(apparent.mean() - (650.0 - 1.2e5 * 0.0037)) < 4.0 * apparent.std()
    assert apparent.std() < 3.0 < 1e5 * values["delay"].std() + values["damping"].std()
    assert values["delay"].std() < 1e-4 and values["damping"].min() >= 0.0
    assert np.corrcoef(values["delay"], values["damping"])[0, 1] > 0.5


def test_a_long_press_is_fitted_in_pieces_as_exactly():
    kind = campaigns.KINDS["clean"]
    silent = {
        sensor: {**kind.rig[sensor], "noise_std": 0.0} for sensor in ("force_sensor", "position_sensor")
    }
    run = campaigns._press_run(replace(kind, rig={**kind.rig, **silent}), np.random.default_rng(0), 10.0)
    cut = pieces(run, 0.001)
    assert sum(int(piece.valid.sum()) for piece in cut) == len(run.tick) - 500
    timing = campaigns.campaign("clean", 0, speeds=(), seconds=0, rest=0).timing
    law = kelvin_voigt()
    inner = Problem(Motion(SECOND, cut, timing, 0.022), Readings.of(cut, 0.5), law, 0.0).at(0.0037, 0.0)
    np.testing.assert_allclose(inner.coefficients, [1.2e5, 650.0, 0.0], rtol=1e-5, atol=1e-3)


def test_a_contact_cut_by_lost_rows_counts_once_the_motion_has_forgotten_them():
    """30 rows lost as the touches turn: what was commanded there is in the motion that follows."""
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
    known = after_gaps(halves, SECOND, 0.001)
    assert [int(run.valid.sum()) for run in known] == [120, 79, 120, 79]
    assert after_gaps(runs, SECOND, 0.001)[0].valid.all()
    worst = []
    for cut in (known, halves):
        motion = Motion(SECOND, cut, timing, 0.022)
        inner = Problem(motion, Readings.of(cut, 0.5), kelvin_voigt(), 0.0).at(0.0037, 0.0)
        worst.append(np.max(np.abs(inner.coefficients - [1.2e5, 650.0, 0.0]) / [1.2e5, 650.0, 1.0]))
    assert worst[0] < 1e-3 < 1e-2 < worst[1]


def test_undamped_contact_has_no_negative_damping():
    kind = campaigns.KINDS["clean"]
    soft = replace(kind, contact={**kind.contact, "damping": [0.0]})
    runs = campaigns._touch_runs(soft, np.random.default_rng(0), (0.003, 0.006, 0.012))
    timing = campaigns.campaign("clean", 0, speeds=(), seconds=0, rest=0).timing
    one = Problem(Motion(SECOND, runs, timing, 0.022), Readings.of(runs, 0.5), kelvin_voigt(), 0.0)
    found = profile(one, size=(21, 5))
    damping = found.draws[:, found.names.index("damping")]
    assert damping.min() >= 0.0 and damping.mean() < 4.0 * damping.std()
    assert found.mean[0] == pytest.approx(0.0037, abs=4.0 * found.draws[:, 0].std())


@pytest.mark.parametrize("name, law", (("clean", "kelvin_voigt"), ("hertz", "hunt_crossley")))
def test_the_law_is_named(name, law):
    one = problem(name, kelvin_voigt(), speeds=(0.003, 0.006, 0.012) * 2)
    judged = judge(one.motion, one.readings, None, ("linear", "kelvin_voigt", "hunt_crossley"))
    assert judged[0].law.name == law and not judged[0].law.pulls
    assert all(other.short[0] > 2.0 * other.short[1] for other in judged[1:] if other.law.name != law)
    if name == "hertz":
        assert judged[0].law.shape == {"exponent": 1.5}


def test_cells_have_their_edges_where_rows_come_into_contact():
    at = np.array([0.1, 0.15, 0.7])
    np.testing.assert_allclose(contact_profile.cut(0.0, 1.0, at, 6), [0.0, 0.1, 0.15, 0.425, 0.7, 0.85, 1.0])
    np.testing.assert_allclose(contact_profile.cut(0.0, 1.0, at, 3), [0.0, 0.15, 0.7, 1.0])
    np.testing.assert_allclose(contact_profile.cut(0.0, 1.0, at[:0], 4), [0.0, 0.25, 0.5, 0.75, 1.0])
    exact = problem("clean", kelvin_voigt(), speeds=(0.006, 0.012, 0.003), seed=3)
    (plane, *_) = exact.onsets_between(0.0037, -3e-6, 3e-6)
    inside = [exact.motion.at(0.0037)[0] > place for place in (plane - 1e-9, plane + 1e-9)]
    assert np.sum(inside[0] != inside[1]) == 1


def test_a_search_about_a_delay_beyond_the_longest_stays_within_it():
    """Stay within the longest delay: beyond it the grid about the delay had one place."""
    clean = problem("clean", kelvin_voigt(), speeds=(0.006, 0.012))
    late = replace(clean.readings, force=np.roll(clean.readings.force, 40, axis=0))
    late = Problem(clean.motion, late, clean.law, clean.plane)
    delay, *_ = quick(late, (LONGEST + 0.002, 0.0, np.inf))
    assert delay <= LONGEST
