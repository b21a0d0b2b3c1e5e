"""Computation of a sweep's chunks and of the scenarios of its studies on a cluster."""

from collections.abc import Generator, Iterable
from functools import lru_cache

import numpy as np

from tuning.caches.cluster import ClusterWorkers, WorkUnit
from tuning.caches.worker import build_setting_error
from tuning.sweeps import point_batches
from tuning.sweeps.chunks import Rows, SweepProgram, build_sweep, run_chunk
from tuning.sweeps.manifest import decode_manifest, encode_manifest, list_process_differences
from tuning.sweeps.run_sweep import ChunkComputer

BATCHES_PER_STUDY = 64  # number of batches of a study's points, for any number of workers


def build_chunk_computer(workers: ClusterWorkers) -> ChunkComputer:
    """Return a function that computes chunks of a sweep on `workers`."""

    def run(sweep: SweepProgram, parts: Iterable[int]) -> Generator[tuple[int, Rows], None, None]:
        content = encode_manifest(sweep.manifest)
        units = (WorkUnit(part, (content, part)) for part in parts)
        # No process setting is requested here, because each worker compares its own with the manifest.
        return workers.run(run_manifest_chunk, units, None, sweep.manifest.sha256[:16])

    return run


def build_point_computer(workers: ClusterWorkers) -> point_batches.PointComputer:
    """Return a function that computes batches of scenarios at given points on `workers`."""

    def run(
        sweep: SweepProgram, batches: Iterable[point_batches.PointBatch]
    ) -> Generator[tuple[str, Rows], None, None]:
        content = encode_manifest(sweep.manifest)
        units = (WorkUnit(batch.name, (content, batch.points, batch.noise)) for batch in batches)
        return workers.run(run_manifest_points, units, None, sweep.manifest.sha256[:16])

    return run


def run_manifest_chunk(content: bytes, part: int) -> Rows:
    """Compute a chunk's rows on a worker; raise `InputError` if code or settings differ from the manifest."""
    sweep = _load_sweep(content)
    return run_chunk(sweep, *sweep.manifest.chunk_range(part))


def run_manifest_points(content: bytes, at: np.ndarray, noise: np.ndarray) -> Rows:
    """Run the scenarios at points `at` on a worker; raise `InputError` as `run_manifest_chunk` does."""
    return point_batches.run_batch(_load_sweep(content), at, noise)


@lru_cache(maxsize=2)
def _load_sweep(content: bytes) -> SweepProgram:
    manifest = decode_manifest(content, "sweep")
    for difference in list_process_differences(manifest):
        raise build_setting_error(difference, difference.startswith("xla_flags"))
    return build_sweep(manifest)
