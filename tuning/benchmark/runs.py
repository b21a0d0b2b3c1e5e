"""Runs of one mechanism under one law for the comparison: plain, pushed and damped ones.

All mechanisms that share a `CommonProgram` run in one compiled program per law.
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
from tuning.statistics.intervals import Estimate
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
    """Scenarios of one mechanism on which every law is evaluated, as NumPy arrays."""

    mechanism: Mechanism
    common: CommonProgram  # program that the mechanism shares with others
    plain: Scenario  # scenarios without perturbation
    twins: Scenario  # scenarios with damping added (`tuning.transparency.damping_perturbations`)
    space: IdealContacts  # ideal first contacts of the scenarios


def build_scenario_set(mechanism: Mechanism, common: CommonProgram, scenarios: int, seed: int) -> ScenarioSet:
    """Draw the scenarios of a mechanism and compute their ideal contacts."""
    draws = draw(mechanism, scenarios, seed)
    twin, twin_draws = perturb_damping(mechanism, draws)
    plain = common.scenarios(mechanism, build_scenarios(mechanism, draws, seed))
    twins = common.scenarios(twin, build_scenarios(twin, twin_draws, seed))
    return ScenarioSet(
        mechanism,
        common,
        plain,
        twins,
        compute_ideal_contacts(common.law(beforehand=False), plain, _broadcast_velocity(plain), 1),
    )


def evaluate_gains(
    scene: ScenarioSet, law: str, gains: Mapping[str, float], limit: float, seed: int
) -> dict[str, Estimate]:
    """Compute all metrics of a law under these gains; `limit` and `seed` as in `figures.judge`."""
    contacts, space = scene.mechanism.approach.contacts, scene.space
    runs = _run_scenarios(scene, law, gains, space)
    if contacts > 1:
        # The approach speeds of later contacts depend on the law, and so do their ideal contacts.
        plain: Any = runs.plain
        velocity = np.where(plain.good, plain.metrics.approach_velocity, _broadcast_velocity(scene.plain))
        space = compute_ideal_contacts(scene.common.law(beforehand=False), scene.plain, velocity, contacts)
        runs = _run_scenarios(scene, law, gains, space)
    return compute_metrics(
        runs,
        (space.early, space.late),
        space.restitution[0],
        np.max(space.depth, axis=1),
        _compute_amplification(scene, law, gains),
        limit,
        seed,
    )


def count_evaluated_lanes(scene: ScenarioSet) -> int:
    """Return the number of lanes that `evaluate_gains` runs."""
    return (
        len(PerturbedOutcomes._fields)
        * len(scene.plain.velocity)
        * (1 + (scene.mechanism.approach.contacts > 1))
    )


def _run_scenarios(
    scene: ScenarioSet, law: str, gains: Mapping[str, float], space: IdealContacts
) -> PerturbedOutcomes:
    """Run all scenarios of the metrics as one batch; `space` holds their ideal contacts."""
    pushed = [add_probe(scene.plain, space, share) for share in (EARLY_PUSH_CENTRE, LATE_PUSH_CENTRE)]
    scenarios = join_batches([add_probe(scene.plain, space), *pushed, add_probe(scene.twins, space)])
    loop = scene.common.loop(build_loop(scene.mechanism, law, scenarios))
    values = {name: np.full(len(scenarios.velocity), value) for name, value in gains.items()}
    return PerturbedOutcomes(*split_batch(evaluate(loop, values, scenarios), len(scene.plain.velocity)))


def _broadcast_velocity(scenarios: Scenario) -> Any:
    return np.broadcast_to(scenarios.velocity, scenarios.phase.shape)


def _compute_amplification(scene: ScenarioSet, law: str, gains: Mapping[str, float]) -> float:
    """Return the noise amplification [1], averaged over the scenarios' control periods."""
    period, clearance = jnp.asarray(scene.plain.control_period), jnp.asarray(scene.plain.clearance)
    values = {name: jnp.full_like(period, value) for name, value in gains.items()}
    return float(jnp.mean(COMPENSATORS[law].noise_amplification(values, KnownConstants(period, clearance))))
