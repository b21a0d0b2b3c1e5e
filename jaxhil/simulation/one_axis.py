"""Simulation of rigs with one axis, as an implementation of `RigModel`."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Gains
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.evaluation import RigModel
from jaxhil.simulation.loop import Loop, RigConstants, build_rig_constants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.outcome import Outcome, compare_with_ideal
from jaxhil.simulation.rollout import rollout, run_contacts, start_rollout
from jaxhil.simulation.scenario import Scenario, build_scenarios
from jaxhil.simulation.tick import RunState


@dataclasses.dataclass(frozen=True)
class OneAxis(RigModel):
    """Rig with one axis: a run is one contact, and its error is the restitution error."""

    axes: ClassVar[int] = 1
    run_name: ClassVar[str] = "contact"
    errors: ClassVar[tuple[str, ...]] = ("error",)
    verdict_error: ClassVar[str] = "error"

    def scenarios(
        self, mechanism: Mechanism, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
    ) -> Scenario:
        """Return scenarios of a mechanism; see `jaxhil.simulation.scenario.build_scenarios`."""
        return build_scenarios(mechanism, draws, seed, first)

    def loop(self, mechanism: Mechanism, compensator: str, scenarios: Scenario, **parts: bool) -> Loop:
        """Return the loop that runs all scenarios; `parts` contains options of `build_loop`."""
        return build_loop(mechanism, compensator, scenarios, **parts)

    def runs(self, mechanism: Mechanism) -> int:
        """Return the number of runs in a scenario of this mechanism; each run is one contact."""
        return mechanism.approach.contacts

    def run(self, loop: Loop, gains: Gains, scenario: Scenario) -> Outcome:
        """Run the contacts of a batch of scenarios and compare them with the ideal contacts."""
        return compare_with_ideal(loop, scenario, rollout(loop, gains, scenario))

    def initial_state(self, loop: Loop, gains: Gains, scenario: Scenario) -> RunState:
        """Return the simulation's state at the start of the first approach."""
        return start_rollout(loop, self.prepared(loop, scenario), gains)

    def at_rest(self, scenarios: Scenario, idle: np.ndarray) -> Scenario:
        """Return a copy of the scenarios in which `idle` lanes (which only fill a tile) have no contacts."""
        contacts: Any = np.where(idle, 0, scenarios.contacts).astype(np.int32)
        return scenarios._replace(contacts=contacts)

    def expected_duration(self, scenarios: Scenario) -> np.ndarray:
        """Return the sum of sqrt(mass/stiffness) [s] of a scenario's contacts, for sorting lanes only."""
        stiffness = np.asarray(scenarios.contact.stiffness)
        while stiffness.ndim > 2:
            stiffness = stiffness[:, 0]
        slots = np.arange(len(stiffness))[:, None] < np.asarray(scenarios.contacts)
        periods = np.sqrt(np.asarray(scenarios.equivalent_mass) / np.maximum(stiffness, 1e-9))
        return np.sum(np.where(slots, periods, 0), axis=0)

    def whole_delays(self, scenarios: Scenario) -> np.ndarray:
        """Return a sorting key for each scenario, which places scenarios with similar delays together.

        Two scenarios have equal keys if every delay has the same number of whole control periods in both.
        """
        simulator = np.asarray(scenarios.simulator.delay)
        period = np.asarray(scenarios.control_period)
        force, position = (
            np.floor((simulator + np.asarray(sensor.delay)) / period + 1e-9)
            for sensor in (scenarios.force_sensor, scenarios.position_sensor)
        )
        return force + position / (1 + np.max(position))

    def without_noise(self, scenarios: Scenario) -> Scenario:
        """Return a copy of the scenarios in which the sensors have no noise and a constant bias."""
        force, position = scenarios.force_sensor, scenarios.position_sensor
        walk = force.bias_walk
        force = force._replace(
            noise_std=np.zeros_like(force.noise_std),
            bias_walk=None if walk is None else np.zeros_like(walk),
        )
        position = position._replace(noise_std=np.zeros_like(position.noise_std))
        return scenarios._replace(force_sensor=force, position_sensor=position)

    def with_compensator(self, loop: Loop, compensator: str) -> Loop:
        """Return a copy of the loop with another compensator, chosen by its name."""
        return dataclasses.replace(loop, compensator=COMPENSATORS[compensator])

    def compensator_name(self, loop: Loop) -> str:
        """Return the name of a loop's compensator."""
        return loop.compensator.name

    def prepared(self, loop: Loop, scenarios: Scenario) -> RigConstants:
        """Compute the constants of the runs, which do not depend on the gains and are passed to `outcome`."""
        return build_rig_constants(loop, scenarios, measured=loop.compensator.reads_position)

    def outcome(self, loop: Loop, gains: Gains, rig: RigConstants) -> Outcome:
        """Run the scenarios that `prepared` received. The outcome is differentiable with respect to gains."""
        if loop.compensator.is_large:
            rig = _separate_loops(rig)
        return compare_with_ideal(loop, rig.scenario, run_contacts(loop, gains, rig))

    def noise_amplification(self, loop: Loop, gains: Gains, rig: RigConstants) -> Float[Array, "*batch"]:
        """Return the factor [1] by which the compensator amplifies force sensor noise."""
        return loop.compensator.noise_amplification(gains, rig.constants)


ONE_AXIS = OneAxis()
evaluate = ONE_AXIS.evaluate


def _separate_loops(rig: RigConstants) -> RigConstants:
    """Return an equal copy of `rig` that makes XLA compile the contact loop as a separate function.

    XLA merges nested loops into one function, but does not merge a loop that contains a sort. A dummy sort of
    two numbers therefore splits the code into shorter functions. LLVM's time for a function grows with the
    square of its length.
    """
    contacts = rig.scenario.contacts
    bound = jnp.max(contacts)
    bound = jnp.sort(jnp.stack([bound, bound + 1]))[1]
    return rig._replace(scenario=rig.scenario._replace(contacts=jnp.minimum(contacts, bound)))
