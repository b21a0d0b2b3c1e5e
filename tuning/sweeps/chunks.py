"""Computation of the chunks of a sweep on all cores: from indices of scenarios to rows of the store.

One compiled program serves every chunk. Its delay lines are sized for the extremes of all possible draws, so
that a scenario's row is identical to the bit in any chunk.
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
    """Sweep of a manifest with its loop, ready to run."""

    manifest: Manifest
    mechanism: AnyMechanism  # mechanism in the gain file
    loop: Any  # loop for all possible draws (`widest_loop`)
    gains: dict[str, float]  # gains in the gain file

    @property
    def model(self) -> RigModel:
        """Return the model of the mechanism's rig."""
        return rig_model(self.mechanism)


class _Batch(NamedTuple):
    """Scenarios to run."""

    first: int  # index of the first scenario
    draws: dict[str, np.ndarray]  # drawn values by dotted path
    scenarios: Any


def build_sweep(manifest: Manifest) -> Sweep:
    """Build the sweep of a manifest; raise `InputError` if its gain file is invalid."""
    loaded = loaded_gains(manifest)
    return Sweep(manifest, loaded.mechanism, widest_loop(loaded, manifest.works), loaded.gains)


def widest_loop(loaded: LoadedGains, works: bool) -> Any:
    """Return the loop for all possible draws; with `works`, mechanical works are computed exactly."""
    draws = extremes(loaded.mechanism)
    if PERIOD in draws:
        # Reversed, the longest delay meets the shortest period, which needs the longest delay line.
        draws[PERIOD] = draws[PERIOD][::-1]
    model = rig_model(loaded.mechanism)
    scenarios = model.scenarios(loaded.mechanism, draws)
    return model.loop(loaded.mechanism, loaded.compensator, scenarios, energies=works, exact=works)


def run_chunk(sweep: Sweep, first: int, number: int, precision: str | None = None) -> Rows:
    """Compute the rows of scenarios `first` to `first + number - 1`; `number` is at most that of a chunk.

    A run that fails or becomes non-finite gives a row with that status.
    """
    return _begin(sweep, _draw(sweep, first, number, precision))()


def run_parts(sweep: Sweep, parts: Iterable[int]) -> Generator[tuple[int, Rows], None, None]:
    """Yield the number and rows of each part; the next part is computed while the caller uses them."""
    running = None
    for part in parts:
        # The next part is queued behind the running one, so that no core is idle. The first part starts the
        # threads of JAX, which must be allowed to use all cores.
        with on_half_the_cores(0) if running is not None else nullcontext():
            begun = part, _begin(sweep, _draw(sweep, *sweep.manifest.part_rows(part), None))
        if running is not None:
            yield _finished(running)
        running = begun
    if running is not None:
        yield _finished(running)


def in_precision(scenarios: Any, precision: str) -> Any:
    """Convert the scenarios' floating-point numbers, and thereby the program, to the precision."""

    def cast(leaf: Any) -> Any:
        leaf = np.asarray(leaf)
        if leaf.dtype.kind != "f":
            return leaf
        # A number broadcast to all lanes stays one number in memory.
        values = leaf[..., :1] if leaf.strides[-1] == 0 else leaf
        return np.broadcast_to(values.astype(precision, copy=False), leaf.shape)

    return jax.tree.map(cast, scenarios)


def _draw(sweep: Sweep, first: int, number: int, precision: str | None) -> _Batch:
    manifest = sweep.manifest
    draws, scenarios = drawn_scenarios(sweep.mechanism, manifest.sampling, manifest.seed, first, number)
    return _Batch(first, draws, in_precision(scenarios, precision or manifest.precision))


def _begin(sweep: Sweep, batch: _Batch) -> Callable[[], Rows]:
    """Start the computation of a batch; return a function that waits for its rows."""
    manifest = sweep.manifest
    limit, works = manifest.largest_error, manifest.works
    read = partial(read_of, sweep.mechanism, works)
    outcome = sweep.model.begin_evaluation(sweep.loop, sweep.gains, batch.scenarios, manifest.chunk, read)
    return lambda: rows_of(sweep.mechanism, *batch, outcome(), limit, works)


def _finished(running: tuple[int, Callable[[], Rows]]) -> tuple[int, Rows]:
    part, rows = running
    with on_half_the_cores(0):
        return part, rows()
