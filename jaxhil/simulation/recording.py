"""Recording of the loop tick by tick: the controller's readings and commands in every lane of a batch.

Plots and time series of a run, test vectors of a bundle for the rig, and replays of verification use it.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxhil.laws.simulation_base import Gains, Signals
from jaxhil.mechanism.structs import Mechanism, value_at
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation import kept_programs
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.loop import Loop, RigConstants, build_rig_constants
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.rollout import start, stretch, stretch_length, turn_over
from jaxhil.simulation.scenario import Scenario, build_scenarios
from jaxhil.simulation.tick import RunState, Tick

CHUNK = 512  # ticks per call of the compiled program


class Lane(NamedTuple):
    """Readings and commands of the controller in one lane, (ticks,), until the end of its last contact."""

    signals: Signals  # readings of the controller
    command: np.ndarray | Array  # F_c [N]
    # stiffness [N/m] and damping [N s/m], if the controller identifies them
    identified: tuple[np.ndarray | Array, np.ndarray | Array] | None
    # whether the loop sets F_c = 0 at the first tick of a run: before t = 0 there is no force, although a
    # noisy or biased sensor reads one
    zeroed: bool
    # position command [m] from the numerical model's motion after each tick
    sent: np.ndarray | Array | None = None
    contact: np.ndarray | Array | None = None  # index of the contact of each tick


def nominal_and_draws(mechanism: Mechanism, number: int, seed: int) -> Scenario:
    """Return `number` >= 1 lanes: the nominal run, then draws of the mechanism's uncertain numbers."""
    draws = {}
    for path, drawn in draw(mechanism, number - 1, seed).items():
        nominal = np.broadcast_to(np.asarray(value_at(mechanism, path), float), drawn.shape[1:])
        draws[path] = np.concatenate([nominal[None], drawn])
    return build_scenarios(mechanism, draws, seed=seed)


def record_lanes(loaded: LoadedGains, batch: Scenario) -> tuple[Metrics, list[Lane]]:
    """Run the loop until every lane is done; return metrics (slots, lanes), and each lane's record.

    Free flight between two surfaces is not skipped, since the rig does not skip it either. A record ends
    before its first number that is not finite.
    """
    loop = build_loop(loaded.mechanism, loaded.compensator, batch)
    metrics, ticks = record_ticks(loop, loaded.gains, batch)
    zeroed = loop.has_force_noise or loop.has_force_bias
    return metrics, [
        _lane(jax.tree.map(lambda leaf, index=index: leaf[:, index], ticks), zeroed)
        for index in range(ticks.active.shape[1])
    ]


def record_ticks(loop: Loop, gains: Mapping[str, Any], batch: Scenario) -> tuple[Metrics, Tick]:
    """Run the loop until every lane is done; return metrics (slots, lanes) and all ticks (ticks, lanes)."""
    arrays = as_arrays(gains)
    rig, run = begin(loop, arrays, batch)
    chunks = []
    while np.any(run.active):
        run, ticks = kept_programs.run(_record_chunk, loop, rig, arrays, run)
        chunks.append(jax.device_get(ticks))
    return jax.device_get(run.metrics), jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)


def prepare_recording(loaded: LoadedGains, batch: Scenario) -> None:
    """Compile the programs of `record_lanes` for these arguments."""
    loop, gains = build_loop(loaded.mechanism, loaded.compensator, batch), as_arrays(loaded.gains)
    rig, run = begin(loop, gains, batch)
    kept_programs.prepare(_record_chunk, loop, rig, gains, run)


def begin(loop: Loop, gains: Gains, batch: Scenario) -> tuple[RigConstants, RunState]:
    """Return the constants and the state of a batch of scenarios before the first tick."""
    return kept_programs.run(_begin, loop, gains, batch)


def as_arrays(gains: Mapping[str, Any]) -> Gains:
    """Return gains as JAX arrays."""
    return {name: jnp.asarray(value) for name, value in gains.items()}


def _lane(ticks: Tick, zeroed: bool) -> Lane:
    """Return the record of one lane."""
    # A pause between two contacts is part of the record; ticks after the last active one are not.
    end = int(np.max(np.nonzero(ticks.active)[0], initial=-1)) + 1
    numbers = [*ticks.signals, ticks.command, ticks.sent, *(ticks.identified or ())]
    finite = np.all(np.isfinite(np.stack(numbers)[:, :end]), axis=0)
    end = end if np.all(finite) else int(np.argmin(finite))
    ticks = jax.tree.map(lambda leaf: leaf[:end], ticks)
    return Lane(ticks.signals, ticks.command, ticks.identified, zeroed, ticks.sent, ticks.contact)


def _begin(loop: Loop, gains: Gains, scenario: Scenario) -> tuple[RigConstants, RunState]:
    """Return the constants and the state before the first tick."""
    rig = build_rig_constants(loop, scenario)
    return rig, start(loop, rig, gains, skip_flight=False)


def _record_chunk(loop: Loop, rig: RigConstants, gains: Gains, run: RunState) -> tuple[RunState, Tick]:
    """Run and record `CHUNK` ticks."""

    def body(run, _):
        run, ticks = stretch(loop, rig, gains, run, record=True)
        return turn_over(loop, rig, gains, run, skip_flight=False), ticks

    run, ticks = lax.scan(body, run, None, length=CHUNK // stretch_length(loop))
    return run, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), ticks)
