"""Draws of uncertain parameters: distributions compared with SciPy; dependence on seed and index alone."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from jaxhil.errors import InputError
from jaxhil.mechanism.file import builtin_names, from_plain_data, load, to_plain_data
from jaxhil.mechanism.number_ranges import numeric_keys
from jaxhil.mechanism.structs import MAGNITUDE_LIMITS
from jaxhil.mechanism.uncertainty import (
    PHASE_KEY,
    count_dimensions,
    draw,
    draw_at_points,
    draw_extremes,
    draw_quasi_random,
)

CERTAIN = ["uncertainty={}", "contact.damping=[1.0, 2.0]"]
BASE = to_plain_data(load("varying", CERTAIN).mechanism)
NOMINAL = [124355.0, 373065.0, 62177.5]


def mechanism_with(path, entry, **values):
    """Return the base mechanism with one uncertain key; `values` set other keys, `a__b` for a.b."""
    raw = copy.deepcopy(BASE)
    for dotted, value in values.items():
        *tables, key = dotted.split("__")
        node = raw
        for table in tables:
            node = node[table]
        node[key] = value
    raw["uncertainty"] = {path: entry}
    return from_plain_data(raw, "some file")


def refusal(path, entry, **values):
    with pytest.raises(InputError) as caught:
        mechanism_with(path, entry, **values)
    message = str(caught.value)
    assert message.isprintable() and message.startswith("some file: ")
    return message


FREQUENCY, DELAY = "rig.simulator.natural_frequency", "rig.force_sensor.delay"
POLYNOMIALS = {f"rig.simulator.{key}" for key in ("coefficients", "numerator", "denominator")}
DISTRIBUTIONS = [
    (FREQUENCY, {"distribution": "uniform", "low": 10.0, "high": 14}, stats.uniform(10, 4)),
    (FREQUENCY, {"distribution": "uniform", "factor": [0.5, 2]}, stats.uniform(15, 45)),
    (FREQUENCY, {"distribution": "loguniform", "factor": [0.5, 2]}, stats.loguniform(15, 60)),
    (FREQUENCY, {"distribution": "loguniform", "low": 1, "high": 9}, stats.loguniform(1, 9)),
    (DELAY, {"distribution": "normal", "std": 0.0005}, stats.norm(0.004, 0.0005)),
    (DELAY, {"distribution": "normal", "std": 2.0}, stats.truncnorm(-0.002, 0.498, 0.004, 2.0)),
    (PHASE_KEY, {"distribution": "uniform", "low": 0.2, "high": 0.4}, stats.uniform(0.2, 0.2)),
    (PHASE_KEY, {"distribution": "normal", "std": 1}, stats.truncnorm(-1 / 3, 2 / 3, 1 / 3, 1)),
]


@pytest.mark.parametrize("draws", [draw, draw_quasi_random])
@pytest.mark.parametrize(("path", "entry", "expected"), DISTRIBUTIONS)
def test_draws_have_the_stated_distribution(draws, path, entry, expected):
    values = draws(mechanism_with(path, entry), 4096, 3)[path]
    for column in np.reshape(values, (4096, -1)).T:
        result = stats.kstest(column, expected.cdf)
        # Quasi-random points are far closer to the distribution than random ones.
        assert result.pvalue > 0.01
        assert draws is draw or result.statistic < 1e-3


def test_contact_phases_are_uniform_and_independent_for_every_contact():
    phases = draw(from_plain_data(BASE, "f"), 4096, 0)
    assert list(phases) == [PHASE_KEY]
    assert phases[PHASE_KEY].shape == (4096, 3)
    for column in phases[PHASE_KEY].T:
        assert stats.kstest(column, stats.uniform.cdf).pvalue > 0.01
    assert np.max(np.abs(np.corrcoef(phases[PHASE_KEY].T) - np.eye(3))) < 4 / np.sqrt(4096)


@pytest.mark.parametrize("draws", [draw, draw_quasi_random])
def test_uncertain_list_entries_scale_jointly_unless_declared_independent(draws):
    entry = {"distribution": "loguniform", "factor": [0.3, 3.0]}
    joint = draws(mechanism_with("contact.stiffness", entry), 4096, 1)["contact.stiffness"]
    assert joint.shape == (4096, 3)
    np.testing.assert_allclose(joint / NOMINAL, (joint[:, :1] / NOMINAL[0]) * np.ones(3), rtol=1e-15)
    mechanism = mechanism_with("contact.stiffness", entry | {"independent": True})
    independent = draws(mechanism, 4096, 1)["contact.stiffness"]
    correlation = np.corrcoef(np.log(independent).T) - np.eye(3)
    assert np.max(np.abs(correlation)) < 4 / np.sqrt(4096)
    for factors in ((joint / NOMINAL)[:, 0], *(independent / NOMINAL).T):
        assert stats.kstest(factors, stats.loguniform(0.3, 3.0).cdf).pvalue > 0.01


def test_absolute_uncertainty_of_a_list_key_applies_to_its_first_entry():
    absolute = {"distribution": "uniform", "low": 2.0, "high": 4.0}
    values = draw(mechanism_with("contact.damping", absolute), 1000, 1)["contact.damping"]
    assert np.all((values[:, 0] >= 2.0) & (values[:, 0] <= 4.0))
    np.testing.assert_allclose(values[:, 1], 2.0 * values[:, 0], rtol=1e-15)
    normal = {"distribution": "normal", "std": 0.1}
    values = draw(mechanism_with("contact.damping", normal), 4096, 1)["contact.damping"]
    np.testing.assert_allclose(values[:, 1], 2.0 * values[:, 0], rtol=1e-15)
    assert stats.kstest(values[:, 0], stats.norm(1.0, 0.1).cdf).pvalue > 0.01
    independent = draw(mechanism_with("contact.damping", normal | {"independent": True}), 4096, 1)
    assert stats.kstest(independent["contact.damping"][:, 1], stats.norm(2.0, 0.1).cdf).pvalue > 0.01
    # Nominally undamped contact can get damping.
    undamped = mechanism_with("contact.damping", absolute, contact__damping=[0.0, 0.0])
    values = draw(undamped, 1000, 1)["contact.damping"]
    assert np.all((values >= 2.0) & (values <= 4.0)) and np.all(values[:, 0] == values[:, 1])


def test_draws_of_nested_lists_keep_their_shape():
    mechanism = load("layered").mechanism
    values = draw(mechanism, 5, 0)["contact.stiffness"]
    nominal = np.array(mechanism.contact.stiffness)
    assert values.shape == (5, 2, 3)
    factors = values[:, :1, :1] / nominal[0, 0] * np.ones((2, 3))
    np.testing.assert_allclose(values / nominal, factors, rtol=1e-15)
    independent = load("layered", ['uncertainty."contact.stiffness".independent=true']).mechanism
    values = draw(independent, 5, 0)["contact.stiffness"] / nominal
    assert values.shape == (5, 2, 3) and len(np.unique(values)) == 30


@settings(deadline=None)
@given(
    st.integers(0, 2**70),
    st.integers(0, 5000),
    st.integers(0, 30),
    st.sampled_from(["varying", "layered"]),
)
def test_draw_depends_only_on_seed_and_scenario_index(seed, first, number, name):
    mechanism = load(name).mechanism
    several = draw(mechanism, number, seed, first)
    for path, values in several.items():
        assert values.shape[0] == number
        for i in {0, number // 2, number - 1} & set(range(number)):
            np.testing.assert_array_equal(values[i], draw(mechanism, 1, seed, first + i)[path][0])


def test_draws_are_distinct_and_do_not_depend_on_block_boundaries():
    mechanism = load().mechanism
    whole = draw(mechanism, 5000, 7)
    for path, values in draw(mechanism, 3000, 7, first=1500).items():
        np.testing.assert_array_equal(values, whole[path][1500:4500])
        assert len(np.unique(values.reshape(3000, -1)[:, 0])) == 3000
        assert not np.any(values == draw(mechanism, 3000, 8, first=1500)[path])


def test_draws_of_a_key_do_not_depend_on_other_uncertain_keys():
    mechanism = load().mechanism
    more = ["uncertainty.'rig.simulator.delay'={distribution='uniform', factor=[0.5, 1]}"]
    other = draw(load("varying", [*more, "approach.contacts=5"]).mechanism, 10, 0)
    for path, values in draw(mechanism, 10, 0).items():
        np.testing.assert_array_equal(values, other[path][:, :3] if path == PHASE_KEY else other[path])


def test_recorded_uncertainty_draws_are_reproduced():
    """These numbers must not change between versions, so that recorded sweeps are reproducible."""
    values = draw(load().mechanism, 1, seed=1, first=1024)
    np.testing.assert_allclose(
        [values["approach.velocity"][0], values[DELAY][0], values[PHASE_KEY][0, 2]],
        [0.004737103501163611, 0.004076758988365051, 0.636892879481792],
        rtol=1e-13,
    )


def test_quasi_random_points_depend_on_seed_and_fill_the_unit_cube_evenly():
    mechanism = load().mechanism
    points = draw_quasi_random(mechanism, 100, 5)
    for path, values in draw_quasi_random(mechanism, 70, 5).items():
        assert values.shape[0] == 70
        np.testing.assert_array_equal(values, draw_quasi_random(mechanism, 70, 5)[path])
        assert not np.array_equal(values, draw_quasi_random(mechanism, 70, 6)[path])
        assert points[path].shape[1:] == values.shape[1:]
    phase = draw_quasi_random(mechanism, 64, 5)[PHASE_KEY]
    for column in phase.T:
        # One point in each of 64 equal intervals.
        assert sorted(np.floor(64 * column)) == list(range(64))


def test_draw_accepts_zero_scenarios_and_rejects_negative_arguments():
    mechanism = load().mechanism
    for values in (draw(mechanism, 0, 0), draw_quasi_random(mechanism, 0, 0)):
        assert {path: entry.shape for path, entry in values.items()} == {
            "contact.stiffness": (0, 3),
            FREQUENCY: (0,),
            DELAY: (0,),
            "approach.velocity": (0,),
            PHASE_KEY: (0, 3),
        }
    for arguments in ((-1, 0), (1, -1), (1, 0, -1)):
        with pytest.raises(ValueError, match="found"):
            draw(mechanism, *arguments)
        with pytest.raises(ValueError, match="found"):
            draw_quasi_random(mechanism, *[-1, 0] if arguments[0] < 0 else [1, -1])


@pytest.mark.parametrize("path", sorted(set(numeric_keys()) - POLYNOMIALS))
@settings(deadline=None, max_examples=30)
@given(nominal=st.just(0.0) | st.floats(1e-9, 1e4), std=st.floats(*MAGNITUDE_LIMITS))
def test_normal_draws_are_truncated_to_allowed_values(path, nominal, std):
    allowed = numeric_keys()[path]
    lowest = BASE["approach"]["velocity"] if path.endswith("velocity_limit") else allowed.low + 1e-9
    nominal = float(np.clip(nominal, lowest, min(allowed.high, 1e4)))
    raw = copy.deepcopy(BASE)
    if path.startswith("bodies.") and "equivalent" not in path:
        raw["bodies"] = {"chaser_mass": 1.0, "target_mass": 1.0}
    of_one_law = {
        "contact.reference_depth": {"law": "hardening"},
        "contact.unloading_ratio": {"law": "elastoplastic"},
        "contact.preload": {"law": "preloaded"},
        "contact.friction": {"law": "preloaded"},
        "contact.exponent": {"law": "hunt_crossley"},
        "contact.depths": {"law": "piecewise_linear", "stiffness": [[1.0, 2.0]], "depths": [1.0]},
    }
    if path in of_one_law:
        raw["contact"] |= {"damping": [0.0], **of_one_law[path]}
    if path == "rig.simulator.time_constant":
        raw["rig"]["simulator"] = {"model": "first_order"}
    if path == "rig.force_sensor.jitter":
        raw["rig"]["force_sensor"] = {"delay": 1.0}
    if path == "rig.simulator.window":
        raw["rig"]["simulator"] = {"model": "moving_average"}
    if path.startswith("rig.force_sensor.filter"):
        raw["rig"]["force_sensor"] = {"filter": {"kind": "bessel", "order": 2}}
    node = raw
    *tables, key = path.split(".")
    for table in tables:
        node = node[table]
    node[key] = [nominal] if isinstance(node.get(key), list) else nominal
    if path == "contact.clearance":
        node[key] = nominal + 1.0
    raw["uncertainty"] = {path: {"distribution": "normal", "std": std}}
    values = draw(from_plain_data(raw, "f"), 50, 0)[path]
    assert all(np.isfinite(value) and allowed.allows(float(value)) for value in values.ravel())


@pytest.mark.parametrize(
    ("path", "entry", "reason"),
    [
        ("contact.stifness", {"distribution": "normal", "std": 1.0}, "did you mean contact.stiff"),
        ("approach.contacts", {"distribution": "normal", "std": 1.0}, "numeric key"),
        ("contact.tension", {"distribution": "normal", "std": 1.0}, "numeric key"),
        ("contact.law", {"distribution": "normal", "std": 1.0}, "numeric key"),
        ("contact", {"distribution": "normal", "std": 1.0}, "numeric key"),
        ("a\nb", {"distribution": "normal", "std": 1.0}, '"a\\nb": found a key that'),
        ("rig.simulator.numerator", {"distribution": "normal", "std": 1.0}, "G(0) = 1"),
        ("rig.simulator.time_constant", {"distribution": "normal", "std": 1.0}, "found nothing as"),
        ("contact.depths", {"distribution": "normal", "std": 1.0}, "found [] as its value"),
        ("contact.clearance", {"distribution": "normal", "std": 1.0}, "found inf as its value"),
        (FREQUENCY, {"distribution": "cauchy", "std": 1.0}, ".distribution: found 'cauchy'"),
        (FREQUENCY, {"std": 1.0}, ".distribution: found nothing"),
        (FREQUENCY, {"distribution": "normal", "sd": 1.0}, ".sd: found an unknown key"),
        (FREQUENCY, {"distribution": "normal"}, "found no range, expected std"),
        (FREQUENCY, {"distribution": "normal", "std": 0.0}, ".std: found 0.0"),
        (FREQUENCY, {"distribution": "normal", "std": 1.0, "low": 1.0}, "found low and std"),
        (FREQUENCY, {"distribution": "normal", "factor": [1, 2]}, "found factor, expected std"),
        (FREQUENCY, {"distribution": "uniform", "low": 1.0}, "found low, expected either factor"),
        (FREQUENCY, {"distribution": "uniform", "std": 1.0}, "found std, expected either factor"),
        (FREQUENCY, {"distribution": "uniform", "low": 2, "high": 1}, ".low: found [2.0, 1.0]"),
        (FREQUENCY, {"distribution": "uniform", "low": 2, "high": 2}, ".low: found [2.0, 2.0]"),
        (FREQUENCY, {"distribution": "uniform", "factor": [2, 1]}, ".factor: found [2.0, 1.0]"),
        (FREQUENCY, {"distribution": "uniform", "factor": [1, 2, 3]}, ".factor: found a list of 3"),
        (FREQUENCY, {"distribution": "uniform", "factor": [0, 2]}, ".factor[0]: found 0"),
        (FREQUENCY, {"distribution": "uniform", "low": 0, "high": 1}, "found a draw of 0"),
        (
            FREQUENCY,
            {"distribution": "uniform", "factor": [1, 1e99]},
            "found a draw of 3e+100",
        ),
        (PHASE_KEY, {"distribution": "uniform", "low": 0, "high": 1.5}, "found a draw of 1.5"),
        (DELAY, {"distribution": "uniform", "low": -0.1, "high": 1}, "found a draw of -0.1"),
        (DELAY, {"distribution": "loguniform", "low": 0, "high": 1}, ".low: found 0.0"),
        ("rig.force_sensor.bias", {"distribution": "loguniform", "low": -1, "high": 1}, "found -1"),
    ],
)
def test_unusable_uncertainty_table_is_rejected(path, entry, reason):
    message = refusal(path, entry)
    assert "uncertainty." in message and reason in message


def test_mechanism_rules_are_checked_in_the_whole_uncertain_range():
    third = {"model": "third_order", "coefficients": [0.1, 0.1, 0.005]}
    path, wide = "rig.simulator.coefficients", {"distribution": "uniform", "factor": [0.4, 1.5]}
    narrow = wide | {"factor": [0.6, 1.5]}
    assert "unstable" in refusal(path, wide, rig__simulator=third)
    assert "unstable" in refusal(path, narrow | {"independent": True}, rig__simulator=third)
    assert "unstable" in refusal(path, {"distribution": "normal", "std": 1.0}, rig__simulator=third)
    values = draw(mechanism_with(path, narrow, rig__simulator=third), 500, 0)[path]
    assert np.all(values[:, 0] * values[:, 1] > values[:, 2])

    path, factor = "contact.depths", {"distribution": "uniform", "factor": [0.5, 1.5]}
    layers = {"contact__law": "piecewise_linear", "contact__stiffness": [[1e5, 2e5, 3e5]]}
    layers |= {"contact__depths": [0.001, 0.002]}
    assert "independent: found true" in refusal(path, factor | {"independent": True}, **layers)
    values = draw(mechanism_with(path, factor, **layers), 500, 0)[path]
    assert np.all(values[:, 0] < values[:, 1])

    damped = {"distribution": "uniform", "low": 1.0, "high": 2.0}
    undamped = {"contact__damping": [0.0], "rig__command_hold": "zoh"}
    ideal = undamped | {"rig__simulator": {"model": "ideal"}}
    assert "rig.command_hold" in refusal("contact.damping", damped, **ideal)
    zero = {"distribution": "uniform", "factor": [0.5, 2.0]}
    assert not np.any(draw(mechanism_with("contact.damping", zero, **ideal), 9, 0)["contact.damping"])

    start = {"contact__clearance": 2e-4}
    fast = {"distribution": "uniform", "factor": [1.0, 2.0]}
    assert "contact.clearance" in refusal("approach.velocity", fast, **start)
    assert "contact.clearance" in refusal("contact.clearance", factor, **start)
    mixed = {"contact__damping": [0.0, 2.0]}
    assert "a list contact.damping that begins with 0" in refusal("contact.damping", damped, **mixed)
    independent = mechanism_with("contact.damping", damped | {"independent": True}, **mixed)
    assert np.all(draw(independent, 9, 0)["contact.damping"] >= 1.0)


def test_draws_of_a_negative_nominal_value_keep_the_sign():
    entry = {"distribution": "loguniform", "factor": [0.5, 2.0]}
    bias = "rig.force_sensor.bias"
    values = draw(mechanism_with(bias, entry, rig__force_sensor={"bias": -3.0}), 2000, 0)[bias]
    assert stats.kstest(-values, stats.loguniform(1.5, 6.0).cdf).pvalue > 0.01


def test_draws_from_extreme_ranges_do_not_overflow():
    wide = {"distribution": "loguniform", "low": MAGNITUDE_LIMITS[0], "high": MAGNITUDE_LIMITS[1]}
    values = np.log10(draw(mechanism_with(FREQUENCY, wide), 4096, 0)[FREQUENCY])
    assert stats.kstest(values, stats.uniform(-100, 200).cdf).pvalue > 0.01


@pytest.mark.parametrize("name", builtin_names())
def test_draws_of_builtin_mechanisms_are_valid_mechanisms(name):
    mechanism = load(name).mechanism
    draws = draw(mechanism, 20, 0)
    assert set(draws) == {*mechanism.uncertainty, PHASE_KEY}
    for i in range(20):
        raw = to_plain_data(mechanism)
        for path, values in draws.items():
            *tables, key = path.split(".")
            node = raw
            for table in tables:
                node = node[table]
            node[key] = (values[i, 0] if path == PHASE_KEY else values[i]).tolist()
        assert from_plain_data(raw, "f").contact.stiffness == draws["contact.stiffness"][i].tolist()


@pytest.mark.parametrize("name", builtin_names())
def test_every_draw_lies_between_the_reported_extremes(name):
    parsed = load(name).mechanism
    ends = draw_extremes(parsed)
    for path, values in draw(parsed, 2000, 5).items():
        assert np.all(np.minimum(*ends[path]) <= values) and np.all(values <= np.maximum(*ends[path]))
        # The extremes are attainable, not just bounds.
        assert np.all(np.ptp(ends[path], axis=0) <= 4 * np.ptp(values, axis=0))


def test_quasi_random_draws_are_transformed_points_of_the_unit_cube():
    parsed = from_plain_data(BASE, "f")
    points = np.full((2, sum(count_dimensions(parsed).values())), 0.25)
    np.testing.assert_array_equal(draw_at_points(parsed, points)[PHASE_KEY], np.full((2, 3), 0.25))
