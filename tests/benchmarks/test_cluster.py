"""What a cluster costs: two to eight workers beside one process on the same cores.

Run with `pytest -m benchmark -s tests/benchmarks/test_cluster.py` on a quiet machine.
"""

import time

import pytest
from clusters import started
from test_sweep import default_gains

from jaxhil.simulation.gain_file import check_document
from tuning.sweeps.chunks import run_parts
from tuning.sweeps.cluster import on_cluster
from tuning.sweeps.manifest import Choices, build_manifest
from tuning.sweeps.parts import same_rows
from tuning.sweeps.run import run_sweep
from tuning.sweeps.store import open_store, read_part

pytestmark = pytest.mark.benchmark
CHUNK, PARTS, REPEATS = 4096, 32, 3


def swept(folder, manifest, computer=run_parts):
    """Seconds of a sweep, and its rows."""
    store = open_store(folder, manifest, resume=False)
    begin = time.perf_counter()
    run_sweep(store, lambda *_: None, lambda *_: None, computer)
    took = time.perf_counter() - begin
    return took, [read_part(store, part) for part in range(PARTS)]


@pytest.mark.parametrize("workers", [2, 4, 8])
def test_workers_beside_one_process_on_the_same_cores(workers, tmp_path, capsys):
    manifest = build_manifest(check_document(default_gains()), Choices(PARTS * CHUNK, chunk=CHUNK))
    here, there = [], []
    with started(tmp_path) as cluster:
        for _ in range(workers):
            cluster.worker("--nthreads", "1")
        # The first time everyone reads the program.
        for turn in range(1 + REPEATS):
            own, rows = swept(tmp_path / f"here {turn}", manifest)
            other, found = swept(tmp_path / f"there {turn}", manifest, on_cluster(cluster.address))
            assert all(same_rows(one, two) == [] for one, two in zip(rows, found, strict=True))
            here.append(own)
            there.append(other)
    efficiency = min(here[1:]) / min(there[1:])
    with capsys.disabled():
        print(
            f"\n{workers} workers on the cores of one process, the same rows: {efficiency:.2f} of its"
            f" scenarios/s ({PARTS * CHUNK / min(there[1:]):.3g} over {PARTS * CHUNK / min(here[1:]):.3g};"
            f" pieces of {workers * min(there[1:]) / PARTS:.2f} s)"
        )
    assert efficiency >= 0.5
