"""Recording of the compensator's readings and commands at every tick, for each lane of a batch.

These records are used for plots and time series of a run, for test vectors in a bundle for the rig, and for
the replay of a run by the rig's controller during verification.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxhil.laws.simulation_base import Gains, Signals
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation import cached_programs
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.loop import Loop, RigConstants, build_rig_constants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.rollout import begin_next_contacts, run_segment, segment_length, start_rollout
from jaxhil.simulation.scenario import Scenario, build_scenarios
from jaxhil.simulation.tick import RunState, Tick
from jaxhil.simulation.timing import without_missed_ticks

TICKS_PER_CALL = 512  # number of ticks that one call of the compiled program simulates


class LaneRecord(NamedTuple):
    """Readings and commands of the compensator in one lane, up to the end of the last contact.

    Arrays have the shape (ticks,).
    """

    signals: Signals  # inputs of the compensator
    command: np.ndarray | Array  # force command F_c [N]
    # estimates of stiffness [N/m] and damping [N s/m]; None if the compensator identifies neither
    identified: tuple[np.ndarray | Array, np.ndarray | Array] | None
    # Whether the loop sets the force command to 0 at the first tick of a run: no force acts before a run, but
    # a sensor with noise or bias reads one.
    zeroed: bool
    # position command at the end of each tick [m]
    sent: np.ndarray | Array | None = None
    contact: np.ndarray | Array | None = None  # index of the current or next contact, from 0


def nominal_and_draws(mechanism: Mechanism, number: int, seed: int) -> Scenario:
    """Return `number` scenarios: the nominal scenario first, then draws of the uncertain parameters.

    The scenarios have no missed ticks.
    """
    draws = {}
    for path, drawn in draw(mechanism, number - 1, seed).items():
        nominal = np.broadcast_to(np.asarray(value_at(mechanism, path), float), drawn.shape[1:])
        draws[path] = np.concatenate([nominal[None], drawn])
    return without_missed_ticks(build_scenarios(mechanism, draws, seed=seed))


def record_lanes(loaded: LoadedGains, batch: Scenario) -> tuple[Metrics, list[LaneRecord]]:
    """Run all scenarios; return the metrics, (contacts, lanes), and the record of each lane.

    Free flight is simulated, not skipped, so that the records have the same ticks as the rig. A record ends
    before the first tick with a number that is not finite.
    """
    loop = build_loop(loaded.mechanism, loaded.compensator, batch)
    metrics, ticks = record_ticks(loop, loaded.gains, batch)
    zeroed = loop.has_force_noise or loop.has_force_bias
    return metrics, [
        _build_lane_record(jax.tree.map(lambda leaf, index=index: leaf[:, index], ticks), zeroed)
        for index in range(ticks.active.shape[1])
    ]


def record_ticks(loop: Loop, gains: Mapping[str, Any], batch: Scenario) -> tuple[Metrics, Tick]:
    """Run all scenarios; return the metrics, (contacts, lanes), and all ticks, (ticks, lanes)."""
    arrays = convert_gains(gains)
    rig, run = start_batch(loop, arrays, batch)
    chunks = []
    while np.any(run.active):
        run, ticks = cached_programs.run_cached(_record_segment, loop, rig, arrays, run)
        chunks.append(jax.device_get(ticks))
    return jax.device_get(run.metrics), jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)


def start_batch(loop: Loop, gains: Gains, batch: Scenario) -> tuple[RigConstants, RunState]:
    """Return constants and initial state of the loop for a batch of scenarios, from a cached program."""
    return cached_programs.run_cached(_start_loop, loop, gains, batch)


def convert_gains(gains: Mapping[str, Any]) -> Gains:
    """Convert gains to JAX arrays."""
    return {name: jnp.asarray(value) for name, value in gains.items()}


def _build_lane_record(ticks: Tick, zeroed: bool) -> LaneRecord:
    """Return the record of one lane, without the ticks after its last contact."""
    # A lane may be inactive between two contacts; only the ticks after its last active tick are removed.
    end = int(np.max(np.nonzero(ticks.active)[0], initial=-1)) + 1
    numbers = [*ticks.signals, ticks.command, ticks.sent, *(ticks.identified or ())]
    finite = np.all(np.isfinite(np.stack(numbers)[:, :end]), axis=0)
    end = end if np.all(finite) else int(np.argmin(finite))
    ticks = jax.tree.map(lambda leaf: leaf[:end], ticks)
    return LaneRecord(ticks.signals, ticks.command, ticks.identified, zeroed, ticks.sent, ticks.contact)


def _start_loop(loop: Loop, gains: Gains, scenario: Scenario) -> tuple[RigConstants, RunState]:
    rig = build_rig_constants(loop, scenario)
    return rig, start_rollout(loop, rig, gains, skip_flight=False)


def _record_segment(loop: Loop, rig: RigConstants, gains: Gains, run: RunState) -> tuple[RunState, Tick]:
    """Simulate and record `TICKS_PER_CALL` ticks."""

    def body(run, _):
        run, ticks = run_segment(loop, rig, gains, run, record=True)
        return begin_next_contacts(loop, rig, gains, run, skip_flight=False), ticks

    run, ticks = lax.scan(body, run, None, length=TICKS_PER_CALL // segment_length(loop))
    return run, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), ticks)
