"""Speed of a cluster of two to eight workers compared with one process, and load of the scheduler.

Run with `pytest -m benchmark -s tests/benchmarks/test_cluster.py`.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from clusters import on_cluster, started
from test_sweep import default_gains

from jaxhil.simulation.gain_file import check_document
from tuning.caches.cluster import WorkUnit, run_on_workers
from tuning.sweeps.chunk_file import list_different_columns
from tuning.sweeps.chunks import run_chunks
from tuning.sweeps.manifest import ManifestOptions, build_manifest
from tuning.sweeps.run_sweep import run_sweep
from tuning.sweeps.store import open_store, read_chunk

pytestmark = pytest.mark.benchmark
CHUNK, PARTS, REPEATS = 4096, 32, 3
THOUSAND, PIECES = 1000, 4000
STUBS = Path(__file__).with_name("stub_workers.py")


def run_timed_sweep(folder, manifest, computer=run_chunks):
    """Return the duration [s] of a sweep and its rows."""
    store = open_store(folder, manifest, resume=False)
    begin = time.perf_counter()
    run_sweep(store, lambda *_: None, lambda *_: None, computer)
    took = time.perf_counter() - begin
    return took, [read_chunk(store, part) for part in range(PARTS)]


@pytest.mark.parametrize("workers", [2, 4, 8])
def test_cluster_sweep_is_at_least_half_as_fast_as_local_sweep(workers, tmp_path, capsys):
    manifest = build_manifest(check_document(default_gains()), ManifestOptions(PARTS * CHUNK, chunk=CHUNK))
    local_times, cluster_times = [], []
    with started(tmp_path) as cluster:
        for _ in range(workers):
            cluster.worker("--nthreads", "1")
        # In the first repetition every worker reads the program.
        for turn in range(1 + REPEATS):
            local_time, rows = run_timed_sweep(tmp_path / f"here {turn}", manifest)
            cluster_time, cluster_rows = run_timed_sweep(
                tmp_path / f"there {turn}", manifest, on_cluster(cluster.address)
            )
            assert all(
                list_different_columns(one, two) == [] for one, two in zip(rows, cluster_rows, strict=True)
            )
            local_times.append(local_time)
            tlocal_times.append(cluster_time)
    efficiency = min(local_times[1:]) / min(cluster_times[1:])
    with capsys.disabled():
        print(
            f"\n{workers} workers on the cores of one process, the same rows: {efficiency:.2f} of its"
            f" scenarios/s ({PARTS * CHUNK / min(cluster_times[1:]):.3g} over"
            f" {PARTS * CHUNK / min(local_times[1:]):.3g};"
            f" chunks of {workers * min(cluster_times[1:]) / PARTS:.2f} s)"
        )
    assert efficiency >= 0.5


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="times of other processes are Linux's")
def test_scheduler_is_not_the_bottleneck_of_a_thousand_workers(tmp_path, capsys):
    """Measure the CPU time that scheduler and command use for one empty task."""
    distributed = pytest.importorskip("distributed")
    with started(tmp_path) as cluster:
        command = [sys.executable, str(STUBS), cluster.address, str(THOUSAND)]
        stubs = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL, start_new_session=True)
        cluster.processes.append(stubs)
        with distributed.Client(cluster.address, set_as_default=False) as client:
            while client.scheduler_info(n_workers=0)["n_workers"] < THOUSAND:
                assert stubs.poll() is None
                time.sleep(1.0)
        scheduler, ours, begin = cpu_seconds(cluster.processes[0]), time.process_time(), time.perf_counter()
        pieces = (WorkUnit(i, (-i,)) for i in range(PIECES))
        results = dict(run_on_workers(cluster.address, abs, pieces, None, "stubs"))
        took, ours = time.perf_counter() - begin, time.process_time() - ours
        scheduler = cpu_seconds(cluster.processes[0]) - scheduler
    np.testing.assert_array_equal([results[i] for i in range(PIECES)], np.arange(PIECES))
    busy = THOUSAND * max(scheduler, ours) / PIECES
    with capsys.disabled():
        print(
            f"\n{THOUSAND} idle workers in one process: {PIECES / took:.3g} pieces/s; of processor"
            f" a piece costs the scheduler {1e3 * scheduler / PIECES:.2f} ms, the command"
            f" {1e3 * ours / PIECES:.2f} ms: pieces of {busy:.2g} s keep {THOUSAND} workers busy"
        )
    assert busy <= 10.0


def cpu_seconds(process):
    """Return the CPU time [s] that a process has used."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
