"""Store of a sweep: chunks are complete or absent; other files are never mistaken for chunks."""

import os
import resource

import msgspec
import numpy as np
import pytest
from sweep_cases import case, manifest

from jaxhil.errors import InputError
from jaxhil.rig import digest
from tuning.sweeps.chunk_file import decode_chunk, encode_chunk, list_different_columns
from tuning.sweeps.columns import CONTACT_STATUSES, SCENARIO_OUTCOMES, classify_outcomes, list_error_columns
from tuning.sweeps.manifest import list_process_differences
from tuning.sweeps.run_sweep import summarise_failures
from tuning.sweeps.store import (
    lock_store,
    open_store,
    read_chunk,
    read_intact_chunk,
    read_row,
    read_store,
    remove_chunks,
    write_chunk,
    write_verdict,
)
from tuning.sweeps.stored_studies import IndicesRequest, write_study
from tuning.sweeps.studies import ErrorIndices

MANIFEST = manifest(case(2))
# temporary file of a process that does not exist: no process has this number
UNFINISHED = f".jaxhil-{2**22 + 1}-0123abcd-0.tmp"


SLOTS = list_error_columns(("error",), 2)


def fake_rows(part, label=MANIFEST, seed=0):
    """Return artificial rows of a chunk, with missing values."""
    first, number = label.chunk_range(part)
    generator = np.random.default_rng([seed, part])
    rows = {}
    for column in label.columns:
        values = generator.normal(size=number)
        values[generator.random(number) < 0.2] = np.nan
        if column.kind == "integer":
            rows[column.name] = np.arange(first, first + number)
        elif column.kind == "flag":
            rows[column.name] = generator.random(number) < 0.5
        elif column.kind == "text":
            texts = SCENARIO_OUTCOMES if column.name == "outcome" else CONTACT_STATUSES
            rows[column.name] = generator.integers(0, len(texts), number).astype(np.int8)
        else:
            rows[column.name] = values
    return {
        **rows,
        **classify_outcomes(rows, SLOTS, np.array(np.inf), np.array(1e-3), label.error_limit),
    }


@pytest.fixture
def store(tmp_path):
    made = open_store(tmp_path / "store", MANIFEST, resume=False)
    for part in range(MANIFEST.parts):
        write_chunk(made, part, fake_rows(part))
    return made


def test_summary_of_sweep_counts_the_failures_of_all_chunks(store):
    failed = np.concatenate([fake_rows(part)["failed"] for part in range(MANIFEST.parts)])
    summary = summarise_failures(store)
    assert summary["scenarios"] == 100 and summary["failed"] == np.sum(failed)
    probability = summary["failure_probability"]
    assert probability["value"] == np.mean(failed) and probability["low"] < np.mean(failed)
    assert summary["sweep_sha256"] == MANIFEST.sha256


def refused(*words):
    return pytest.raises(InputError, match=".*".join(words))


def test_sweep_store_is_read_as_written(store):
    for part in range(MANIFEST.parts):
        result = read_chunk(store, part)
        assert result is not None and list(result) == [column.name for column in MANIFEST.columns]
        assert list_different_columns(result, fake_rows(part)) == []
    assert list_different_columns(read_row(store, 99), {k: v[3:4] for k, v in fake_rows(3).items()}) == []


def test_sweep_store_is_a_parquet_dataset_with_names_units_and_nulls(store):
    from pyarrow import parquet

    table = parquet.read_table(store.folder / "parts")
    assert table.num_rows == 100
    assert table.column("index").to_pylist() == list(range(100))
    assert table.schema.field("energy_in_2").metadata[b"unit"] == b"J"
    expected = np.concatenate([fake_rows(part)["error_1"] for part in range(MANIFEST.parts)])
    assert table.column("error_1").null_count == np.sum(np.isnan(expected)) > 0
    assert set(table.column("outcome").to_pylist()) <= set(SCENARIO_OUTCOMES)


@pytest.mark.parametrize("harm", ["cut", "flipped", "empty", "gone", "other sweep", "other part"])
def test_sweep_store_ignores_a_damaged_or_third_party_chunk_file(store, tmp_path, harm):
    path = store.chunk_path(1)
    content = bytearray(path.read_bytes())
    if harm == "cut":
        path.write_bytes(content[:-10])
    elif harm == "flipped":
        content[len(content) // 3] ^= 0xFF
        path.write_bytes(content)
    elif harm == "empty":
        path.write_bytes(b"")
    elif harm == "gone":
        path.unlink()
    elif harm == "other part":
        path.write_bytes(store.chunk_path(0).read_bytes())
    else:
        other = open_store(tmp_path / "other", manifest(case(2), seed=1), resume=False)
        write_chunk(other, 1, fake_rows(1))
        path.write_bytes(other.chunk_path(1).read_bytes())
    assert read_chunk(store, 1) is None
    assert read_chunk(store, 0) is not None
    with refused("part-000001.parquet", "--resume"):
        read_row(store, 40)


def test_sweep_store_detects_any_flipped_bit_of_a_chunk_file():
    content = encode_chunk(MANIFEST, fake_rows(0))
    assert decode_chunk(MANIFEST, 0, content) is not None
    for bit in np.random.default_rng(0).integers(0, 8 * len(content), 1000):
        harmed = bytearray(content)
        harmed[bit // 8] ^= 1 << int(bit % 8)
        assert decode_chunk(MANIFEST, 0, bytes(harmed)) is None


def test_sweep_store_ignores_a_chunk_file_rewritten_by_another_program(store):
    from pyarrow import parquet

    path = store.chunk_path(0)
    table = parquet.read_table(path)
    parquet.write_table(table, path)
    assert table.schema.metadata.keys() == parquet.read_table(path).schema.metadata.keys()
    with refused("part-000000.parquet: found a damaged file or one of another sweep", "--resume"):
        read_intact_chunk(store, 0)


@pytest.mark.parametrize("column", ["outcome", "failed", "worst_error", "error_2", "status_1"])
def test_sweep_store_outcomes_follow_from_errors(store, column):
    good = {"status": 1, "error": 0.25, "position_shortfall": 0.0, "peak_force": 1.0, "duration": 1.0}
    good |= {f"reference_{name}": good[name] for name in ("peak_force", "duration")}
    rows = fake_rows(0)
    for name, value in good.items():
        rows[f"{name}_1"][5] = rows[f"{name}_2"][5] = value
    rows = {
        **rows,
        **classify_outcomes(rows, SLOTS, np.array(np.inf), np.array(1e-3), MANIFEST.error_limit),
    }
    assert (
        SCENARIO_OUTCOMES[rows["outcome"][5]] == "good"
        and not rows["failed"][5]
        and rows["worst_error"][5] == 0.25
    )
    write_chunk(store, 0, rows)
    assert read_chunk(store, 0) is not None
    other = {"outcome": 3, "failed": True, "worst_error": 0.5, "error_2": 7.0, "status_1": 2}
    rows[column][5] = other[column]
    write_chunk(store, 0, rows)
    assert read_chunk(store, 0) is None


def test_sweep_store_rejects_an_index_beyond_the_end(store):
    with refused("index: found 100, expected 0 to 99"):
        read_row(store, 100)


def test_sweep_store_rejects_a_folder_that_is_not_empty(store, tmp_path):
    with refused("--resume"):
        open_store(store.folder, MANIFEST, resume=False)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").touch()
    for resume in (False, True):
        with refused("thesis", "expected"):
            open_store(tmp_path / "thesis", MANIFEST, resume)


def test_sweep_store_of_other_inputs_is_rejected_with_names_of_differences(store):
    with refused("other inputs", "seed: found 0, requested 7"):
        open_store(store.folder, manifest(case(2), seed=7), resume=True)


def test_sweep_store_with_missing_column_is_rejected_with_column_name(tmp_path):
    columns = [column for column in MANIFEST.columns if not column.name.startswith("position_shortfall")]
    assert len(columns) == len(MANIFEST.columns) - 2
    old = msgspec.structs.replace(MANIFEST, columns=columns)
    old = msgspec.structs.replace(old, sha256=digest(msgspec.to_builtins(old)))
    folder = open_store(tmp_path / "store", old, resume=False).folder
    difference = "columns: found other columns than this version writes"
    with refused("other code", difference):
        open_store(folder, MANIFEST, resume=True)
    # The store can still be read, with a warning.
    assert list_process_differences(read_store(folder).manifest) == [
        difference
    ] and not list_process_differences(MANIFEST)


def test_resumed_sweep_removes_unfinished_files_of_the_store(store):
    (store.folder / "studies").mkdir()
    unfinished = [store.folder / folder / UNFINISHED for folder in ("", "parts", "studies")]
    remaining = ["verdict.json", "studies/drivers-2.json", ".thesis.docx.tmp", "parts/.thesis.docx.1.tmp"]
    remaining = [store.folder / name for name in remaining]
    for path in (*unfinished, *remaining):
        path.write_text("{}")
    assert open_store(store.folder, MANIFEST, resume=True).manifest == MANIFEST
    assert [path.exists() for path in (*unfinished, *remaining)] == [False] * 3 + [True] * 4


def test_new_sweep_store_rejects_folder_with_old_studies_or_verdict(store):
    (store.folder / "manifest.json").unlink()
    for part in range(MANIFEST.parts):
        store.chunk_path(part).unlink()
    (store.folder / "studies").mkdir()
    for resume in (False, True):
        with refused("store: found 'studies' and no sweep"):
            open_store(store.folder, MANIFEST, resume)
    (store.folder / "studies").rmdir()
    for name in ("verdict.json", "errors.png"):
        (store.folder / name).touch()
        for resume in (False, True):
            with refused(f"store: found '{name}' and no sweep"):
                open_store(store.folder, MANIFEST, resume)
        (store.folder / name).unlink()
    open_store(store.folder, MANIFEST, resume=False)


def test_full_disk_is_reported_in_one_line_and_sweep_store_keeps_its_chunks(store):
    before = store.chunk_path(0).read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        with refused("part-000000.parquet: cannot be written: "):
            write_chunk(store, 0, fake_rows(0, seed=1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert store.chunk_path(0).read_bytes() == before
    assert len(os.listdir(store.folder / "parts")) == MANIFEST.parts


def test_sweep_store_folder_that_cannot_be_created_is_reported_in_one_line(tmp_path):
    (tmp_path / "file").touch()
    with refused("file/store: cannot be written: "):
        open_store(tmp_path / "file" / "store", MANIFEST, resume=False)


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_sweep_store_in_read_only_folder_is_reported_in_one_line(store):
    (store.folder / "parts").chmod(0o500)
    with refused("part-000000.parquet: cannot be written: Permission denied"):
        write_chunk(store, 0, fake_rows(0))


def test_sweep_store_is_resumed_only_by_the_same_source_code(tmp_path):
    old = msgspec.structs.replace(MANIFEST, sources_sha256="0" * 64)
    old = msgspec.structs.replace(old, sha256=digest(msgspec.to_builtins(old)))
    folder = open_store(tmp_path / "store", old, resume=False).folder
    what_to_do = "expected a new folder, or --resume with the version that wrote this store"
    with refused("store: was made by other code: sources_sha256: found 000000000000...", what_to_do):
        open_store(folder, MANIFEST, resume=True)


def test_sweep_store_changes_no_third_party_file(tmp_path):
    thesis = tmp_path / "thesis"
    thesis.mkdir()
    for name in (".thesis.docx.tmp", ".thesis.docx.1.tmp", "thesis.docx", ".lock"):
        (thesis / name).write_text("years")
    before = {path: (path.read_text(), path.stat().st_mtime_ns) for path in thesis.iterdir()}
    for resume in (False, True):
        with refused("thesis: found '.thesis.docx.1.tmp' and no sweep, expected an empty folder"):
            with lock_store(thesis):
                open_store(thesis, MANIFEST, resume)
    assert {path: (path.read_text(), path.stat().st_mtime_ns) for path in thesis.iterdir()} == before


@pytest.mark.parametrize("name", [".lock", "manifest.json", "parts", "verdict.json", "studies"])
@pytest.mark.parametrize("kind", ["link", "pipe", "folder link"])
def test_sweep_store_follows_no_link_and_does_not_block_on_pipe(store, tmp_path, name, kind):
    folder = store.folder / name
    if folder.is_dir():
        folder.rename(tmp_path / "away")
    folder.unlink(missing_ok=True)
    (tmp_path / "precious").write_text("years")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / UNFINISHED).write_text("years")
    if kind == "pipe":
        os.mkfifo(folder)
    else:
        folder.symlink_to(tmp_path / ("precious" if kind == "link" else "elsewhere"))
    before = os.lstat(folder).st_ino
    with refused(name, "found a (link|pipe), expected a (plain file|folder)"), lock_store(store.folder):
        opened = open_store(store.folder, MANIFEST, resume=True)
        write_verdict(opened, {"verdict": "good"})
        write_study(opened, IndicesRequest(2), ErrorIndices((), 1.0, 4, 0))
    assert os.lstat(folder).st_ino == before
    assert (tmp_path / "precious").read_text() == "years"
    assert os.listdir(tmp_path / "elsewhere") == [UNFINISHED]


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_sweep_store_chunk_must_be_a_plain_file(store, tmp_path, kind):
    path = store.chunk_path(2)
    path.rename(tmp_path / "part")
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(tmp_path / "part")
    assert read_chunk(store, 2) is None
    with refused("part-000002.parquet: cannot be written: found a"):
        write_chunk(store, 2, fake_rows(2))
    remove_chunks(store, 1)
    assert sorted(os.listdir(path.parent)) == ["part-000000.parquet", path.name]


def test_sweep_store_is_locked_against_a_second_sweep(tmp_path):
    with lock_store(tmp_path), refused("another sweep"), lock_store(tmp_path):
        pass
    with lock_store(tmp_path):
        pass
