"""Trying out gains without derivatives: on fresh scenarios to judge them, on training scenarios to search.

Both go through one compiled program, that of `jaxhil.simulation.evaluation`, with as many lanes at every
call.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxhil.compensators import COMPENSATORS
from jaxhil.compensators.base import Constants
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.evaluation import Outcome, begin_evaluation, evaluate
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.scenario import Scenario, build_scenarios
from tuning.batches import cut, join
from tuning.gains.objective import Objective, contact_terms, objective_value, one_each
from tuning.gains.tasks import TuneTask, common_loop, gain_bounds, gains_at, tuned_names
from tuning.optimisation.unit_box import Bounds
from tuning.transparency.probes import LANES_PER_SCENARIO, ProbedScenarios, are_probes, probed_scenarios

# Draws of the validation come from another seed than those of training.
VALIDATION_SEED = 0x5EED


class Validation:
    """Like tasks with fresh scenarios, and the nominal run of each as one more lane of its own.

    fresh: (tasks) scenarios of each; probed: the same with their copies, where the tasks are probed, as all
    are or none; names, bounds: of the gains that are tuned for any of the tasks.
    """

    def __init__(self, tasks: list[TuneTask], validation: int, seed: int):
        seed = seed + VALIDATION_SEED
        self.tasks = tasks
        self.fresh: list[Scenario] = []
        self.probed: list[ProbedScenarios | None] = []
        every, loops = [], []
        for task in tasks:
            drawn = draw(task.mechanism, validation, seed)
            self.fresh.append(build_scenarios(task.mechanism, drawn, seed))
            if task.probed:
                probed = probed_scenarios(task.mechanism, drawn, seed)
                nominal = probed_scenarios(task.mechanism).scenarios
                own = join([probed.scenarios, jax.tree.map(lambda leaf: leaf[..., :1], nominal)])
            else:
                probed, own = None, join([self.fresh[-1], build_scenarios(task.mechanism)])
            self.probed.append(probed)
            if task.common is None:
                both = join([own, task.scenarios])
                loop = build_loop(task.mechanism, task.compensator, both, chatter=True)
            else:
                loop = task.common.loop(build_loop(task.mechanism, task.compensator, own, chatter=True))
                own = task.common.scenarios(task.mechanism, own)
            every.append(own)
            loops.append(loop)
        self.loop: Loop = common_loop(loops)
        self.names = tuned_names(tasks)
        self.bounds: list[Bounds] = [gain_bounds(task, self.names) for task in tasks]
        self._scenarios: Scenario = join(every)
        self._training: Any = jax.tree.map(
            lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]),
            *[task.scenarios for task in tasks],
        )
        self._probed = tasks[0].probed
        self._each = validation * (LANES_PER_SCENARIO if self._probed else 1) + 1
        self._lanes = self._each * len(tasks)

    def judge(self, gains: list[dict[str, float]]) -> list[Outcome]:
        """Outcome on the fresh scenarios of every task under its gains, the nominal run last."""
        return [plain for plain, _ in self.judge_probed(gains)]

    def judge_probed(
        self, gains: list[dict[str, float]], compensator: str | None = None
    ) -> list[tuple[Outcome, Outcome | None]]:
        """What `judge` returns and, where the tasks are probed, the outcome of the fresh scenarios with their
        copies, (slots, scenarios, `LANES_PER_SCENARIO`); of another `compensator` than that of the tasks, if
        one is given."""
        loop = self.loop
        if compensator is not None:
            loop = dataclasses.replace(loop, compensator=COMPENSATORS[compensator])
        every = cut(evaluate(loop, self._values(gains), self._scenarios), self._each)
        if not self._probed:
            return [(own, None) for own in every]

        def plain(leaf):
            return np.concatenate([leaf[..., :-1:LANES_PER_SCENARIO], leaf[..., -1:]], axis=-1)

        def copies(leaf):
            return leaf[..., :-1].reshape(*leaf.shape[:-1], -1, LANES_PER_SCENARIO)

        return [(jax.tree.map(plain, own), jax.tree.map(copies, own)) for own in every]

    def losses(
        self,
        objective: Objective | Sequence[Objective],
        which: list[int],
        coordinates: Float[np.ndarray, "which points gains"],
        scenarios: int | None = None,
        lanes: int = 0,
    ) -> Float[np.ndarray, "which points"]:
        """`objective_value` of points of the unit box on the training scenarios of the tasks `which`, or on
        the first so many `scenarios` of each, copies counted; the objective is that of all tasks, or one of
        each. At least so many `lanes` are computed at a time."""
        objectives = one_each(objective, len(self.tasks))
        noise = any(objectives[task].noise_weight > 0 for task in which)
        number = self._training.velocity.shape[-1]
        number = min(scenarios or number, number)
        points = coordinates.shape[1]
        pairs = [(i, point) for i in range(len(which)) for point in range(points)]
        found = np.empty((len(which), points))
        lanes = max(lanes, self._lanes)
        at_once = max(1, lanes // number)
        parts = [pairs[begin : begin + at_once] for begin in range(0, len(pairs), at_once)]
        # A part is prepared, and another one looked through, while one between them runs.
        running = [self._begin(noise, which, coordinates, some, number, lanes) for some in parts]
        for some, ended in zip(parts, running, strict=True):
            outcome, amplification = ended()
            # (slots, pairs, scenarios)
            terms = [np.asarray(term).reshape(-1, len(some), number) for term in contact_terms(outcome)]
            wanted = outcome.wanted.reshape(terms[0].shape)
            copies = are_probes(number) & self._probed
            for k, (i, point) in enumerate(some):
                asked = wanted[:, k]
                excess, chatter = (term[:, k][asked] for term in terms[1:])
                error, probe_errors = (terms[0][:, k][asked & ones] for ones in (~copies, copies))
                own = objectives[which[i]]
                probe_errors = probe_errors if self._probed else None
                found[i, point] = objective_value(own, error, excess, amplification[k], chatter, probe_errors)
        return found

    def _begin(
        self, noise, which, coordinates, some, number, lanes
    ) -> Callable[[], tuple[Outcome, np.ndarray]]:
        """Start some pairs; what is returned waits for their outcome and noise amplification."""
        index = np.array([which[i] for i, _ in some])
        rows = [self.gains(which[i], coordinates[i, point]) for i, point in some]
        values = {name: np.repeat([row[name] for row in rows], number) for name in rows[0]}

        def side_by_side(leaf):
            picked = np.moveaxis(leaf[index][..., :number], 0, -2)
            return picked.reshape(*picked.shape[:-2], picked.shape[-2] * picked.shape[-1])

        scenarios = jax.tree.map(side_by_side, self._training)
        ended = begin_evaluation(self.loop, values, scenarios, at_least=lanes)
        if not noise:
            return lambda: (ended(), np.ones(len(some)))
        # The mean over the scenarios, as `tuning.gains.objective.residuals` has it.
        constants = Constants(jnp.asarray(scenarios.control_period), jnp.asarray(scenarios.clearance))
        own: Any = {name: jnp.asarray(value) for name, value in values.items()}
        amplification = np.asarray(self.loop.compensator.noise_amplification(own, constants))
        return lambda: (ended(), np.mean(amplification.reshape(len(some), number), axis=1))

    def gains(self, task: int, coordinates: Float[np.ndarray, "gains"]) -> dict[str, float]:
        """All of the compensator's gains at a point of the unit box."""
        return gains_at(self.tasks[task], self.names, self.bounds[task], coordinates)

    def _values(self, gains: list[dict[str, float]]) -> dict[str, Any]:
        return {name: np.repeat([one[name] for one in gains], self._each) for name in gains[0]}
