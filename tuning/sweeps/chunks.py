"""Computation of a sweep's chunks: the scenarios are drawn, run on all cores, and converted to rows.

All chunks share one compiled program. Its delay lines are long enough for every possible draw, so that the
row of a scenario is the same to the last bit whichever chunk contains it.
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
    """Everything that is needed to run scenarios of a sweep."""

    manifest: Manifest
    mechanism: AnyMechanism  # mechanism of the gain file
    loop: Any  # static properties of the loop, valid for all possible draws (`build_widest_loop`)
    gains: dict[str, float]  # gains of the gain file

    @property
    def model(self) -> RigModel:
        return choose_rig_model(self.mechanism)


class _ScenarioBatch(NamedTuple):
    """Consecutive scenarios of a sweep, and the values that were drawn for them."""

    first: int  # index of the first scenario
    draws: dict[str, np.ndarray]  # drawn values by key of the mechanism file
    scenarios: Any  # batch with one lane per scenario


def build_sweep(manifest: Manifest) -> SweepProgram:
    """Build the program of a sweep from its manifest; raise `InputError` if the gain file is invalid."""
    loaded = load_gains(manifest)
    return SweepProgram(manifest, loaded.mechanism, build_widest_loop(loaded, manifest.works), loaded.gains)


def build_widest_loop(loaded: LoadedGains, works: bool) -> Any:
    """Build a loop whose delay lines fit every possible draw; if `works`, it computes mechanical work."""
    draws = draw_extremes(loaded.mechanism)
    if CONTROL_PERIOD_KEY in draws:
        # The longest delay and the shortest control period together need the longest delay line.
        draws[CONTROL_PERIOD_KEY] = draws[CONTROL_PERIOD_KEY][::-1]
    model = choose_rig_model(loaded.mechanism)
    scenarios = model.scenarios(loaded.mechanism, draws)
    return model.loop(loaded.mechanism, loaded.compensator, scenarios, energies=works, exact=works)


def run_chunk(sweep: SweepProgram, first: int, number: int, precision: str | None = None) -> Rows:
    """Compute the rows of `number` scenarios, at most a chunk; `first` is the index of the first scenario.

    If a scenario fails or becomes non-finite, the status in its row says so. `precision` replaces the
    precision of the manifest.
    """
    return _begin_evaluation(sweep, _draw_batch(sweep, first, number, precision))()


def run_chunks(sweep: SweepProgram, parts: Iterable[int]) -> Generator[tuple[int, Rows], None, None]:
    """Compute chunks; yield each chunk's number and rows while the next chunk is being computed."""
    running = None
    for part in parts:
        # The next chunk is queued while one is running, so that no core is idle. The first chunk starts the
        # threads of JAX, which must be allowed to use all cores.
        with use_half_the_cores(0) if running is not None else nullcontext():
            started = (
                part,
                _begin_evaluation(sweep, _draw_batch(sweep, *sweep.manifest.chunk_range(part), None)),
            )
        if running is not None:
            yield _finish_chunk(running)
        running = started
    if running is not None:
        yield _finish_chunk(running)


def convert_precision(scenarios: Any, precision: str) -> Any:
    """Convert the scenarios' floating-point numbers to `precision`, so that they are simulated in it."""

    def cast(leaf: Any) -> Any:
        leaf = np.asarray(leaf)
        if leaf.dtype.kind != "f":
            return leaf
        # A number that is broadcast to all lanes stays a single number in memory.
        values = leaf[..., :1] if leaf.strides[-1] == 0 else leaf
        return np.broadcast_to(values.astype(precision, copy=False), leaf.shape)

    return jax.tree.map(cast, scenarios)


def _draw_batch(sweep: SweepProgram, first: int, number: int, precision: str | None) -> _ScenarioBatch:
    manifest = sweep.manifest
    draws, scenarios = draw_scenarios(sweep.mechanism, manifest.sampling, manifest.seed, first, number)
    return _ScenarioBatch(first, draws, convert_precision(scenarios, precision or manifest.precision))


def _begin_evaluation(sweep: SweepProgram, batch: _ScenarioBatch) -> Callable[[], Rows]:
    """Start the computation of a batch; return a function that waits for the batch's rows."""
    manifest = sweep.manifest
    limit, works = manifest.error_limit, manifest.works
    read = partial(select_read_fields, sweep.mechanism, works)
    outcome = sweep.model.begin_evaluation(sweep.loop, sweep.gains, batch.scenarios, manifest.chunk, read)
    return lambda: build_rows(sweep.mechanism, *batch, outcome(), limit, works)


def _finish_chunk(running: tuple[int, Callable[[], Rows]]) -> tuple[int, Rows]:
    part, rows = running
    with use_half_the_cores(0):
        return part, rows()
