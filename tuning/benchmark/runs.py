"""Runs for `jaxhil compare` of one compensator on one one-axis mechanism, with and without perturbations.

The perturbations are pushes and additional damping. All mechanisms that share a `CommonProgram` use the same
compiled program of a compensator.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import KnownConstants
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.scenario import Scenario, build_scenarios
from tuning.batches import join_batches, split_batch
from tuning.gains.common_program import CommonProgram
from tuning.statistics.intervals import IntervalEstimate
from tuning.transparency.damping_perturbations import perturb_damping
from tuning.transparency.metrics import PerturbedOutcomes, compute_metrics
from tuning.transparency.pushes import (
    EARLY_PUSH_CENTRE,
    LATE_PUSH_CENTRE,
    IdealContacts,
    add_probe,
    compute_ideal_contacts,
)


class ScenarioSet(NamedTuple):
    """Scenarios of one one-axis mechanism, as NumPy arrays; all compensators use the same scenarios."""

    mechanism: Mechanism  # mechanism with its uncertainty
    common: CommonProgram  # program that the mechanism shares with other mechanisms
    plain: Scenario  # scenarios without a perturbation
    damped: Scenario  # the same scenarios with additional damping
    ideal_contacts: IdealContacts  # first ideal contact of each scenario

    @property
    def lanes(self) -> int:
        """Return the number of runs (lanes) that `evaluate` simulates, for progress messages."""
        return (
            len(PerturbedOutcomes._fields)
            * len(self.plain.velocity)
            * (1 + (self.mechanism.approach.contacts > 1))
        )

    def evaluate(
        self, law: str, gains: Mapping[str, float], limit: float, seed: int
    ) -> dict[str, IntervalEstimate]:
        """Simulate a compensator with the given gains in all scenarios, and compute its metrics by name.

        `limit` [1] is the limit of the restitution error, `seed` the seed of the bootstrap.
        """
        contacts, ideal_contacts = self.mechanism.approach.contacts, self.ideal_contacts
        runs = _run_scenarios(self, law, gains, ideal_contacts)
        if contacts > 1:
            # The approach speeds of later contacts depend on the compensator, and so do their ideal contacts.
            plain: Any = runs.plain
            velocity = np.where(plain.good, plain.metrics.approach_velocity, _broadcast_velocity(self.plain))
            contact_law = self.common.law(precomputed=False)
            ideal_contacts = compute_ideal_contacts(contact_law, self.plain, velocity, contacts)
            runs = _run_scenarios(self, law, gains, ideal_contacts)
        return compute_metrics(
            runs,
            (ideal_contacts.early, ideal_contacts.late),
            ideal_contacts.restitution[0],
            np.max(ideal_contacts.depth, axis=1),
            _compute_amplification(self, law, gains),
            limit,
            seed,
        )


def build_scenario_set(mechanism: Mechanism, common: CommonProgram, scenarios: int, seed: int) -> ScenarioSet:
    """Draw a mechanism's scenarios, make copies with additional damping, and compute the ideal contacts."""
    draws = draw(mechanism, scenarios, seed)
    damped_mechanism, damped_draws = perturb_damping(mechanism, draws)
    plain = common.scenarios(mechanism, build_scenarios(mechanism, draws, seed))
    damped = common.scenarios(damped_mechanism, build_scenarios(damped_mechanism, damped_draws, seed))
    return ScenarioSet(
        mechanism,
        common,
        plain,
        damped,
        compute_ideal_contacts(common.law(precomputed=False), plain, _broadcast_velocity(plain), 1),
    )


def _run_scenarios(
    scene: ScenarioSet, law: str, gains: Mapping[str, float], ideal_contacts: IdealContacts
) -> PerturbedOutcomes:
    """Simulate each scenario four times: unperturbed, with an early push, with a late push, and damped."""
    plain, damped = (add_probe(scenarios, ideal_contacts) for scenarios in (scene.plain, scene.damped))
    early = add_probe(scene.plain, ideal_contacts, EARLY_PUSH_CENTRE)
    late = add_probe(scene.plain, ideal_contacts, LATE_PUSH_CENTRE)
    scenarios = join_batches([plain, early, late, damped])
    loop = scene.common.loop(build_loop(scene.mechanism, law, scenarios))
    values = {name: np.full(len(scenarios.velocity), value) for name, value in gains.items()}
    return PerturbedOutcomes(*split_batch(evaluate(loop, values, scenarios), len(scene.plain.velocity)))


def _broadcast_velocity(scenarios: Scenario) -> Any:
    return np.broadcast_to(scenarios.velocity, scenarios.phase.shape)


def _compute_amplification(scene: ScenarioSet, law: str, gains: Mapping[str, float]) -> float:
    """Return the compensator's amplification of white force noise [1], averaged over the scenarios."""
    period, clearance = jnp.asarray(scene.plain.control_period), jnp.asarray(scene.plain.clearance)
    values = {name: jnp.full_like(period, value) for name, value in gains.items()}
    return float(jnp.mean(COMPENSATORS[law].noise_amplification(values, KnownConstants(period, clearance))))
