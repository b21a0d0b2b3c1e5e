"""`--set` and `--unset`: changes of mechanism values on the command line, and error messages."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanism_table import file_refusal

import jaxhil
from jaxhil.errors import InputError
from jaxhil.mechanism.file import builtin_path, load, to_plain_data
from jaxhil.mechanism.number_ranges import numeric_keys

TEXT = builtin_path("claw-350kg").read_text()


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("contact.law=linear", "contact.law", "linear"),
        ("contact.law = 'linear'", "contact.law", "linear"),
        ("contact . 'law'=linear", "contact.law", "linear"),
        ("approach.velocity=1e-2", "approach.velocity", 0.01),
        ("approach.contacts=7", "approach.contacts", 7),
        ("contact.tension=true", "contact.tension", True),
        ("contact.stiffness=2e5", "contact.stiffness", [2e5]),
        ("contact.stiffness[1]=2e5", "contact.stiffness", [124355.0, 2e5, 62177.5]),
        ("contact.damping[0]=5", "contact.damping", [5.0]),
        ("rig.force_sensor.range=100", "rig.force_sensor.range", 100.0),
        ("rig.force_sensor.range=inf", "rig.force_sensor.range", math.inf),
        ("rig.position_sensor.delay=0.002", "rig.position_sensor.delay", 0.002),
        ("name=other-name", "name", "other-name"),
        ("uncertainty={}", "uncertainty", {}),
    ],
)
def test_override_replaces_the_value_of_a_key(override, path, value):
    node = to_plain_data(load("varying", [override]).mechanism)
    for part in path.split(".")[:-1]:
        node = node[part]
    assert node.get(path.split(".")[-1], math.inf) == value


def test_override_accepts_quoted_keys_tables_and_nested_list_entries():
    overrides = [
        "uncertainty={}",
        'rig.simulator={model="first_order", time_constant=0.01}',
        "uncertainty.'rig.simulator.time_constant'={distribution='normal', std=1}",
        "rig.simulator.time_constant=3",
    ]
    mechanism = load("varying", overrides).mechanism
    assert mechanism.uncertainty["rig.simulator.time_constant"].std == 1.0
    other = load("varying", ['uncertainty."contact.stiffness".factor[0]=0.5']).mechanism
    assert other.uncertainty["contact.stiffness"].factor == [0.5, 1.6]
    assert mechanism.rig.simulator.model == "first_order"
    assert mechanism.rig.simulator.damping_ratio is None
    layered = load("layered", ["contact.stiffness[1][2]=1"]).mechanism
    assert layered.contact.stiffness[1] == [60000.0, 120000.0, 1.0]


def test_later_override_wins_and_file_digest_is_unchanged():
    loaded = load("varying", ["approach.velocity=1", "approach.velocity=2"])
    assert loaded.mechanism.approach.velocity == 2.0
    assert loaded.sha256 == load("varying").sha256


def test_override_of_list_entry_accepts_single_number_in_file(written):
    path = written(TEXT.replace("[124355.0]", "124355"))
    assert load(path, ["contact.stiffness[0]=5"]).mechanism.contact.stiffness == [5.0]


SECOND_ORDER = ["rig.simulator.natural_frequency", "rig.simulator.damping_ratio"]


def test_override_of_simulator_model_accepts_only_keys_of_that_model():
    first_order = ["rig.simulator.model=first_order", "rig.simulator.time_constant=0.01"]
    message = file_refusal("varying", first_order)
    assert message.startswith(f"varying: --set {' '.join(first_order)}: rig.simulator.")
    assert ", expected nothing (first_order does not use it: unset it)" in message
    mechanism = load("varying", first_order, SECOND_ORDER).mechanism
    simulator = mechanism.rig.simulator
    assert (simulator.model, simulator.time_constant, simulator.delay) == ("first_order", 0.01, 0.001)
    assert simulator.natural_frequency is None
    # A removed key is not uncertain either.
    assert set(load("varying").mechanism.uncertainty) - set(mechanism.uncertainty) == {SECOND_ORDER[0]}
    ideal = load("varying", ["rig.simulator.model=ideal"], SECOND_ORDER).mechanism
    changes = {"rig.simulator.model": "ideal", **dict.fromkeys(SECOND_ORDER)}
    assert ideal == load("varying", changes).mechanism == jaxhil.load("varying", changes)


def test_unset_option_removes_keys_tables_and_uncertainty():
    mechanism = load("varying", (), ["contact.damping", "rig.force_sensor", "approach.contacts"]).mechanism
    assert mechanism.contact.damping == [0.0] and mechanism.rig.force_sensor.delay == 0.0
    assert mechanism.approach.contacts == 1 and "rig.force_sensor.delay" not in mechanism.uncertainty
    assert load("varying", (), ["uncertainty"]).mechanism.uncertainty == {}
    changed = load("varying", (), ["uncertainty.'contact.stiffness'"]).mechanism
    assert changed.contact == load("varying").mechanism.contact
    assert "contact.stiffness" not in changed.uncertainty and "approach.velocity" in changed.uncertainty
    masses = ["bodies.chaser_mass=700", "bodies.target_mass=700"]
    assert load("varying", masses, ["bodies.equivalent_mass"]).mechanism.bodies.mass == 350.0


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("approach.velocity", "approach.velocity: found nothing, expected a number > 0 m/s"),
        ("rig", "rig: found nothing, expected a table"),
        ("rig.simulator.model", "rig.simulator.model: found nothing, expected one of first_order, ideal"),
        ("approach.velosity", "approach.velosity: found an unknown key"),
        ("approach.velosity", "did you mean velocity?"),
        ("rig.force_sensor.range", "rig.force_sensor.range: found no such key, expected a key that"),
        ("rig.position_sensor.delay", "rig.position_sensor.delay: found no such key, expected a key that"),
        ("contact.stiffness[1]", "contact.stiffness[1]: found an entry of a list, expected a key"),
        ("uncertainty.'contact.damping'", "found no such key, expected a key that"),
        ("approach.velocity=1", "'approach.velocity=1', expected a dotted path"),
        ("", "expected a dotted path"),
        ("a..b", "expected a dotted path"),
    ],
)
def test_unusable_unset_option_is_named_in_error(path, reason):
    message = file_refusal("varying", (), [path])
    assert message.startswith("varying: --unset ") and reason in message


def test_uncertainty_of_key_without_value_is_rejected():
    message = file_refusal(
        "varying", ["uncertainty.'rig.simulator.time_constant'={distribution='normal', std=1}"]
    )
    assert "found nothing as its value, expected a key with a value" in message


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("", "expected PATH=VALUE"),
        ("=1", "expected PATH=VALUE"),
        ("contact.law", "expected PATH=VALUE"),
        ("contact.=1", "expected PATH=VALUE"),
        ("a" + ".a" * 10_000 + "=1", "expected PATH=VALUE"),
        ('"\\q"=1', "expected PATH=VALUE"),
        ("contact.law=", "contact.law: found nothing after ="),
        ("approach.velocity=.5", "approach.velocity: found '.5', expected a TOML value"),
        ("approach.velocity=fast", "approach.velocity: found 'fast', expected a number > 0"),
        ("approach.velocity=1\nname='x'", "approach.velocity: found "),
        ("approach.velocity=-1", "approach.velocity: found -1, expected a number > 0"),
        ("approach.velocity=nan", "approach.velocity: found nan, expected a number > 0"),
        ("approach.velocity=2020-01-01", "approach.velocity: found datetime"),
        ("approach.velocity=" + "[" * 5000, "approach.velocity: found values nested too deeply"),
        ("approach.velocity=" + "1" * 200_000, "approach.velocity: found 200000 characters"),
        ("approach.velosity=1", "approach.velosity: found an unknown key"),
        ("approach.velosity=1", "did you mean velocity?"),
        ("velocity=1", "did you mean approach.velocity?"),
        ("approach.velocity.x=1", "approach.velocity.x: found no such key"),
        ("approach.velocity[0]=1", "approach.velocity[0]: found no such key"),
        ("contact.damping[2]=1", "contact.damping[2]: found a list of 1 entry"),
        ("contact.depths[0]=1", "contact.depths[0]: found no list,"),
        ("contact.stiffness[0][0][0]=1", "contact.stiffness[0][0][0]: found no such key"),
        ('uncertainty."a\nb".std=1', "expected "),
        ("bodies.chaser_mass=1", "bodies.equivalent_mass: found a body's mass as well"),
        ("contact.law=piecewise_linear", "contact.depths: found no entries"),
    ],
)
def test_unusable_override_is_named_in_error(override, reason):
    message = file_refusal("varying", [override])
    assert message.startswith("varying: --set ") and reason in message


def test_override_of_subkey_of_non_table_value_is_rejected(written):
    path = written("rig = 5")
    message = file_refusal(path, ["rig.simulator.model=ideal"])
    assert "--set rig.simulator.model=ideal: rig: found 5, expected a table" in message


def test_error_in_mechanism_file_is_not_attributed_to_an_override(written):
    path = written(TEXT.replace("velocity = 0.005", "velocity = -1"))
    assert file_refusal(path, ["name=x"]).startswith(f"{path}: approach.velocity: found -1")
    assert load(path, ["approach.velocity=1"]).mechanism.approach.velocity == 1.0


@settings(deadline=None)
@given(st.text(max_size=60) | st.from_regex(r"(contact|rig\.simulator)\.[a-z_.\[\]0-9]*=.*"))
def test_any_override_is_applied_or_rejected_with_one_line_message(text):
    try:
        load("varying", [text])
    except InputError:
        assert "--set" in file_refusal("varying", [text])


@pytest.mark.parametrize("path", [*numeric_keys()])
def test_every_numeric_key_can_be_overridden_or_error_names_the_key(path):
    try:
        mechanism = load("varying", [f"{path}=1"]).mechanism
    except InputError as error:
        assert f": --set {path}=1: " in str(error)
    else:
        node = mechanism
        for part in path.split("."):
            node = getattr(node, part)
        assert node in (1.0, [1.0])
