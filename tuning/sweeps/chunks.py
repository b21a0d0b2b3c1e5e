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
from jaxhil.mechanism.uncertainty import draw_extremes
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation.evaluation import RigModel
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.jax_environment import use_half_the_cores
from tuning.sweeps.columns import build_rows, select_read_fields
from tuning.sweeps.draws import draw_scenarios
from tuning.sweeps.manifest import Manifest, load_gains

Rows = dict[str, np.ndarray]
CONTROL_PERIOD_KEY = "rig.control_period"


class SweepProgram(NamedTuple):
    """Sweep of a manifest with its loop, ready to run."""

    manifest: Manifest
    mechanism: AnyMechanism  # mechanism in the gain file
    loop: Any  # loop for all possible draws (`build_widest_loop`)
    gains: dict[str, float]  # gains in the gain file

    @property
    def model(self) -> RigModel:
        """Return the model of the mechanism's rig."""
        return choose_rig_model(self.mechanism)


class _ScenarioBatch(NamedTuple):
    """Scenarios to run."""

    first: int  # index of the first scenario
    draws: dict[str, np.ndarray]  # drawn values by dotted path
    scenarios: Any


def build_sweep(manifest: Manifest) -> SweepProgram:
    """Build the sweep of a manifest; raise `InputError` if its gain file is invalid."""
    loaded = load_gains(manifest)
    return SweepProgram(manifest, loaded.mechanism, build_widest_loop(loaded, manifest.works), loaded.gains)


def build_widest_loop(loaded: LoadedGains, works: bool) -> Any:
    """Return the loop for all possible draws; with `works`, mechanical works are computed exactly."""
    draws = draw_extremes(loaded.mechanism)
    if CONTROL_PERIOD_KEY in draws:
        # Reversed, the longest delay meets the shortest period, which needs the longest delay line.
        draws[CONTROL_PERIOD_KEY] = draws[CONTROL_PERIOD_KEY][::-1]
    model = choose_rig_model(loaded.mechanism)
    scenarios = model.scenarios(loaded.mechanism, draws)
    return model.loop(loaded.mechanism, loaded.compensator, scenarios, energies=works, exact=works)


def run_chunk(sweep: SweepProgram, first: int, number: int, precision: str | None = None) -> Rows:
    """Compute the rows of scenarios `first` to `first + number - 1`; `number` is at most that of a chunk.

    A run that fails or becomes non-finite gives a row with that status.
    """
    return _begin_evaluation(sweep, _draw_batch(sweep, first, number, precision))()


def run_chunks(sweep: SweepProgram, parts: Iterable[int]) -> Generator[tuple[int, Rows], None, None]:
    """Yield the number and rows of each part; the next part is computed while the caller uses them."""
    running = None
    for part in parts:
        # The next part is queued behind the running one, so that no core is idle. The first part starts the
        # threads of JAX, which must be allowed to use all cores.
        with use_half_the_cores(0) if running is not None else nullcontext():
            begun = (
                part,
                _begin_evaluation(sweep, _draw_batch(sweep, *sweep.manifest.chunk_range(part), None)),
            )
        if running is not None:
            yield _finish_chunk(running)
        running = begun
    if running is not None:
        yield _finish_chunk(running)


def convert_precision(scenarios: Any, precision: str) -> Any:
    """Convert the scenarios' floating-point numbers, and thereby the program, to the precision."""

    def cast(leaf: Any) -> Any:
        leaf = np.asarray(leaf)
        if leaf.dtype.kind != "f":
            return leaf
        # A number broadcast to all lanes stays one number in memory.
        values = leaf[..., :1] if leaf.strides[-1] == 0 else leaf
        return np.broadcast_to(values.astype(precision, copy=False), leaf.shape)

    return jax.tree.map(cast, scenarios)


def _draw_batch(sweep: SweepProgram, first: int, number: int, precision: str | None) -> _ScenarioBatch:
    manifest = sweep.manifest
    draws, scenarios = draw_scenarios(sweep.mechanism, manifest.sampling, manifest.seed, first, number)
    return _ScenarioBatch(first, draws, convert_precision(scenarios, precision or manifest.precision))


def _begin_evaluation(sweep: SweepProgram, batch: _ScenarioBatch) -> Callable[[], Rows]:
    """Start the computation of a batch; return a function that waits for its rows."""
    manifest = sweep.manifest
    limit, works = manifest.error_limit, manifest.works
    read = partial(select_read_fields, sweep.mechanism, works)
    outcome = sweep.model.begin_evaluation(sweep.loop, sweep.gains, batch.scenarios, manifest.chunk, read)
    return lambda: build_rows(sweep.mechanism, *batch, outcome(), limit, works)


def _finish_chunk(running: tuple[int, Callable[[], Rows]]) -> tuple[int, Rows]:
    part, rows = running
    with use_half_the_cores(0):
        return part, rows()
