"""What a mechanism may say: types, ranges, and rules that join keys, each reported with its key."""

import copy
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxhil.errors import InputError, one_line, shown
from jaxhil.mechanism.file import from_builtins, to_builtins
from jaxhil.mechanism.rules import is_hurwitz
from jaxhil.mechanism.structs import Bodies, Mechanism, numeric_keys, value_at

# Every key of the schema, apart from those that exclude each other.
FULL = {
    "schema": "jaxhil/mechanism/1",
    "name": "full",
    "source": "assumed",
    "bodies": {"equivalent_mass": 350.0},
    "approach": {"velocity": 0.005, "contacts": 3, "phase": 0.25},
    "contact": {
        "law": "kelvin_voigt",
        "stiffness": [124355.0, 373065.0],
        "damping": [100.0],
        "tension": False,
        "clearance": 0.02,
        "exponent": 1.5,
        "depths": [0.001, 0.002],
    },
    "rig": {
        "control_period": 0.001,
        "integrator": "zoh",
        "command_latency": 1,
        "command_hold": "zoh",
        "simulator": {
            "model": "second_order",
            "natural_frequency": 12.0,
            "damping_ratio": 0.8,
            "time_constant": 0.01,
            "coefficients": [0.1, 0.1, 0.001],
            "numerator": [1.0],
            "denominator": [1.0, 1.0],
            "delay": 0.004,
            "velocity_limit": 0.5,
            "acceleration_limit": 2.0,
        },
        "force_sensor": {
            "delay": 0.008,
            "time_constant": 0.001,
            "noise_std": 2.0,
            "quantum": 0.1,
            "dead_zone": 1.0,
            "bias": -1.0,
            "range": 1000.0,
        },
        "position_sensor": {"delay": 0.001, "noise_std": 1e-6, "quantum": 1e-6},
        "contact_plane": 2e-5,
    },
    "uncertainty": {
        "contact.stiffness": {"distribution": "loguniform", "factor": [0.3, 3.0]},
        "rig.simulator.natural_frequency": {"distribution": "uniform", "low": 10.0, "high": 14.0},
        "rig.force_sensor.delay": {"distribution": "normal", "std": 0.0005, "independent": True},
    },
}
REQUIRED = [
    "schema",
    "name",
    "bodies",
    "bodies.equivalent_mass",
    "approach",
    "approach.velocity",
    "contact",
    "contact.law",
    "contact.stiffness",
    "rig",
    "rig.control_period",
    "rig.simulator",
    "rig.simulator.model",
    "rig.simulator.natural_frequency",
    "rig.simulator.damping_ratio",
]
POSITIVE = [
    "bodies.equivalent_mass",
    "approach.velocity",
    "contact.stiffness",
    "contact.clearance",
    "contact.depths",
    "rig.control_period",
    "rig.simulator.natural_frequency",
    "rig.simulator.damping_ratio",
    "rig.simulator.coefficients",
    "rig.simulator.velocity_limit",
    "rig.simulator.acceleration_limit",
    "rig.force_sensor.range",
]
MAY_BE_INFINITE = [
    "contact.clearance",
    "rig.simulator.velocity_limit",
    "rig.simulator.acceleration_limit",
    "rig.force_sensor.range",
]


# Refused beside the law of the full table.
OF_ONE_LAW = ("contact.reference_depth", "contact.unloading_ratio")


def changed(changes=(), base=FULL):
    """A copy of the full table with the values at dotted paths replaced; `...` removes a key."""
    raw = copy.deepcopy(base)
    for path, value in dict(changes).items():
        *tables, key = path.split(".")
        node = raw
        for table in tables:
            node = node.setdefault(table, {})
        if value is ...:
            del node[key]
        else:
            node[key] = value
    return raw


def refusal(raw):
    """The message of a refused table: one printable line that names the source."""
    with pytest.raises(InputError) as caught:
        from_builtins(raw, "some file")
    message = str(caught.value)
    assert message.isprintable() and message.startswith("some file: ") and len(message) < 500
    return message


def leaves(node=FULL, path=""):
    for key, value in node.items():
        if isinstance(value, dict) and key != "uncertainty":
            yield from leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}"


def tables(node=FULL, path=""):
    yield path
    for key, value in node.items():
        if isinstance(value, dict) and key != "uncertainty":
            yield from tables(value, f"{path}{key}.")


def test_full_table_is_read_value_by_value():
    mechanism = from_builtins(FULL, "f")
    for path in leaves():
        if path != "uncertainty":
            node = FULL
            for part in path.split("."):
                node = node[part]
            assert value_at(mechanism, path) == node
    for path in numeric_keys():
        if not path.startswith("bodies.") and path not in OF_ONE_LAW:
            assert path in set(leaves())
    assert mechanism.uncertainty["contact.stiffness"].factor == [0.3, 3.0]
    assert mechanism.uncertainty["rig.force_sensor.delay"].independent


def test_defaults():
    raw = {"schema": FULL["schema"], "name": "n", "bodies": {"equivalent_mass": 1}}
    raw |= {"approach": {"velocity": 1}, "contact": {"law": "linear", "stiffness": 5}}
    raw |= {"rig": {"control_period": 0.001, "simulator": {"model": "ideal"}}}
    mechanism = from_builtins(raw, "f")
    assert mechanism.source == "assumed" and mechanism.uncertainty == {}
    assert (mechanism.approach.contacts, mechanism.approach.phase) == (1, 1 / 3)
    contact, rig = mechanism.contact, mechanism.rig
    assert (contact.stiffness, contact.damping, contact.depths) == ([5.0], [0.0], [])
    assert (contact.tension, contact.clearance, contact.exponent) == (False, math.inf, 1.5)
    assert (rig.integrator, rig.command_latency) == ("semi_implicit_euler", 0)
    assert (rig.command_hold, rig.simulator.delay, rig.contact_plane) == ("linear", 0.0, 0.0)
    assert rig.simulator.velocity_limit == rig.simulator.acceleration_limit == math.inf
    assert rig.force_sensor.range == math.inf
    for name in ("delay", "time_constant", "noise_std", "quantum", "dead_zone", "bias"):
        assert getattr(rig.force_sensor, name) == 0.0
    for name in ("delay", "noise_std", "quantum"):
        assert getattr(rig.position_sensor, name) == 0.0


def test_equivalent_mass_of_two_bodies():
    assert Bodies(chaser_mass=300.0, target_mass=600.0).mass == 200.0
    assert Bodies(equivalent_mass=7.0).mass == 7.0
    with pytest.raises(ValueError, match="bodies"):
        _ = Bodies(chaser_mass=1.0).mass


@pytest.mark.parametrize("path", REQUIRED)
def test_missing_key_is_named(path):
    assert f": {path}: found nothing" in refusal(changed({path: ...}))


@pytest.mark.parametrize("path", sorted(set(leaves()) - set(REQUIRED)))
def test_other_keys_may_be_missing(path):
    assert isinstance(from_builtins(changed({path: ...}), "f"), Mechanism)


@pytest.mark.parametrize("path", [*leaves(), *(table[:-1] for table in tables() if table)])
@pytest.mark.parametrize("value", ["a\nb\x1b[31m", True, {"x": 1}, [[[1.0]]], b"raw", -1e308])
def test_wrong_type_is_named(path, value):
    if (path == "contact.tension" and value is True) or path in ("name", "source"):
        value = 3
    if path == "rig.force_sensor.bias" and isinstance(value, float):
        value = "text"
    message = refusal(changed({path: value}))
    assert f": {path}" in message and ", allowed " in message


@pytest.mark.parametrize("table", [*tables()])
@pytest.mark.parametrize("key", ["unknown", "", "new\nline", "\x1b[31m" * 50, '"\\', "\ud800"])
def test_unknown_key_is_named(table, key):
    raw = changed()
    node = raw
    for part in table.split(".")[:-1]:
        node = node[part]
    node[key] = 1.0
    message = refusal(raw)
    assert f": {table}" in message and "unknown key" in message


def test_misspelt_key_gets_a_hint():
    message = refusal(changed({"contact.stiffness": ..., "contact.stifness": 1e5}))
    assert "contact.stifness: found an unknown key" in message
    assert "did you mean stiffness?" in message


@pytest.mark.parametrize("path", [*numeric_keys()])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 10**400, -(10**400)])
def test_numbers_are_finite_unless_the_key_allows(path, value):
    listed = [value, 1.0, 1.0] if isinstance(dict(flat(FULL)).get(path), list) else value
    base = changed()
    if path in ("bodies.chaser_mass", "bodies.target_mass"):
        base["bodies"] = {"chaser_mass": 1.0, "target_mass": 1.0}
    raw = changed({path: listed}, base)
    if value == math.inf and path in MAY_BE_INFINITE:
        assert value_at(from_builtins(raw, "f"), path) == math.inf
    else:
        assert f": {path}" in refusal(raw)


def flat(node, path=""):
    for key, value in node.items():
        if isinstance(value, dict):
            yield from flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


@pytest.mark.parametrize("path", sorted(set(numeric_keys()) & set(leaves())))
def test_zero_and_negative(path):
    nominal = dict(flat(FULL))[path]
    signed = ("contact_plane", "force_sensor.bias", "simulator.numerator", "simulator.denominator")
    may_be_negative = path.removeprefix("rig.") in signed
    for value in (0.0, -1e-9):
        listed = [value, *nominal[1:]] if isinstance(nominal, list) else value
        raw = changed({path: listed})
        if (value < 0.0 and not may_be_negative) or path in [*POSITIVE, "contact.exponent"]:
            assert f": {path}" in refusal(raw)
        else:
            assert isinstance(from_builtins(raw, "f"), Mechanism)


@pytest.mark.parametrize(
    ("path", "inside", "outside"),
    [
        ("approach.phase", 1.0, 1.001),
        ("approach.contacts", 1000, 1001),
        ("approach.contacts", 1, 0),
        ("approach.contacts", 1, 1.0),
        ("contact.exponent", 1.0, 0.99),
        ("rig.control_period", 0.1, 0.11),
        ("rig.command_latency", 1, 2),
        ("rig.command_latency", 0, -1),
        ("rig.simulator.delay", 1.0, 1.01),
        ("rig.force_sensor.delay", 1.0, 1.01),
        ("rig.position_sensor.delay", 1.0, 1.01),
        ("contact.stiffness", [1.0] * 1000, [1.0] * 1001),
        ("contact.stiffness", [1.0], []),
        ("contact.damping", 0, []),
        ("contact.depths", [0.001, 0.002], [0.001, 0.001]),
        ("contact.law", "hunt_crossley", "elastic"),
        ("rig.integrator", "explicit_euler", "rk4"),
        ("rig.command_hold", "linear", "foh"),
        ("name", "n" * 100, "n" * 101),
        ("name", "naïve mechanism", "two\nlines"),
        ("source", "two\nlines\tand more", "\x1b[31m"),
        ("schema", "jaxhil/mechanism/1", "jaxhil/mechanism/2"),
    ],
)
def test_edges_of_ranges(path, inside, outside):
    assert isinstance(from_builtins(changed({path: inside}), "f"), Mechanism)
    message = refusal(changed({path: outside}))
    assert f": {path}" in message and ", allowed " in message


HARDENING = {"contact.law": "hardening", "contact.reference_depth": 2e-4}
DEPTH_DAMPED = {"contact.law": "depth_damped", "contact.reference_depth": 2e-4}
ELASTOPLASTIC = {
    "contact.law": "elastoplastic",
    "contact.unloading_ratio": 1.0,
    "contact.damping": [0.0, 0.0],
}


@pytest.mark.parametrize("contact", [HARDENING, DEPTH_DAMPED, ELASTOPLASTIC], ids=lambda c: c["contact.law"])
def test_keys_of_one_law(contact):
    name, key = contact["contact.law"], list(contact)[1]
    drawn = {"uncertainty": {key: {"distribution": "uniform", "factor": [1.0, 1.5]}}}
    mechanism = from_builtins(changed({**contact, **drawn}), "f")
    assert value_at(mechanism, key) == contact[key]
    message = refusal(changed({k: value for k, value in contact.items() if k != key}))
    assert f": {key}: found nothing, allowed a number >" in message and f"(law {name} needs it)" in message
    for value in (0.99 if "ratio" in key else 0.0, math.inf, "1", [1.0]):
        assert f": {key}: found " in refusal(changed({**contact, key: value}))
    message = refusal(changed({key: contact[key]}))
    assert f": {key}: found {contact[key]}, allowed nothing (only for law " in message and name in message
    other = OF_ONE_LAW[key == OF_ONE_LAW[0]]
    assert f": {other}: found 2.0, allowed nothing" in refusal(changed({**contact, other: 2.0}))
    low = {key: {"distribution": "uniform", "low": 0.0, "high": 2.0}}
    assert f': uncertainty."{key}": found values as far as 0' in refusal(
        changed({**contact, "uncertainty": low})
    )


def test_elastoplastic_contact_has_no_damping():
    message = refusal(changed({**ELASTOPLASTIC, "contact.damping": [0.0, 3.0]}))
    assert ": contact.damping: found [0.0, 3.0], allowed 0 (law elastoplastic" in message
    drawn = {"contact.damping": {"distribution": "uniform", "low": 0.0, "high": 2.0}}
    assert "found an uncertain damping" in refusal(changed({**ELASTOPLASTIC, "uncertainty": drawn}))


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"bodies.chaser_mass": 1.0}, "bodies.equivalent_mass"),
        ({"bodies": {"chaser_mass": 1.0}}, "bodies.target_mass"),
        ({"bodies": {"target_mass": 1.0}}, "bodies.chaser_mass"),
        ({"bodies": {"chaser_mass": 1e308, "target_mass": 1e308}}, "bodies"),
        ({"contact.stiffness": [1e5, [1e5]]}, "contact.stiffness[1]"),
        ({"contact.law": "piecewise_linear"}, "contact.stiffness[0]"),
        (
            {"contact.law": "piecewise_linear", "contact.stiffness": [[1e5, 2e5]]},
            "contact.stiffness[0]",
        ),
        ({"contact.law": "piecewise_linear", "contact.depths": []}, "contact.depths"),
        (
            {"contact.law": "piecewise_linear", "contact.stiffness": [[1e5, 0.0, 1.0]]},
            "contact.stiffness[0][1]",
        ),
        ({"contact.clearance": 1e-4}, "contact.clearance"),
        (
            {"rig.simulator.model": "first_order", "rig.simulator.time_constant": 0.0},
            "rig.simulator.time_constant",
        ),
        (
            {"rig.simulator.model": "third_order", "rig.simulator.coefficients": [0.1, 0.1, 0.011]},
            "rig.simulator.coefficients",
        ),
        (
            {"rig.simulator.model": "third_order", "rig.simulator.coefficients": ...},
            "rig.simulator.coefficients",
        ),
        ({"rig.simulator.coefficients": [0.1, 0.1]}, "rig.simulator.coefficients"),
        ({"rig.simulator.model": "ideal"}, "rig.command_hold"),
    ],
)
def test_rules_across_keys(changes, key):
    assert f": {key}: found" in refusal(changed(changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"bodies": {"chaser_mass": 300, "target_mass": 1000}},
        {"contact.law": "piecewise_linear", "contact.stiffness": [[1e5, 2e5, 3e5]]},
        {"rig.simulator.model": "first_order"},
        {"rig.simulator.model": "third_order"},
        {"rig.simulator.model": "transfer_function"},
        {"rig.simulator.model": "ideal", "contact.damping": 0.0},
        {"rig.simulator.model": "ideal", "contact.law": "linear"},
        {"rig.simulator.model": "ideal", "rig.command_hold": "linear"},
    ],
)
def test_other_laws_and_models(changes):
    mechanism = from_builtins(changed(changes), "f")
    assert from_builtins(to_builtins(mechanism), "f") == mechanism


@pytest.mark.parametrize(
    ("changes", "lag"),
    [
        ({"rig.simulator.model": "ideal", "contact.damping": 0.0}, 0.0),
        ({"rig.simulator.model": "first_order"}, 0.01),
        # Drawn down to 10 Hz.
        ({}, 2 * 0.8 / (2 * math.pi * 10.0)),
        ({"rig.simulator.model": "third_order"}, 0.1),
        (
            {
                "rig.simulator.model": "transfer_function",
                "rig.simulator.numerator": [0.3, 2.0],
                "rig.simulator.denominator": [1e-3, 0.5, 2.0],
            },
            0.25 - 0.15,
        ),
    ],
)
def test_both_positions_start_inside_the_gap(changes, lag):
    # Free approach and phase, then latency, transport delay and lag of x_a.
    start = 0.005 * (0.02 + 0.001 + 0.001 + 0.004 + lag)
    changes = changes | {"rig.contact_plane": ...}
    assert from_builtins(changed(changes | {"contact.clearance": start * (1 + 1e-9)}), "f")
    message = refusal(changed(changes | {"contact.clearance": start * (1 - 1e-9)}))
    assert ": contact.clearance: found " in message and f"allowed a clearance > {start:g}" in message


@pytest.mark.parametrize(
    ("clearance", "plane", "allowed"),
    [
        (math.inf, -1.001e-4, "a number > -0.0001, -0.02 s v: the start"),
        (0.02, -1.001e-4, "a number > -0.0001, -0.02 s v, and < 0.0197427"),
        # Free approach and phase, then latency, transport delay and lag of x_a.
        (0.02, 0.02 - 0.99 * 0.005 * (0.026 + 2 * 0.8 / (2 * math.pi * 10.0)), "and < 0.0197427, the clear"),
    ],
)
def test_the_start_is_free_of_the_contact_plane(clearance, plane, allowed):
    changes = {"contact.clearance": clearance}
    assert from_builtins(changed(changes | {"rig.contact_plane": 0.99 * plane}), "f")
    message = refusal(changed(changes | {"rig.contact_plane": plane}))
    assert ": rig.contact_plane: found " in message and allowed in message


@pytest.mark.parametrize(
    ("numerator", "denominator", "key"),
    [
        ([1.0, 1.0], [1.0, 1.0], "numerator"),
        ([1.0], [1.0], "numerator"),
        ([1.0 + 2e-9], [1.0, 1.0], "numerator"),
        ([0.0], [1.0, 1.0], "numerator"),
        ([-1.0], [1.0, -1.0], "denominator"),
        ([1.0], [1.0, 0.0, 1.0], "denominator"),
        ([1.0], [1.0, 1.0, 0.0], "denominator"),
        ([1.0], [1.0, 1.0, 1.0, 1.0], "denominator"),
        ([1.0], [1e308, 1e-308, 1e308, 1.0], "denominator"),
        ([1.0 + 5e-10], [1.0, 1.0], None),
        ([0.0, 0.0, 2.0], [0.0, 1.0, 3.0, 2.0], None),
        ([-1.0], [-1.0, -1.0], None),
        ([1.0, 1.0], np.poly(-np.ones(20)).tolist(), None),
    ],
)
def test_transfer_function(numerator, denominator, key):
    # One-sided: a gap would have to be wider than the lag of some of these.
    changes = {"rig.simulator.model": "transfer_function", "contact.clearance": ...}
    changes |= {"rig.simulator.numerator": numerator, "rig.simulator.denominator": denominator}
    raw = changed(changes)
    if key:
        assert f": rig.simulator.{key}: found" in refusal(raw)
    else:
        simulator = from_builtins(raw, "f").rig.simulator
        assert simulator.numerator == list(np.trim_zeros(numerator, "f"))
        assert simulator.denominator == list(np.trim_zeros(denominator, "f"))


@settings(deadline=None)
@given(
    st.lists(st.complex_numbers(min_magnitude=0.01, max_magnitude=100.0), max_size=3),
    st.lists(st.floats(-100.0, 100.0), max_size=3),
)
def test_hurwitz_against_roots(pairs, reals):
    roots = [*pairs, *np.conj(pairs), *reals]
    rightmost = max((root.real for root in map(complex, roots)), default=-1.0)
    polynomial = np.real(np.poly(roots)) if roots else np.ones(1)
    # Rounding of the coefficients moves roots next to the axis over it.
    if abs(rightmost) > 1e-2:
        assert is_hurwitz(polynomial.tolist()) == (rightmost < 0.0)
        assert is_hurwitz((-polynomial).tolist()) == (rightmost < 0.0)


@settings(deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    ),
    st.data(),
)
def test_any_value_anywhere_is_accepted_or_refused_in_one_line(value, data):
    path = data.draw(st.sampled_from([*leaves(), *(table[:-1] for table in tables() if table)]))
    raw = changed({path: value})
    try:
        mechanism = from_builtins(raw, "some file")
    except InputError:
        assert path.split(".")[0] in refusal(raw)
    else:
        assert from_builtins(to_builtins(mechanism), "f") == mechanism


@settings(deadline=None)
@given(st.text(), st.integers(3, 80))
def test_shown_and_one_line_are_short_and_printable(text, limit):
    assert one_line(text).isprintable()
    assert one_line(text, limit).isprintable() and len(one_line(text, limit)) <= limit
    assert shown(text).isprintable() and len(shown(text)) <= 60
    assert shown([text]).isprintable() and len(shown([text])) <= 60


def test_shown_copes_with_values_that_have_no_text():
    nested = []
    for _ in range(100_000):
        nested = [nested]
    assert shown(nested) == "a deeply nested list"
    assert shown(10**5000) == "a number of thousands of digits"
    assert shown({"a": 1}) == "a table"
    assert (shown(None), shown(True), shown(-1.5)) == ("nothing", "true", "-1.5")
