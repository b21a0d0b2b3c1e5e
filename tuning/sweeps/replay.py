"""Replay: one scenario of a store again, to the bit, and its motion for a picture."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxhil.errors import InputError, one_line
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.motion import Piece, scenario_motion
from tuning.sweeps.chunks import Sweep, build_sweep, run_chunk
from tuning.sweeps.draws import drawn_scenarios
from tuning.sweeps.manifest import loaded_gains
from tuning.sweeps.parts import same_rows
from tuning.sweeps.store import Store, read_row


class Replay(NamedTuple):
    """A scenario of a store, run again."""

    sweep: Sweep
    stored: dict[str, np.ndarray]  # its row, arrays of length 1
    again: dict[str, np.ndarray]  # the row made again
    different: list[str]  # names of the columns that differ


def replay(store: Store, index: int) -> Replay:
    """Run scenario `index` again, by itself, in the program that ran its chunk.

    Raises `InputError` for an index that the store does not hold.
    """
    if isinstance(loaded_gains(store.manifest).mechanism, SixAxisMechanism):
        found, allowed = "a sweep of six axes", "one of one axis: jaxhil simulate runs six, --set says which"
        raise InputError(f"{one_line(str(store.folder))}: found {found}, allowed {allowed}")
    stored = read_row(store, index)
    sweep = build_sweep(store.manifest)
    again = run_chunk(sweep, index, 1)
    return Replay(sweep, stored, again, same_rows(stored, again))


def motion_of(sweep: Sweep, index: int) -> list[Piece]:
    """The scenario's motion tick by tick, for plots, in float64."""
    manifest = sweep.manifest
    _, scenarios = drawn_scenarios(sweep.mechanism, manifest.sampling, manifest.seed, index, 1)
    loaded = loaded_gains(manifest)
    gains: Any = {name: np.full(1, value) for name, value in loaded.gains.items()}
    lane = jax.tree.map(np.asarray, scenarios)
    return scenario_motion(loaded._replace(gains=gains), lane)
