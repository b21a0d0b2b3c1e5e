"""Gain files: atomic writes, exact values after reading, one-line errors, and the force envelope."""

import copy
import itertools
import json
import math
import os
from collections import namedtuple

import numpy as np
import pytest
from conftest import Ran
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize
from user_registered_laws import SquaredSpring

import jaxhil
from jaxhil.errors import InputError
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.response_error.simulation import typical_stiffness
from jaxhil.mechanism.file import builtin_names, load
from jaxhil.rig import Controller, GainFileError, digest
from jaxhil.simulation.gain_file import check_document, load_gain_file
from jaxhil.simulation.scenario import build_scenarios
from tuning.gain_file import build_document, to_json_data, validity_envelope, write_gain_file

ENVELOPE = {"delay": {"low": 0.01, "high": 0.012, "unit": "s"}}


def make(mechanism_name="varying", compensator="response_error", overrides=(), **changes):
    """Return the document of a mechanism with gains by the literature's rule or from `changes`."""
    mechanism, sha256, _ = load(mechanism_name, overrides)
    gains = {gain.name: gain.nominal(mechanism) for gain in COMPENSATORS[compensator].gains}
    gains.update(changes)
    figures = {"nominal": {"error": 0.01}}
    return build_document(compensator, gains, mechanism, sha256, ENVELOPE, figures, 7, {"tune_s": 1.5})


@pytest.mark.parametrize("compensator", COMPENSATORS)
@pytest.mark.parametrize("mechanism_name", builtin_names())
def test_gain_file_is_read_back_as_written(mechanism_name, compensator, tmp_path):
    document = make(mechanism_name, compensator)
    path = tmp_path / "gains.json"
    write_gain_file(path, document)
    loaded = load_gain_file(path)
    assert loaded.document == document
    assert loaded.compensator == compensator
    assert loaded.mechanism == load(mechanism_name).mechanism
    assert loaded.gains == {name: entry["value"] for name, entry in document["gains"].items()}
    assert list(loaded.gains) == [gain.name for gain in COMPENSATORS[compensator].gains]
    assert Controller.from_file(path).control_period == loaded.mechanism.rig.control_period


def test_gain_file_digest_ignores_date_and_timings():
    document = make()
    later = {**document, "created": "2031-01-01T00:00:00+00:00", "timings": {}}
    assert digest(later) == digest(document) == document["sha256"]
    assert digest({**document, "seed": 8}) != document["sha256"]


def test_gain_file_units_and_bounds_equal_those_of_the_compensator():
    document, mechanism = make(), load("varying").mechanism
    for gain in COMPENSATORS["response_error"].gains:
        entry = document["gains"][gain.name]
        assert (entry["unit"], entry["lower"], entry["upper"]) == (
            gain.unit,
            gain.lower(mechanism),
            gain.upper(mechanism),
        )


def test_gain_file_stores_overridden_mechanism_values():
    loaded = check_document(make(overrides=["contact.stiffness=5e4", "rig.force_sensor.range=900"]))
    assert loaded.mechanism.contact.stiffness == [5e4]
    assert loaded.mechanism.rig.force_sensor.range == 900.0


def test_gain_file_is_ascii_json_with_sorted_keys_and_digest(tmp_path):
    path = tmp_path / "gains.json"
    document = make()
    write_gain_file(path, {**document, "note": "Dämpfung", "sha256": "stale"})
    text = path.read_bytes()
    assert text.isascii() and text.endswith(b"}\n")
    content = json.loads(text)
    assert list(content) == sorted(content)
    assert content["sha256"] == digest(content)
    assert load_gain_file(path).document["note"] == "Dämpfung"


def test_gain_file_is_unchanged_after_failed_write(tmp_path, monkeypatch):
    path = tmp_path / "gains.json"
    write_gain_file(path, make())
    before = path.read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        with pytest.raises(InputError, match=r"gains\.json: cannot be written: No space left on device"):
            write_gain_file(path, {**make(), "seed": 8})
    with pytest.raises(ValueError, match="JSON"):
        write_gain_file(path, {**make(), "figures": {"error": math.nan}})
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["gains.json"]


def test_write_of_gain_file_to_missing_folder_is_rejected(tmp_path):
    with pytest.raises(InputError, match="cannot be written: No such file or directory"):
        write_gain_file(tmp_path / "nowhere" / "gains.json", make())


def test_json_data_has_null_for_non_finite_values():
    Pair = namedtuple("Pair", "error peak")
    value = {"a": np.array([1.0, np.nan]), "b": (np.inf, 2), "c": np.float32(0.5), "d": Pair(-math.inf, True)}
    assert to_json_data(value) == {
        "a": [1.0, None],
        "b": [None, 2],
        "c": 0.5,
        "d": {"error": None, "peak": True},
    }
    with pytest.raises(TypeError, match="found a set"):
        to_json_data({"a": {1}})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"forgetting": 1.01}, r"gains: forgetting: found 1\.01, expected 0\.8 to 1 1"),
        ({"forgetting": math.nan}, "gains: forgetting: found nan"),
        ({"phase_leed": 0.0}, "gains: phase_leed: found an extra gain, expected phase_lead, "),
    ],
)
def test_gain_document_with_gains_out_of_bounds_is_rejected(changes, message):
    with pytest.raises(InputError, match=message):
        make(**changes)


def test_gain_document_with_missing_gain_or_unknown_compensator_is_rejected():
    mechanism, sha256, _ = load("varying")
    with pytest.raises(
        InputError, match="gains: lead_filter: found nothing, expected phase_lead, lead_filter"
    ):
        build_document("phase_lead", {"phase_lead": 0.0}, mechanism, sha256, {}, {}, 0, {})
    with pytest.raises(InputError, match="compensator: found 'pid', expected one of none, "):
        build_document("pid", {}, mechanism, sha256, {}, {}, 0, {})


def test_gain_beyond_its_bound_by_rounding_is_clipped_in_gain_document():
    assert make(forgetting=1.0 + 2e-16 * 5)["gains"]["forgetting"]["value"] == 1.0


def change(document, path, value):
    """Return a signed copy of the document with the value at a dotted path replaced, or removed if None."""
    document = copy.deepcopy(document)
    *parents, last = path.split(".")
    table = document
    for parent in parents:
        table = table[parent]
    if value is None:
        del table[last]
    else:
        table[last] = value
    document["sha256"] = digest(document)
    return document


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("schema", "jaxhil/gains/2", "schema: found 'jaxhil/gains/2', expected 'jaxhil/gains/1'"),
        ("compensator", "pid", "compensator: found 'pid', expected one of"),
        ("compensator", "phase_lead", "gains: found an extra gain"),
        ("gains.forgetting", None, "gains.forgetting: found nothing"),
        ("gains.forgetting.unit", "s", "gains.forgetting.unit: found 's', expected '1'"),
        ("gains.forgetting.value", 0.5, "gains.forgetting.value: found 0.5, expected 0.8 to 1.0"),
        ("gains.forgetting.lower", 0.5, "gains.forgetting.lower: found 0.5, expected 0.8 to 1 for this"),
        ("gains.phase_lead.upper", 1.0, "gains.phase_lead.upper: found 1.0, expected 0 to 0.0"),
        ("control_period", 0.002, "control_period: found 0.002, expected 0.001, as mechanism"),
        ("mechanism.rig.control_period", 0.002, "control_period: found 0.001, expected 0.002"),
        ("mechanism", None, "mechanism: found nothing"),
        ("mechanism.bodies.equivalent_mass", -1.0, "mechanism: bodies.equivalent_mass: found -1.0"),
        ("mechanism.contact.law", "magnetic", "mechanism: contact.law: found 'magnetic'"),
        ("mechanism_sha256", "abc", "mechanism_sha256: found 'abc', expected 64 hexadecimal digits"),
        ("envelope", None, "envelope: found nothing, expected an object of {low, high, unit} objects"),
        ("envelope.delay", [0.0, 1.0], "envelope: found a table, expected an object of {low, high, unit}"),
        ("figures", 3, "figures: found 3, expected an object"),
        ("seed", True, "seed: found true, expected an integer >= 0"),
        ("seed", -1, "seed: found -1, expected an integer >= 0"),
        ("versions.jax", 1, "versions: found a table, expected an object of texts"),
        ("created", "yesterday", "created: found 'yesterday', expected a date and time with time zone"),
        ("timings", None, "timings: found nothing"),
    ],
)
def test_gain_file_rejects_inconsistent_entry(path, value, message, tmp_path):
    file = tmp_path / "gains.json"
    file.write_text(json.dumps(change(make(), path, value)))
    with pytest.raises(InputError) as caught:
        load_gain_file(file)
    text = str(caught.value)
    assert text.startswith(f"{file}: ") and message in text and text.isprintable()


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff", b'{"schema": NaN}', b"[" * 100_000])
def test_gain_file_reader_rejects_other_file_types(content, tmp_path):
    file = tmp_path / "gains.json"
    file.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_gain_file(file)
    assert str(caught.value).isprintable()


def assert_refused_everywhere(file, document, text, jaxhil):
    """Check that library, rig controller and commands reject a document with the same message."""
    file.write_text(json.dumps({**document, "sha256": digest(document)}))
    for read, error in ((load_gain_file, InputError), (Controller.from_file, GainFileError)):
        with pytest.raises(error) as caught:
            read(file)
        assert str(caught.value) == text
    for command in (["sweep"], ["export"], ["simulate", "--gains"]):
        assert jaxhil(*command, file) == Ran(2, "", f"jaxhil: {text}\n")


def test_gain_file_of_earlier_version_is_rejected_with_advice(tmp_path, jaxhil):
    file, document = tmp_path / "gains.json", make("varying", "impulse_ledger")
    for name in ("prior_friction_spread", "prior_preload_spread"):
        del document["gains"][name]
    text = (
        f"{file}: gains.prior_friction_spread: found nothing, expected all gains of impulse_ledger "
        "(for a file of an earlier version, run `jaxhil tune` again)"
    )
    assert_refused_everywhere(file, document, text, jaxhil)


@pytest.mark.parametrize("law", ["retrospective_reference", "retrospective_delay_bank"])
def test_gain_file_of_retired_compensator_is_rejected_with_replacement(law, tmp_path, jaxhil):
    file, document = tmp_path / "gains.json", make("varying", "impulse_ledger")
    text = f"{file}: compensator: found '{law}', expected 'impulse_ledger', which replaces it"
    assert_refused_everywhere(file, {**document, "compensator": law}, text, jaxhil)


def test_gain_file_edited_without_new_digest_is_rejected(tmp_path):
    file = tmp_path / "gains.json"
    write_gain_file(file, make())
    file.write_text(file.read_text().replace('"value": 0.98', '"value": 0.97'))
    with pytest.raises(InputError, match=r"sha256: found .*was it edited"):
        load_gain_file(file)
    with pytest.raises(InputError, match="cannot be read"):
        load_gain_file(tmp_path / "none.json")


DOCUMENT = make()


def places(value, path=()):
    """Yield every path into nested objects and lists."""
    yield path
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for key, entry in entries:
        yield from places(entry, (*path, key))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([path for path in places(DOCUMENT) if path]), JSON)
def test_any_changed_gain_file_is_accepted_or_rejected_with_one_line_message(path, value):
    document = copy.deepcopy(DOCUMENT)
    table = document
    for key in path[:-1]:
        table = table[key]
    table[path[-1]] = value
    document["sha256"] = digest(document)
    try:
        loaded = check_document(document)
    except InputError as error:
        assert str(error).isprintable()
    else:
        assert loaded.document is document


def test_force_envelope_of_linear_contact_matches_closed_form():
    mechanism = load("varying").mechanism
    draws = {
        "contact.stiffness": np.array([[1e5, 4e5, 5e4], [2e5, 8e5, 1e5]]),
        "approach.velocity": np.array([0.004, 0.006]),
        "rig.force_sensor.delay": np.array([0.007, 0.009]),
        "rig.simulator.delay": np.array([0.004, 0.004]),
    }
    envelope = validity_envelope(mechanism, build_scenarios(mechanism, draws))
    assert {name: span["unit"] for name, span in envelope.items()} == {
        "contact_frequency": "Hz",
        "delay": "s",
        "approach_velocity": "m/s",
        "force": "N",
    }
    expected = {
        "contact_frequency": [math.sqrt(k / 350) / (2 * math.pi) for k in (5e4, 8e5)],
        "delay": [0.011, 0.013],
        "approach_velocity": [0.004, 0.006],
        "force": [0.004 * math.sqrt(5e4 * 350), 0.006 * math.sqrt(8e5 * 350)],
    }
    for name, (low, high) in expected.items():
        np.testing.assert_allclose([envelope[name]["low"], envelope[name]["high"]], [low, high], rtol=1e-12)


def test_force_envelope_covers_only_simulated_contacts():
    mechanism = load("varying", ["approach.contacts=1"]).mechanism
    frequency = validity_envelope(mechanism, build_scenarios(mechanism))["contact_frequency"]
    np.testing.assert_allclose([frequency["low"], frequency["high"]], math.sqrt(124355 / 350) / (2 * math.pi))


def test_force_envelope_of_hunt_crossley_contact_uses_typical_stiffness():
    overrides = ["contact.law=hunt_crossley", "contact.stiffness=[1e7]", "contact.damping=[0.1]"]
    mechanism = load("claw-350kg", [*overrides, "contact.exponent=1.3"]).mechanism
    envelope = validity_envelope(mechanism, build_scenarios(mechanism))
    omega = math.sqrt(typical_stiffness(mechanism) / 350)
    np.testing.assert_allclose(envelope["contact_frequency"]["low"], omega / (2 * math.pi), rtol=1e-12)


def test_force_envelope_of_user_registered_contact_law_matches_closed_form():
    """F = k d^2: M v^2/2 = k d^3/3, so F = k^(1/3) (3 M v^2/2)^(2/3)."""
    jaxhil.register(SquaredSpring())
    stiffness, velocity = np.array([[4e8, 1e9], [2e8, 5e8]]), np.array([0.004, 0.006])
    overrides = ["contact.law=squared_spring", "contact.stiffness=[1e9, 5e8]", "approach.contacts=2"]
    mechanism = load("rig-300kg", overrides).mechanism
    draws = {"contact.stiffness": stiffness.T, "approach.velocity": velocity}
    envelope = validity_envelope(mechanism, build_scenarios(mechanism, draws))
    force = np.cbrt(stiffness) * np.cbrt((1.5 * 300 * velocity**2) ** 2)
    frequency = force / (velocity * 300) / (2 * math.pi)
    for name, values in (("force", force), ("contact_frequency", frequency)):
        result = [envelope[name]["low"], envelope[name]["high"]]
        np.testing.assert_allclose(result, [np.min(values), np.max(values)], rtol=1e-6)


@pytest.mark.parametrize("velocity", [0.002, 0.005, 0.01, 0.05])
def test_force_envelope_of_layered_contact_matches_integration(velocity):
    mechanism = load("layered", [f"approach.velocity={velocity}", "approach.contacts=1"]).mechanism
    slopes, depths = [8e4, 1.6e5, 3.2e5], [0.0002, 0.0004]

    def force(depth):
        edges = [0.0, *depths, math.inf]
        return sum(k * max(0.0, min(depth, b) - a) for k, a, b in zip(slopes, edges, edges[1:], strict=False))

    def work(depth):
        # The trapezoidal rule between the corners is exact.
        corners = [d for d in (0.0, *depths) if d < depth] + [depth]
        return sum((force(a) + force(b)) / 2 * (b - a) for a, b in itertools.pairwise(corners))

    deepest = optimize.brentq(lambda d: work(d) - 350 * velocity**2 / 2, 0.0, 0.1, xtol=1e-16, rtol=1e-14)
    envelope = validity_envelope(mechanism, build_scenarios(mechanism))
    np.testing.assert_allclose(envelope["force"]["high"], force(deepest), rtol=1e-9)
    frequency = force(deepest) / (velocity * 350) / (2 * math.pi)
    np.testing.assert_allclose(envelope["contact_frequency"]["high"], frequency, rtol=1e-9)
