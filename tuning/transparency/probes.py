"""Transparency probes: copies of each scenario with an early push, with a late push, and with more damping.

A compensator that predicts the contact could be tuned to ignore the hardware. This would be the most accurate
choice if all contacts were alike. Therefore each scenario has three probes whose restitution the compensator
cannot predict:

    early, late   a push that no model contains acts on the hardware (`tuning.transparency.pushes`)
    damped        the contact dissipates more energy (`tuning.transparency.damping_perturbations`)

Each probe has its own e*, the restitution of the ideal contact with the same push or damping. A compensator
that ignores the push or the damping therefore has a restitution error e - e*, which tuning reduces like any
other error. The push acts on the first contact, at a fixed time after the first touch, on the rig and in the
ideal contact. A probe ends after this contact.

Scenario i and its probes are the lanes 4 i to 4 i + 3, so that the first lanes of a batch contain all kinds.
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
from tuning.statistics.intervals import IntervalEstimate
from tuning.transparency.damping_perturbations import perturb_damping
from tuning.transparency.metrics import PerturbedOutcomes, compute_transparency_metrics
from tuning.transparency.pushes import EARLY_PUSH_CENTRE, LATE_PUSH_CENTRE, add_probe, compute_ideal_contacts

LANES_PER_SCENARIO = 4  # number of lanes of a scenario: without a probe, early, late, damped
# Default weights of the objective for a compensator that predicts the contact.
ANTICIPATING_WEIGHTS = {"transparency_weight": 1.0, "command_weight": 0.3}


class ProbedScenarios(NamedTuple):
    """Scenarios, their transparency probes (copies with a push or more damping), and e* of ideal contacts."""

    scenarios: Scenario  # scenarios and probes, (..., scenarios * `LANES_PER_SCENARIO`)
    plain: Any  # restitution e* of the first ideal contact without a push [1], (scenarios,)
    early: Any  # restitution e* of the first ideal contact with an early push [1], (scenarios,)
    late: Any  # restitution e* of the first ideal contact with a late push [1], (scenarios,)


def choose_default_weights(compensator: str, axes: int = 1) -> dict[str, float]:
    """Return the weights of a compensator's default objective (`tuning.gains.objective.Objective`), by name.

    If the compensator predicts the contact, the errors of transparency probes (copies of the scenarios with
    a push or more damping) have the same weight as the errors of the scenarios. Excess force is penalised,
    because such a compensator can correct a late response by a short, large force. The restitution error
    alone would reward this. For other compensators, the dictionary is empty.
    """
    return dict(ANTICIPATING_WEIGHTS) if get_compensator(compensator, axes).anticipates else {}


def mask_probes(lanes: int) -> np.ndarray:
    """Return which of the first `lanes` lanes of `ProbedScenarios` are probes, (lanes,) of bool."""
    return np.arange(lanes) % LANES_PER_SCENARIO > 0


def build_probed_scenarios(
    mechanism: Mechanism, draws: Mapping[str, np.ndarray] | None = None, seed: int = 0
) -> ProbedScenarios:
    """Build scenarios (see `build_scenarios`), each with copies: early push, late push, more damping."""
    plain = build_scenarios(mechanism, draws, seed)
    number = len(plain.velocity)
    perturbed, damped = perturb_damping(mechanism, draws or {"approach.phase": np.asarray(plain.phase).T})
    slots = plain.phase.shape[0]
    velocity: Any = np.broadcast_to(plain.velocity, (slots, number))
    law = find_contact_law(mechanism.contact.law).simulation_law
    ideal_contacts = compute_ideal_contacts(law, plain, velocity, 1)
    damped_scenarios = build_scenarios(perturbed, damped, seed)
    pushes = [
        _add_push(plain, ideal_contacts, centre, e)
        for centre, e in ((EARLY_PUSH_CENTRE, ideal_contacts.early), (LATE_PUSH_CENTRE, ideal_contacts.late))
    ]
    batches = [_add_push(plain, ideal_contacts), *pushes, _add_push(damped_scenarios, ideal_contacts)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves, axis=-1), *batches)
    interleaved = jax.tree.map(
        lambda leaf: leaf.reshape(*leaf.shape[:-2], LANES_PER_SCENARIO * number), stacked
    )
    return ProbedScenarios(
        scenarios=interleaved,
        plain=ideal_contacts.restitution[0],
        early=ideal_contacts.early,
        late=ideal_contacts.late,
    )


def _add_push(
    scenarios: Scenario, ideal_contacts: Any, centre: float | None = None, restitution: Any = None
) -> Scenario:
    """Add a push on the first contact, centred at the fraction `centre` of the ideal contact's duration.

    `restitution` is the restitution e* of the ideal contact with the push. Without `centre`, add no push.
    """
    values = np.full((3, *ideal_contacts.peak_force.shape), np.nan)
    if centre is not None:
        values[:, 0] = restitution, ideal_contacts.peak_force[0], ideal_contacts.duration[0]
        scenarios = scenarios._replace(contacts=np.minimum(scenarios.contacts, 1))
    # The trajectory error of probes is not used. Two samples of the ideal motion, its ends, are sufficient.
    pushed = add_probe(scenarios, ideal_contacts._replace(depth=ideal_contacts.depth[:, [0, -1]]), centre)
    reference: Any = IdealContact(*values)
    return pushed._replace(reference=reference)


def compute_probe_metrics(probed: ProbedScenarios, outcome: Outcome) -> dict[str, IntervalEstimate]:
    """Compute the metrics `early`, `late`, `slope` and `peak` of scenarios with transparency probes.

    The arrays in `outcome` have the shape (slots, scenarios, `LANES_PER_SCENARIO`). The last axis contains
    the scenario itself and its copies with an early push, a late push and more damping.
    """
    plain, early, late, damped = (
        jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[..., i], outcome) for i in range(LANES_PER_SCENARIO)
    )
    runs = PerturbedOutcomes(plain, early, late, damped)
    return compute_transparency_metrics(runs, (probed.early, probed.late), probed.plain, seed=0)
