"""Computation of a sweep's parts and of its studies' points by a cluster (`tuning.caches.cluster`)."""

from collections.abc import Generator, Iterable
from functools import lru_cache

import numpy as np

from tuning.caches.cluster import ClusterWorkers, WorkUnit
from tuning.caches.worker import build_setting_error
from tuning.sweeps import point_batches
from tuning.sweeps.chunks import Rows, SweepProgram, build_sweep, run_chunk
from tuning.sweeps.manifest import decode_manifest, encode_manifest, list_process_differences
from tuning.sweeps.run_sweep import ChunkComputer

BATCHES_PER_STUDY = 64  # number of pieces into which points are divided, for any number of workers


def build_chunk_computer(workers: ClusterWorkers) -> ChunkComputer:
    """Return a function that computes parts on these workers."""

    def run(sweep: SweepProgram, parts: Iterable[int]) -> Generator[tuple[int, Rows], None, None]:
        content = encode_manifest(sweep.manifest)
        pieces = (WorkUnit(part, (content, part)) for part in parts)
        # No setting is passed: each worker compares its own with the manifest.
        return workers.run(run_manifest_chunk, pieces, None, sweep.manifest.sha256[:16])

    return run


def build_point_computer(workers: ClusterWorkers) -> point_batches.PointComputer:
    """Return a function that computes points on these workers."""

    def run(
        sweep: SweepProgram, pieces: Iterable[point_batches.PointBatch]
    ) -> Generator[tuple[str, Rows], None, None]:
        content = encode_manifest(sweep.manifest)
        tasks = (WorkUnit(piece.name, (content, piece.points, piece.noise)) for piece in pieces)
        return workers.run(run_manifest_points, tasks, None, sweep.manifest.sha256[:16])

    return run


def run_manifest_chunk(content: bytes, part: int) -> Rows:
    """Compute a part's rows from the content of a manifest file; raise `InputError` on a different worker."""
    sweep = _load_sweep(content)
    return run_chunk(sweep, *sweep.manifest.chunk_range(part))


def run_manifest_points(content: bytes, at: np.ndarray, noise: np.ndarray) -> Rows:
    """Compute a piece of a study likewise (`tuning.sweeps.point_batches.run_piece`)."""
    return point_batches.run_batch(_load_sweep(content), at, noise)


@lru_cache(maxsize=2)
def _load_sweep(content: bytes) -> SweepProgram:
    manifest = decode_manifest(content, "sweep")
    for difference in list_process_differences(manifest):
        raise build_setting_error(difference, difference.startswith("xla_flags"))
    return build_sweep(manifest)
