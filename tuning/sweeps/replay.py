"""Replay of one stored scenario: its row, recomputed to the last bit, and its motion at every tick."""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.motion_curves import RunMotion, compute_scenario_motion
from tuning.sweeps.chunk_file import list_different_columns
from tuning.sweeps.chunks import SweepProgram, build_sweep, run_chunk
from tuning.sweeps.draws import draw_scenarios
from tuning.sweeps.manifest import load_gains
from tuning.sweeps.store import SweepStore, read_row

if TYPE_CHECKING:
    from jaxhil.sixdof.recording import RunRecord


class ScenarioReplay(NamedTuple):
    """Stored row and recomputed row of one scenario."""

    sweep: SweepProgram
    stored: dict[str, np.ndarray]  # stored row, arrays of length 1
    again: dict[str, np.ndarray]  # recomputed row, arrays of length 1
    different_columns: list[str]  # names of the columns that differ


def replay_scenario(store: SweepStore, index: int) -> ScenarioReplay:
    """Run scenario `index` again with the sweep's program, and compare the row with the stored row.

    Raise `InputError` if the store does not contain the index.
    """
    stored = read_row(store, index)
    sweep = build_sweep(store.manifest)
    again = run_chunk(sweep, index, 1)
    return ScenarioReplay(sweep, stored, again, list_different_columns(stored, again))


def compute_motion(sweep: SweepProgram, index: int) -> list[RunMotion]:
    """Compute the motion of a one-axis scenario at every tick, in float64, for plots."""
    loaded = load_gains(sweep.manifest)
    gains: Any = {name: np.full(1, value) for name, value in loaded.gains.items()}
    lane = jax.tree.map(np.asarray, _draw_scenario(sweep, index))
    return compute_scenario_motion(loaded._replace(gains=gains), lane)


def record_six_axes(sweep: SweepProgram, index: int) -> "RunRecord":
    """Compute the motion of a six-axis scenario at every tick."""
    from jaxhil.sixdof.recording import record_scenario

    assert isinstance(sweep.mechanism, SixAxisMechanism)
    lane = jax.tree.map(jnp.asarray, _draw_scenario(sweep, index))
    return record_scenario(sweep.mechanism, sweep.loop, sweep.gains, lane)


def _draw_scenario(sweep: SweepProgram, index: int) -> Any:
    """Draw scenario `index` as a batch with a single lane, in float64."""
    manifest = sweep.manifest
    return draw_scenarios(sweep.mechanism, manifest.sampling, manifest.seed, index, 1)[1]
