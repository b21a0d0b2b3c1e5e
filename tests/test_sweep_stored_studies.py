"""What is kept beside the rows: read as it was written, to the bit, or not at all."""

import json
import math
import os
import resource

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sweep_cases import case, manifest

from jaxhil.errors import InputError
from jaxhil.runtime import digest
from tuning.statistics.subset_simulation import SubsetSimulation
from tuning.sweeps.chunks import build_sweep
from tuning.sweeps.store import Store, open_store
from tuning.sweeps.stored_studies import (
    IndicesStudy,
    RareStudy,
    decode,
    encode,
    indices_of,
    indices_path,
    indices_study,
    rare_of,
    rare_path,
    rare_study,
    read_indices,
    read_rare,
    write_indices,
    write_rare,
    write_verdict,
)
from tuning.sweeps.studies import ErrorIndices, InputIndices, error_indices, rare_failure

MANIFEST = manifest(limit=1.5)
KINDS = (IndicesStudy, RareStudy)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
COUNTS = st.integers(0, 2**40)


def same(one, other):
    """The same named tuples to the bit: texts, numbers, arrays, nan and the sign of 0."""
    if isinstance(one, np.ndarray):
        return (one.shape, one.dtype, one.tobytes()) == (other.shape, other.dtype, other.tobytes())
    if isinstance(one, tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
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
STUDIES = (indices_study(MANIFEST, 128, SOME_DRIVERS), rare_study(MANIFEST, 1.5, 1000, 2, SOME_RARE))


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "store", MANIFEST, resume=False)


@pytest.fixture(scope="module")
def sweep():
    return build_sweep(MANIFEST)


def unwritten(*words):
    return pytest.raises(InputError, match="cannot be written: .*".join(words))


@given(drivers())
def test_drivers_are_read_as_they_were_written(found):
    study = decode(encode(indices_study(MANIFEST, 128, found)), IndicesStudy)
    assert study is not None and same(indices_of(study), found)


@given(RARE)
def test_rare_failures_are_read_as_they_were_written(found):
    study = decode(encode(rare_study(MANIFEST, 1.5, 1000, REPLICATES, found)), RareStudy)
    assert study is not None and same(rare_of(study), found)


@given(st.sampled_from(KINDS), st.binary(max_size=300))
def test_any_bytes_are_no_study(kind, content):
    assert decode(content, kind) is None


@given(st.sampled_from(STUDIES), st.data())
@settings(max_examples=400)
def test_no_bit_of_a_study_can_change_unseen(study, data):
    content = bytearray(encode(study))
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    assert decode(bytes(content), type(study)) in (None, study)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | NUMBERS | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(STUDIES), st.data())
@settings(max_examples=300)
def test_what_is_signed_is_read_as_it_says_or_not_at_all(study, data):
    document = json.loads(encode(study))
    place = data.draw(st.sampled_from([document, document["result"]]))
    place[data.draw(st.sampled_from([*place, "more"]))] = data.draw(JSON)
    document["sha256"] = digest(document)
    found = decode(json.dumps(document).encode(), type(study))
    if found is not None:
        assert msgspec.to_builtins(found) == document
        # Arrays that do not fit together are no result, and no crash.
        result = indices_of(found) if isinstance(found, IndicesStudy) else rare_of(found)
        assert result is None or len(result) == len(msgspec.to_builtins(found.result))


def test_what_json_cannot_express_is_not_written(store):
    # Where no nan can be, there is no sign for it.
    with unwritten("drivers-2.json: ", "JSON"):
        write_indices(store, 2, SOME_DRIVERS._replace(cap=math.nan))
    with unwritten("rare-1.5-10x1000.json: ", "JSON"):
        write_rare(store, 1.5, SOME_RARE._replace(coefficient_of_variation=math.nan))
    assert not (store.folder / "studies").exists()


def test_what_is_kept_is_what_would_be_found_again(store, sweep):
    first, again = (error_indices(sweep, 8) for _ in range(2))
    write_indices(store, 8, first)
    assert same(read_indices(store, 8), again)
    content = indices_path(store, 8).read_bytes()
    write_indices(store, 8, again)
    assert indices_path(store, 8).read_bytes() == content

    first, again = (rare_failure(sweep, 2.0, samples=20, replicates=2) for _ in range(2))
    write_rare(store, 2.0, first, 20, 2)
    assert same(read_rare(store, 2.0, 20, 2), again)
    content = rare_path(store, 2.0, 20, 2).read_bytes()
    write_rare(store, 2.0, again, 20, 2)
    assert rare_path(store, 2.0, 20, 2).read_bytes() == content


def test_where_nothing_varies_and_nothing_fails(tmp_path):
    still = build_sweep(manifest(case(uncertainty={}), limit=1.5))
    store = open_store(tmp_path / "store", still.manifest, resume=False)
    nothing = rare_failure(still, 1e9, samples=20, replicates=2)
    assert nothing.probability == 0 and nothing.coefficient_of_variation == math.inf
    write_rare(store, 1e9, nothing, 20, 2)
    assert same(read_rare(store, 1e9, 20, 2), nothing)
    constant = ErrorIndices((InputIndices("approach.phase", *[math.nan, 0.0, 1.0] * 2),), 15.0, 6, 0)
    write_indices(store, 2, constant)
    assert same(read_indices(store, 2), constant)


def test_only_a_study_of_the_same_arguments_and_sweep_is_taken(store):
    write_indices(store, 128, SOME_DRIVERS)
    write_rare(store, 1.5, SOME_RARE, replicates=2)
    assert read_indices(store, 128) is not None and read_rare(store, 1.5, replicates=2) is not None
    assert read_indices(store, 64) is None
    assert read_rare(store, 1.6, replicates=2) is None
    assert read_rare(store, 1.5, samples=500, replicates=2) is None and read_rare(store, 1.5) is None
    # Nor one that another file's name was given to.
    os.replace(indices_path(store, 128), indices_path(store, 64))
    os.replace(rare_path(store, 1.5, 1000, 2), rare_path(store, 1.6, 1000, 2))
    assert read_indices(store, 64) is None and read_rare(store, 1.6, replicates=2) is None


@pytest.mark.parametrize("other", [manifest(limit=1.5, seed=1), manifest(limit=1.6)])
def test_a_study_of_another_sweep_is_not_taken(store, other):
    write_indices(Store(store.folder, other), 128, SOME_DRIVERS)
    write_rare(Store(store.folder, other), 1.5, SOME_RARE, replicates=2)
    assert read_indices(store, 128) is None and read_rare(store, 1.5, replicates=2) is None


def test_a_study_says_what_it_is_of(store):
    write_rare(store, 1.5, SOME_RARE, replicates=2)
    found = json.loads(rare_path(store, 1.5, 1000, 2).read_bytes())
    del found["result"]
    assert found.pop("sha256") != MANIFEST.sha256
    assert found == {
        **{"schema": "jaxhil/study/1", "study": "rare", "sweep_sha256": MANIFEST.sha256},
        **{"seed": 0, "versions": MANIFEST.versions, "limit": 1.5, "samples": 1000, "replicates": 2},
    }


@pytest.mark.parametrize("harm", ["cut", "empty", "folder", "large"])
def test_a_damaged_study_is_none(store, harm):
    write_indices(store, 128, SOME_DRIVERS)
    path = indices_path(store, 128)
    content = path.read_bytes()
    path.unlink()
    if harm == "folder":
        path.mkdir()
    else:
        path.write_bytes({"cut": content[:-3], "empty": b"", "large": content + b" " * 2**23}[harm])
    assert read_indices(store, 128) is None
    if harm != "folder":
        write_indices(store, 128, SOME_DRIVERS)
        assert path.read_bytes() == content
    else:
        with unwritten("drivers-128.json: ", "directory"):
            write_indices(store, 128, SOME_DRIVERS)


def test_a_full_disk_is_one_line_and_keeps_what_is_there(store):
    write_indices(store, 128, SOME_DRIVERS)
    write_verdict(store, '{"verdict": "good"}\n')
    before = indices_path(store, 128).read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, limits[1]))
    try:
        with unwritten("drivers-128.json: ", ""):
            write_indices(store, 128, SOME_DRIVERS._replace(capped=4))
        with unwritten("verdict.json: ", ""):
            write_verdict(store, '{"verdict": "bad"}\n')
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert indices_path(store, 128).read_bytes() == before
    assert (store.folder / "verdict.json").read_text() == '{"verdict": "good"}\n'
    assert {path.name for path in store.folder.rglob("*.tmp")} == set()


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_one_line(store):
    (store.folder / "studies").mkdir(mode=0o500)
    with unwritten("drivers-128.json: ", "Permission denied"):
        write_indices(store, 128, SOME_DRIVERS)
