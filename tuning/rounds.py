"""Solving many tasks from many starts: a short round for all, further ones for what is worth it.

A start of a task is a problem. One compiled program takes a fixed number of problems at a time; hard ones do
not hold up easy ones, since every round deals out anew what has not converged. After the first round only the
most promising starts of a task go on.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxhil.evaluation import expected_duration, parameters_by_slot
from jaxhil.loop import Loop, build_rig
from jaxhil.scenario import Scenario
from tuning import programs
from tuning.environment import program_folder
from tuning.objective import RMS, SCALE, Objective, Problem, common_terms, residuals
from tuning.optimiser import STATUSES, Bounds, Solution, solve
from tuning.problems import Task, common_loop, gain_bounds, spread_starts, tuned_names

FEW, MANY = 4, 32  # problems in one call of the program
TILE = 128  # lanes computed side by side on a device: more leave the cache
FIRST_ROUND = 8  # steps
PROMISING = 3  # starts of a task that go on after the first round
LONGEST = 32  # steps of one call
CONVERGED, STEP_LIMIT, NOT_FINITE = STATUSES.index("converged"), STATUSES.index("step limit"), 2
GIVEN_UP = "given up"

# In training a contact that takes longer than this many times its undelayed duration, and so many
# seconds more, has failed.
PATIENCE = 2.0
SHORTEST_PATIENCE = 0.15  # s


class Start(NamedTuple):
    """One start of the solve: status, steps, value of the objective (its norm, `tuning.objective`) it ended
    with and had after every step, and its gains."""

    status: str
    steps: int
    rms: float
    history: list[float]
    gains: dict[str, float]


@dataclasses.dataclass
class _Problem:
    """A start on its way: gains now, loss after every step so far; the gains it was told to begin at."""

    task: int
    gains: np.ndarray
    told: np.ndarray | None = None
    status: int | str = STEP_LIMIT
    history: list[float] = dataclasses.field(default_factory=list)

    @property
    def loss(self) -> float:
        return self.history[-1] if self.history and np.isfinite(self.history[-1]) else np.inf


def solve_tasks(
    tasks: list[Task],
    starts: int,
    steps: int,
    seed: int,
    objective: Objective | Sequence[Objective] = RMS,
    report: Callable[[str], None] = lambda text: None,
    first: Sequence[Sequence[Mapping[str, float]]] = (),
) -> list[list[Start]]:
    """Every start of every task; the tasks are alike (`tuning.problems.alike`).

    `objective` is that of all tasks, or one of each, which differ by their weights alone: tasks may be the
    same but for it. `first` has, of each task, gains within its bounds to begin at: they take the places of
    its last starts, and none of these starts ends worse than at the very gains.
    """
    names = tuned_names(tasks)
    bounds = [gain_bounds(task, names) for task in tasks]
    problems = []
    for index, task in enumerate(tasks):
        literature = np.array([task.literature[name] for name in names])
        told = [np.array([gains[name] for name in names]) for gains in (first[index] if first else ())]
        others = starts - len(told)
        if others > 0:
            spread = spread_starts(literature, bounds[index], others, seed)
            problems.extend(_Problem(index, gains) for gains in spread)
        problems.extend(_Problem(index, gains, told=gains) for gains in told)
    objectives = [objective] * len(tasks) if isinstance(objective, Objective) else list(objective)
    advance = _stepper(tasks, names, bounds, objectives, len(problems))
    # Neighbours in a call take about as long.
    order = np.argsort([-float(np.max(expected_duration(task.scenarios))) for task in tasks], kind="stable")
    rank = {int(task): place for place, task in enumerate(order)}
    problems.sort(key=lambda problem: rank[problem.task])
    done = 0
    while done < steps:
        going = [problem for problem in problems if problem.status == STEP_LIMIT]
        if not going:
            break
        several = done == 0 and starts > PROMISING
        limit = min(steps - done, FIRST_ROUND if several else LONGEST)
        report(f"{len(going)} of {len(problems)} starts, {limit} steps")
        advance(going, limit)
        done += limit
        if done < steps:
            _give_up(problems)
    _take_back(problems, tasks, names, objectives)
    return [
        [_finished(p, names, tasks[index]) for p in problems if p.task == index]
        for index in range(len(tasks))
    ]


def _give_up(problems: list[_Problem]) -> None:
    """Leave each task its most promising starts."""
    by_task: dict[int, list[_Problem]] = {}
    for problem in problems:
        by_task.setdefault(problem.task, []).append(problem)
    for own in by_task.values():
        for problem in sorted(own, key=lambda problem: problem.loss)[PROMISING:]:
            if problem.status == STEP_LIMIT:
                problem.status = GIVEN_UP


def _take_back(problems: list[_Problem], tasks, names, objectives) -> None:
    """Put what ended worse than at the gains it was told to begin at back to them.

    The solver works strictly inside the bounds: it begins beside gains that lie on one.
    """
    told = [problem for problem in problems if problem.told is not None]
    if not told:
        return
    # A gain whose bounds are equal is what they are: so the program that solves can tell the loss at a point.
    points = [_Problem(index, np.asarray(problem.told)) for index, problem in enumerate(told)]
    pinned = [Bounds(point.gains, point.gains, np.zeros(len(names))) for point in points]
    own = [problem.task for problem in told]
    advance = _stepper([tasks[i] for i in own], names, pinned, [objectives[i] for i in own], len(problems))
    advance(points, 1)
    for problem, point in zip(told, points, strict=True):
        if point.loss < problem.loss:
            problem.gains, problem.history[-1] = point.gains, point.loss


def _finished(problem: _Problem, names: tuple[str, ...], task: Task) -> Start:
    moved = {gain.name for gain in task.tuned}
    found = {name: float(gain) for name, gain in zip(names, problem.gains, strict=True) if name in moved}
    history = [float(value) for value in SCALE * np.sqrt(2 * np.array(problem.history))]
    status = problem.status if isinstance(problem.status, str) else STATUSES[problem.status]
    return Start(status, len(history), history[-1], history, {**task.literature, **found})


def _stepper(tasks, names, bounds, objectives, number) -> Callable[[list[_Problem], int], None]:
    """A function that takes problems up to so many steps further."""
    loop = common_loop([task.loop for task in tasks])
    fixed = [{k: v for k, v in task.literature.items() if k not in names} for task in tasks]
    weights = [one.weights for one in objectives]
    each = [(t.scenarios, f, b, w) for t, f, b, w in zip(tasks, fixed, bounds, weights, strict=True)]
    table = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *each)
    size = FEW if number <= FEW else MANY
    lanes = len(tasks[0].scenarios.velocity)
    static = (loop, names, common_terms(objectives)), LONGEST, max(1, TILE // lanes)

    def advance(problems: list[_Problem], limit: int) -> None:
        for begin in range(0, len(problems), size):
            some = problems[begin : begin + size]
            index = np.array([p.task for p in some] + [some[0].task] * (size - len(some)))
            starts = np.stack([p.gains for p in some] + [some[0].gains] * (size - len(some)))
            scenarios, others, limits, weighed = jax.tree.map(itemgetter(index), table)
            # Nothing runs in the lanes that only fill the call.
            idle = np.arange(size)[:, None] >= len(some)
            contacts = np.where(idle, 0, scenarios.contacts).astype(np.int32)
            scenarios = scenarios._replace(contacts=contacts)
            arguments = scenarios, others, weighed, limits, starts, np.array(limit)
            solution = jax.device_get(programs.run(_advance, static, arguments, program_folder()))
            for i, problem in enumerate(some):
                _take(problem, solution, i)

    return advance


def _take(problem: _Problem, solution: Solution, i: int) -> None:
    taken = int(solution.steps[i])
    before = problem.history[-1] if problem.history else np.inf
    losses = np.minimum.accumulate(np.append(before, np.asarray(solution.history[i])[: max(taken, 1)]))[1:]
    problem.history.extend(float(loss) for loss in losses)
    problem.status = int(solution.status[i])
    # A round begins anew with cautious steps; none of them is worse than where it began.
    if np.isfinite(solution.loss[i]):
        problem.gains = np.asarray(solution.gains[i])


def _advance(static: tuple[Any, int, int], arguments: Any) -> Solution:
    what, longest, tile = static
    loop = what[0]
    scenarios, fixed, weights, bounds, starts, limit = arguments

    def rig(scenarios):
        return build_rig(loop, scenarios._replace(time_limit=_patience(loop, scenarios)))

    problems = Problem(jax.vmap(rig)(scenarios), fixed, weights)
    return solve(residuals, what, problems, bounds, starts, limit, longest=longest, tile=tile)


def _patience(loop: Loop, scenarios: Scenario) -> Array:
    """How long [s] a contact may take in training before it has failed: some of its undelayed durations."""
    shape = scenarios.phase.shape
    mass = jnp.broadcast_to(scenarios.equivalent_mass, shape)
    velocity = jnp.broadcast_to(scenarios.velocity, shape)
    reference = loop.law.reference(parameters_by_slot(scenarios.contact), mass, velocity)
    longest = PATIENCE * jnp.max(reference.duration, axis=0) + SHORTEST_PATIENCE
    return jnp.minimum(longest, scenarios.time_limit)
