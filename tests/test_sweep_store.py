"""The store: parts whole or not at all, and nothing taken for what it is not."""

import os
import resource

import msgspec
import numpy as np
import pytest
from sweep_cases import case, manifest

from jaxhil.errors import InputError
from jaxhil.runtime import digest
from tuning.sweeps.columns import OUTCOMES, STATUSES
from tuning.sweeps.manifest import unlike_here
from tuning.sweeps.store import locked, open_store, read_part, read_row, read_store, same_rows, write_part

MANIFEST = manifest(case(2))


def made_up(part, label=MANIFEST, seed=0):
    """Rows of a part, made up, with gaps."""
    first, number = label.part_rows(part)
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
            texts = OUTCOMES if column.name == "outcome" else STATUSES
            rows[column.name] = generator.integers(0, len(texts), number).astype(np.int8)
        else:
            rows[column.name] = values
    return rows


@pytest.fixture
def store(tmp_path):
    made = open_store(tmp_path / "store", MANIFEST, resume=False)
    for part in range(MANIFEST.parts):
        write_part(made, part, made_up(part))
    return made


def refused(*words):
    return pytest.raises(InputError, match=".*".join(words))


def test_what_is_written_is_read(store):
    for part in range(MANIFEST.parts):
        found = read_part(store, part)
        assert found is not None and list(found) == [column.name for column in MANIFEST.columns]
        assert same_rows(found, made_up(part)) == []
    assert same_rows(read_row(store, 99), {k: v[3:4] for k, v in made_up(3).items()}) == []


def test_it_is_a_parquet_dataset_with_names_units_and_nulls(store):
    from pyarrow import parquet

    table = parquet.read_table(store.folder / "parts")
    assert table.num_rows == 100
    assert table.column("index").to_pylist() == list(range(100))
    assert table.schema.field("energy_in_2").metadata[b"unit"] == b"J"
    expected = np.concatenate([made_up(part)["error_1"] for part in range(MANIFEST.parts)])
    assert table.column("error_1").null_count == np.sum(np.isnan(expected)) > 0
    assert set(table.column("outcome").to_pylist()) <= set(OUTCOMES)


@pytest.mark.parametrize("harm", ["cut", "flipped", "empty", "gone", "other sweep", "other part"])
def test_a_damaged_or_foreign_part_is_not_taken(store, tmp_path, harm):
    path = store.part_path(1)
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
        path.write_bytes(store.part_path(0).read_bytes())
    else:
        other = open_store(tmp_path / "other", manifest(case(2), seed=1), resume=False)
        write_part(other, 1, made_up(1))
        path.write_bytes(other.part_path(1).read_bytes())
    assert read_part(store, 1) is None
    assert read_part(store, 0) is not None
    with refused("part-000001.parquet", "--resume"):
        read_row(store, 40)


def test_no_bit_of_a_part_can_change_unseen(store):
    path, expected = store.part_path(0), made_up(0)
    content = path.read_bytes()
    for place in np.random.default_rng(0).integers(0, len(content), 60):
        harmed = bytearray(content)
        harmed[place] ^= 1 << int(place % 8)
        path.write_bytes(harmed)
        found = read_part(store, 0)
        assert found is None or same_rows(found, expected) == []


def test_an_index_beyond_the_end_is_refused(store):
    with refused("index: found 100, allowed 0 to 99"):
        read_row(store, 100)


def test_a_folder_with_something_in_it_is_refused(store, tmp_path):
    with refused("--resume"):
        open_store(store.folder, MANIFEST, resume=False)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").touch()
    for resume in (False, True):
        with refused("thesis", "allowed"):
            open_store(tmp_path / "thesis", MANIFEST, resume)


def test_other_inputs_are_refused_by_name(store):
    with refused("other inputs", "seed: found 0, asked for 7"):
        open_store(store.folder, manifest(case(2), seed=7), resume=True)


def test_a_store_without_a_column_is_refused_by_name(tmp_path):
    columns = [column for column in MANIFEST.columns if not column.name.startswith("position_shortfall")]
    assert len(columns) == len(MANIFEST.columns) - 2
    old = msgspec.structs.replace(MANIFEST, columns=columns)
    old = msgspec.structs.replace(old, sha256=digest(msgspec.to_builtins(old)))
    folder = open_store(tmp_path / "store", old, resume=False).folder
    difference = "columns: found others than this version writes"
    with refused("other inputs", difference):
        open_store(folder, MANIFEST, resume=True)
    # It can still be read, with a word of warning.
    assert unlike_here(read_store(folder).manifest) == [difference] and not unlike_here(MANIFEST)


def test_resuming_removes_what_was_left_unfinished(store):
    stale = store.folder / "parts" / ".part-000002.parquet.123.tmp"
    stale.write_bytes(b"PAR1")
    assert open_store(store.folder, MANIFEST, resume=True).manifest == MANIFEST
    assert not stale.exists()


def test_nothing_unfinished_is_left_beside_the_rows(store):
    (store.folder / "studies").mkdir()
    left = [store.folder / ".verdict.json.1.tmp", store.folder / "studies" / ".drivers-2.json.1.tmp"]
    kept = [store.folder / "verdict.json", store.folder / "studies" / "drivers-2.json"]
    for path in (*left, *kept):
        path.write_text("{}")
    open_store(store.folder, MANIFEST, resume=True)
    assert [path.exists() for path in (*left, *kept)] == [False, False, True, True]


def test_a_new_store_takes_over_no_study_and_no_verdict(store):
    (store.folder / "manifest.json").unlink()
    for part in range(MANIFEST.parts):
        store.part_path(part).unlink()
    (store.folder / "studies").mkdir()
    for resume in (False, True):
        with refused("store: found a folder with something in it"):
            open_store(store.folder, MANIFEST, resume)
    (store.folder / "studies").rmdir()
    (store.folder / "verdict.json").touch()
    for resume in (False, True):
        with refused("store: found a folder with something in it"):
            open_store(store.folder, MANIFEST, resume)


def test_a_full_disk_is_one_line_and_keeps_what_is_there(store):
    before = store.part_path(0).read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        with refused("part-000000.parquet: cannot be written: "):
            write_part(store, 0, made_up(0, seed=1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert store.part_path(0).read_bytes() == before
    assert len(os.listdir(store.folder / "parts")) == MANIFEST.parts


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    with refused("file/store: cannot be written: "):
        open_store(tmp_path / "file" / "store", MANIFEST, resume=False)


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_one_line(store):
    (store.folder / "parts").chmod(0o500)
    with refused("part-000000.parquet: cannot be written: Permission denied"):
        write_part(store, 0, made_up(0))


def test_two_sweeps_do_not_write_to_one_store(tmp_path):
    with locked(tmp_path), refused("another sweep"), locked(tmp_path):
        pass
    with locked(tmp_path):
        pass
