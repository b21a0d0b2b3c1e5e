"""Reading mechanism files: built-ins, unreadable files, `--set`, round trips."""

import hashlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.inspect import ListType, Metadata, StructType, UnionType

import jaxhil
from jaxhil.errors import InputError
from jaxhil.mechanism.file import (
    DEFAULT,
    MAX_BYTES,
    builtin_names,
    builtin_path,
    from_builtins,
    load,
    suite_names,
    to_builtins,
)
from jaxhil.mechanism.structs import numeric_keys, schema_type

TEXT = builtin_path("claw-350kg").read_text()


def refusal(path, overrides=(), unset=()):
    """The message of a refused file: one printable line that starts with the file's name."""
    with pytest.raises(InputError) as caught:
        load(path, overrides, unset)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 700
    return message


@pytest.fixture
def written(tmp_path):
    """Writes bytes or text to a file and returns its path."""

    def write(content):
        path = tmp_path / "rig.toml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def test_builtins_are_those_promised():
    names = "claw-350kg layered rattling rig-300kg rod-100n-mm varying"
    assert builtin_names() == names.split()
    assert load() == load(DEFAULT) == load("varying")


SUITES = "damped dead-zone depth-damped elastoplastic fast friction hardening hertz lag layered long"
SUITES += " mixed noise-free noisy plane preload rattling repeated"


def test_suites_are_those_promised():
    assert suite_names() == [f"suite-{name}" for name in SUITES.split()]
    for name in suite_names():
        mechanism, _, label = load(name)
        assert label == mechanism.name == name
        assert mechanism.source.startswith("assumed: ") and "\n" not in mechanism.source
        assert mechanism == from_builtins(to_builtins(mechanism), name)


@pytest.mark.parametrize("name", builtin_names())
def test_builtin(name):
    mechanism, sha256, label = load(name)
    assert mechanism.name == label == name
    assert sha256 == hashlib.sha256(builtin_path(name).read_bytes()).hexdigest()
    assert "published orders of magnitude" in mechanism.source and "assumed" in mechanism.source
    assert "contact.stiffness" in mechanism.uncertainty
    assert mechanism.rig.force_sensor.noise_std == 0.0


def test_builtin_numbers():
    """The built-ins have the contact frequency and damping ratio that their comments state."""
    for name, frequency, ratio in (
        ("rig-300kg", 3.0, 0.0),
        ("claw-350kg", 3.0, 0.03),
        ("varying", 3.0, 0.02),
        ("rattling", 3.0, 0.01),
    ):
        mechanism = load(name).mechanism
        mass, stiffness = mechanism.bodies.mass, np.ravel(mechanism.contact.stiffness)[0]
        assert math.sqrt(stiffness / mass) / (2 * math.pi) == pytest.approx(frequency, abs=1e-4)
        damping = 2 * ratio * math.sqrt(stiffness * mass)
        assert mechanism.contact.damping[0] == pytest.approx(damping, rel=2e-4)


def test_file_is_read_like_the_builtin(written):
    path = written(TEXT)
    loaded = load(path)
    assert loaded.mechanism == load(str(path)).mechanism == load("claw-350kg").mechanism
    assert loaded.label == str(path)
    assert load(written("\ufeff" + TEXT.replace("\n", "\r\n"))).mechanism == loaded.mechanism


def test_a_path_is_never_a_builtin(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "no such file" in refusal(Path("varying"))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "empty file"),
        (b" \n\t\n", "empty file"),
        (b"\xef\xbb\xbf", "found nothing"),
        (bytes(range(256)), "not UTF-8"),
        (b"\x00\x01\x02", "not valid TOML"),
        (b"\x89PNG\r\n\x1a\n", "not UTF-8"),
        (b"name = ", "not valid TOML"),
        (b"a = 1\na = 2", "not valid TOML"),
        (b"x = " + b"9" * 5000, "not valid TOML"),
        (b"x = " + b"[" * 5000, "nested too deeply"),
        (b"a." * 500_000 + b"b = 1", "a key of more than 64 parts"),
        (b'"a".' * 100 + b"b = 1", "a key of more than 64 parts"),
        (b"['a' . " + b"'\".'\t." * 100 + b"b]", "a key of more than 64 parts"),
        (b"#" * (MAX_BYTES + 1), "more than 1048576 bytes"),
        (b"schema = 'jaxhil/mechanism/1'", ": name: found nothing"),
    ],
    ids=lambda value: repr(value[:12]),
)
def test_unusable_content(written, content, reason):
    path = written(content)
    message = refusal(path)
    assert message.startswith(f"{path}: ") and reason in message


def test_long_texts_and_lists_are_no_long_keys(written):
    lists = ", ".join(["0.5 "] * 1000)
    text = TEXT.replace("[395.8]", f"[{lists}]") + "# " + "a.b" * 500
    text = text.replace('name = "claw-350kg"', f'name = "{"a." * 50}"')
    dots = ". " * 200
    for quotes in ('"""', "'''"):
        replaced = text.replace('source = "', f"source = {quotes}{dots} \"' \n{dots}", 1)
        replaced = replaced.replace('every uncertainty"', f"every uncertainty{quotes}", 1)
        assert len(load(written(replaced)).mechanism.contact.damping) == 1000


def test_unreadable_files(tmp_path):
    assert "found a directory" in refusal(tmp_path)
    assert "found a directory" in refusal("")
    assert "no such file" in refusal(tmp_path / "absent.toml")
    assert "did you mean varying?" in refusal("varyng")
    assert "cannot be read" in refusal("a\0b")
    assert "cannot be read: File name too long" in refusal("a" * 500)
    assert "line\\nbreak" in refusal(tmp_path / "line\nbreak")
    with pytest.raises(InputError, match="did you mean varying"):
        builtin_path("varyin")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root reads every file")
def test_file_without_permission(written):
    path = written(TEXT)
    path.chmod(0)
    assert "Permission denied" in refusal(path)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, len(TEXT) - 1))
def test_truncated_file_is_refused_or_still_a_mechanism(written, cut):
    """A file cut anywhere is refused in one line, or what is left of it is a whole mechanism."""
    path = written(TEXT[:cut])
    try:
        mechanism = load(path).mechanism
    except InputError:
        assert refusal(path).startswith(f"{path}: ")
    else:
        assert mechanism.contact == load("claw-350kg").mechanism.contact


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(noise=st.binary(max_size=40), position=st.integers(0, len(TEXT)))
def test_damaged_file_is_read_or_refused_in_one_line(written, noise, position):
    data = TEXT.encode()
    path = written(data[:position] + noise + data[position:])
    try:
        load(path)
    except InputError:
        assert refusal(path).startswith(f"{path}: ")


@pytest.mark.parametrize("name", builtin_names())
def test_round_trip_through_json(name):
    mechanism = load(name, ["rig.force_sensor.bias=-0.1", "approach.phase=0.1"]).mechanism
    text = json.dumps(to_builtins(mechanism), allow_nan=False)
    assert from_builtins(json.loads(text), "a gain file") == mechanism
    assert "null" not in text


def test_from_builtins_refuses_what_is_no_table():
    with pytest.raises(InputError, match=r"^a\\nfile: found \[1\], allowed a table$"):
        from_builtins([1], "a\nfile")  # pyright: ignore[reportArgumentType]


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
def test_override(override, path, value):
    node = to_builtins(load("varying", [override]).mechanism)
    for part in path.split(".")[:-1]:
        node = node[part]
    assert node.get(path.split(".")[-1], math.inf) == value


def test_override_reaches_quoted_keys_tables_and_nested_lists():
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


def test_overrides_apply_in_order_and_leave_the_digest():
    loaded = load("varying", ["approach.velocity=1", "approach.velocity=2"])
    assert loaded.mechanism.approach.velocity == 2.0
    assert loaded.sha256 == load("varying").sha256


def test_override_of_a_bare_number_in_the_file(written):
    path = written(TEXT.replace("[124355.0]", "124355"))
    assert load(path, ["contact.stiffness[0]=5"]).mechanism.contact.stiffness == [5.0]


SECOND_ORDER = ["rig.simulator.natural_frequency", "rig.simulator.damping_ratio"]


def test_another_model_takes_its_keys_and_no_others():
    first_order = ["rig.simulator.model=first_order", "rig.simulator.time_constant=0.01"]
    message = refusal("varying", first_order)
    assert message.startswith(f"varying: --set {' '.join(first_order)}: rig.simulator.")
    assert ", allowed nothing (first_order does not use it: unset it)" in message
    mechanism = load("varying", first_order, SECOND_ORDER).mechanism
    simulator = mechanism.rig.simulator
    assert (simulator.model, simulator.time_constant, simulator.delay) == ("first_order", 0.01, 0.001)
    assert simulator.natural_frequency is None
    # What is no longer there is not uncertain either.
    assert set(load("varying").mechanism.uncertainty) - set(mechanism.uncertainty) == {SECOND_ORDER[0]}
    ideal = load("varying", ["rig.simulator.model=ideal"], SECOND_ORDER).mechanism
    changes = {"rig.simulator.model": "ideal", **dict.fromkeys(SECOND_ORDER)}
    assert ideal == load("varying", changes).mechanism == jaxhil.load("varying", changes)


def test_unset_takes_out_keys_tables_and_uncertainty():
    mechanism = load("varying", (), ["contact.damping", "rig.force_sensor", "approach.contacts"]).mechanism
    assert mechanism.contact.damping == [0.0] and mechanism.rig.force_sensor.delay == 0.0
    assert mechanism.approach.contacts == 1 and "rig.force_sensor.delay" not in mechanism.uncertainty
    assert load("varying", (), ["uncertainty"]).mechanism.uncertainty == {}
    left = load("varying", (), ["uncertainty.'contact.stiffness'"]).mechanism
    assert left.contact == load("varying").mechanism.contact
    assert "contact.stiffness" not in left.uncertainty and "approach.velocity" in left.uncertainty
    masses = ["bodies.chaser_mass=700", "bodies.target_mass=700"]
    assert load("varying", masses, ["bodies.equivalent_mass"]).mechanism.bodies.mass == 350.0


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("approach.velocity", "approach.velocity: found nothing, allowed a number > 0 m/s"),
        ("rig", "rig: found nothing, allowed a table"),
        ("rig.simulator.model", "rig.simulator.model: found nothing, allowed one of first_order, ideal"),
        ("approach.velosity", "approach.velosity: found an unknown key"),
        ("approach.velosity", "did you mean velocity?"),
        ("rig.force_sensor.range", "rig.force_sensor.range: found no such key there, allowed a key that"),
        ("rig.position_sensor.delay", "rig.position_sensor.delay: found no such key there"),
        ("contact.stiffness[1]", "contact.stiffness[1]: found an entry of a list, allowed a key"),
        ("uncertainty.'contact.damping'", "found no such key there"),
        ("approach.velocity=1", "'approach.velocity=1', allowed a dotted path"),
        ("", "allowed a dotted path"),
        ("a..b", "allowed a dotted path"),
    ],
)
def test_unusable_unset_is_named(path, reason):
    message = refusal("varying", (), [path])
    assert message.startswith("varying: --unset ") and reason in message


def test_what_is_uncertain_has_a_value():
    message = refusal("varying", ["uncertainty.'rig.simulator.time_constant'={distribution='normal', std=1}"])
    assert "found nothing as its value, allowed a key with a value" in message


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("", "allowed PATH=VALUE"),
        ("=1", "allowed PATH=VALUE"),
        ("contact.law", "allowed PATH=VALUE"),
        ("contact.=1", "allowed PATH=VALUE"),
        ("a" + ".a" * 10_000 + "=1", "allowed PATH=VALUE"),
        ('"\\q"=1', "allowed PATH=VALUE"),
        ("contact.law=", "contact.law: found nothing after ="),
        ("approach.velocity=.5", "approach.velocity: found '.5', allowed a TOML value"),
        ("approach.velocity=fast", "approach.velocity: found 'fast', allowed a number > 0"),
        ("approach.velocity=1\nname='x'", "approach.velocity: found "),
        ("approach.velocity=-1", "approach.velocity: found -1, allowed a number > 0"),
        ("approach.velocity=nan", "approach.velocity: found nan, allowed a number > 0"),
        ("approach.velocity=2020-01-01", "approach.velocity: found datetime"),
        ("approach.velocity=" + "[" * 5000, "approach.velocity: found values nested too deeply"),
        ("approach.velocity=" + "1" * 200_000, "approach.velocity: found 200000 characters"),
        ("approach.velosity=1", "approach.velosity: found an unknown key"),
        ("approach.velosity=1", "did you mean velocity?"),
        ("velocity=1", "did you mean approach.velocity?"),
        ("approach.velocity.x=1", "approach.velocity.x: found no such key"),
        ("approach.velocity[0]=1", "approach.velocity[0]: found no such key"),
        ("contact.damping[2]=1", "contact.damping[2]: found a list of 1 entry"),
        ("contact.depths[0]=1", "contact.depths[0]: found no list to change"),
        ("contact.stiffness[0][0][0]=1", "contact.stiffness[0][0][0]: found no such key"),
        ('uncertainty."a\nb".std=1', "allowed "),
        ("bodies.chaser_mass=1", "bodies.equivalent_mass: found a body's mass beside it"),
        ("contact.law=piecewise_linear", "contact.depths: found no entries"),
    ],
)
def test_unusable_override_is_named(override, reason):
    message = refusal("varying", [override])
    assert message.startswith("varying: --set ") and reason in message


def test_override_below_a_value_that_is_no_table(written):
    path = written("rig = 5")
    message = refusal(path, ["rig.simulator.model=ideal"])
    assert "--set rig.simulator.model=ideal: rig: found 5, allowed a table" in message


def test_fault_of_the_file_is_not_put_on_an_override(written):
    path = written(TEXT.replace("velocity = 0.005", "velocity = -1"))
    assert refusal(path, ["name=x"]).startswith(f"{path}: approach.velocity: found -1")
    assert load(path, ["approach.velocity=1"]).mechanism.approach.velocity == 1.0


@settings(deadline=None)
@given(st.text(max_size=60) | st.from_regex(r"(contact|rig\.simulator)\.[a-z_.\[\]0-9]*=.*"))
def test_any_override_is_applied_or_refused_in_one_line(text):
    try:
        load("varying", [text])
    except InputError:
        assert "--set" in refusal("varying", [text])


@pytest.mark.parametrize("path", [*numeric_keys()])
def test_every_numeric_key_can_be_overridden_or_says_why(path):
    """`--set PATH=1` reaches its key: the value is taken, or a message is about that very path."""
    try:
        mechanism = load("varying", [f"{path}=1"]).mechanism
    except InputError as error:
        assert f": --set {path}=1: " in str(error)
    else:
        node = mechanism
        for part in path.split("."):
            node = getattr(node, part)
        assert node in (1.0, [1.0])


def test_reading_needs_no_jax():
    code = "import sys, jaxhil.mechanism.file, jaxhil.mechanism.uncertainty; sys.exit('jax' in sys.modules)"
    root = Path(__file__).parent.parent
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


def test_every_key_says_what_it_is_and_every_number_its_unit():
    def keys(kind, path=""):
        fields = kind.type.fields if isinstance(kind, Metadata) else kind.fields
        for field in fields:
            yield f"{path}{field.name}", field.type
            if isinstance(field.type, Metadata) and isinstance(field.type.type, StructType):
                yield from keys(field.type, f"{path}{field.name}.")

    def texts(kind):
        """Meanings and units anywhere in a type."""
        if isinstance(kind, UnionType):
            return [text for member in kind.types for text in texts(member)]
        if not isinstance(kind, Metadata):
            return texts(kind.item_type) if isinstance(kind, ListType) else []
        return [*texts(kind.type), ((kind.extra_json_schema or {}).get("description"), kind.extra or {})]

    said = {path: texts(kind) for path, kind in keys(schema_type())}
    assert "rig.force_sensor.delay" in said and len(said) > 40
    for path, found in said.items():
        assert any(meaning for meaning, _ in found), path
    assert any(extra.get("unit") == "s" for _, extra in said["rig.force_sensor.delay"])
    for path, message in (
        ("rig.control_period=1", "found 1, allowed a number > 0 s and <= 0.1 s"),
        ("rig.force_sensor.delay=2", "found 2, allowed a number from 0 to 1 s"),
        ("rig.force_sensor.bias=x", "found 'x', allowed a finite number of N"),
        ("contact.damping=[-1]", "found -1, allowed a number >= 0 N s/m"),
    ):
        assert message in refusal("varying", [path])
