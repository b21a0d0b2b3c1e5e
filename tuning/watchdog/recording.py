"""Recording of the controller's readings and commands in every tick of many scenarios.

Scenario i equals scenario i of a sweep with the same seed, including the sensor noise. The scenarios are
recorded in chunks, which share one compiled program and limit the memory.
"""

from collections.abc import Generator
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.outcome import compare_with_ideal
from jaxhil.simulation.recording import record_ticks
from jaxhil.simulation.scenario import Scenario
from tuning.sweeps.chunks import build_widest_loop
from tuning.sweeps.draws import draw_scenarios

LANES_PER_RECORDING = 1024  # number of scenarios that are recorded together, to limit the memory

_compare_with_reference = jax.jit(compare_with_ideal, static_argnums=0)


class ScenarioSelection(NamedTuple):
    """Selection of the scenarios 0 to `number` - 1 of a sweep."""

    sampling: str  # sampling method (`tuning.sweeps.draws`)
    seed: int  # seed of the draws
    number: int  # number of scenarios


class RecordedSignals(NamedTuple):
    """Signals of many scenarios (lanes) in every tick; with two surfaces, a run includes all contacts."""

    force: Float[np.ndarray, "ticks lanes"]  # measured force [N]
    position: Float[np.ndarray, "ticks lanes"]  # position of the numerical model [m]
    velocity: Float[np.ndarray, "ticks lanes"]  # velocity of the numerical model [m/s]
    measured: Float[np.ndarray, "ticks lanes"]  # measured position [m]
    command: Float[np.ndarray, "ticks lanes"]  # force command F_c [N]
    sent: Float[np.ndarray, "ticks lanes"]  # position command sent to the drives [m]
    live: Bool[np.ndarray, "ticks lanes"]  # whether the record of the scenario contains this tick
    begins: Bool[np.ndarray, "ticks lanes"]  # whether a run begins in this tick


class RecordedContacts(NamedTuple):
    """Simulated restitution and status of every contact (slot) of every scenario (lane)."""

    restitution: Float[np.ndarray, "slots lanes"]  # restitution e [1]
    reference: Float[np.ndarray, "slots lanes"]  # restitution e* of the ideal contact [1]
    status: Int[np.ndarray, "slots lanes"]  # status of the contact, as in `jaxhil.simulation.metrics`

    @property
    def error(self) -> Float[np.ndarray, "slots lanes"]:
        """Return the restitution error e - e* [1]; NaN if the contact did not end."""
        return np.where(self.status == OK, self.restitution - self.reference, np.nan)


class RecordedRuns(NamedTuple):
    """Scenarios, and the recorded signals and contacts of their runs."""

    first: int  # index of the first scenario in the sweep
    scenarios: Scenario  # parameters of the scenarios
    signals: RecordedSignals  # readings and commands of the controller
    contacts: RecordedContacts  # restitution and status of the contacts


def record_selection(
    loaded: LoadedGains, chosen: ScenarioSelection, lanes: int = LANES_PER_RECORDING
) -> Generator[RecordedRuns, None, None]:
    """Simulate and record the chosen scenarios; yield chunks of `lanes` scenarios."""
    loop = build_widest_loop(loaded, works=False)
    # Fill a short last chunk with further scenarios, so that all chunks use the same compiled program.
    lanes = min(lanes, chosen.number)
    for first in range(0, chosen.number, lanes):
        _, scenarios = draw_scenarios(loaded.mechanism, chosen.sampling, chosen.seed, first, lanes)
        chunk = record_runs(loop, loaded, scenarios, first)
        number = min(lanes, chosen.number - first)
        yield chunk if number == lanes else _select_first_lanes(chunk, number)


def record_runs(loop: Loop, loaded: LoadedGains, scenarios: Scenario, first: int = 0) -> RecordedRuns:
    """Simulate and record the scenarios with the loaded gains; `first` is the index of the first scenario."""
    metrics, record = record_ticks(loop, loaded.gains, scenarios)
    outcome = jax.device_get(_compare_with_reference(loop, scenarios, metrics))
    number = loaded.mechanism.approach.contacts
    contacts = RecordedContacts(
        *(
            np.asarray(leaf)[:number]
            for leaf in (metrics.restitution, outcome.reference_restitution, metrics.status)
        )
    )
    ticks = np.arange(len(record.active))[:, None]
    # A record ends with the last active tick, and includes the pauses between contacts.
    live = ticks <= np.max(np.where(record.active, ticks, -1), axis=0)
    force, position, velocity, measured, age = (np.asarray(leaf) for leaf in record.signals)
    begins = live & (age == 0)
    command, sent = np.asarray(record.command), np.asarray(record.sent)
    if loop.has_force_noise or loop.has_force_bias:
        command = np.where(begins, 0.0, command)
    columns = force, position, velocity, measured, command, sent
    finite = np.all([np.isfinite(column) for column in columns], axis=0)
    live &= np.logical_and.accumulate(finite | ~live, axis=0)
    return RecordedRuns(first, scenarios, RecordedSignals(*columns, live, begins), contacts)


def _select_first_lanes(chunk: RecordedRuns, number: int) -> RecordedRuns:
    return chunk._replace(
        scenarios=jax.tree.map(lambda leaf: leaf[..., :number], chunk.scenarios),
        signals=RecordedSignals(*(leaf[:, :number] for leaf in chunk.signals)),
        contacts=RecordedContacts(*(leaf[:, :number] for leaf in chunk.contacts)),
    )
