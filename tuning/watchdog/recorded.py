"""Recording of scenarios by index: readings and commands of the controller at every tick.

Scenario i is that of a sweep with the same seed, sensor noise included. All chunks share one compiled
program, and memory is bounded.
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

LANES = 1024  # scenarios recorded at a time

_compared = jax.jit(compare_with_reference, static_argnums=0)


class Scenarios(NamedTuple):
    """Selection of scenarios 0 to `number` - 1."""

    sampling: str  # sampling method (`tuning.sweeps.draws`)
    seed: int  # seed of the draws
    number: int  # number of scenarios


class Signals(NamedTuple):
    """Signals of many lanes at every tick; between two surfaces all contacts are one run."""

    force: Float[np.ndarray, "ticks lanes"]  # measured force [N]
    position: Float[np.ndarray, "ticks lanes"]  # position of the numerical model [m]
    velocity: Float[np.ndarray, "ticks lanes"]  # velocity of the numerical model [m/s]
    measured: Float[np.ndarray, "ticks lanes"]  # measured position [m]
    command: Float[np.ndarray, "ticks lanes"]  # force command F_c [N]
    sent: Float[np.ndarray, "ticks lanes"]  # position command sent to the drives [m]
    live: Bool[np.ndarray, "ticks lanes"]  # whether the lane's record has not ended
    begins: Bool[np.ndarray, "ticks lanes"]  # whether a run begins


class Contacts(NamedTuple):
    """Results of the contacts."""

    restitution: Float[np.ndarray, "slots lanes"]  # restitution e [1]
    reference: Float[np.ndarray, "slots lanes"]  # restitution e* of the ideal contact [1]
    status: Int[np.ndarray, "slots lanes"]  # as in `jaxhil.simulation.metrics`

    @property
    def error(self) -> Float[np.ndarray, "slots lanes"]:
        """Return the restitution error [1]; NaN if the contact did not end."""
        return np.where(self.status == OK, self.restitution - self.reference, np.nan)


class Chunk(NamedTuple):
    """Recorded scenarios."""

    first: int  # index of the first lane's scenario
    scenarios: Scenario
    signals: Signals  # readings and commands of the controller
    contacts: Contacts  # results of the contacts


def recorded_chunks(
    loaded: LoadedGains, chosen: Scenarios, lanes: int = LANES
) -> Generator[Chunk, None, None]:
    """Record the chosen scenarios, `lanes` at a time; yield the chunks."""
    loop = widest_loop(loaded, works=False)
    # A short last chunk is recorded with further scenarios, so that it needs no other program.
    lanes = min(lanes, chosen.number)
    for first in range(0, chosen.number, lanes):
        _, scenarios = drawn_scenarios(loaded.mechanism, chosen.sampling, chosen.seed, first, lanes)
        chunk = record_chunk(loop, loaded, scenarios, first)
        number = min(lanes, chosen.number - first)
        yield chunk if number == lanes else _first_lanes(chunk, number)


def record_chunk(loop: Loop, loaded: LoadedGains, scenarios: Scenario, first: int = 0) -> Chunk:
    """Record the runs of the scenarios under the loaded gains."""
    metrics, record = record_ticks(loop, loaded.gains, scenarios)
    outcome = jax.device_get(_compared(loop, scenarios, metrics))
    number = loaded.mechanism.approach.contacts
    contacts = Contacts(
        *(
            np.asarray(leaf)[:number]
            for leaf in (metrics.restitution, outcome.reference_restitution, metrics.status)
        )
    )
    ticks = np.arange(len(record.active))[:, None]
    # A record ends with its last active tick; a pause between two contacts is part of it.
    live = ticks <= np.max(np.where(record.active, ticks, -1), axis=0)
    force, position, velocity, measured, age = (np.asarray(leaf) for leaf in record.signals)
    begins = live & (age == 0)
    command, sent = np.asarray(record.command), np.asarray(record.sent)
    if loop.has_force_noise or loop.has_force_bias:
        command = np.where(begins, 0.0, command)
    columns = force, position, velocity, measured, command, sent
    finite = np.all([np.isfinite(column) for column in columns], axis=0)
    live &= np.logical_and.accumulate(finite | ~live, axis=0)
    return Chunk(first, scenarios, Signals(*columns, live, begins), contacts)


def _first_lanes(chunk: Chunk, number: int) -> Chunk:
    return chunk._replace(
        scenarios=jax.tree.map(lambda leaf: leaf[..., :number], chunk.scenarios),
        signals=Signals(*(leaf[:, :number] for leaf in chunk.signals)),
        contacts=Contacts(*(leaf[:, :number] for leaf in chunk.contacts)),
    )
