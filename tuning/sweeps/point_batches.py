"""Runs of the scenarios that a study selects, as points of the unit cube of all uncertain numbers.

The points run in batches with the program of a sweep, in this process or on the workers of a cluster. Each
finished batch is cached, since its result depends only on the sweep and the points.
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

MIN_POINTS_PER_BATCH = 256  # smallest number of points per batch if there are several batches
POINT_COLUMNS = ("outcome", "worst_error")

CountCallback = Callable[[int], None]  # callback that gets a number of scenarios


class PointBatch(NamedTuple):
    """Points of the unit cube whose scenarios run together."""

    name: str  # unique name, from the digest of points and noise
    points: Float[np.ndarray, "number inputs"]  # coordinates from 0 to 1
    noise: Int[np.ndarray, "number"]  # index of the noise realisation of each point


# Function that runs batches, and yields their names and rows in any order.
PointComputer = Callable[[SweepProgram, Iterable[PointBatch]], Iterator[tuple[str, Rows]]]


def run_batch(sweep: SweepProgram, points: np.ndarray, noise: np.ndarray) -> Rows:
    """Run one scenario per point, for at most one chunk of points; return the columns `POINT_COLUMNS`."""
    manifest = sweep.manifest
    scenarios = sweep.model.scenarios(sweep.mechanism, draw_at_points(sweep.mechanism, points), manifest.seed)
    key = np.stack([scenarios.key[0], noise.astype(np.uint32)])
    scenarios = convert_precision(scenarios._replace(key=key), manifest.precision)
    outcome = sweep.model.evaluate(sweep.loop, sweep.gains, scenarios, at_least=manifest.chunk)
    rows = build_rows(sweep.mechanism, 0, {}, scenarios, outcome, manifest.error_limit, manifest.works)
    return {name: rows[name] for name in POINT_COLUMNS}


def run_locally(sweep: SweepProgram, batches: Iterable[PointBatch]) -> Iterator[tuple[str, Rows]]:
    return ((batch.name, run_batch(sweep, batch.points, batch.noise)) for batch in batches)


class PointRunSettings(NamedTuple):
    """Settings for running the points of a study: progress reports, cache, function that runs batches."""

    report_computed: CountCallback = lambda _: None  # called with the number of scenarios of each new batch
    report_cached: CountCallback = lambda _: None  # called with the number of scenarios of each cached batch
    checkpoints: Checkpoints = NO_CHECKPOINTS  # cache of finished batches
    computer: PointComputer = run_locally  # runs the batches that are not in the cache
    max_batches: int = 1  # largest number of batches, if the chunk size permits


LOCAL_RUN = PointRunSettings()


def run_points(
    sweep: SweepProgram, points: np.ndarray, noise: np.ndarray, running: PointRunSettings = LOCAL_RUN
) -> Rows:
    """Run one scenario for each point of the unit cube; return the columns `POINT_COLUMNS`.

    `points` has the shape (scenarios, inputs); `noise` has each scenario's index of the noise realisation.
    The division into batches does not affect the result.
    """
    number, label = len(points), sweep.manifest.sha256
    size = min(sweep.manifest.chunk, max(MIN_POINTS_PER_BATCH, -(-number // running.max_batches)))
    slices = (slice(begin, begin + size) for begin in range(0, number, size))
    order = [_build_batch(points[part], noise[part]) for part in slices]
    batches = {batch.name: batch for batch in order}
    rows: dict[str, Rows] = {}
    for name, batch in batches.items():
        cached = running.checkpoints.read(name, (label, batch), dict[str, np.ndarray])
        if cached is not None:
            rows[name] = cached
            running.report_cached(len(batch.points))
    missing = [batch for name, batch in batches.items() if name not in rows]
    for name, computed in running.computer(sweep, missing) if missing else ():
        running.checkpoints.write(name, (label, batches[name]), computed)
        rows[name] = computed
        running.report_computed(len(batches[name].points))
    return {column: np.concatenate([rows[batch.name][column] for batch in order]) for column in POINT_COLUMNS}


def _build_batch(points: np.ndarray, noise: np.ndarray) -> PointBatch:
    content = hashlib.sha256(np.ascontiguousarray(points).tobytes())
    content.update(np.ascontiguousarray(noise, np.int64).tobytes())
    return PointBatch(f"points {content.hexdigest()[:32]}", points, noise)
