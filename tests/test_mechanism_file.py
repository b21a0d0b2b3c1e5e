"""Mechanism files: built-in mechanisms, unreadable files, round trips and key descriptions."""

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
from mechanism_table import file_refusal
from msgspec.inspect import ListType, Metadata, StructType, UnionType

from jaxhil.errors import InputError
from jaxhil.mechanism.file import (
    DEFAULT_MECHANISM,
    builtin_names,
    builtin_path,
    from_plain_data,
    load,
    suite_names,
    to_plain_data,
)
from jaxhil.mechanism.number_ranges import describe_struct
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.toml_table import MAX_BYTES

TEXT = builtin_path("claw-350kg").read_text()


def test_builtin_mechanisms_equal_documented_list():
    names = "claw-350kg layered rattling rig-300kg robot-150ms robot-34ms robot-50ms rod-100n-mm"
    names += " two-robots-250hz varying"
    assert builtin_names() == names.split()
    assert load() == load(DEFAULT_MECHANISM) == load("varying")


SUITES = "damped dead-zone depth-damped elastoplastic fast friction hardening hertz lag layered long"
SUITES += " mixed noise-free noisy plane preload rattling repeated"


def test_mechanism_suites_equal_documented_list():
    assert suite_names() == [f"suite-{name}" for name in SUITES.split()]
    for name in suite_names():
        mechanism, _, label = load(name)
        assert label == mechanism.name == name
        assert mechanism.source.startswith("assumed: ") and "\n" not in mechanism.source
        assert mechanism == from_plain_data(to_plain_data(mechanism), name)


@pytest.mark.parametrize("name", builtin_names())
def test_builtin_mechanism_has_name_digest_and_source(name):
    mechanism, sha256, label = load(name)
    assert mechanism.name == label == name
    assert sha256 == hashlib.sha256(builtin_path(name).read_bytes()).hexdigest()
    published = {
        **dict.fromkeys(("robot-34ms", "robot-50ms", "robot-150ms"), "github.com/"),
        "two-robots-250hz": "published of the European Proximity Operations Simulator",
    }
    assert (
        published.get(name, "published orders of magnitude") in mechanism.source
        and "assumed" in mechanism.source
    )
    assert "contact.stiffness" in mechanism.uncertainty
    assert mechanism.rig.force_sensor.noise_std == 0.0


def test_builtin_mechanisms_have_frequency_and_damping_ratio_stated_in_comments():
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


def test_copied_mechanism_file_is_read_like_the_builtin_mechanism(written):
    path = written(TEXT)
    loaded = load(path)
    assert loaded.mechanism == load(str(path)).mechanism == load("claw-350kg").mechanism
    assert loaded.label == str(path)
    assert load(written("\ufeff" + TEXT.replace("\n", "\r\n"))).mechanism == loaded.mechanism


def test_mechanism_path_is_never_mistaken_for_builtin_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "no such file" in file_refusal(Path("varying"))


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
        (b"a = 1\nkind = bessel", "(at line 2, column 8): found 'kind = bessel'; texts need quotes"),
        (b"a = 1\na = 2", "not valid TOML"),
        (b"x = " + b"9" * 5000, "not valid TOML"),
        (b"x = " + b"[" * 5000, "nested too deeply"),
        (b"a." * 500_000 + b"b = 1", "too many parts in a key, expected at most 64"),
        (b'"a".' * 100 + b"b = 1", "too many parts in a key, expected at most 64"),
        (b"['a' . " + b"'\".'\t." * 100 + b"b]", "too many parts in a key, expected at most 64"),
        (b"#" * (MAX_BYTES + 1), "more than 1048576 bytes"),
        (b"schema = 'jaxhil/mechanism/1'", ": name: found nothing"),
    ],
    ids=lambda value: repr(value[:12]),
)
def test_unusable_mechanism_file_content_is_rejected(written, content, reason):
    path = written(content)
    message = file_refusal(path)
    assert message.startswith(f"{path}: ") and reason in message


def test_all_invalid_keys_of_mechanism_file_are_named_in_one_message(written):
    text = TEXT.replace("velocity = ", "velocity = -").replace("[bodies]", "[bodies]\nequivalent_mas = 300")
    path = written(text.replace("control_period = 0.001", "control_period = 1.0"))
    keys = [line.removeprefix(f"{path}: ").split(": ")[0] for line in file_refusal(path).split("\n")]
    assert keys == ["bodies.equivalent_mas", "approach.velocity", "rig.control_period"]
    # Rules that involve several keys follow when each key has a valid value.
    changes = ["bodies={ chaser_mass = 300 }", "contact.law=hardening", "rig.simulator.time_constant=0.1"]
    lines = file_refusal(written(TEXT), changes).split("\n")
    assert [line.split(": ")[2] for line in lines] == [
        "bodies.target_mass",
        "contact.reference_depth",
        "rig.simulator.time_constant",
    ]
    with pytest.raises(InputError) as caught:
        from_plain_data({}, "data")
    assert str(caught.value) == "data: schema: found nothing, expected jaxhil/mechanism/1"


def test_long_texts_and_lists_in_mechanism_file_are_accepted(written):
    lists = ", ".join(["0.5 "] * 1000)
    text = TEXT.replace("[395.8]", f"[{lists}]") + "# " + "a.b" * 500
    text = text.replace('name = "claw-350kg"', f'name = "{"a." * 50}"')
    dots = ". " * 200
    for quotes in ('"""', "'''"):
        replaced = text.replace('source = "', f"source = {quotes}{dots} \"' \n{dots}", 1)
        replaced = replaced.replace('every uncertainty"', f"every uncertainty{quotes}", 1)
        assert len(load(written(replaced)).mechanism.contact.damping) == 1000


def test_unreadable_mechanism_files_are_rejected(tmp_path):
    assert "found a directory" in file_refusal(tmp_path)
    assert "found a directory" in file_refusal("")
    assert "no such file" in file_refusal(tmp_path / "absent.toml")
    assert "did you mean varying?" in file_refusal("varyng")
    assert "cannot be read" in file_refusal("a\0b")
    assert "cannot be read: File name too long" in file_refusal("a" * 500)
    assert "line\\nbreak" in file_refusal(tmp_path / "line\nbreak")
    with pytest.raises(InputError, match="did you mean varying"):
        builtin_path("varyin")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root reads every file")
def test_mechanism_file_without_read_permission_is_rejected(written):
    path = written(TEXT)
    path.chmod(0)
    assert "Permission denied" in file_refusal(path)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, len(TEXT) - 1))
def test_truncated_mechanism_file_is_rejected_unless_still_complete(written, cut):
    path = written(TEXT[:cut])
    try:
        mechanism = load(path).mechanism
    except InputError:
        assert file_refusal(path).startswith(f"{path}: ")
    else:
        assert mechanism.contact == load("claw-350kg").mechanism.contact


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(noise=st.binary(max_size=40), position=st.integers(0, len(TEXT)))
def test_damaged_mechanism_file_is_read_or_rejected_with_one_line_message(written, noise, position):
    data = TEXT.encode()
    path = written(data[:position] + noise + data[position:])
    try:
        load(path)
    except InputError:
        assert file_refusal(path).startswith(f"{path}: ")


@pytest.mark.parametrize("name", builtin_names())
def test_mechanism_survives_round_trip_through_json(name):
    mechanism = load(name, ["rig.force_sensor.bias=-0.1", "approach.phase=0.1"]).mechanism
    text = json.dumps(to_plain_data(mechanism), allow_nan=False)
    assert from_plain_data(json.loads(text), "a gain file") == mechanism
    assert "null" not in text


def test_mechanism_data_that_are_not_a_table_are_rejected():
    with pytest.raises(InputError, match=r"^a\\nfile: found \[1\], expected a table$"):
        from_plain_data([1], "a\nfile")  # pyright: ignore[reportArgumentType]


def test_mechanism_file_is_read_without_jax():
    code = "import sys, jaxhil.mechanism.file, jaxhil.mechanism.uncertainty; sys.exit('jax' in sys.modules)"
    root = Path(__file__).parent.parent
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


def test_every_mechanism_key_has_a_description_and_every_number_a_unit():
    def keys(kind, path=""):
        fields = kind.type.fields if isinstance(kind, Metadata) else kind.fields
        for field in fields:
            yield f"{path}{field.name}", field.type
            if isinstance(field.type, Metadata) and isinstance(field.type.type, StructType):
                yield from keys(field.type, f"{path}{field.name}.")

    def texts(kind):
        """Yield all descriptions and units in a type."""
        if isinstance(kind, UnionType):
            return [text for member in kind.types for text in texts(member)]
        if not isinstance(kind, Metadata):
            return texts(kind.item_type) if isinstance(kind, ListType) else []
        return [*texts(kind.type), ((kind.extra_json_schema or {}).get("description"), kind.extra or {})]

    described = {path: texts(kind) for path, kind in keys(describe_struct(Mechanism))}
    assert "rig.force_sensor.delay" in described and len(described) > 40
    for path, result in described.items():
        assert any(meaning for meaning, _ in result), path
    assert any(extra.get("unit") == "s" for _, extra in described["rig.force_sensor.delay"])
    for path, message in (
        ("rig.control_period=1", "found 1, expected a number > 0 s and <= 0.1 s"),
        ("rig.force_sensor.delay=2", "found 2, expected a number from 0 to 1 s"),
        ("rig.force_sensor.bias=x", "found 'x', expected a finite number of N"),
        ("contact.damping=[-1]", "found -1, expected a number >= 0 N s/m"),
    ):
        assert message in file_refusal("varying", [path])
