"""Sweeps that are interrupted, resumed or distributed over workers: identical stores."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
from sweep_cases import case, manifest

from jaxhil.errors import InputError
from tuning.gain_file import write_gain_file
from tuning.statistics.intervals import SequentialState, is_narrow_enough, update_sequence
from tuning.sweeps import run_sweep as run_sweep_module
from tuning.sweeps.chunk_file import list_different_columns
from tuning.sweeps.chunks import run_chunk
from tuning.sweeps.replay import compute_motion, replay_scenario
from tuning.sweeps.run_sweep import compare_precisions, count_outcomes, run_sweep
from tuning.sweeps.store import open_store, read_chunk, read_store, write_chunk

pytestmark = pytest.mark.users_options

MANIFEST = manifest(case(), scenarios=300, limit=1.5)
HERE = Path(__file__).parent
# temporary file of a process that does not exist: no process has this number
UNFINISHED = f".jaxhil-{2**22 + 1}-0123abcd-0.tmp"


class Log(list):
    """Counters of the rows that `run_sweep` reports as found in the store and as computed."""

    def __init__(self):
        self.found, self.computed = 0, 0

    def sweep(self, folder, resume=True, label=MANIFEST, **options):
        store = open_store(folder, label, resume)

        def found(rows, tally):
            self.found += rows

        def computed(rows, tally):
            self.computed += rows

        return store, *run_sweep(store, found, computed, **options)


def all_rows(store):
    parts = [read_chunk(store, part) for part in range(store.manifest.parts)]
    assert all(part is not None for part in parts)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@pytest.fixture(scope="module")
def uninterrupted_sweep(tmp_path_factory):
    """Return rows, sweep and tally of a sweep without interruptions."""
    store, sweep, tally = Log().sweep(tmp_path_factory.mktemp("whole") / "store", resume=False)
    return store, all_rows(store), sweep, tally


def test_sweep_tally_equals_tally_of_stored_rows(uninterrupted_sweep):
    _, rows, _, tally = uninterrupted_sweep
    assert tally.scenarios == 300 and tally.failed == np.sum(rows["failed"])
    assert 0 < tally.failed < 300
    assert count_outcomes(tally) == {"good": 300 - tally.failed, "error beyond limit": tally.failed}
    worst = np.argsort(-np.abs(rows["worst_error"]))[:10]
    np.testing.assert_array_equal([index for _, _, index in tally.worst], worst)


def test_missing_or_damaged_sweep_chunks_are_computed_again(uninterrupted_sweep, tmp_path):
    _, rows, _, tally = uninterrupted_sweep
    store, _, _ = Log().sweep(tmp_path / "store")
    store.chunk_path(0).unlink()
    store.chunk_path(9).unlink()
    content = store.chunk_path(4).read_bytes()
    store.chunk_path(4).write_bytes(content[: len(content) // 2])
    (tmp_path / "store" / "parts" / UNFINISHED).write_bytes(content[:100])
    log = Log()
    store, _, again = log.sweep(tmp_path / "store")
    assert (log.found, log.computed) == (300 - 32 - 32 - 12, 32 + 32 + 12)
    assert list_different_columns(all_rows(store), rows) == [] and again == tally
    assert len(list((tmp_path / "store" / "parts").iterdir())) == 10


def test_interrupted_sweep_keeps_written_rows(uninterrupted_sweep, tmp_path):
    _, rows, _, tally = uninterrupted_sweep
    store = open_store(tmp_path / "store", MANIFEST, resume=False)

    def interrupted(number, tally):
        if tally.scenarios >= 96:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_sweep(store, lambda *_: None, interrupted)
    log = Log()
    store, _, again = log.sweep(tmp_path / "store")
    assert log.found == 96 + 32  # the chunk that was being written is also kept
    assert list_different_columns(all_rows(store), rows) == [] and again == tally


def test_sweep_chunk_is_written_while_next_chunk_is_computed(tmp_path, monkeypatch):
    store, next_begun = open_store(tmp_path / "store", MANIFEST, resume=False), threading.Event()

    def computer(sweep, parts):
        yield 0, run_chunk(sweep, *MANIFEST.chunk_range(0))
        next_begun.set()
        yield 1, run_chunk(sweep, *MANIFEST.chunk_range(1))

    def write(store, part, rows):
        assert next_begun.wait(60)
        write_chunk(store, part, rows)

    monkeypatch.setattr(run_sweep_module, "write_chunk", write)
    counts = []
    run_sweep(store, lambda *_: None, lambda rows, tally: counts.append(tally.scenarios), computer)
    assert counts == [32, 64]
    assert all(read_chunk(store, part) is not None for part in (0, 1))


def test_sweep_reports_chunk_that_cannot_be_written(tmp_path):
    store = open_store(tmp_path / "store", MANIFEST, resume=False)
    store.chunk_path(2).mkdir()
    with pytest.raises(InputError, match=r"part-000002\.parquet"):
        run_sweep(store, lambda *_: None, lambda *_: None)
    assert all(read_chunk(store, part) is not None for part in (0, 1))


def test_killed_and_resumed_sweep_gives_store_of_uninterrupted_sweep(uninterrupted_sweep, tmp_path):
    _, rows, _, _ = uninterrupted_sweep
    write_gain_file(tmp_path / "gains.json", case())
    folder = tmp_path / "store"
    program = "import conftest, sys; from tuning.__main__ import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "sweep", str(tmp_path / "gains.json"), "--resume", "--json"]
    command += ["--scenarios", "300", "--chunk", "32", "--limit", "1.5", "-o", str(folder)]
    path = os.pathsep.join([str(HERE.parent), str(HERE)])
    environment = {**os.environ, "PYTHONPATH": path, "JAXHIL_CACHE": str(tmp_path / "cache")}
    silent = {"env": environment, "cwd": HERE, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **silent) as process:
        while process.poll() is None and not list(folder.glob("parts/part-*")):
            time.sleep(0.002)
        process.send_signal(signal.SIGKILL)
    assert 1 <= len(list(folder.glob("parts/part-*"))) < 10
    log = Log()
    store, _, _ = log.sweep(folder)
    assert log.found >= 32 and log.computed > 0
    assert list_different_columns(all_rows(store), rows) == []


def test_replay_of_any_sweep_row_is_bit_identical(uninterrupted_sweep):
    store, rows, _, _ = uninterrupted_sweep
    for index in np.random.default_rng(0).integers(0, 300, 6):
        result = replay_scenario(read_store(store.folder), int(index))
        assert result.different_columns == []
        np.testing.assert_array_equal(result.again["error_1"], rows["error_1"][index])


def test_replay_detects_a_changed_sweep_row(uninterrupted_sweep, tmp_path):
    store = read_store(shutil.copytree(uninterrupted_sweep[0].folder, tmp_path / "store"))
    changed = dict(read_chunk(store, 0))
    changed["peak_force_1"] = changed["peak_force_1"].copy()
    changed["peak_force_1"][5] = np.nextafter(changed["peak_force_1"][5], np.inf)
    write_chunk(store, 0, changed)
    assert replay_scenario(store, 5).different_columns == ["peak_force_1"]
    assert replay_scenario(store, 6).different_columns == []


def test_replayed_motion_equals_simulation_of_the_scenario(uninterrupted_sweep):
    _, rows, sweep, _ = uninterrupted_sweep
    (piece,) = compute_motion(sweep, 17)
    curve = piece.curves["rig"]
    rebound = -np.diff(curve.position)[-1] / 2e-3
    np.testing.assert_allclose(rebound / curve.velocity, rows["restitution_1"][17], rtol=1e-9)


def test_float32_and_float64_are_compared_on_the_same_scenarios(uninterrupted_sweep):
    _, rows, sweep, _ = uninterrupted_sweep
    result = compare_precisions(sweep, 64)
    assert result.scenarios == 32 and result.failed_float64 == np.sum(rows["failed"][:32])
    assert result.largest_difference is not None and 0 < result.largest_difference < 1e-4
    assert result.changed_outcomes == abs(result.failed_float64 - result.failed_float32)


WIDE = 0.25  # a width reached after 300 scenarios, but not after 64
UNTIL = manifest(case(), scenarios=300, limit=1.5, until_width=WIDE)


@pytest.fixture(scope="module")
def stopped_sweep(tmp_path_factory):
    """Return store, chunks and tally of a sweep that stopped at a narrow interval."""
    store, _, tally = Log().sweep(tmp_path_factory.mktemp("until") / "store", resume=False, label=UNTIL)
    return store, parts_of(store), tally


def parts_of(store):
    return sorted(path.name for path in store.folder.glob("parts/part-*"))


def test_sweep_stops_when_failure_interval_is_first_narrow_enough(uninterrupted_sweep, stopped_sweep):
    _, rows, _, _ = uninterrupted_sweep
    store, parts, tally = stopped_sweep
    failed, running = rows["failed"], SequentialState()
    for looks in range(1, 11):
        part = failed[32 * (looks - 1) : 32 * looks]
        running = update_sequence(running, int(np.sum(part)), len(part))
        if is_narrow_enough(running, WIDE):
            break
    assert 2 < looks < 9 and tally.looks == running
    assert tally.scenarios == 32 * looks and len(parts) == looks
    for number in range(looks):
        made = read_chunk(store, number)
        assert made is not None
        assert (
            list_different_columns(made, {k: v[32 * number : 32 * number + 32] for k, v in rows.items()})
            == []
        )
    assert replay_scenario(read_store(store.folder), 32 * looks - 1).different_columns == []
    with pytest.raises(InputError, match="expected a scenario before the sweep"):
        replay_scenario(store, 299)


def test_sweep_that_reached_its_interval_width_is_not_continued(stopped_sweep):
    store, parts, tally = stopped_sweep
    log = Log()
    _, _, again = log.sweep(store.folder, label=UNTIL)
    assert again == tally and parts_of(store) == parts
    assert (log.found, log.computed) == (tally.scenarios, 0)
    with pytest.raises(InputError, match=r"until_width: found 0\.25, requested 0\.1"):
        Log().sweep(store.folder, label=manifest(case(), scenarios=300, limit=1.5, until_width=0.1))


def test_sweep_stop_does_not_depend_on_order_of_finished_chunks(stopped_sweep, tmp_path):
    _, parts, tally = stopped_sweep

    def shuffled(sweep, missing):
        for part in np.random.default_rng(0).permutation(list(missing)):
            yield int(part), run_chunk(sweep, *sweep.manifest.chunk_range(int(part)))

    store, _, again = Log().sweep(tmp_path / "store", label=UNTIL, computer=shuffled)
    assert again == tally and parts_of(store) == parts
    # Some chunks are missing in between.
    store.chunk_path(0).unlink()
    store.chunk_path(2).unlink()
    log = Log()
    assert log.sweep(tmp_path / "store", label=UNTIL)[2] == tally and parts_of(store) == parts
    assert (log.found, log.computed) == (tally.scenarios - 64, 64)


def test_sweep_ends_at_its_largest_number_of_scenarios(uninterrupted_sweep, tmp_path):
    _, rows, _, _ = uninterrupted_sweep
    label = manifest(case(), scenarios=300, limit=1.5, until_width=1e-6)
    store, _, tally = Log().sweep(tmp_path / "store", label=label)
    assert tally.scenarios == 300 and list_different_columns(all_rows(store), rows) == []
    # Chunks beyond the stop of a sweep, left by an interruption, are removed.
    wide = read_store(store.folder)._replace(manifest=msgspec.structs.replace(label, until_width=WIDE))
    _, tally = run_sweep(wide, lambda *_: None, lambda *_: None)
    assert tally.scenarios < 300 and len(parts_of(store)) == -(-tally.scenarios // 32)
