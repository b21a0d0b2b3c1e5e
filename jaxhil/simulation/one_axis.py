"""Model of a rig that moves along one axis."""

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
from jaxhil.simulation.rollout import rollout, run_contacts
from jaxhil.simulation.scenario import Scenario, build_scenarios


@dataclasses.dataclass(frozen=True)
class OneAxis(RigModel):
    """Model of a rig along one axis: its runs are contacts, their error is e - e*."""

    axes: ClassVar[int] = 1
    run_name: ClassVar[str] = "contact"
    errors: ClassVar[tuple[str, ...]] = ("error",)

    def scenarios(
        self, mechanism: Mechanism, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
    ) -> Scenario:
        """Return scenarios; see `jaxhil.simulation.scenario.build_scenarios`."""
        return build_scenarios(mechanism, draws, seed, first)

    def loop(self, mechanism: Mechanism, compensator: str, scenarios: Scenario, **parts: bool) -> Loop:
        """Return the loop; `parts` are the options of `jaxhil.simulation.loop_construction.build_loop`."""
        return build_loop(mechanism, compensator, scenarios, **parts)

    def runs(self, mechanism: Mechanism) -> int:
        """Return the number of contacts of a scenario."""
        return mechanism.approach.contacts

    def run(self, loop: Loop, gains: Gains, scenario: Scenario) -> Outcome:
        """Run the contacts of a batch and compare them with the ideal ones."""
        return compare_with_ideal(loop, scenario, rollout(loop, gains, scenario))

    def at_rest(self, scenarios: Scenario, idle: np.ndarray) -> Scenario:
        """Return scenarios in which the `idle` lanes have no contact."""
        contacts: Any = np.where(idle, 0, scenarios.contacts).astype(np.int32)
        return scenarios._replace(contacts=contacts)

    def expected_duration(self, scenarios: Scenario) -> np.ndarray:
        """Return a rough duration [s]: half a period sqrt(M/k) per contact, used only for sorting."""
        stiffness = np.asarray(scenarios.contact.stiffness)
        while stiffness.ndim > 2:
            stiffness = stiffness[:, 0]
        slots = np.arange(len(stiffness))[:, None] < np.asarray(scenarios.contacts)
        periods = np.sqrt(np.asarray(scenarios.equivalent_mass) / np.maximum(stiffness, 1e-9))
        return np.sum(np.where(slots, periods, 0), axis=0)

    def whole_delays(self, scenarios: Scenario) -> np.ndarray:
        """Return a number that differs if a delay's whole periods differ, used only for sorting."""
        simulator = np.asarray(scenarios.simulator.delay)
        period = np.asarray(scenarios.control_period)
        force, position = (
            np.floor((simulator + np.asarray(sensor.delay)) / period + 1e-9)
            for sensor in (scenarios.force_sensor, scenarios.position_sensor)
        )
        return force + position / (1 + np.max(position))

    def without_noise(self, scenarios: Scenario) -> Scenario:
        """Return the scenarios with noise-free sensors."""
        force, position = (
            sensor._replace(noise_std=np.zeros_like(sensor.noise_std))
            for sensor in (scenarios.force_sensor, scenarios.position_sensor)
        )
        return scenarios._replace(force_sensor=force, position_sensor=position)

    def with_compensator(self, loop: Loop, compensator: str) -> Loop:
        """Return the loop with another compensator."""
        return dataclasses.replace(loop, compensator=COMPENSATORS[compensator])

    def compensator_name(self, loop: Loop) -> str:
        """Return the name of a loop's compensator."""
        return loop.compensator.name

    def prepared(self, loop: Loop, scenarios: Scenario) -> RigConstants:
        """Return the constants of a run, which do not depend on the gains."""
        return build_rig_constants(loop, scenarios, measured=loop.compensator.reads_position)

    def outcome(self, loop: Loop, gains: Gains, rig: RigConstants) -> Outcome:
        """Return the outcome of a result of `prepared`; differentiable with respect to the gains."""
        if loop.compensator.is_large:
            rig = _separate_loops(rig)
        return compare_with_ideal(loop, rig.scenario, run_contacts(loop, gains, rig))

    def noise_amplification(self, loop: Loop, gains: Gains, rig: RigConstants) -> Float[Array, "*batch"]:
        """Return the compensator's amplification of the force sensor's noise [1]."""
        return loop.compensator.noise_amplification(gains, rig.constants)


ONE_AXIS = OneAxis()
evaluate = ONE_AXIS.evaluate


def _separate_loops(rig: RigConstants) -> RigConstants:
    """Return an equal rig for which XLA compiles loops around the runs separately from them.

    XLA compiles the outermost loop without a sort, with all loops in it, as one function, and LLVM's time for
    a function grows with the square of its length. The sort of two numbers here keeps outer loops separate.
    """
    contacts = rig.scenario.contacts
    most = jnp.max(contacts)
    most = jnp.sort(jnp.stack([most, most + 1]))[1]
    return rig._replace(scenario=rig.scenario._replace(contacts=jnp.minimum(contacts, most)))
