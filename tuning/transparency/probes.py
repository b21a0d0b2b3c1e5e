"""Transparency probes: each scenario once more with an early push, with a late push, and damped.

A law that anticipates the contact can be tuned into a simulation that ignores the hardware: where all
contacts are alike, that is the most accurate. So each scenario comes with three probes whose restitution the
law cannot know beforehand:

    early, late   a push on the hardware, which no model knows of (`tuning.transparency.pushes`)
    damped        the same contact with more dissipation (`tuning.transparency.damping_perturbations`)

Each has its own true restitution e*: that of the pushed, or damped, contact in space. A law that swallows the
push, or gives back energy that is not there, errs by e - e* as in any other contact: transparency and slope
are then restitution errors, differentiable, in one unit with all others. The push counts from the hardware's
first touch, and is the same in space; it acts on the first contact, after which a probe ends.

Scenario and probes lie side by side, lanes 4 i to 4 i + 3 for scenario i: whatever takes the first few lanes
has some of each.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxhil.contact.laws import contact_law
from jaxhil.contact.reference import Reference
from jaxhil.laws.compensators import compensator_of
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.scenario import Scenario, build_scenarios
from tuning.statistics.intervals import Estimate
from tuning.transparency.damping_perturbations import perturb_damping
from tuning.transparency.figures import Runs, transparency_figures
from tuning.transparency.pushes import EARLY, LATE, in_space, probed

LANES_PER_SCENARIO = 4  # lanes of a scenario: plain, early, late, damped
# Weights of the objective of a law that anticipates, unless others are given.
ANTICIPATING = {"transparency_weight": 1.0, "command_weight": 0.3}


class ProbedScenarios(NamedTuple):
    """A batch of scenarios with their transparency probes."""

    scenarios: Scenario  # (..., scenarios * `LANES_PER_SCENARIO`)
    plain: Any  # restitution in space without a push (scenarios,)
    early: Any  # under an early push, integrated alike
    late: Any  # under a late one


def default_weights(compensator: str) -> dict[str, float]:
    """Weights of `tuning.gains.objective.Objective` that a compensator has unless others are given, by name.

    Where the law anticipates, the errors of the probes count as much as those of the scenarios, and force is
    dear: what such a law is late by it can pay back by a kick, which the error alone rewards. Where a law can
    but pass on what it measures, neither counts.
    """
    return dict(ANTICIPATING) if compensator_of(compensator).anticipates else {}


def are_probes(lanes: int) -> np.ndarray:
    """Which of so many lanes, with those of the probes, are of probes."""
    return np.arange(lanes) % LANES_PER_SCENARIO > 0


def probed_scenarios(
    mechanism: Mechanism, draws: Mapping[str, np.ndarray] | None = None, seed: int = 0
) -> ProbedScenarios:
    """The scenarios of `jaxhil.simulation.scenario.build_scenarios`, each with its probes."""
    plain = build_scenarios(mechanism, draws, seed)
    number = len(plain.velocity)
    perturbed, damped = perturb_damping(mechanism, draws or {"approach.phase": np.asarray(plain.phase).T})
    slots = plain.phase.shape[0]
    velocity: Any = np.broadcast_to(plain.velocity, (slots, number))
    space = in_space(contact_law(mechanism.contact.law).simulated, plain, velocity, 1)
    own = build_scenarios(perturbed, damped, seed)
    pushes = [_pushed(plain, space, share, e) for share, e in ((EARLY, space.early), (LATE, space.late))]
    batches = [_pushed(plain, space), *pushes, _pushed(own, space)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves, axis=-1), *batches)
    side_by_side = jax.tree.map(
        lambda leaf: leaf.reshape(*leaf.shape[:-2], LANES_PER_SCENARIO * number), stacked
    )
    return ProbedScenarios(side_by_side, space.restitution[0], space.early, space.late)


def _pushed(scenarios: Scenario, space: Any, share: float | None = None, restitution: Any = None) -> Scenario:
    """The scenarios with a push at a share of the first contact's duration in space, where one is given, and
    what the contact's `restitution` then is."""
    known = np.full((3, *space.peak_force.shape), np.nan)
    if share is not None:
        known[:, 0] = restitution, space.peak_force[0], space.duration[0]
        scenarios = scenarios._replace(contacts=np.minimum(scenarios.contacts, 1))
    # Nobody asks how far the model is off the motion in space: its two ends will do.
    own = probed(scenarios, space._replace(depth=space.depth[:, [0, -1]]), share)
    reference: Any = Reference(*known)
    return own._replace(reference=reference)


def probe_figures(probed: ProbedScenarios, outcome: Outcome, seed: int = 0) -> dict[str, Estimate]:
    """early, late, slope and peak of `tuning.transparency.figures` from the outcome (slots, scenarios,
    `LANES_PER_SCENARIO`) of `probed` scenarios; the slope over the damped ones."""
    plain, early, late, damped = (
        jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[..., i], outcome) for i in range(LANES_PER_SCENARIO)
    )
    judged = Runs(plain, early, late, damped)
    return transparency_figures(judged, (probed.early, probed.late), probed.plain, seed)
