"""Manifests of sweeps: read as written; a changed manifest is rejected in one line."""

import json

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sweep_cases import case, manifest

from jaxhil.errors import InputError
from jaxhil.rig import digest
from tuning.sweeps.manifest import (
    decode_manifest,
    encode_manifest,
    list_code_differences,
    list_input_differences,
    list_process_differences,
    rounding_flags,
)

GOOD = manifest()
DOCUMENT = json.loads(encode_manifest(GOOD))
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


def refusal(content):
    with pytest.raises(InputError) as caught:
        decode_manifest(content, "store/manifest.json")
    message = str(caught.value)
    assert message.startswith("store/manifest.json: ") and message.isprintable()
    return message


def test_sweep_manifest_survives_a_round_trip():
    assert decode_manifest(encode_manifest(GOOD), "f") == GOOD
    endless = manifest(limit=0)
    assert decode_manifest(encode_manifest(endless), "f") == endless and endless.error_limit == 0
    assert GOOD.error_limit == float("inf")


def test_sweep_manifest_contains_interval_width_only_if_specified():
    # Without a width, the manifest has no entry for it, as in earlier versions.
    assert b"until_width" not in encode_manifest(GOOD) and "until_width" not in DOCUMENT
    wide = manifest(until_width=0.1)
    assert decode_manifest(encode_manifest(wide), "f") == wide and wide.until_width == 0.1
    assert list_input_differences(GOOD, wide) == ["until_width: found nothing, requested 0.1"]
    with pytest.raises(InputError, match="until_width: found sampling sobol, expected random"):
        manifest(until_width=0.1, sampling="sobol", scenarios=96, chunk=32)


@given(st.binary(max_size=200))
def test_sweep_manifest_of_arbitrary_bytes_is_rejected(content):
    refusal(content)


@given(st.sampled_from(sorted(DOCUMENT)), JSON, st.booleans())
@settings(max_examples=200)
def test_sweep_manifest_with_changed_value_and_valid_digest_is_read_or_rejected(key, value, signed):
    changed = {**DOCUMENT, key: value}
    if signed:
        changed["sha256"] = digest(changed)
    try:
        result = decode_manifest(json.dumps(changed).encode(), "store/manifest.json")
    except InputError as error:
        assert str(error).startswith("store/manifest.json: ") and str(error).isprintable()
    else:
        # A changed value is read as that value or rejected.
        assert msgspec.to_builtins(result) == changed
        assert signed or key in ("created", "sha256") or DOCUMENT[key] == value


def test_missing_and_unknown_keys_of_sweep_manifest_are_named_in_error():
    assert "seed" in refusal(json.dumps({k: v for k, v in DOCUMENT.items() if k != "seed"}).encode())
    assert "speed" in refusal(json.dumps({**DOCUMENT, "speed": 1}).encode())
    assert "jaxhil/sweep/2" in refusal(b"[]")
    assert "NaN" in refusal(encode_manifest(GOOD).replace(b'"seed": 0', b'"seed": NaN'))


def test_sweep_chunks_cover_all_scenarios():
    assert GOOD.parts == 4
    assert [GOOD.chunk_range(part) for part in range(4)] == [(0, 32), (32, 32), (64, 32), (96, 4)]


@pytest.mark.parametrize(
    ("key", "value"),
    [("seed", 1), ("scenarios", 96), ("sampling", "sobol"), ("precision", "float32"), ("limit", 0.1)],
)
def test_sweep_manifest_comparison_names_every_difference(key, value):
    (difference,) = list_input_differences(
        manifest(scenarios=112), manifest(**{"scenarios": 112, key: value})
    )
    assert difference.startswith(f"{key}: found ")


def test_sweep_manifest_of_earlier_schema_is_rejected_with_advice():
    old = json.dumps({**DOCUMENT, "schema": "jaxhil/sweep/1"}).encode()
    assert "expected jaxhil/sweep/2: sweep again into a new folder, or use the version" in refusal(old)


def test_sweep_manifest_with_flipped_bit_is_rejected_unless_only_date_changes():
    content = encode_manifest(GOOD)
    for bit in np.random.default_rng(0).integers(0, 8 * len(content), 1000):
        harmed = bytearray(content)
        harmed[bit // 8] ^= 1 << int(bit % 8)
        try:
            result = decode_manifest(bytes(harmed), "store/manifest.json")
        except InputError as error:
            assert str(error).startswith("store/manifest.json: ") and str(error).isprintable()
        else:
            assert msgspec.structs.replace(result, created=GOOD.created) == GOOD


def test_sweep_manifest_depends_on_gains_and_source_code():
    (difference,) = list_input_differences(GOOD, manifest(case(compensator="phase_lead")))
    assert difference.startswith("gains_sha256: ")
    newer = msgspec.structs.replace(GOOD, versions={**GOOD.versions, "jax": "9.9"}, sources_sha256="0" * 64)
    sources, version = list_code_differences(GOOD, newer)
    assert sources.startswith("sources_sha256: found ") and sources.endswith("here 000000000000...")
    assert version.startswith("versions.jax: ") and "9.9" in version
    assert list_process_differences(newer)[0].startswith("sources_sha256: found 000000000000..., here ")
    assert (
        not list_input_differences(GOOD, manifest())
        and not list_code_differences(GOOD, manifest())
        and not list_process_differences(GOOD)
    )


def test_sweep_manifest_contains_only_xla_flags_that_may_change_results():
    ours = rounding_flags("--xla_force_host_platform_device_count=8 --b=1 --a=2")
    assert ours == rounding_flags("--a=2 --b=1") == "--a=2 --b=1"
    assert rounding_flags("--xla_force_host_platform_device_count=1 --b=1") != rounding_flags("--b=1")


def test_sobol_sweep_with_fewer_scenarios_than_replicates_is_rejected():
    assert manifest(sampling="sobol", scenarios=16, chunk=5).replicates == 16
    with pytest.raises(InputError, match="--scenarios: found 15, expected 16 or more"):
        manifest(sampling="sobol", scenarios=15)
