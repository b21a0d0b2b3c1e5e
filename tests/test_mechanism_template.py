"""New mechanism files, their JSON Schema, and the key descriptions used for both."""

import functools
import re
import tomllib
from typing import Annotated

import jsonschema
import msgspec
import pytest

from jaxhil.mechanism.file import (
    builtin_names,
    builtin_path,
    load,
    load_any,
    six_axis_names,
    suite_names,
    to_plain_data,
)
from jaxhil.mechanism.json_schema import build_json_schema
from jaxhil.mechanism.keys import describe_tables
from jaxhil.mechanism.number_ranges import numeric_keys
from jaxhil.mechanism.structs import MAX_CONTACTS, key_metadata
from jaxhil.mechanism.template import format_mechanism_file

NAMES = [*builtin_names(), *suite_names()]


@pytest.fixture(scope="module")
def validator():
    schema = build_json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


CORRELATED = {
    "correlation": {
        "keys": ["approach.velocity", "rig.force_sensor.delay"],
        "matrix": [[1.0], [-0.25, 1.0]],
    }
}


@pytest.mark.parametrize("name", [*NAMES, "correlated"])
def test_new_mechanism_file_is_equivalent_to_the_copied_mechanism(name, written):
    mechanism = load("varying", CORRELATED).mechanism if name == "correlated" else load(name).mechanism
    text = format_mechanism_file(mechanism)
    assert load(written(text)).mechanism == mechanism
    assert max(map(len, text.splitlines())) <= 110 or max(map(len, mechanism.source.splitlines())) > 90


def test_new_mechanism_file_has_every_key_at_its_default(written):
    text = format_mechanism_file(load("rig-300kg").mechanism)
    defaults = {
        f"{table.path}.{key.name}".lstrip("."): key.default
        for table in describe_tables()
        for key in table.keys
    }
    shown, path = {}, ""
    for line in text.splitlines():
        if result := re.fullmatch(r"#?\[([\w.]+)\].*", line):
            path = result[1] + "."
        elif result := re.match(r"(#?)(\w+) =(.*)", line):
            value = tomllib.loads("value =" + result[3]) if result[3].split("#")[0].strip() else {}
            shown[path + result[2]] = (result[1], value.get("value"))
    assert set(shown) == {name for name in defaults if '"' not in name}
    assert all(value == defaults[name] for name, (sign, value) in shown.items() if sign)
    # Compare with the file without comment signs, where the law uses the keys.
    of_laws = {key.name for table in describe_tables() for key in table.keys if key.users}
    live = re.sub(
        r"^#(\w+)( = )", lambda line: line[0] if line[1] in of_laws else line[1] + line[2], text, flags=re.M
    )
    live = "\n".join(line for line in live.splitlines() if not re.match(r"\w+ = +# ", line))
    assert load(written(live)).mechanism == load("rig-300kg").mechanism


def test_new_mechanism_file_contains_description_of_every_key():
    text = format_mechanism_file(load("varying").mechanism)
    assert re.search(r"^velocity = 0\.005 +# speed of the first approach: a number > 0 m/s$", text, re.M)
    assert re.search(r"^#tension = false +# whether kelvin_voigt may pull: true or false$", text, re.M)


def test_mechanism_key_descriptions_state_unit_range_and_contact_laws():
    keys = {f"{table.path}.{key.name}": key for table in describe_tables() for key in table.keys}
    numbers = {path for path in keys if '"' not in path and keys[path].unit is not None}
    # Integer keys, and keys that stand for others.
    others = {"approach.contacts", "rig.command_latency", "rig.force_sensor.filter.order"}
    others |= {"correlation.matrix", "contact.damping_ratio"}
    assert numbers - others == set(numeric_keys())
    assert all(keys[path].unit == numeric_keys()[path].unit for path in numbers - others)
    assert keys["approach.contacts"].allowed == f"an integer from 1 to {MAX_CONTACTS}"
    assert keys["contact.preload"].users == ("preloaded",)
    assert keys["rig.simulator.coefficients"].users == ("third_order",)
    assert "elastoplastic" not in keys["contact.damping"].users
    assert keys["contact.damping_ratio"].users == ("kelvin_voigt", "hardening")
    assert keys["approach.velocity"].required and not keys["approach.contacts"].required


class _Silent(msgspec.Struct):
    drag: Annotated[float, msgspec.Meta(ge=0.0)]


class _Unitless(msgspec.Struct):
    drag: Annotated[float, key_metadata("of the air", ge=0.0)] | None = None


@pytest.mark.parametrize(
    ("kind", "reason"),
    [(_Silent, "drag: found no description"), (_Unitless, "drag: found no unit")],
)
def test_mechanism_key_without_description_or_unit_raises_error(kind, reason):
    with pytest.raises(ValueError, match=reason):
        describe_tables(kind)


@pytest.mark.parametrize("name", [*NAMES, *six_axis_names()])
def test_json_schema_accepts_builtin_mechanisms(validator, name):
    validator.validate(tomllib.loads(builtin_path(name).read_text(encoding="utf-8")))


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [
        ("approach", "velocity", -1.0),
        ("approach", "speed", 1.0),
        ("contact", "law", "magic"),
        ("contact", "damping", "much"),
        ("rig", "control_period", 0.5),
        ("uncertainty", "contact.hardness", {"distribution": "uniform", "factor": [0.5, 2.0]}),
        ("uncertainty", "contact.stiffness", {"distribution": "uniform", "factor": [0.5]}),
    ],
)
def test_json_schema_rejects_values_that_mechanism_reader_rejects(validator, table, key, value):
    document = to_plain_data(load("varying").mechanism)
    document[table][key] = value
    assert not validator.is_valid(document)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("target", "mass"), 0.0),
        (("contact", "tip", "chaser", "shape"), "cube"),
        (("contact", "tip", "law"), "magic"),
        (("rig", "simulator", "delay"), {"translation": 1e-3}),
        (("rig", "simulator", "delay"), [1e-3] * 5),
        (("rig", "force_sensor", "crosstalk"), "much"),
        (("rig", "velocity_limit"), 1.0),
    ],
)
def test_json_schema_rejects_values_that_six_axis_reader_rejects(validator, path, value):
    document = to_plain_data(load_any("probe-drogue").mechanism)
    assert validator.is_valid(document)
    *tables, key = path
    functools.reduce(dict.__getitem__, tables, document)[key] = value
    assert not validator.is_valid(document)


def test_json_schema_accepts_units_and_single_numbers_for_lists(validator):
    document = to_plain_data(load("varying").mechanism)
    document["contact"]["stiffness"] = 1e5
    validator.validate(document)
    sensor = validator.schema["$defs"]["ForceSensor"]["properties"]
    assert sensor["delay"]["description"] == "transport delay of the reading [s]"
    assert "default" not in sensor["range"]  # JSON has no infinity
