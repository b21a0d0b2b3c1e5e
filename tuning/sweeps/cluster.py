"""Parts of a sweep, and points of its studies, computed by a cluster's workers (`tuning.caches.cluster`)."""

from collections.abc import Generator, Iterable
from functools import lru_cache

import numpy as np

from tuning.caches.cluster import Piece, Workers
from tuning.caches.worker import differs
from tuning.sweeps import points
from tuning.sweeps.chunks import Rows, Sweep, build_sweep, run_chunk
from tuning.sweeps.manifest import decode, encode, unlike_here
from tuning.sweeps.run import Computer

SEVERAL = 64  # pieces that points are cut into, whatever the workers


def parts_on(workers: Workers) -> Computer:
    """Parts computed by these workers."""

    def run(sweep: Sweep, parts: Iterable[int]) -> Generator[tuple[int, Rows], None, None]:
        content = encode(sweep.manifest)
        asked = (Piece(part, (content, part)) for part in parts)
        # The manifest says what a worker has to be like.
        return workers.run(run_part, asked, None, sweep.manifest.sha256[:16])

    return run


def points_on(workers: Workers) -> points.Computer:
    """Points computed by these workers."""

    def run(sweep: Sweep, pieces: Iterable[points.Points]) -> Generator[tuple[str, Rows], None, None]:
        content = encode(sweep.manifest)
        asked = (Piece(piece.name, (content, piece.points, piece.noise)) for piece in pieces)
        return workers.run(run_points, asked, None, sweep.manifest.sha256[:16])

    return run


def run_part(content: bytes, part: int) -> Rows:
    """A part's rows, from the content of a manifest file. Raises `InputError` where they might differ from
    those of the process that asks."""
    sweep = _sweep(content)
    return run_chunk(sweep, *sweep.manifest.part_rows(part))


def run_points(content: bytes, at: np.ndarray, noise: np.ndarray) -> Rows:
    """A piece of a study, likewise (`tuning.sweeps.points.run_piece`)."""
    return points.run_piece(_sweep(content), at, noise)


@lru_cache(maxsize=2)
def _sweep(content: bytes) -> Sweep:
    manifest = decode(content, "sweep")
    for one in unlike_here(manifest):
        raise differs(one, one.startswith("xla_flags"))
    return build_sweep(manifest)
