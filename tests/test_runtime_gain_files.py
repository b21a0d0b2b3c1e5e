"""Gain files in the runtime controller: inconsistent files are rejected in one line."""

import json
import math
from typing import Any

import pytest
from gain_documents import GAINS, gain_document, sign
from hypothesis import given, settings
from hypothesis import strategies as st
from runtime_readings import readings, run

from jaxhil.rig import Controller, GainFileError, digest


def refused(document: Any, *words: str) -> str:
    with pytest.raises(GainFileError) as caught:
        Controller.from_dict(document)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 400
    for word in words:
        assert word in message
    return message


def paths(node: Any, path: tuple = ()) -> list[tuple]:
    """Yield the paths of every entry, at any depth."""
    result = [path] if path else []
    entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in entries:
        result += paths(value, (*path, key))
    return result


def value_at(document: Any, path: tuple) -> Any:
    for key in path:
        document = document[key]
    return document


SIGNED = [
    (name, path)
    for name in sorted(GAINS)
    for path in paths(gain_document(name))
    if path[0] not in ("created", "timings")
]
JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda values: st.lists(values, max_size=2) | st.dictionaries(st.text(max_size=4), values, max_size=2),
    max_leaves=4,
)


@given(place=st.sampled_from(SIGNED), value=JSON_VALUES, remove=st.booleans())
@settings(max_examples=300, deadline=None)
def test_gain_file_with_any_field_mutated_is_rejected(place, value, remove):
    name, path = place
    document = gain_document(name)
    container, key = value_at(document, path[:-1]), path[-1]
    if remove:
        del container[key]
    elif json.dumps(container[key], sort_keys=True) == json.dumps(value, sort_keys=True):
        return
    else:
        container[key] = value
    refused(document)


@given(value=JSON_VALUES, path=st.sampled_from([p for n, p in SIGNED if n == "response_error"]))
@settings(max_examples=300, deadline=None)
def test_changed_gain_file_with_valid_digest_loads_or_is_rejected_with_one_line_message(path, value):
    document = gain_document()
    value_at(document, path[:-1])[path[-1]] = value
    try:
        sign(document)
    except ValueError:
        refused(document)
        return
    try:
        controller = Controller.from_dict(document)
    except GainFileError as error:
        assert str(error).isprintable()
    else:
        controller.step(100.0, 1e-3, 0.0, 1e-3)


@pytest.mark.parametrize("name", sorted(GAINS))
def test_controller_from_gain_file_equals_controller_from_dictionary(name, tmp_path):
    document = gain_document(name)
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(document, indent=2), encoding="utf-8")
    ticks = readings(100)
    assert run(Controller.from_file(path), ticks) == run(Controller.from_dict(document), ticks)


def test_gain_file_digest_covers_content_but_not_date_and_timings():
    document = gain_document()
    stated = document["sha256"]
    document["created"], document["timings"] = "later", {}
    assert digest(document) == stated
    Controller.from_dict(document)
    assert digest(dict(reversed(document.items()))) == stated
    document["seed"] = 1
    assert digest(document) != stated
    # Recorded from `sha256sum` of the canonical text itself.
    assert digest({"b": 1.5, "a": "\u00e9", "sha256": "", "created": "", "timings": {}}) == (
        "58cb8a469294078eeafef7f1c22eb93d48a3fe96f63021dee6f65daf4b817635"
    )


def change(*path_and_value: Any) -> dict[str, Any]:
    """Return a response-error document with one entry replaced, or removed for `...`."""
    *path, key, value = path_and_value
    document = gain_document()
    container = value_at(document, tuple(path))
    if value is ...:
        del container[key]
    else:
        container[key] = value
    return sign(document)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (("compensator", "pid"), ["compensator", "'pid'", "response_error"]),
        (("compensator", ["none"]), ["compensator", "a list"]),
        (("compensator", "none"), ["gains", "extra", "no gains"]),
        (("gains", ...), ["gains", "nothing"]),
        (("gains", "forgetting", ...), ["gains.forgetting", "nothing"]),
        (("gains", "speed", {}), ["extra gain 'speed'"]),
        (("gains", "forgetting", 0.99), ["gains.forgetting", "0.99", "an object"]),
        (("gains", "phase_lead", "unit", "ms"), ["gains.phase_lead.unit", "'ms'", "'s'"]),
        (("gains", "phase_lead", "unit", ...), ["gains.phase_lead.unit", "nothing"]),
        (("gains", "phase_lead", "value", 0.06), ["phase_lead.value", "0.06", "0.0 to 0.05"]),
        (("gains", "phase_lead", "value", -1e-9), ["phase_lead.value", "0.0 to 0.05"]),
        (("gains", "phase_lead", "value", True), ["phase_lead.value", "true", "finite number"]),
        (("gains", "phase_lead", "value", "0"), ["phase_lead.value", "'0'", "finite number"]),
        (("gains", "phase_lead", "value", 10**400), ["phase_lead.value", "finite number"]),
        (("gains", "phase_lead", "lower", ...), ["phase_lead.lower", "nothing"]),
        (("gains", "phase_lead", "upper", None), ["phase_lead.upper", "null"]),
        (("gains", "lead_filter", {"value": 0, "unit": "s", "lower": 0, "upper": 1}), ["1e-06 to 2.1"]),
        (("gains", "forgetting", {"value": 2, "unit": "1", "lower": 0, "upper": 3}), ["0.5 to 1.0"]),
        (("gains", "response_error", {"value": 50, "unit": "1", "lower": 0, "upper": 99}), ["0.0 to 2.0"]),
        (("control_period", 0), ["control_period", "1e-05 to 0.1"]),
        (("control_period", True), ["control_period", "true"]),
        (("control_period", 0.002), ["control_period", "0.002", "0.001"]),
        (("mechanism", ...), ["mechanism", "nothing"]),
        (("mechanism", []), ["mechanism", "a list"]),
        (("mechanism", "rig", ...), ["mechanism.rig", "nothing"]),
        (("mechanism", "rig", "control_period", 0.004), ["control_period", "0.004"]),
        (("mechanism", "contact", ...), ["mechanism.contact", "nothing"]),
        (("mechanism", "contact", "clearance", -1.0), ["mechanism.contact.clearance", "-1.0"]),
    ],
)
def test_inconsistent_gain_file_is_rejected_with_name_of_key(edit, words):
    refused(change(*edit), *words)


def test_gain_file_with_delay_longer_than_delay_line_is_rejected():
    document = gain_document(control_period=1e-5)
    document["gains"]["identification_delay"] |= {"value": 1.5, "upper": 1.5}
    refused(sign(document), "gains", "periods, expected 0 to 100000")


def test_gain_file_schema_and_digest_are_checked_before_other_entries():
    refused({}, "schema", "nothing")
    refused([], "a list")
    refused({"schema": "jaxhil/gains/2"}, "'jaxhil/gains/2'", "'jaxhil/gains/1'")
    document = change("compensator", "pid")
    refused({**document, "sha256": "0" * 64}, "sha256", "0" * 64)
    refused({**document, "sha256": None}, "sha256", "null")
    refused({**document, "seed": math.nan}, "JSON")
    refused({**document, "seed": {1, 2}}, "JSON")


def test_deeply_nested_gain_file_is_rejected():
    deep: Any = 0
    for _ in range(3000):
        deep = [deep]
    document = gain_document()
    document["figures"] = deep
    refused(document, "nesting")
    circle: list = []
    circle.append(circle)
    document["figures"] = circle
    refused(document, "nesting")


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "not JSON"),
        (b"{", "not JSON"),
        (b"[1, 2]", "a list"),
        (b"\xff\xfe", "UTF-8"),
        (b"\xef\xbb\xbf{}", "not JSON"),
        (b'{"schema": NaN}', "NaN"),
        (b'{"schema": 1, "schema": 2}', "twice"),
        (b'{"seed": ' + b"9" * 5000 + b"}", "not JSON"),
        (b"[" * 200_000, "nesting"),
        (b" " * (4 * 1024 * 1024 + 1), "at most 4194304 bytes"),
        (b'{"schema": "a\\nb\\u001b\\ud800"}', "schema"),
    ],
    ids=lambda value: None if isinstance(value, str) else repr(value[:12]),
)
def test_unreadable_gain_file_is_rejected_with_one_printable_line(content, word, tmp_path):
    path = tmp_path / "gains.json"
    path.write_bytes(content)
    with pytest.raises(GainFileError, match=word) as caught:
        Controller.from_file(path)
    message = str(caught.value)
    assert message.isprintable() and message.startswith(str(path)) and len(message) < 500


def test_unreadable_gain_file_paths_are_rejected(tmp_path):
    for path in (tmp_path / "absent\n.json", tmp_path, "nul\0byte"):
        with pytest.raises(GainFileError, match="cannot be read") as caught:
            Controller.from_file(path)
        assert str(caught.value).isprintable()


def test_gain_file_accepts_integers_for_gains():
    document = change("gains", "initial_stiffness", "value", 90000)
    assert Controller.from_dict(document).identified == (90000.0, 50.0)
