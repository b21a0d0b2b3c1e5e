"""Local dask.distributed cluster: a scheduler and workers started as by a user."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from tuning.caches.cluster import connect_workers
from tuning.sweeps.cluster_computers import build_chunk_computer

ROOT = Path(__file__).parent.parent


class Cluster:
    """Scheduler and workers, each a separate process."""

    def __init__(self, folder):
        self.file, self.processes = folder / "scheduler.json", []
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        while not self.file.exists() or not self.file.read_text().endswith("}"):
            time.sleep(0.05)
        self.address = json.loads(self.file.read_text())["address"]

    def _start(self, kind, *arguments, **environment):
        """Start a process with an environment that contains only the package path."""
        ours = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "NPROC")}
        path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
        command = [sys.executable, "-m", "dask", kind, "--scheduler-file", str(self.file), "--no-dashboard"]
        self.processes.append(
            subprocess.Popen(
                [*command, *arguments],
                env={**ours, "PYTHONPATH": path, **environment},
                cwd=self.file.parent,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        )
        return self.processes[-1]

    def worker(self, *arguments, **environment):
        return self._start("worker", *arguments, **environment)

    def kill(self, process):
        """Kill the worker and its supervising process."""
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def killed_meanwhile(monkeypatch, holder, cluster, worker, name="on_workers"):
    """Run the wrapped function, and kill `worker` as soon as the workers have finished one work unit."""
    handed = getattr(holder, name)

    def killing(*asked):
        for one in handed(*asked):
            if worker.poll() is None:
                cluster.kill(worker)
            yield one

    monkeypatch.setattr(holder, name, killing)


@contextmanager
def started(folder):
    pytest.importorskip("distributed")
    cluster = Cluster(folder)
    try:
        yield cluster
    finally:
        for process in cluster.processes:
            if process.poll() is None:
                cluster.kill(process)


def on_cluster(address):
    """Compute chunks of a sweep on the workers of the scheduler at this address."""

    def run(sweep, parts):
        with connect_workers(address) as workers:
            yield from build_chunk_computer(workers)(sweep, parts)

    return run


def awaited(seconds):
    """Work unit of the given duration; returns its start and end time."""
    begun = time.time()
    time.sleep(seconds)
    return begun, time.time()
