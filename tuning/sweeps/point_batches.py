"""Scenarios at selected points of the unit box of all uncertain numbers, run by a sweep's program.

They run in pieces, in this process or on the workers of a cluster. Each finished piece is cached, since its
result depends only on the sweep and its points.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxhil.mechanism.uncertainty import draw_at_points
from tuning.caches.checkpoints import NO_CHECKPOINTS, Checkpoints
from tuning.sweeps.chunks import Rows, SweepProgram, convert_precision
from tuning.sweeps.columns import build_rows

MIN_POINTS_PER_BATCH = 256  # least number of points per piece if there are several
POINT_COLUMNS = ("outcome", "worst_error")

CountCallback = Callable[[int], None]  # called with a number of scenarios


class PointBatch(NamedTuple):
    """Piece of the points to run."""

    name: str  # unique name, from the digest of points and noise
    points: Float[np.ndarray, "number inputs"]  # points of the unit box
    noise: Int[np.ndarray, "number"]  # indices of the noise realisations


# Runs pieces and yields their names and rows in any order.
PointComputer = Callable[[SweepProgram, Iterable[PointBatch]], Iterator[tuple[str, Rows]]]


def run_batch(sweep: SweepProgram, points: np.ndarray, noise: np.ndarray) -> Rows:
    """Compute `POINT_COLUMNS` of the scenarios at the points, at most a chunk, in order."""
    manifest = sweep.manifest
    scenarios = sweep.model.scenarios(sweep.mechanism, draw_at_points(sweep.mechanism, points), manifest.seed)
    key = np.stack([scenarios.key[0], noise.astype(np.uint32)])
    scenarios = convert_precision(scenarios._replace(key=key), manifest.precision)
    outcome = sweep.model.evaluate(sweep.loop, sweep.gains, scenarios, at_least=manifest.chunk)
    rows = build_rows(sweep.mechanism, 0, {}, scenarios, outcome, manifest.error_limit, manifest.works)
    return {name: rows[name] for name in POINT_COLUMNS}


def run_locally(sweep: SweepProgram, pieces: Iterable[PointBatch]) -> Iterator[tuple[str, Rows]]:
    """Run pieces one after the other in this process."""
    return ((piece.name, run_batch(sweep, piece.points, piece.noise)) for piece in pieces)


class PointRunSettings(NamedTuple):
    """Settings with which points are run."""

    done: CountCallback = lambda _: None  # called with the number of scenarios that were run
    found: CountCallback = lambda _: None  # called with the number of scenarios that were in the cache
    kept: Checkpoints = NO_CHECKPOINTS  # cache of finished pieces
    computer: PointComputer = run_locally
    several: int = 1  # number of pieces if there are at least `MIN_POINTS_PER_BATCH` points for each


LOCAL_RUN = PointRunSettings()


def run_points(
    sweep: SweepProgram, points: np.ndarray, noise: np.ndarray, running: PointRunSettings = LOCAL_RUN
) -> Rows:
    """Compute `POINT_COLUMNS` of the scenarios at points (number, inputs) of the unit box, in order.

    `noise` (number,) holds indices of realisations. Results do not depend on the pieces, to the bit.
    """
    number, label = len(points), sweep.manifest.sha256
    size = min(sweep.manifest.chunk, max(MIN_POINTS_PER_BATCH, -(-number // running.several)))
    cuts = (slice(begin, begin + size) for begin in range(0, number, size))
    order = [_build_batch(points[cut], noise[cut]) for cut in cuts]
    pieces = {piece.name: piece for piece in order}
    rows: dict[str, Rows] = {}
    for name, piece in pieces.items():
        cached = running.kept.read(name, (label, piece), dict[str, np.ndarray])
        if cached is not None:
            rows[name] = cached
            running.found(len(piece.points))
    missing = [piece for name, piece in pieces.items() if name not in rows]
    for name, computed in running.computer(sweep, missing) if missing else ():
        running.kept.write(name, (label, pieces[name]), computed)
        rows[name] = computed
        running.done(len(pieces[name].points))
    return {column: np.concatenate([rows[piece.name][column] for piece in order]) for column in POINT_COLUMNS}


def _build_batch(points: np.ndarray, noise: np.ndarray) -> PointBatch:
    content = hashlib.sha256(np.ascontiguousarray(points).tobytes())
    content.update(np.ascontiguousarray(noise, np.int64).tobytes())
    return PointBatch(f"points {content.hexdigest()[:32]}", points, noise)
