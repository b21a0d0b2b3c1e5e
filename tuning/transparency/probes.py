"""Transparency probes: copies of each scenario with an early push, with a late push, and with more damping.

A law that anticipates the contact can be tuned to ignore the hardware, which is most accurate if all contacts
are alike. So each scenario has three probes whose restitution the law cannot predict:

    early, late   with a push on the hardware that is in no model (`tuning.transparency.pushes`)
    damped        with more dissipation (`tuning.transparency.damping_perturbations`)

Each has its own true restitution e*, that of the pushed or damped ideal contact. A law that ignores the push,
or returns energy that the contact dissipated, has an error e - e* as in any other contact. Transparency and
slope are thus restitution errors, which are differentiable and have the same unit as all others. The push's
time counts from the first touch, on the rig and in the ideal contact. It acts on the first contact, after
which a probe ends.

Scenario i and its probes are lanes 4 i to 4 i + 3, so that any first lanes include some of each.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxhil.contact.ideal_contact import IdealContact
from jaxhil.contact.laws import find_contact_law
from jaxhil.laws.compensators import get_compensator
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.scenario import Scenario, build_scenarios
from tuning.statistics.intervals import Estimate
from tuning.transparency.damping_perturbations import perturb_damping
from tuning.transparency.metrics import PerturbedOutcomes, compute_transparency_metrics
from tuning.transparency.pushes import EARLY_PUSH_CENTRE, LATE_PUSH_CENTRE, add_probe, compute_ideal_contacts

LANES_PER_SCENARIO = 4  # lanes of a scenario: plain, early, late, damped
# Default weights of the objective of a law that anticipates.
ANTICIPATING_WEIGHTS = {"transparency_weight": 1.0, "command_weight": 0.3}


class ProbedScenarios(NamedTuple):
    """Batch of scenarios with their transparency probes."""

    scenarios: Scenario  # (..., scenarios * `LANES_PER_SCENARIO`)
    plain: Any  # restitution e* of the ideal contact without a push (scenarios,)
    early: Any  # e* with an early push, by the same integration (scenarios,)
    late: Any  # e* with a late push, by the same integration (scenarios,)


def choose_default_weights(compensator: str, axes: int = 1) -> dict[str, float]:
    """Return the default weights of `tuning.gains.objective.Objective` for a compensator, by name.

    For a law that anticipates, errors of probes count as much as those of scenarios, and excess force is
    penalised, since such a law can correct a late response by a short, large force, which the error alone
    rewards. For a law that only passes on the measured force, neither counts.
    """
    return dict(ANTICIPATING_WEIGHTS) if get_compensator(compensator, axes).anticipates else {}


def mask_probes(lanes: int) -> np.ndarray:
    """Return which of the lanes of probed scenarios are probes, (lanes,) of bool."""
    return np.arange(lanes) % LANES_PER_SCENARIO > 0


def build_probed_scenarios(
    mechanism: Mechanism, draws: Mapping[str, np.ndarray] | None = None, seed: int = 0
) -> ProbedScenarios:
    """Build the scenarios of `jaxhil.simulation.scenario.build_scenarios`, each with its probes."""
    plain = build_scenarios(mechanism, draws, seed)
    number = len(plain.velocity)
    perturbed, damped = perturb_damping(mechanism, draws or {"approach.phase": np.asarray(plain.phase).T})
    slots = plain.phase.shape[0]
    velocity: Any = np.broadcast_to(plain.velocity, (slots, number))
    space = compute_ideal_contacts(find_contact_law(mechanism.contact.law).simulated, plain, velocity, 1)
    twins = build_scenarios(perturbed, damped, seed)
    pushes = [
        _add_push(plain, space, share, e)
        for share, e in ((EARLY_PUSH_CENTRE, space.early), (LATE_PUSH_CENTRE, space.late))
    ]
    batches = [_add_push(plain, space), *pushes, _add_push(twins, space)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves, axis=-1), *batches)
    side_by_side = jax.tree.map(
        lambda leaf: leaf.reshape(*leaf.shape[:-2], LANES_PER_SCENARIO * number), stacked
    )
    return ProbedScenarios(side_by_side, space.restitution[0], space.early, space.late)


def _add_push(
    scenarios: Scenario, space: Any, share: float | None = None, restitution: Any = None
) -> Scenario:
    """Return the scenarios with a push at a `share` of the first ideal contact's duration, if one is given.

    `restitution` is that of the ideal contact with the push.
    """
    values = np.full((3, *space.peak_force.shape), np.nan)
    if share is not None:
        values[:, 0] = restitution, space.peak_force[0], space.duration[0]
        scenarios = scenarios._replace(contacts=np.minimum(scenarios.contacts, 1))
    # The trajectory error of probes is not used, so that the two ends of the ideal motion suffice.
    pushed = add_probe(scenarios, space._replace(depth=space.depth[:, [0, -1]]), share)
    reference: Any = IdealContact(*values)
    return pushed._replace(reference=reference)


def compute_probe_metrics(probed: ProbedScenarios, outcome: Outcome, seed: int = 0) -> dict[str, Estimate]:
    """Return early, late, slope and peak of `tuning.transparency.metrics` for `add_probe` scenarios.

    `outcome` has leaves (slots, scenarios, `LANES_PER_SCENARIO`).
    """
    plain, early, late, damped = (
        jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[..., i], outcome) for i in range(LANES_PER_SCENARIO)
    )
    runs = PerturbedOutcomes(plain, early, late, damped)
    return compute_transparency_metrics(runs, (probed.early, probed.late), probed.plain, seed)
