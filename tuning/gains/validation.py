"""Trying out gains without derivatives: on fresh scenarios to judge them, on training scenarios to search.

Both go through one compiled program, that of `jaxhil.simulation.evaluation`, with as many lanes at every
call.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxhil.laws.simulation_base import Constants
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.evaluation import Batch, RigModel, lanes_of
from jaxhil.simulation.outcome import Outcome
from tuning.batches import cut, join
from tuning.gains.objective import Objective, contact_terms, metrics_of, objective_value, one_each
from tuning.gains.tasks import TuneTask, common_loop, gain_bounds, gains_at, tuned_names
from tuning.gains.work import Work
from tuning.optimisation.unit_box import Bounds, to_coordinates
from tuning.transparency.probes import LANES_PER_SCENARIO, ProbedScenarios, are_probes, probed_scenarios

# Draws of the validation come from another seed than those of training.
VALIDATION_SEED = 0x5EED


@dataclass(frozen=True)
class Validation:
    """Like tasks with fresh scenarios, ready to be evaluated under any gains; see `build_validation`."""

    tasks: list[TuneTask]  # the tasks, whose scenarios are those of training
    fresh: list[Any]  # fresh scenarios of each
    # the same with their transparency probes; None of each where the tasks are not probed
    probed: list[ProbedScenarios | None]
    loop: Any  # that of all tasks
    names: tuple[str, ...]  # of the gains that are tuned for any of the tasks
    bounds: list[Bounds]  # of those gains, of each task
    # fresh scenarios of all tasks side by side, with probes if any, after each task's its nominal run
    judged: Any
    training: Any  # training scenarios, (tasks, ..., scenarios)
    lanes: int  # of `judged` that belong to a task
    work: Work  # hears of every run

    def judge(
        self, gains: list[dict[str, float]], compensator: str | None = None, noise: bool = True
    ) -> list[tuple[Outcome, Outcome | None]]:
        """Of every task under its gains: outcome on fresh scenarios, the nominal run last; where tasks are
        probed, outcome (slots, scenarios, `LANES_PER_SCENARIO`) of the fresh scenarios with their probes.
        Of another `compensator` than that of the tasks, if one is given; or without the sensors' noise."""
        model, loop = self.tasks[0].model, self.loop
        if compensator is not None:
            loop = model.with_compensator(loop, compensator)
        values = {name: np.repeat([one[name] for one in gains], self.lanes) for name in gains[0]}
        outcome = model.begin_batch(loop, values, self._judged if noise else self._judged_without_noise)()
        every = cut(outcome, self.lanes)
        self.work.ran(self.lanes * len(self.tasks))
        if not self.tasks[0].probed:
            return [(own, None) for own in every]

        def plain(leaf):
            return np.concatenate([leaf[..., :-1:LANES_PER_SCENARIO], leaf[..., -1:]], axis=-1)

        def with_probes(leaf):
            return leaf[..., :-1].reshape(*leaf.shape[:-1], -1, LANES_PER_SCENARIO)

        return [(jax.tree.map(plain, own), jax.tree.map(with_probes, own)) for own in every]

    def losses(
        self,
        objective: Objective | Sequence[Objective],
        which: list[int],
        coordinates: Float[np.ndarray, "which points gains"],
        scenarios: int | None = None,
        lanes: int = 0,
    ) -> Float[np.ndarray, "which points"]:
        """`objective_value` of points of the unit box on the training scenarios of the tasks `which`, or on
        the first so many `scenarios` of each, probes counted; the objective is that of all tasks, or one of
        each. At least so many `lanes` are computed at a time."""
        objectives = one_each(objective, len(self.tasks))
        noise = any(objectives[task].noise_weight > 0 for task in which)
        number = lanes_of(self.training)
        number = min(scenarios or number, number)
        points = coordinates.shape[1]
        found = np.empty((len(which), points))
        lanes = max(lanes, self.lanes * len(self.tasks))
        at_once = max(1, lanes // number)
        # As many points of all tasks in every part: the same scenarios serve all.
        together = min(len(which), at_once)
        each = at_once // together
        parts = [
            (slice(first, first + together), slice(point, point + each))
            for first in range(0, len(which), together)
            for point in range(0, points, each)
        ]
        # A part is prepared, and another one looked through, while one between them runs.
        read = _of_terms if objectives[which[0]].function is None else _everything
        running = [
            self._begin(noise, which[some], coordinates[some, own], number, lanes, read)
            for some, own in parts
        ]
        for (some, own), ended in zip(parts, running, strict=True):
            outcome, amplification = ended()
            shape, pairs = amplification.shape, amplification.size
            self.work.ran(pairs * number)
            # (slots, tasks, points, scenarios)
            terms = [term.reshape(-1, *shape, number) for term in contact_terms(outcome)]
            wanted = outcome.wanted.reshape(terms[0].shape)
            probes = are_probes(number) & self.tasks[0].probed
            values = self._values_of(objectives[which[0]], outcome, pairs)
            for place, task in enumerate(which[some]):
                asked = wanted[:, place, 0]  # a contact is asked for at every point
                error, excess, chatter = (np.moveaxis(term[:, place], 1, 0) for term in terms)
                found[some.start + place, own] = objective_value(
                    objectives[task],
                    error[:, asked & ~probes],
                    excess[:, asked],
                    amplification[place],
                    chatter[:, asked],
                    error[:, asked & probes] if self.tasks[0].probed else None,
                    None if values is None else values.reshape(shape)[place],
                )
        return found

    def _values_of(
        self, objective: Objective, outcome: Outcome, pairs: int
    ) -> Float[np.ndarray, "pairs"] | None:
        """Of the user's function, if there is one, for every pair of task and point."""
        if objective.function is None:
            return None
        task = self.tasks[0]
        return objective.function.numbers(metrics_of(outcome, pairs, task.contacts, task.probed))

    def _begin(
        self, noise, which, coordinates, number, lanes, read
    ) -> Callable[[], tuple[Outcome, Float[np.ndarray, "which points"]]]:
        """Start as many points of each task; what is returned waits for what is `read` of their outcome, and
        for the noise's amplification."""
        gains = [self._gains(task, own) for task, own in zip(which, coordinates, strict=True)]
        values = {name: np.repeat([own[name] for own in gains], number) for name in self.tasks[0].literature}
        shape = coordinates.shape[:2]
        scenarios, batch = self._placed(tuple(which), shape[1], number, lanes)
        ended = self.tasks[0].model.begin_batch(self.loop, values, batch, read)
        if not noise:
            return lambda: (ended(), np.ones(shape))
        # The mean over the scenarios, as `tuning.gains.objective.residuals` has it.
        constants = Constants(
            jax.numpy.asarray(scenarios.control_period), jax.numpy.asarray(scenarios.clearance)
        )
        own: Any = {name: jax.numpy.asarray(value) for name, value in values.items()}
        amplification = np.asarray(self.loop.compensator.noise_amplification(own, constants))
        return lambda: (ended(), np.mean(amplification.reshape(*shape, number), axis=-1))

    @cached_property
    def _judged(self) -> Batch:
        # Where few are judged, they share the program of the training scenarios.
        return self.tasks[0].model.place_batch(self.judged, at_least=lanes_of(self.training))

    @cached_property
    def _judged_without_noise(self) -> Batch:
        # The same program: its noise is multiplied by 0.
        model = self.tasks[0].model
        return model.place_batch(model.without_noise(self.judged), at_least=lanes_of(self.training))

    @cached_property
    def _placed(self) -> Callable[[tuple[int, ...], int, int, int], tuple[Any, Batch]]:
        """Training scenarios of tasks, the first so many of each, once for each of so many points; the same
        on the devices. The last few are kept: a search asks for them again and again."""
        return lru_cache(maxsize=4)(partial(_placed, self.tasks[0].model, self.training))

    def gains(self, task: int, coordinates: Float[np.ndarray, "gains"]) -> dict[str, float]:
        """All of the compensator's gains at a point of the unit box."""
        return {name: float(gain) for name, gain in self._gains(task, coordinates).items()}

    def _gains(
        self, task: int, coordinates: Float[np.ndarray, "*points gains"]
    ) -> dict[str, Float[np.ndarray, "*points"]]:
        return gains_at(self.tasks[task], self.names, self.bounds[task], coordinates)

    def coordinates(
        self, task: int, several: Sequence[Mapping[str, float]]
    ) -> Float[np.ndarray, "several gains"]:
        """The points of the unit box where several sets of gains are."""
        gains = np.array([[one[name] for name in self.names] for one in several])
        return to_coordinates(gains.reshape(len(several), len(self.names)), self.bounds[task])


def _everything(outcome: Outcome) -> Outcome:
    return outcome


def _of_terms(outcome: Any) -> Any:
    """What `contact_terms` needs of an outcome."""
    return outcome._replace(metrics=None, reference_restitution=None, reference_peak_force=None)


def _placed(
    model: RigModel, training: Any, which: tuple[int, ...], points: int, number: int, lanes: int
) -> tuple[Any, Batch]:
    def side_by_side(leaf):
        picked = np.moveaxis(leaf[np.repeat(which, points)][..., :number], 0, -2)
        return picked.reshape(*picked.shape[:-2], picked.shape[-2] * picked.shape[-1])

    scenarios = jax.tree.map(side_by_side, training)
    return scenarios, model.place_batch(scenarios, at_least=lanes)


def build_validation(
    tasks: list[TuneTask], scenarios: int, seed: int, work: Work | None = None
) -> Validation:
    """So many fresh scenarios of each of the tasks, which are alike (`tuning.gains.tasks.alike`)."""
    drawn = [_fresh(task, scenarios, seed + VALIDATION_SEED) for task in tasks]
    fresh, probed, judged, loops = (list(each) for each in zip(*drawn, strict=True))
    names = tuned_names(tasks)
    return Validation(
        tasks=tasks,
        fresh=fresh,
        probed=probed,
        loop=common_loop(loops),
        names=names,
        bounds=[gain_bounds(task, names) for task in tasks],
        judged=join(judged),
        training=jax.tree.map(
            lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]),
            *[task.scenarios for task in tasks],
        ),
        lanes=judged_runs(scenarios, tasks[0].probed),
        work=work or Work(),
    )


def judged_runs(scenarios: int, probed: bool) -> int:
    """Runs of a task under one set of gains, with its nominal one."""
    return scenarios * (LANES_PER_SCENARIO if probed else 1) + 1


def split_nominal(outcome: Outcome) -> tuple[Any, Any]:
    """What `Validation.judge` gives, as outcome of the fresh scenarios and of the nominal run."""
    fresh, nominal = (
        jax.tree.map(lambda leaf, part=part: leaf[..., part], outcome)
        for part in (slice(-1), slice(-1, None))
    )
    return fresh, nominal


def fresh_scenarios(task: TuneTask, number: int, seed: int) -> Any:
    """Scenarios of a task that its tuning with that seed never saw."""
    seed += VALIDATION_SEED
    return task.model.scenarios(task.mechanism, draw(task.mechanism, number, seed), seed)


def _fresh(task: TuneTask, number: int, seed: int) -> tuple[Any, ProbedScenarios | None, Any, Any]:
    """Fresh scenarios of a task, the same with their probes, what is judged of it, its loop."""
    drawn = draw(task.mechanism, number, seed)
    fresh, probed = task.model.scenarios(task.mechanism, drawn, seed), None
    if task.probed and isinstance(task.mechanism, Mechanism):
        probed = probed_scenarios(task.mechanism, drawn, seed)
        nominal = probed_scenarios(task.mechanism).scenarios
        judged = join([probed.scenarios, jax.tree.map(lambda leaf: leaf[..., :1], nominal)])
    else:
        judged = join([fresh, task.model.scenarios(task.mechanism)])
    if task.common is None:
        both = join([judged, task.scenarios])
        return fresh, probed, judged, task.model.loop(task.mechanism, task.compensator, both, chatter=True)
    assert isinstance(task.mechanism, Mechanism)
    loop = task.common.loop(task.model.loop(task.mechanism, task.compensator, judged, chatter=True))
    return fresh, probed, task.common.scenarios(task.mechanism, judged), loop
