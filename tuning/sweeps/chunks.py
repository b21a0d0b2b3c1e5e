"""Chunks of a sweep: scenarios by index through the loop, on every core, as rows of the store.

One compiled program serves every chunk. Its delay lines are made for the extremes of what can be drawn, not
for what a chunk happens to draw, so that a scenario's rows are the same to the bit in any chunk.
"""

from collections.abc import Callable, Generator, Iterable
from contextlib import nullcontext
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.uncertainty import extremes
from jaxhil.rig_models import rig_model
from jaxhil.simulation.environment import on_half_the_cores
from jaxhil.simulation.evaluation import RigModel
from jaxhil.simulation.gain_file import LoadedGains
from tuning.sweeps.columns import read_of, rows_of
from tuning.sweeps.draws import drawn_scenarios
from tuning.sweeps.manifest import Manifest, loaded_gains

Rows = dict[str, np.ndarray]
PERIOD = "rig.control_period"


class Sweep(NamedTuple):
    """What a manifest asks for, ready to run."""

    manifest: Manifest
    mechanism: AnyMechanism  # of the gain file
    loop: Any  # serves whatever can be drawn (`widest_loop`)
    gains: dict[str, float]  # of the gain file

    @property
    def model(self) -> RigModel:
        """The model of the mechanism's rig."""
        return rig_model(self.mechanism)


class _Batch(NamedTuple):
    """Scenarios to run."""

    first: int  # index of the first
    draws: dict[str, np.ndarray]  # what they are made of, by dotted path
    scenarios: Any


def build_sweep(manifest: Manifest) -> Sweep:
    """Raises `InputError` for a manifest with an impossible gain file."""
    loaded = loaded_gains(manifest)
    return Sweep(manifest, loaded.mechanism, widest_loop(loaded, manifest.works), loaded.gains)


def widest_loop(loaded: LoadedGains, works: bool) -> Any:
    """The loop that serves whatever can be drawn."""
    draws = extremes(loaded.mechanism)
    if PERIOD in draws:
        # The longest delay counted in the shortest periods.
        draws[PERIOD] = draws[PERIOD][::-1]
    model = rig_model(loaded.mechanism)
    scenarios = model.scenarios(loaded.mechanism, draws)
    return model.loop(loaded.mechanism, loaded.compensator, scenarios, energies=works, exact=works)


def run_chunk(sweep: Sweep, first: int, number: int, precision: str | None = None) -> Rows:
    """Rows of the scenarios number `first` to `first + number - 1`; `number` is at most the chunk's.

    A run that fails, or whose numbers are no longer finite, is a row that says so.
    """
    return _begin(sweep, _draw(sweep, first, number, precision))()


def run_parts(sweep: Sweep, parts: Iterable[int]) -> Generator[tuple[int, Rows], None, None]:
    """Part by part its number and rows. While the caller uses them, the next part is computed already."""
    running = None
    for part in parts:
        # It waits its turn behind the one that runs, so that no core does. The first one starts threads, to
        # which all are open.
        with on_half_the_cores(0) if running is not None else nullcontext():
            begun = part, _begin(sweep, _draw(sweep, *sweep.manifest.part_rows(part), None))
        if running is not None:
            yield _finished(running)
        running = begun
    if running is not None:
        yield _finished(running)


def in_precision(scenarios: Any, precision: str) -> Any:
    """Scenarios whose numbers make the program one of that precision."""

    def cast(leaf: Any) -> Any:
        leaf = np.asarray(leaf)
        if leaf.dtype.kind != "f":
            return leaf
        # What all lanes have in common stays one number.
        own = leaf[..., :1] if leaf.strides[-1] == 0 else leaf
        return np.broadcast_to(own.astype(precision, copy=False), leaf.shape)

    return jax.tree.map(cast, scenarios)


def _draw(sweep: Sweep, first: int, number: int, precision: str | None) -> _Batch:
    manifest = sweep.manifest
    draws, scenarios = drawn_scenarios(sweep.mechanism, manifest.sampling, manifest.seed, first, number)
    return _Batch(first, draws, in_precision(scenarios, precision or manifest.precision))


def _begin(sweep: Sweep, batch: _Batch) -> Callable[[], Rows]:
    """Start computing; what is returned waits for the rows."""
    manifest = sweep.manifest
    limit, works = manifest.largest_error, manifest.works
    read = partial(read_of, sweep.mechanism, works)
    outcome = sweep.model.begin_evaluation(sweep.loop, sweep.gains, batch.scenarios, manifest.chunk, read)
    return lambda: rows_of(sweep.mechanism, *batch, outcome(), limit, works)


def _finished(running: tuple[int, Callable[[], Rows]]) -> tuple[int, Rows]:
    part, rows = running
    with on_half_the_cores(0):
        return part, rows()
