"""Rig model for six axes, for `tune`, `sweep` and similar commands.

Each episode (a contact with all its touches) has two errors: energy error and twist error. The arrays of an
outcome contain all episodes twice: first with the energy errors, then with the twist errors.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxhil.laws.simulation_base import Gains
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation import cached_programs, jax_environment
from jaxhil.simulation import metrics as one_axis
from jaxhil.simulation.contact_bounds import is_contact_out_of_bounds
from jaxhil.simulation.evaluation import RigModel, count_lanes, map_tiles, unfold_tiles
from jaxhil.simulation.outcome import Outcome
from jaxhil.sixdof import building
from jaxhil.sixdof.loop import build_rig_constants
from jaxhil.sixdof.loop_state import Loop
from jaxhil.sixdof.metrics import Metrics, evaluate
from jaxhil.sixdof.rollout import (
    CAPTURED,
    JAMMED,
    MISS,
    NON_FINITE,
    REBOUNDED,
    TIMEOUT,
    EpisodeProgress,
    compute_ideal_contact,
    start_scenario,
)
from jaxhil.sixdof.scenario import Scenario

# Statuses of six-axis episodes, with the corresponding one-axis statuses; other statuses become "diverged".
STATUSES = {
    MISS: one_axis.NOT_REACHED,
    REBOUNDED: one_axis.OK,
    CAPTURED: one_axis.OK,
    JAMMED: one_axis.TIMEOUT,
    TIMEOUT: one_axis.TIMEOUT,
    NON_FINITE: one_axis.NON_FINITE,
}


@dataclasses.dataclass(frozen=True)
class SixAxes(RigModel):
    """Rig model for six axes. Each run is one episode, with an energy error and a twist error."""

    axes: ClassVar[int] = 6
    run_name: ClassVar[str] = "episode"
    errors: ClassVar[tuple[str, ...]] = ("energy_error", "twist_error")
    verdict_error: ClassVar[str] = "twist_error"  # an episode without twist error has no energy error
    compiler_options: ClassVar[Mapping[str, int | str]] = jax_environment.SIX_AXIS_OPTIONS

    def scenarios(
        self,
        mechanism: SixAxisMechanism,
        draws: Mapping[str, Any] | None = None,
        seed: int = 0,
        first: int = 0,
    ) -> Scenario:
        """Build a batch of scenarios; see `jaxhil.sixdof.building.build_scenarios`."""
        return jax.tree.map(np.asarray, building.build_scenarios(mechanism, draws, seed, first))

    def loop(self, mechanism: SixAxisMechanism, compensator: str, scenarios: Scenario, **parts: bool) -> Loop:
        """Build the loop that runs all scenarios; `parts` (options for one axis only) is ignored."""
        return building.make_loop(mechanism, compensator, scenarios)

    def runs(self, mechanism: SixAxisMechanism) -> int:
        """Return the number of runs in a scenario. A run is an episode (a contact with all its touches)."""
        return mechanism.approach.episodes if mechanism.approach else 1

    def with_ideal_contacts(self, batches: Sequence[Scenario]) -> list[Scenario]:
        """Compute the ideal contacts of all batches at once, on all devices; return the completed batches."""
        together = self.place_batch(jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *batches))
        results = cached_programs.run_cached(
            _compute_ideal_contacts, self, together.scenarios, options=self.compiler_options
        )
        shapes = jax.eval_shape(compute_ideal_contact, batches[0])
        contacts = jax.tree.unflatten(jax.tree.structure(shapes), unfold_tiles(together, results))
        complete, begin = [], 0
        for batch in batches:
            lanes = slice(begin, begin + count_lanes(batch))
            contact = jax.tree.map(lambda leaf, lanes=lanes: leaf[..., lanes], contacts)
            complete.append(batch._replace(ideal_contact=contact))
            begin = lanes.stop
        return complete

    def run(self, loop: Loop, gains: Gains, scenario: Scenario) -> Outcome:
        """Simulate a batch of scenarios, and compare the episodes with the ideal contacts."""
        return to_outcome(evaluate(loop, gains, _separate_loops(scenario)).metrics, scenario)

    def initial_state(self, loop: Loop, gains: Gains, scenario: Scenario) -> EpisodeProgress:
        """Return the state of the simulation before the first tick of a batch of scenarios."""
        return start_scenario(loop, build_rig_constants(loop, gains, scenario), scenario)

    def at_rest(self, scenarios: Scenario, idle: np.ndarray) -> Scenario:
        """Return a copy of the scenarios; the `idle` lanes, which only fill a tile, have the duration 0."""
        duration: Any = np.where(idle, 0.0, scenarios.duration).astype(np.asarray(scenarios.duration).dtype)
        return scenarios._replace(duration=duration)

    def expected_duration(self, scenarios: Scenario) -> np.ndarray:
        """Return 0 for every scenario, because the duration of a run is not known in advance."""
        return np.zeros(np.shape(scenarios.duration))

    def whole_delays(self, scenarios: Scenario) -> np.ndarray:
        """Return the sorting key 0 for every scenario: sorting by delay does not save time for six axes."""
        return np.zeros(np.shape(scenarios.duration))

    def without_noise(self, scenarios: Scenario) -> Scenario:
        """Return the scenarios with noise-free sensors of force and pose, and a constant bias."""
        sensor, names = scenarios.sensor, ["noise_std", "position_noise_std"]
        names += [] if sensor.bias_walk is None else ["bias_walk"]
        quiet = {name: np.zeros_like(getattr(sensor, name)) for name in names}
        return scenarios._replace(sensor=sensor._replace(**quiet))

    def with_compensator(self, loop: Loop, compensator: str) -> Loop:
        """Return a copy of the loop with another compensator, chosen by its name."""
        return dataclasses.replace(loop, compensator=compensator)

    def compensator_name(self, loop: Loop) -> str:
        """Return the name of a loop's compensator."""
        return loop.compensator


SIX_AXES = SixAxes()


def _separate_loops(scenario: Scenario) -> Scenario:
    """Return an equal copy of `scenario`, with which XLA compiles the tick loop as a separate function.

    Otherwise, XLA merges the tick loop with the loop over tiles (groups of lanes). A dummy sort of two
    numbers prevents this; see the function of the same name in `jaxhil.simulation.one_axis`.
    """
    most = jnp.max(scenario.duration)
    most = jnp.sort(jnp.stack([most, most + 1]))[1]
    return scenario._replace(duration=jnp.minimum(scenario.duration, most))


def _compute_ideal_contacts(_: SixAxes, scenarios: Any) -> tuple[Array, ...]:
    """Compute the ideal contacts of scenarios that are arranged in tiles (groups of lanes).

    The result is a tuple of arrays in the same arrangement.
    """
    return tuple(map_tiles(lambda _, tile: jax.tree.leaves(compute_ideal_contact(tile)), (), scenarios))


def to_outcome(episodes: Metrics, scenario: Scenario) -> Outcome:
    """Convert the metrics of episodes to an outcome, whose arrays contain every episode twice.

    The first half has the energy errors, the second half the twist errors. Metrics that only one-axis rigs
    have are 0.
    """
    # A draw that misses the target has no contact to evaluate.
    begins = jnp.isfinite(scenario.start.chaser.position.z)
    is_scheduled = (episodes.status != MISS) & begins[None]
    is_finite = jnp.isfinite(episodes.energy_error) & jnp.isfinite(episodes.twist_error)
    status = jnp.full_like(episodes.status, one_axis.DIVERGED)
    for code, one_axis_code in STATUSES.items():
        status = jnp.where(episodes.status == code, one_axis_code, status)
    status = jnp.where(
        is_scheduled,
        jnp.where((status == one_axis.OK) & ~is_finite, one_axis.NON_FINITE, status),
        one_axis.NOT_REACHED,
    )
    zero = jnp.zeros_like(episodes.energy_error)
    metrics = one_axis.Metrics(
        restitution=episodes.restitution,
        approach_velocity=episodes.approach_velocity,
        peak_force=episodes.peak_force,
        peak_command=episodes.peak_command,
        excess_variation=zero,
        position_shortfall=zero,
        duration=episodes.duration,
        work_in=zero,
        work_out=zero,
        trajectory_error=zero,
        force_delay=zero,
        status=status,
        ticks=0 * status,
    )
    ratio = episodes.peak_command / jnp.where(
        episodes.reference_peak_force > 0, episodes.reference_peak_force, jnp.nan
    )
    both = Outcome(
        metrics=metrics,
        reference_restitution=episodes.reference_restitution,
        reference_peak_force=episodes.reference_peak_force,
        reference_duration=episodes.reference_duration,
        error=episodes.energy_error,
        peak_ratio=ratio,
        chatter=zero,
        is_scheduled=is_scheduled,
        good=status == one_axis.OK,
        is_unlike_ideal=(status == one_axis.OK)
        & is_contact_out_of_bounds(
            episodes.peak_force,
            episodes.reference_peak_force,
            episodes.duration,
            episodes.reference_duration,
            scenario.control_period[None],
        ),
    )
    rows: Outcome = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), both)
    return rows._replace(error=jnp.concatenate([episodes.energy_error, episodes.twist_error]))
