"""Evaluation of gains, without derivatives, on fresh scenarios and (during searches) on training scenarios.

All calls have the same number of lanes, so that they share a compiled program of
`jaxhil.simulation.evaluation`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxhil.laws.simulation_base import KnownConstants
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.evaluation import Batch, RigModel, count_lanes
from jaxhil.simulation.outcome import Outcome
from tuning.batches import join_batches, split_batch
from tuning.gains.contact_terms import compute_contact_terms, extract_scenario_metrics
from tuning.gains.objective import (
    Objective,
    evaluate_objective,
    list_objectives,
)
from tuning.gains.search_progress import SearchProgress
from tuning.gains.tasks import TuneTask, build_gain_bounds, convert_to_gains, join_loops, list_tuned_gains
from tuning.optimisation.unit_box import GainBounds, to_coordinates
from tuning.transparency.probes import (
    LANES_PER_SCENARIO,
    ProbedScenarios,
    build_probed_scenarios,
    mask_probes,
)

VALIDATION_SEED_OFFSET = 0x5EED  # added to the seed of training, so that fresh scenarios differ


@dataclass(frozen=True)
class Validation:
    """Evaluator of the gains of tasks that run in the same compiled program; see `build_validation`."""

    tasks: list[TuneTask]  # tasks with their training scenarios
    fresh: list[Any]  # fresh scenarios of each task
    # fresh scenarios of each task together with their transparency probes; None for tasks without probes
    probed: list[ProbedScenarios | None]
    loop: Any  # static properties of the simulated loop, common to all tasks
    names: tuple[str, ...]  # names of the gains that are tuned in at least one task
    bounds: list[GainBounds]  # bounds of the gains `names`, for each task
    # scenarios to evaluate: for each task the fresh scenarios, with probes if any, then the nominal run
    evaluated: Any
    training: Any  # training scenarios, (tasks, ..., scenarios)
    lanes: int  # number of lanes per task in `evaluated`
    work: SearchProgress  # progress counter

    def evaluate(
        self, gains: list[dict[str, float]], compensator: str | None = None, noise: bool = True
    ) -> list[tuple[Outcome, Outcome | None]]:
        """Evaluate one set of gains per task on fresh scenarios, which training does not use.

        `compensator` replaces the tasks' compensator. `noise=False` removes the sensor noise.

        Returns:
            Two outcomes for each task. The first contains the fresh scenarios and, as its last element, the
            nominal run. The second contains each fresh scenario with its probes (perturbed copies), as arrays
            (contacts, scenarios, `LANES_PER_SCENARIO`); it is None for tasks without probes.
        """
        model, loop = self.tasks[0].model, self.loop
        if compensator is not None:
            loop = model.with_compensator(loop, compensator)
        values = {name: np.repeat([task[name] for task in gains], self.lanes) for name in gains[0]}
        outcome = model.begin_batch(loop, values, self._evaluated_batch if noise else self._noiseless_batch)()
        outcomes = split_batch(outcome, self.lanes)
        self.work.report_runs(self.lanes * len(self.tasks))
        if not self.tasks[0].probed:
            return [(outcome, None) for outcome in outcomes]

        def plain(leaf):
            return np.concatenate([leaf[..., :-1:LANES_PER_SCENARIO], leaf[..., -1:]], axis=-1)

        def with_probes(leaf):
            return leaf[..., :-1].reshape(*leaf.shape[:-1], -1, LANES_PER_SCENARIO)

        return [(jax.tree.map(plain, leaves), jax.tree.map(with_probes, leaves)) for leaves in outcomes]

    def losses(
        self,
        objective: Objective | Sequence[Objective],
        which: list[int],
        coordinates: Float[np.ndarray, "which points gains"],
        scenarios: int | None = None,
        lanes: int = 0,
    ) -> Float[np.ndarray, "which points"]:
        """Evaluate the objective for gains in unit coordinates, on training scenarios of the tasks `which`.

        `coordinates` are gains, scaled to 0..1. `objective` is common to all tasks, or a list with one per
        task. Only the first `scenarios` training scenarios of each task are used; this number includes probes
        (perturbed copies of scenarios). Each batch is padded to at least `lanes` lanes.
        """
        objectives = list_objectives(objective, len(self.tasks))
        noise = any(objectives[task].noise_weight > 0 for task in which)
        number = count_lanes(self.training)
        number = min(scenarios or number, number)
        points = coordinates.shape[1]
        losses = np.empty((len(which), points))
        lanes = max(lanes, self.lanes * len(self.tasks))
        at_once = max(1, lanes // number)
        # All calls have the same number of points per task, so that they use the same scenarios in device
        # memory.
        tasks_per_call = min(len(which), at_once)
        points_per_call = at_once // tasks_per_call
        calls = [
            (slice(first, first + tasks_per_call), slice(point, point + points_per_call))
            for first in range(0, len(which), tasks_per_call)
            for point in range(0, points, points_per_call)
        ]
        # All calls are queued first, so that the devices compute while the host reads results.
        read = _keep_contact_terms if objectives[which[0]].function is None else _keep_outcome
        running = [
            self._begin(noise, which[rows], coordinates[rows, columns], number, lanes, read)
            for rows, columns in calls
        ]
        for (rows, columns), result in zip(calls, running, strict=True):
            outcome, amplification = result()
            outcome = self.tasks[0].model.select_verdict_error(outcome)
            shape, pairs = amplification.shape, amplification.size
            self.work.report_runs(pairs * number)
            # arrays (contacts, tasks, points, scenarios)
            terms = [term.reshape(-1, *shape, number) for term in compute_contact_terms(outcome)]
            is_scheduled = outcome.is_scheduled.reshape(terms[0].shape)
            probes = mask_probes(number) & self.tasks[0].probed
            values = self._evaluate_function(objectives[which[0]], outcome, pairs)
            for index, task in enumerate(which[rows]):
                mask = is_scheduled[:, index, 0]  # the scheduled contacts are the same at every point
                error, excess, chatter = (np.moveaxis(term[:, index], 1, 0) for term in terms)
                losses[rows.start + index, columns] = evaluate_objective(
                    objectives[task],
                    error[:, mask & ~probes],
                    excess[:, mask],
                    amplification[index],
                    chatter[:, mask],
                    error[:, mask & probes] if self.tasks[0].probed else None,
                    None if values is None else values.reshape(shape)[index],
                )
        return losses

    def _evaluate_function(
        self, objective: Objective, outcome: Outcome, pairs: int
    ) -> Float[np.ndarray, "pairs"] | None:
        """Evaluate the user's objective function, if there is one, for each pair of task and gains."""
        if objective.function is None:
            return None
        task = self.tasks[0]
        return objective.function.numbers(
            extract_scenario_metrics(outcome, pairs, task.contacts, task.probed)
        )

    def _begin(
        self, noise, which, coordinates, number, lanes, read
    ) -> Callable[[], tuple[Outcome, Float[np.ndarray, "which points"]]]:
        """Start to evaluate several sets of gains for each task; return a function that waits for the end.

        This function returns the part of the outcome that `read` selects, and the noise amplification of each
        set of gains.
        """
        gains = [self._gains(task, points) for task, points in zip(which, coordinates, strict=True)]
        names = self.tasks[0].literature
        values = {name: np.repeat([task_gains[name] for task_gains in gains], number) for name in names}
        shape = coordinates.shape[:2]
        scenarios, batch = self._placed(tuple(which), shape[1], number, lanes)
        ended = self.tasks[0].model.begin_batch(self.loop, values, batch, read)
        if not noise:
            return lambda: (ended(), np.ones(shape))
        # A point's amplification is the mean over its scenarios, as in `gains.objective.compute_residuals`.
        constants = KnownConstants(
            jax.numpy.asarray(scenarios.control_period), jax.numpy.asarray(scenarios.clearance)
        )
        arrays: Any = {name: jax.numpy.asarray(value) for name, value in values.items()}
        amplification = np.asarray(self.loop.compensator.noise_amplification(arrays, constants))
        return lambda: (ended(), np.mean(amplification.reshape(*shape, number), axis=-1))

    @cached_property
    def _evaluated_batch(self) -> Batch:
        # A small batch is padded to the number of training lanes, so that both batches share a program.
        return self.tasks[0].model.place_batch(self.evaluated, count_lanes(self.training), self.loop)

    @cached_property
    def _noiseless_batch(self) -> Batch:
        # The noise is multiplied by 0, so that runs with and without noise share a program.
        model = self.tasks[0].model
        return model.place_batch(model.without_noise(self.evaluated), count_lanes(self.training), self.loop)

    @cached_property
    def _placed(self) -> Callable[[tuple[int, ...], int, int, int], tuple[Any, Batch]]:
        """Return a function that places training scenarios and caches them, because searches reuse them."""
        model, loop = self.tasks[0].model, self.loop
        return lru_cache(maxsize=4)(partial(_place_training_scenarios, model, loop, self.training))

    def gains(self, task: int, coordinates: Float[np.ndarray, "gains"]) -> dict[str, float]:
        """Return all gains of a task's compensator; `coordinates` are the tuned ones, scaled to 0..1."""
        return {name: float(gain) for name, gain in self._gains(task, coordinates).items()}

    def _gains(
        self, task: int, coordinates: Float[np.ndarray, "*points gains"]
    ) -> dict[str, Float[np.ndarray, "*points"]]:
        return convert_to_gains(self.tasks[task], self.names, self.bounds[task], coordinates)

    def coordinates(
        self, task: int, several: Sequence[Mapping[str, float]]
    ) -> Float[np.ndarray, "several gains"]:
        gains = np.array([[values[name] for name in self.names] for values in several])
        return to_coordinates(gains.reshape(len(several), len(self.names)), self.bounds[task])


def _keep_outcome(outcome: Outcome) -> Outcome:
    return outcome


def _keep_contact_terms(outcome: Any) -> Any:
    """Keep the fields of an outcome that `compute_contact_terms` needs; replace all other fields by None."""
    return outcome._replace(metrics=None, reference_restitution=None, reference_peak_force=None)


def _place_training_scenarios(
    model: RigModel, loop: Any, training: Any, which: tuple[int, ...], points: int, number: int, lanes: int
) -> tuple[Any, Batch]:
    """Repeat the first training scenarios of each task per point; return host arrays and a device batch."""

    def side_by_side(leaf):
        picked = np.moveaxis(leaf[np.repeat(which, points)][..., :number], 0, -2)
        return picked.reshape(*picked.shape[:-2], picked.shape[-2] * picked.shape[-1])

    scenarios = jax.tree.map(side_by_side, training)
    return scenarios, model.place_batch(scenarios, lanes, loop)


def build_validation(
    tasks: list[TuneTask], scenarios: int, seed: int, work: SearchProgress | None = None
) -> Validation:
    """Build the evaluator of tasks that share a compiled program, with `scenarios` new scenarios per task.

    Ideal contacts do not depend on the gains, so they are computed only once, here.
    """
    drawn = [_draw_evaluation_lanes(task, scenarios, seed + VALIDATION_SEED_OFFSET) for task in tasks]
    fresh, probed, evaluated, loops = (list(column) for column in zip(*drawn, strict=True))
    batches = tasks[0].model.with_ideal_contacts([*evaluated, *[task.scenarios for task in tasks]])
    evaluated, training = batches[: len(tasks)], batches[len(tasks) :]
    tasks = [replace(task, scenarios=batch) for task, batch in zip(tasks, training, strict=True)]
    names = list_tuned_gains(tasks)
    return Validation(
        tasks=tasks,
        fresh=fresh,
        probed=probed,
        loop=join_loops(loops),
        names=names,
        bounds=[build_gain_bounds(task, names) for task in tasks],
        evaluated=join_batches(evaluated),
        training=jax.tree.map(
            lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]),
            *training,
        ),
        lanes=count_evaluated_runs(scenarios, tasks[0].probed),
        work=work or SearchProgress(),
    )


def count_evaluated_runs(scenarios: int, probed: bool) -> int:
    """Count the runs for a set of gains: scenarios, their perturbed copies if `probed`, and a nominal run."""
    return scenarios * (LANES_PER_SCENARIO if probed else 1) + 1


def split_nominal(outcome: Outcome) -> tuple[Any, Any]:
    """Split an outcome into the outcomes of the fresh scenarios and of the nominal run (the last lane)."""
    fresh, nominal = (
        jax.tree.map(lambda leaf, part=part: leaf[..., part], outcome)
        for part in (slice(-1), slice(-1, None))
    )
    return fresh, nominal


def draw_fresh_scenarios(task: TuneTask, number: int, seed: int) -> Any:
    """Draw `number` new scenarios of a task, different from its training scenarios."""
    seed += VALIDATION_SEED_OFFSET
    return task.model.scenarios(task.mechanism, draw(task.mechanism, number, seed), seed)


def _draw_evaluation_lanes(
    task: TuneTask, number: int, seed: int
) -> tuple[Any, ProbedScenarios | None, Any, Any]:
    """Draw the scenarios on which the gains of a task are evaluated.

    Return the fresh scenarios; the same scenarios with probes (perturbed copies), or None; all lanes to
    evaluate, which include the nominal run; and the static properties of the simulated loop.
    """
    drawn = draw(task.mechanism, number, seed)
    fresh, probed = task.model.scenarios(task.mechanism, drawn, seed), None
    if task.probed and isinstance(task.mechanism, Mechanism):
        probed = build_probed_scenarios(task.mechanism, drawn, seed)
        nominal = build_probed_scenarios(task.mechanism).scenarios
        evaluated = join_batches([probed.scenarios, jax.tree.map(lambda leaf: leaf[..., :1], nominal)])
    else:
        evaluated = join_batches([fresh, task.model.scenarios(task.mechanism)])
    if task.common is None:
        both = join_batches([evaluated, task.scenarios])
        return fresh, probed, evaluated, task.model.loop(task.mechanism, task.compensator, both, chatter=True)
    assert isinstance(task.mechanism, Mechanism)
    loop = task.common.loop(task.model.loop(task.mechanism, task.compensator, evaluated, chatter=True))
    return fresh, probed, task.common.scenarios(task.mechanism, evaluated), loop
