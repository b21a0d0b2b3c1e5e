"""Sweeps on a dask.distributed cluster with manually started workers: rows unchanged by a killed worker."""

import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any

import numpy as np
import pytest
from clusters import ROOT, awaited, killed_meanwhile, on_cluster, started
from sweep_cases import NOISY, case, manifest

import tuning
from jaxhil.errors import InputError
from tuning.caches.cluster import ClusterWorkers, WorkUnit, run_on_workers
from tuning.gain_file import write_gain_file
from tuning.sweeps.chunk_file import list_different_columns
from tuning.sweeps.cluster_computers import run_manifest_chunk
from tuning.sweeps.manifest import encode_manifest
from tuning.sweeps.run_sweep import run_sweep
from tuning.sweeps.store import open_store, read_chunk

pytestmark = pytest.mark.users_options

MANIFEST = manifest(case(), scenarios=300, limit=1.5)


def rows_of(folder, computer=None, label=MANIFEST, each=lambda tally: None):
    """Return rows and tally of a sweep."""
    store = open_store(folder, label, resume=True)
    more = {} if computer is None else {"computer": computer}
    _, tally = run_sweep(store, lambda *_: None, lambda number, tally: each(tally), **more)
    parts = [read_chunk(store, part) for part in range(-(-tally.scenarios // label.chunk))]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, tally


@pytest.fixture(scope="module")
def local_sweep(tmp_path_factory):
    """Return a sweep computed locally."""
    return rows_of(tmp_path_factory.mktemp("whole") / "store")


def test_sweep_without_scheduler_fails_with_one_line_message_and_writes_no_files(tmp_path):
    pytest.importorskip("distributed")
    write_gain_file(tmp_path / "gains.json", case())
    with pytest.raises(InputError, match="--scheduler: found 'nowhere"):
        tuning.sweep(tmp_path / "gains.json", folder=tmp_path / "store", scheduler="nowhere://x")
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize(
    ("says", "reason"),
    ((b"", "nothing answers within"), (b"HTTP/1.1 400 Bad", "another program answers")),
)
def test_sweep_with_unresponsive_scheduler_fails_with_one_line_message(monkeypatch, says, reason):
    pytest.importorskip("distributed")
    monkeypatch.setattr("tuning.caches.cluster.SCHEDULER_TIMEOUT", 0.5)
    waited = Event()

    def answer(listening):
        """Answer a call; release callers that still wait after a minute."""
        with listening.accept()[0] as accepted:
            accepted.sendall(says)
            waited.wait(60)

    with socket.create_server(("127.0.0.1", 0)) as listening, ThreadPoolExecutor(1) as thread:
        answered = thread.submit(answer, listening)
        address = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        with pytest.raises(InputError, match=f"--scheduler: found '{address}', .*{reason}"):
            list(run_on_workers(address, awaited, [WorkUnit(0, (0.0,))], None, "never"))
        waited.set()
        answered.result()


def test_cluster_worker_sets_xla_flags_before_jax_import():
    code = "import sys, tuning.caches.worker as w; assert 'jax' not in sys.modules; w.dask_setup(None);"
    code += "import os; assert '--xla_backend_optimization_level=1' in os.environ['XLA_FLAGS']"
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    subprocess.run([sys.executable, "-c", code], check=True, env={**environment, "PYTHONPATH": str(ROOT)})


def test_cluster_worker_with_other_xla_flags_reports_correct_start_command(monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr("tuning.sweeps.manifest.active_xla_flags", lambda: "--others")
        asked = encode_manifest(manifest(case()))
    with pytest.raises(InputError, match=r"start workers with: dask worker ADDRESS --preload"):
        run_manifest_chunk(asked, 0)


@pytest.mark.slow
def test_cluster_sweep_rows_are_unchanged_if_a_worker_is_killed(local_sweep, tmp_path):
    with started(tmp_path) as cluster:
        first, _ = cluster.worker(), cluster.worker("--nthreads", "2")

        def kill_one(tally):
            if first.poll() is None and tally.scenarios >= 64:
                cluster.kill(first)

        rows, tally = rows_of(tmp_path / "store", on_cluster(cluster.address), each=kill_one)
        assert first.poll() is not None
    assert list_different_columns(rows, local_sweep[0]) == [] and tally == local_sweep[1]


@pytest.mark.slow
def test_cluster_worker_with_running_jax_is_rejected_or_preloaded(local_sweep, tmp_path):
    (tmp_path / "early.py").write_text("def dask_setup(worker):\n    import jax\n    jax.devices()\n")
    with started(tmp_path) as cluster:
        wrong = cluster.worker("--preload", str(tmp_path / "early.py"))
        with pytest.raises(InputError, match=r"dask worker ADDRESS --preload tuning\.caches\.worker"):
            rows_of(tmp_path / "refused", on_cluster(cluster.address))
        cluster.kill(wrong)
        cluster.worker("--preload", "tuning.caches.worker", "--preload", str(tmp_path / "early.py"))
        rows, _ = rows_of(tmp_path / "store", on_cluster(cluster.address))
    assert list_different_columns(rows, local_sweep[0]) == []


@pytest.mark.slow
def test_sweep_chunk_that_kills_its_workers_is_computed_locally(tmp_path):
    """Every worker dies during its first chunk and is restarted."""
    few = manifest(case(), scenarios=64, limit=1.5)
    code = "import os, signal, tuning.caches.worker as w\n"
    (tmp_path / "deadly.py").write_text(code + "w.prepare = lambda: os.kill(os.getpid(), signal.SIGKILL)\n")
    with started(tmp_path) as cluster:
        cluster.worker("--preload", str(tmp_path / "deadly.py"))
        rows, tally = rows_of(tmp_path / "store", on_cluster(cluster.address), few)
    here, again = rows_of(tmp_path / "here", label=few)
    assert list_different_columns(rows, here) == [] and tally == again


@pytest.mark.slow
def test_cluster_workers_that_join_later_also_receive_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.caches.cluster.WORKER_COUNT_INTERVAL", 0.5)
    with started(tmp_path) as cluster:
        cluster.worker()
        spans = []
        for _, span in run_on_workers(
            cluster.address, awaited, (WorkUnit(i, (1.0,)) for i in range(40)), None, "late"
        ):
            if not spans:
                for _ in range(3):
                    cluster.worker()
            spans.append(span)
    assert len(spans) == 40
    assert max(sum(begun <= at < ended for begun, ended in spans) for at, _ in spans) == 4


@pytest.mark.slow
def test_sweep_without_workers_is_computed_locally(tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.caches.cluster.IDLE_TIMEOUT", 1.0)
    few = manifest(case(), scenarios=64, limit=1.5)
    with started(tmp_path) as cluster:
        rows, _ = rows_of(tmp_path / "store", on_cluster(cluster.address), few)
    assert list_different_columns(rows, rows_of(tmp_path / "here", label=few)[0]) == []


@pytest.mark.slow
def test_killed_scheduler_is_reported_in_one_line_and_finished_chunks_are_kept(local_sweep, tmp_path):
    with started(tmp_path) as cluster:
        cluster.worker()

        def kill_scheduler(tally):
            if cluster.processes[0].poll() is None:
                cluster.kill(cluster.processes[0])

        with pytest.raises(InputError, match="--resume goes on"):
            rows_of(tmp_path / "store", on_cluster(cluster.address), each=kill_scheduler)
    assert len(list((tmp_path / "store").glob("parts/part-*"))) >= 1
    assert list_different_columns(rows_of(tmp_path / "store")[0], local_sweep[0]) == []


@pytest.mark.slow
def test_sweep_on_a_cluster_stops_after_same_number_of_scenarios_as_local_sweep(tmp_path):
    until = manifest(case(), scenarios=300, limit=1.5, until_width=0.25)
    here, tally = rows_of(tmp_path / "here", label=until)
    with started(tmp_path) as cluster:
        cluster.worker("--nworkers", "2", "--nthreads", "1")
        rows, again = rows_of(tmp_path / "store", on_cluster(cluster.address), label=until)
    assert 64 < tally.scenarios < 300 and again == tally and list_different_columns(rows, here) == []


@pytest.mark.slow
def test_sweep_studies_are_unchanged_if_a_worker_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.sweeps.point_batches.MIN_POINTS_PER_BATCH", 16)
    gains, folder = tmp_path / "gains.json", tmp_path / "store"
    write_gain_file(gains, case(force_sensor=NOISY))
    asked: dict[str, Any] = {"scenarios": 100, "chunk": 64, "limit": 1.5}
    studies = {"drivers": 64, "rare": 1.6}
    here = tuning.sweep(gains, **asked, **studies).document
    tuning.sweep(gains, **asked, folder=folder)
    with started(tmp_path) as cluster:
        first, _ = cluster.worker(), cluster.worker("--nthreads", "2")
        killed_meanwhile(monkeypatch, ClusterWorkers, cluster, first, "run")
        cluster_result = tuning.sweep(
            gains, **asked, **studies, folder=folder, resume=True, scheduler=cluster.address
        ).document
        assert first.poll() is not None
    assert not (folder / ".pieces").exists()
    for name in ("drivers", "rare", "failure_probability", "worst"):
        assert cluster_result[name] == here[name]
