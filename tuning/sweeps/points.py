"""Scenarios at chosen points of the unit box of all uncertain numbers, run through a sweep's own program.

They are run in pieces, here or by the workers of a cluster, each kept when it is finished: what a piece gives
follows from the sweep and its points alone.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxhil.mechanism.uncertainty import at_points
from tuning.caches.pieces import NOTHING_KEPT, Pieces
from tuning.sweeps.chunks import Rows, Sweep, in_precision
from tuning.sweeps.columns import rows_of

FEWEST = 256  # points of a piece, where there are several
COLUMNS = ("outcome", "worst_error")

Done = Callable[[int], None]  # called with a number of scenarios


class Points(NamedTuple):
    """A piece."""

    name: str  # the same for the same points alone
    points: Float[np.ndarray, "number inputs"]  # of the unit box
    noise: Int[np.ndarray, "number"]  # indices of realisations


# Runs pieces and gives their names and rows, in any order.
Computer = Callable[[Sweep, Iterable[Points]], Iterator[tuple[str, Rows]]]


def run_piece(sweep: Sweep, points: np.ndarray, noise: np.ndarray) -> Rows:
    """`COLUMNS` of the scenarios at at most a chunk's points, in order."""
    manifest = sweep.manifest
    scenarios = sweep.model.scenarios(sweep.mechanism, at_points(sweep.mechanism, points), manifest.seed)
    key = np.stack([scenarios.key[0], noise.astype(np.uint32)])
    scenarios = in_precision(scenarios._replace(key=key), manifest.precision)
    outcome = sweep.model.evaluate(sweep.loop, sweep.gains, scenarios, at_least=manifest.chunk)
    rows = rows_of(sweep.mechanism, 0, {}, scenarios, outcome, manifest.largest_error, manifest.works)
    return {name: rows[name] for name in COLUMNS}


def run_here(sweep: Sweep, pieces: Iterable[Points]) -> Iterator[tuple[str, Rows]]:
    """One after the other."""
    return ((piece.name, run_piece(sweep, piece.points, piece.noise)) for piece in pieces)


class Running(NamedTuple):
    """How points are run."""

    done: Done = lambda _: None  # hears of scenarios that were run
    found: Done = lambda _: None  # and of those that are kept from before
    kept: Pieces = NOTHING_KEPT  # where finished pieces are kept
    computer: Computer = run_here
    several: int = 1  # pieces that are wanted, where there are points enough


HERE = Running()


def run_points(sweep: Sweep, points: np.ndarray, noise: np.ndarray, running: Running = HERE) -> Rows:
    """`COLUMNS` of the scenarios at points (number, inputs) of the unit box, in order.

    `noise` (number,) are indices of realisations. To the bit, a scenario's do not depend on the pieces.
    """
    number, label = len(points), sweep.manifest.sha256
    size = min(sweep.manifest.chunk, max(FEWEST, -(-number // running.several)))
    cuts = (slice(begin, begin + size) for begin in range(0, number, size))
    order = [_piece(points[cut], noise[cut]) for cut in cuts]
    pieces = {piece.name: piece for piece in order}
    rows: dict[str, Rows] = {}
    for name, piece in pieces.items():
        found = running.kept.read(name, (label, piece), dict[str, np.ndarray])
        if found is not None:
            rows[name] = found
            running.found(len(piece.points))
    missing = [piece for name, piece in pieces.items() if name not in rows]
    for name, found in running.computer(sweep, missing) if missing else ():
        running.kept.write(name, (label, pieces[name]), found)
        rows[name] = found
        running.done(len(pieces[name].points))
    return {column: np.concatenate([rows[piece.name][column] for piece in order]) for column in COLUMNS}


def _piece(points: np.ndarray, noise: np.ndarray) -> Points:
    content = hashlib.sha256(np.ascontiguousarray(points).tobytes())
    content.update(np.ascontiguousarray(noise, np.int64).tobytes())
    return Points(f"points {content.hexdigest()[:32]}", points, noise)
