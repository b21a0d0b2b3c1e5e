"""Scenarios by index, recorded tick by tick: what a controller on the rig would have read and commanded.

Scenario i is that of a sweep of the same seed at index i, sensor noise included; chunks of them share
one compiled program and bounded memory.
"""

from collections.abc import Generator
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.outcome import compare_with_reference
from jaxhil.simulation.recording import record_ticks
from jaxhil.simulation.scenario import Scenario
from tuning.sweeps.chunks import widest_loop
from tuning.sweeps.draws import drawn_scenarios

LANES = 1024  # recorded at a time

_compared = jax.jit(compare_with_reference, static_argnums=0)


class Scenarios(NamedTuple):
    """Which scenarios."""

    sampling: str  # how they are drawn (`tuning.sweeps.draws`)
    seed: int  # from which
    number: int  # how many from the first


class Signals(NamedTuple):
    """Ticks of many runs. Between two surfaces all contacts are one run."""

    force: Float[np.ndarray, "ticks lanes"]  # measured [N]
    position: Float[np.ndarray, "ticks lanes"]  # of the numerical model [m]
    velocity: Float[np.ndarray, "ticks lanes"]  # of the numerical model [m/s]
    measured: Float[np.ndarray, "ticks lanes"]  # position [m]
    command: Float[np.ndarray, "ticks lanes"]  # F_c [N]
    sent: Float[np.ndarray, "ticks lanes"]  # position command sent to the drives [m]
    live: Bool[np.ndarray, "ticks lanes"]  # whether a run of the lane is under way
    begins: Bool[np.ndarray, "ticks lanes"]  # whether one begins


class Contacts(NamedTuple):
    """What became of the contacts."""

    restitution: Float[np.ndarray, "slots lanes"]  # of each
    reference: Float[np.ndarray, "slots lanes"]  # the reference's
    status: Int[np.ndarray, "slots lanes"]  # as in `jaxhil.simulation.metrics`

    @property
    def error(self) -> Float[np.ndarray, "slots lanes"]:
        """Restitution error; NaN where a contact did not end."""
        return np.where(self.status == OK, self.restitution - self.reference, np.nan)


class Chunk(NamedTuple):
    """Some scenarios, recorded."""

    first: int  # index of the first lane's scenario
    scenarios: Scenario
    signals: Signals  # what the controller read and commanded
    contacts: Contacts  # what became of them


def recorded_chunks(
    loaded: LoadedGains, chosen: Scenarios, lanes: int = LANES
) -> Generator[Chunk, None, None]:
    """The scenarios 0 to `number` - 1, recorded `lanes` at a time."""
    loop = widest_loop(loaded, works=False)
    # A short last chunk is recorded as a whole one: scenarios have no end, and it needs no other program.
    lanes = min(lanes, chosen.number)
    for first in range(0, chosen.number, lanes):
        _, scenarios = drawn_scenarios(loaded.mechanism, chosen.sampling, chosen.seed, first, lanes)
        chunk = record_chunk(loop, loaded, scenarios, first)
        kept = min(lanes, chosen.number - first)
        yield chunk if kept == lanes else _first_lanes(chunk, kept)


def record_chunk(loop: Loop, loaded: LoadedGains, scenarios: Scenario, first: int = 0) -> Chunk:
    """The scenarios' runs under the gains, recorded."""
    metrics, seen = record_ticks(loop, loaded.gains, scenarios)
    outcome = jax.device_get(_compared(loop, scenarios, metrics))
    made = loaded.mechanism.approach.contacts
    contacts = Contacts(
        *(
            np.asarray(leaf)[:made]
            for leaf in (metrics.restitution, outcome.reference_restitution, metrics.status)
        )
    )
    ticks = np.arange(len(seen.active))[:, None]
    # What follows the last active tick is nobody's; a pause between two contacts still is the controller's.
    live = ticks <= np.max(np.where(seen.active, ticks, -1), axis=0)
    force, position, velocity, measured, age = (np.asarray(leaf) for leaf in seen.signals)
    begins = live & (age == 0)
    command, sent = np.asarray(seen.command), np.asarray(seen.sent)
    if loop.has_force_noise or loop.has_force_bias:
        command = np.where(begins, 0.0, command)
    columns = force, position, velocity, measured, command, sent
    finite = np.all([np.isfinite(one) for one in columns], axis=0)
    live &= np.logical_and.accumulate(finite | ~live, axis=0)
    return Chunk(first, scenarios, Signals(*columns, live, begins), contacts)


def _first_lanes(chunk: Chunk, number: int) -> Chunk:
    return chunk._replace(
        scenarios=jax.tree.map(lambda leaf: leaf[..., :number], chunk.scenarios),
        signals=Signals(*(leaf[:, :number] for leaf in chunk.signals)),
        contacts=Contacts(*(leaf[:, :number] for leaf in chunk.contacts)),
    )
