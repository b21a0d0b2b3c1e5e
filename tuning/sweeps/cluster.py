"""Computation of a sweep's parts and of its studies' points by a cluster (`tuning.caches.cluster`)."""

from collections.abc import Generator, Iterable
from functools import lru_cache

import numpy as np

from tuning.caches.cluster import Piece, Workers
from tuning.caches.worker import differs
from tuning.sweeps import points
from tuning.sweeps.chunks import Rows, Sweep, build_sweep, run_chunk
from tuning.sweeps.manifest import decode, encode, unlike_here
from tuning.sweeps.run import Computer

SEVERAL = 64  # number of pieces into which points are divided, for any number of workers


def parts_on(workers: Workers) -> Computer:
    """Return a function that computes parts on these workers."""

    def run(sweep: Sweep, parts: Iterable[int]) -> Generator[tuple[int, Rows], None, None]:
        content = encode(sweep.manifest)
        pieces = (Piece(part, (content, part)) for part in parts)
        # No setting is passed: each worker compares its own with the manifest.
        return workers.run(run_part, pieces, None, sweep.manifest.sha256[:16])

    return run


def points_on(workers: Workers) -> points.Computer:
    """Return a function that computes points on these workers."""

    def run(sweep: Sweep, pieces: Iterable[points.Points]) -> Generator[tuple[str, Rows], None, None]:
        content = encode(sweep.manifest)
        tasks = (Piece(piece.name, (content, piece.points, piece.noise)) for piece in pieces)
        return workers.run(run_points, tasks, None, sweep.manifest.sha256[:16])

    return run


def run_part(content: bytes, part: int) -> Rows:
    """Compute a part's rows from the content of a manifest file; raise `InputError` on a different worker."""
    sweep = _sweep(content)
    return run_chunk(sweep, *sweep.manifest.part_rows(part))


def run_points(content: bytes, at: np.ndarray, noise: np.ndarray) -> Rows:
    """Compute a piece of a study likewise (`tuning.sweeps.points.run_piece`)."""
    return points.run_piece(_sweep(content), at, noise)


@lru_cache(maxsize=2)
def _sweep(content: bytes) -> Sweep:
    manifest = decode(content, "sweep")
    for difference in unlike_here(manifest):
        raise differs(difference, difference.startswith("xla_flags"))
    return build_sweep(manifest)
