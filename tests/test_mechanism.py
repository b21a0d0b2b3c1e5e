"""Mechanism keys: values, defaults, and messages for rejected values."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanism_table import EXCLUDED, FULL, LAYERED, OF_OTHERS, changed, leaves, refusal, tables

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.mechanism.file import from_plain_data, to_plain_data
from jaxhil.mechanism.number_ranges import numeric_keys, value_at
from jaxhil.mechanism.structs import Bodies, Mechanism

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
    "rig.force_sensor.filter.kind",
    "rig.force_sensor.filter.order",
    "rig.force_sensor.filter.cutoff",
]
POSITIVE = [
    "bodies.equivalent_mass",
    "approach.velocity",
    "contact.stiffness",
    "contact.clearance",
    "rig.control_period",
    "rig.simulator.natural_frequency",
    "rig.simulator.damping_ratio",
    "rig.simulator.velocity_limit",
    "rig.simulator.acceleration_limit",
    "rig.force_sensor.range",
    "rig.force_sensor.filter.cutoff",
]
MAY_BE_INFINITE = [
    "contact.clearance",
    "rig.simulator.velocity_limit",
    "rig.simulator.acceleration_limit",
    "rig.force_sensor.range",
]


def test_every_value_of_mechanism_table_is_read():
    mechanism = from_plain_data(FULL, "f")
    for path in leaves():
        if path != "uncertainty":
            node = FULL
            for part in path.split("."):
                node = node[part]
            assert value_at(mechanism, path) == node
    for path in numeric_keys():
        if not path.startswith("bodies.") and path not in (*OF_OTHERS, *EXCLUDED):
            assert path in set(leaves())
    assert mechanism.uncertainty["contact.stiffness"].factor == [0.3, 3.0]
    assert mechanism.uncertainty["rig.force_sensor.delay"].independent


def test_missing_mechanism_keys_get_documented_defaults():
    raw = {"schema": FULL["schema"], "name": "n", "bodies": {"equivalent_mass": 1}}
    raw |= {"approach": {"velocity": 1}, "contact": {"law": "linear", "stiffness": 5}}
    raw |= {"rig": {"control_period": 0.001, "simulator": {"model": "ideal"}}}
    mechanism = from_plain_data(raw, "f")
    assert mechanism.source == "assumed" and mechanism.uncertainty == {}
    assert (mechanism.approach.contacts, mechanism.approach.phase) == (1, 1 / 3)
    contact, rig = mechanism.contact, mechanism.rig
    assert (contact.stiffness, contact.damping, contact.depths) == ([5.0], [0.0], [])
    assert (contact.tension, contact.clearance, contact.exponent) == (False, math.inf, 1.5)
    assert (rig.integrator, rig.command_latency) == ("semi_implicit_euler", 0)
    assert (rig.command_hold, rig.simulator.delay, rig.contact_plane) == ("linear", 0.0, 0.0)
    assert rig.simulator.velocity_limit == rig.simulator.acceleration_limit == math.inf
    assert rig.force_sensor.range == math.inf
    for name in ("delay", "time_constant", "noise_std", "quantum", "dead_zone", "bias", "bias_random_walk"):
        assert getattr(rig.force_sensor, name) == 0.0
    for name in ("delay", "noise_std", "quantum"):
        assert getattr(rig.position_sensor, name) == 0.0


def test_equivalent_mass_is_computed_from_both_masses():
    assert Bodies(chaser_mass=300.0, target_mass=600.0).mass == 200.0
    assert Bodies(equivalent_mass=7.0).mass == 7.0
    with pytest.raises(ValueError, match="bodies"):
        _ = Bodies(chaser_mass=1.0).mass


@pytest.mark.parametrize("path", REQUIRED)
def test_missing_mechanism_key_is_named_in_error(path):
    assert f": {path}: found nothing" in refusal(changed({path: ...}))


@pytest.mark.parametrize("path", sorted(set(leaves()) - set(REQUIRED)))
def test_optional_mechanism_keys_may_be_missing(path):
    assert isinstance(from_plain_data(changed({path: ...}), "f"), Mechanism)


@pytest.mark.parametrize("path", [*leaves(), *(table[:-1] for table in tables() if table)])
@pytest.mark.parametrize("value", ["a\nb\x1b[31m", True, {"x": 1}, [[[1.0]]], b"raw", -1e308])
def test_wrong_type_of_mechanism_value_is_named_in_error(path, value):
    if (path == "contact.tension" and value is True) or path in ("name", "source"):
        value = 3
    if path == "rig.force_sensor.bias" and isinstance(value, float):
        value = "text"
    message = refusal(changed({path: value}))
    assert f": {path}" in message and ", expected " in message


@pytest.mark.parametrize("table", [*tables()])
@pytest.mark.parametrize("key", ["unknown", "", "new\nline", "\x1b[31m" * 50, '"\\', "\ud800"])
def test_unknown_mechanism_key_is_named_in_error(table, key):
    raw = changed()
    node = raw
    for part in table.split(".")[:-1]:
        node = node[part]
    node[key] = 1.0
    message = refusal(raw)
    assert f": {table}" in message and "unknown key" in message


def test_error_for_misspelt_mechanism_key_suggests_correct_key():
    message = refusal(changed({"contact.stiffness": ..., "contact.stifness": 1e5}))
    assert "contact.stifness: found an unknown key" in message
    assert "did you mean stiffness?" in message


@pytest.mark.parametrize("path", [*numeric_keys()])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 10**400, -(10**400)])
def test_non_finite_mechanism_values_are_rejected_unless_key_allows_infinity(path, value):
    listed = [value, 1.0, 1.0] if isinstance((OF_OTHERS | dict(flat(FULL))).get(path), list) else value
    base = changed()
    if path in ("bodies.chaser_mass", "bodies.target_mass"):
        base["bodies"] = {"chaser_mass": 1.0, "target_mass": 1.0}
    raw = changed({path: listed}, base)
    if value == math.inf and path in MAY_BE_INFINITE:
        assert value_at(from_plain_data(raw, "f"), path) == math.inf
    else:
        assert f": {path}" in refusal(raw)


def flat(node, path=""):
    for key, value in node.items():
        if isinstance(value, dict):
            yield from flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


@pytest.mark.parametrize("path", sorted(set(numeric_keys()) & set(leaves())))
def test_zero_and_negative_mechanism_values_are_rejected_if_key_forbids_them(path):
    nominal = dict(flat(FULL))[path]
    signed = ("contact_plane", "force_sensor.bias")
    may_be_negative = path.removeprefix("rig.") in signed
    for value in (0.0, -1e-9):
        listed = [value, *nominal[1:]] if isinstance(nominal, list) else value
        raw = changed({path: listed})
        if (value < 0.0 and not may_be_negative) or path in [*POSITIVE, "contact.exponent"]:
            assert f": {path}" in refusal(raw)
        else:
            assert isinstance(from_plain_data(raw, "f"), Mechanism)


@pytest.mark.parametrize(
    ("path", "inside", "outside"),
    [
        ("approach.phase", 1.0, 1.001),
        ("approach.contacts", 1000, 1001),
        ("approach.contacts", 1, 0),
        ("approach.contacts", 1, 1.0),
        ("rig.control_period", 0.1, 0.11),
        ("rig.command_latency", 4, 5),
        ("rig.command_latency", 0, -1),
        ("rig.simulator.delay", 1.0, 1.01),
        ("rig.force_sensor.delay", 1.0, 1.01),
        ("rig.position_sensor.delay", 1.0, 1.01),
        ("contact.stiffness", [1.0] * 1000, [1.0] * 1001),
        ("contact.stiffness", [1.0], []),
        ("contact.damping", 0, []),
        ("contact.law", "hunt_crossley", "elastic"),
        ("rig.integrator", "explicit_euler", "rk4"),
        ("rig.command_hold", "linear", "foh"),
        ("name", "n" * 100, "n" * 101),
        ("name", "naïve mechanism", "two\nlines"),
        ("source", "two\nlines\tand more", "\x1b[31m"),
        ("schema", "jaxhil/mechanism/1", "jaxhil/mechanism/2"),
    ],
)
def test_mechanism_values_at_range_limits_are_accepted_and_beyond_rejected(path, inside, outside):
    assert isinstance(from_plain_data(changed({path: inside}), "f"), Mechanism)
    message = refusal(changed({path: outside}))
    assert f": {path}" in message and ", expected " in message


@pytest.mark.parametrize(
    ("path", "inside", "outside"),
    [
        ("contact.exponent", 1.0, 0.99),
        ("contact.exponent", 1e100, 1.1e100),
        ("contact.damping", 1e-100, 0.9e-100),
        ("bodies.equivalent_mass", 1e-100, 1e-320),
    ],
)
def test_hunt_crossley_values_at_range_limits_are_accepted_and_beyond_rejected(path, inside, outside):
    base = changed({"contact.law": "hunt_crossley"})
    assert value_at(from_plain_data(changed({path: inside}, base), "f"), path) in (inside, [inside])
    assert f": {path}" in refusal(changed({path: outside}, base))


def test_contact_segment_depths_that_do_not_increase_are_rejected():
    assert from_plain_data(changed(LAYERED), "f").contact.depths == LAYERED["contact.depths"]
    for wrong in ([0.001, 0.001], [0.0, 0.001], [0.001, -0.1]):
        assert ": contact.depths[" in refusal(changed({**LAYERED, "contact.depths": wrong}))


@pytest.mark.parametrize("value", [1e-320, -1e-320, 1e-101, 1.1e100, -1.7e308])
def test_mechanism_values_that_overflow_or_underflow_in_products_are_rejected(value):
    message = refusal(changed({"rig.force_sensor.bias": value}))
    assert f": found {value}, expected a finite number of N, of a magnitude from 1e-100 to 1e+100" in message


@settings(deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    ),
    st.data(),
)
def test_any_value_of_any_mechanism_key_is_accepted_or_rejected_with_one_line_message(value, data):
    path = data.draw(st.sampled_from([*leaves(), *(table[:-1] for table in tables() if table)]))
    raw = changed({path: value})
    try:
        mechanism = from_plain_data(raw, "some file")
    except InputError:
        assert path.split(".")[0] in refusal(raw)
    else:
        assert from_plain_data(to_plain_data(mechanism), "f") == mechanism


@settings(deadline=None)
@given(st.text(), st.integers(3, 80))
def test_formatted_values_in_messages_are_short_and_printable(text, limit):
    assert to_one_line(text).isprintable()
    assert to_one_line(text, limit).isprintable() and len(to_one_line(text, limit)) <= limit
    assert format_value(text).isprintable() and len(format_value(text)) <= 60
    assert format_value([text]).isprintable() and len(format_value([text])) <= 60


def test_message_format_handles_deeply_nested_lists_and_huge_numbers():
    nested = []
    for _ in range(100_000):
        nested = [nested]
    assert format_value(nested) == "a deeply nested list"
    assert format_value(10**5000) == "a number of thousands of digits"
    assert format_value({"a": 1}) == "a table"
    assert (format_value(None), format_value(True), format_value(-1.5)) == ("nothing", "true", "-1.5")
