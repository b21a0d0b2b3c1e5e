"""Studies stored with the rows of a sweep: read as written, to the bit, or ignored."""

import json
import math
import os
import resource

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sweep_cases import case, manifest

from jaxhil.errors import InputError
from jaxhil.rig import digest
from tuning.statistics.subset_simulation import SubsetSimulation
from tuning.sweeps.chunks import build_sweep
from tuning.sweeps.store import SweepStore, open_store, write_verdict
from tuning.sweeps.stored_studies import (
    IndicesRequest,
    RareFailureRequest,
    decode_study,
    encode_study,
    read_study,
    study_path,
    write_study,
)
from tuning.sweeps.studies import ErrorIndices, InputIndices, compute_error_indices, estimate_rare_failure

MANIFEST = manifest(limit=1.5)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
COUNTS = st.integers(0, 2**40)


def are_equal(one, other):
    """Return whether named tuples are equal to the bit: texts, numbers, arrays, NaN and the sign of 0."""
    if isinstance(one, np.ndarray):
        return (one.shape, one.dtype, one.tobytes()) == (other.shape, other.dtype, other.tobytes())
    if isinstance(one, tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(are_equal, one, other))
    return type(one) is type(other) and repr(one) == repr(other)


def drivers():
    numbers = [NUMBERS | st.just(math.nan)] * 6
    inputs = st.lists(st.builds(InputIndices, st.text(st.characters(codec="utf-8")), *numbers), max_size=3)
    return st.builds(ErrorIndices, inputs.map(tuple), NUMBERS, COUNTS, COUNTS)


def arrays(shape, numbers=NUMBERS):
    size = math.prod(shape)
    return st.lists(numbers, min_size=size, max_size=size).map(
        lambda some: np.array(some, float).reshape(shape)
    )


REPLICATES, ENDLESS = 3, NUMBERS | st.just(math.inf)
RARE = st.builds(
    SubsetSimulation,
    *[NUMBERS] * 3,
    *[ENDLESS] * 2,
    arrays((REPLICATES,)),
    arrays((REPLICATES,), ENDLESS),
    arrays((2, REPLICATES), NUMBERS | st.just(math.nan)),
    COUNTS,
    arrays((4, 5)),
    arrays((4,), ENDLESS),
)
A_DRIVER = InputIndices("contact.stiffness", 0.25, -0.125, 0.5, math.nan, 0.0, 1.0)
SOME_DRIVERS = ErrorIndices((A_DRIVER,), 15.0, 768, 3)
SOME_RARE = SubsetSimulation(
    1e-5, 0.0, 2e-5, math.inf, 0.25, np.array([0.0, 2e-5]), np.array([math.inf, 0.25]),
    np.array([[0.5, 0.25], [math.nan, 1.5]]), 4000, np.ones((2, 3)), np.array([math.inf, 2.0]),
)  # fmt: skip
REQUESTS = IndicesRequest(128), RareFailureRequest(1.5, replicates=2)
STUDIES = tuple(zip(REQUESTS, (SOME_DRIVERS, SOME_RARE), strict=True))


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "store", MANIFEST, resume=False)


@pytest.fixture(scope="module")
def sweep():
    return build_sweep(MANIFEST)


def unwritten(*words):
    return pytest.raises(InputError, match="cannot be written: .*".join(words))


@given(drivers())
def test_sobol_study_file_is_read_as_written(found):
    request = IndicesRequest(128)
    assert are_equal(decode_study(MANIFEST, request, encode_study(MANIFEST, request, found)), found)


@given(RARE)
def test_rare_event_study_file_is_read_as_written(found):
    request = RareFailureRequest(1.5, replicates=REPLICATES)
    assert are_equal(decode_study(MANIFEST, request, encode_study(MANIFEST, request, found)), found)


@given(st.sampled_from(REQUESTS), st.binary(max_size=300))
def test_study_file_of_arbitrary_bytes_is_ignored(request, content):
    assert decode_study(MANIFEST, request, content) is None


@given(st.sampled_from(STUDIES), st.data())
@settings(max_examples=400)
def test_study_file_with_any_flipped_bit_is_ignored(study, data):
    request, result = study
    content = bytearray(encode_study(MANIFEST, request, result))
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    read = decode_study(MANIFEST, request, bytes(content))
    assert read is None or are_equal(read, result)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | NUMBERS | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(STUDIES), st.data())
@settings(max_examples=300)
def test_changed_study_file_with_valid_digest_is_read_as_written_or_ignored(study, data):
    request, result = study
    document = json.loads(encode_study(MANIFEST, request, result))
    place = data.draw(st.sampled_from([document, document["result"]]))
    place[data.draw(st.sampled_from([*place, "more"]))] = data.draw(JSON)
    document["sha256"] = digest(document)
    read = decode_study(MANIFEST, request, json.dumps(document).encode())
    if read is not None:
        again = json.loads(encode_study(MANIFEST, request, read))
        # The digest differs if 1 was written for 1.0.
        assert {**again, "sha256": document["sha256"]} == document


def test_study_result_that_json_cannot_express_is_not_written(store):
    # Null cannot stand for NaN in a field that must not be NaN.
    with unwritten("drivers-2.json: ", "JSON"):
        write_study(store, IndicesRequest(2), SOME_DRIVERS._replace(cap=math.nan))
    with unwritten("rare-1.5-10x1000.json: ", "JSON"):
        write_study(store, RareFailureRequest(1.5), SOME_RARE._replace(coefficient_of_variation=math.nan))
    assert not (store.folder / "studies").exists()


def test_stored_study_equals_result_of_a_new_run(store, sweep):
    first, again = (compute_error_indices(sweep, 8) for _ in range(2))
    write_study(store, IndicesRequest(8), first)
    assert are_equal(read_study(store, IndicesRequest(8)), again)
    content = study_path(store, IndicesRequest(8)).read_bytes()
    write_study(store, IndicesRequest(8), again)
    assert study_path(store, IndicesRequest(8)).read_bytes() == content

    first, again = (estimate_rare_failure(sweep, 2.0, samples=20, replicates=2) for _ in range(2))
    write_study(store, RareFailureRequest(2.0, 20, 2), first)
    assert are_equal(read_study(store, RareFailureRequest(2.0, 20, 2)), again)
    content = study_path(store, RareFailureRequest(2.0, 20, 2)).read_bytes()
    write_study(store, RareFailureRequest(2.0, 20, 2), again)
    assert study_path(store, RareFailureRequest(2.0, 20, 2)).read_bytes() == content


def test_study_result_without_variance_or_failures_is_stored(tmp_path):
    still = build_sweep(manifest(case(uncertainty={}), limit=1.5))
    store = open_store(tmp_path / "store", still.manifest, resume=False)
    nothing = estimate_rare_failure(still, 1e9, samples=20, replicates=2)
    assert nothing.probability == 0 and nothing.coefficient_of_variation == math.inf
    write_study(store, RareFailureRequest(1e9, 20, 2), nothing)
    assert are_equal(read_study(store, RareFailureRequest(1e9, 20, 2)), nothing)
    constant = ErrorIndices((InputIndices("approach.phase", *[math.nan, 0.0, 1.0] * 2),), 15.0, 6, 0)
    write_study(store, IndicesRequest(2), constant)
    assert are_equal(read_study(store, IndicesRequest(2)), constant)


def test_stored_study_of_other_arguments_or_another_sweep_is_not_used(store):
    write_study(store, IndicesRequest(128), SOME_DRIVERS)
    write_study(store, RareFailureRequest(1.5, replicates=2), SOME_RARE)
    assert (
        read_study(store, IndicesRequest(128)) is not None
        and read_study(store, RareFailureRequest(1.5, replicates=2)) is not None
    )
    assert read_study(store, IndicesRequest(64)) is None
    assert read_study(store, RareFailureRequest(1.6, replicates=2)) is None
    assert (
        read_study(store, RareFailureRequest(1.5, samples=500, replicates=2)) is None
        and read_study(store, RareFailureRequest(1.5)) is None
    )
    # The same applies to a study file with another file's name.
    os.replace(study_path(store, IndicesRequest(128)), study_path(store, IndicesRequest(64)))
    os.replace(
        study_path(store, RareFailureRequest(1.5, 1000, 2)),
        study_path(store, RareFailureRequest(1.6, 1000, 2)),
    )
    assert (
        read_study(store, IndicesRequest(64)) is None
        and read_study(store, RareFailureRequest(1.6, replicates=2)) is None
    )


@pytest.mark.parametrize("other", [manifest(limit=1.5, seed=1), manifest(limit=1.6)])
def test_study_file_of_another_sweep_is_ignored(store, other):
    write_study(SweepStore(store.folder, other), IndicesRequest(128), SOME_DRIVERS)
    write_study(SweepStore(store.folder, other), RareFailureRequest(1.5, replicates=2), SOME_RARE)
    assert (
        read_study(store, IndicesRequest(128)) is None
        and read_study(store, RareFailureRequest(1.5, replicates=2)) is None
    )


def test_study_file_states_type_and_settings_of_the_study(store):
    write_study(store, RareFailureRequest(1.5, replicates=2), SOME_RARE)
    result = json.loads(study_path(store, RareFailureRequest(1.5, 1000, 2)).read_bytes())
    del result["result"]
    assert result.pop("sha256") != MANIFEST.sha256
    assert result == {
        **{"schema": "jaxhil/study/1", "study": "rare", "sweep_sha256": MANIFEST.sha256},
        **{"seed": 0, "versions": MANIFEST.versions, "limit": 1.5, "samples": 1000, "replicates": 2},
    }


@pytest.mark.parametrize("harm", ["cut", "empty", "folder", "large"])
def test_damaged_study_file_is_ignored(store, harm):
    write_study(store, IndicesRequest(128), SOME_DRIVERS)
    path = study_path(store, IndicesRequest(128))
    content = path.read_bytes()
    path.unlink()
    if harm == "folder":
        path.mkdir()
    else:
        path.write_bytes({"cut": content[:-3], "empty": b"", "large": content + b" " * 2**23}[harm])
    assert read_study(store, IndicesRequest(128)) is None
    if harm != "folder":
        write_study(store, IndicesRequest(128), SOME_DRIVERS)
        assert path.read_bytes() == content
    else:
        with unwritten("drivers-128.json: ", "found a folder, expected a plain file"):
            write_study(store, IndicesRequest(128), SOME_DRIVERS)


def test_full_disk_is_reported_in_one_line_and_old_study_file_is_kept(store):
    write_study(store, IndicesRequest(128), SOME_DRIVERS)
    write_verdict(store, {"verdict": "good"})
    before = study_path(store, IndicesRequest(128)).read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, limits[1]))
    try:
        with unwritten("drivers-128.json: ", ""):
            write_study(store, IndicesRequest(128), SOME_DRIVERS._replace(capped=4))
        with unwritten("verdict.json: ", ""):
            write_verdict(store, {"verdict": "bad"})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert study_path(store, IndicesRequest(128)).read_bytes() == before
    assert json.loads((store.folder / "verdict.json").read_text()) == {"verdict": "good"}
    assert {path.name for path in store.folder.rglob("*.tmp")} == set()


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_study_file_in_read_only_folder_is_reported_in_one_line(store):
    (store.folder / "studies").mkdir(mode=0o500)
    with unwritten("drivers-128.json: ", "Permission denied"):
        write_study(store, IndicesRequest(128), SOME_DRIVERS)
