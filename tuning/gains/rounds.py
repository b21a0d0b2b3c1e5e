"""Solution of many tasks from many starts, in rounds of solver steps.

A start of a task is a problem. One compiled program solves a fixed number of problems per call. Every round
distributes the problems that have not converged to calls again, so that hard ones do not delay easy ones.
After the first, short round only the most promising starts of a task continue.
"""

import dataclasses
import math
from collections.abc import Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxhil.simulation.environment import program_folder
from tuning.caches import program_cache
from tuning.gains.objective import RMS, SCALE, Objective, Problem, common_terms, one_each, residuals
from tuning.gains.tasks import TuneTask, common_loop, gain_bounds, gains_at, tuned_names
from tuning.gains.work import Work
from tuning.optimisation.solution import STATUSES, Solution
from tuning.optimisation.unit_box import Bounds
from tuning.transparency.probes import LANES_PER_SCENARIO

FEW, MANY = 4, 32  # problems in one call of the program
TILE = 64  # lanes computed together on a device; more exceed the processor's cache
FIRST_ROUND = 8  # steps of the first round
PROMISING = 3  # starts of a task that continue after the first round
LONGEST = 32  # largest number of steps of one call
ENOUGH = 0.005  # relative improvement in a round below which a start with probes counts as converged
STEP_LIMIT = STATUSES.index("step limit")
GIVEN_UP = "given up"


class Start(NamedTuple):
    """Result of one start of the solver."""

    status: str  # why the solver stopped
    steps: int  # steps of the solver
    rms: float  # final value of the objective (its norm, see `tuning.gains.objective`)
    history: list[float]  # value of the objective after every step
    gains: dict[str, float]  # all gains of the compensator
    coordinates: np.ndarray = np.empty(0)  # unit coordinates of the gains that are tuned for any of the tasks
    curvature: np.ndarray = np.empty((0, 0))  # J^T J, J the Jacobian of the residuals by the coordinates


class _Advanced(NamedTuple):
    """State of a start after a round."""

    coordinates: np.ndarray  # unit coordinates
    curvature: np.ndarray  # J^T J at the coordinates
    loss: float  # loss at the coordinates
    history: np.ndarray  # loss after every step
    status: int  # index into `STATUSES`


@dataclasses.dataclass
class _Problem:
    """State of one start during the solution."""

    task: int  # index of its task
    coordinates: np.ndarray  # current unit coordinates
    curvature: np.ndarray  # J^T J at the coordinates
    status: int | str = STEP_LIMIT  # index into `STATUSES`, or `GIVEN_UP`
    history: list[float] = dataclasses.field(default_factory=list)  # loss after every step

    @property
    def loss(self) -> float:
        return self.history[-1] if self.history and np.isfinite(self.history[-1]) else np.inf


def solve_tasks(
    tasks: list[TuneTask],
    starts: list[Float[np.ndarray, "starts gains"]],
    steps: int,
    objective: Objective | Sequence[Objective] = RMS,
    work: Work | None = None,
) -> list[list[Start]]:
    """Solve like tasks (`tuning.gains.tasks.alike`) from every start; return the results task by task.

    `starts` holds, per task, unit coordinates of the gains that are tuned for any of the tasks. No start ends
    worse than it began. `objective` is one of all tasks or one per task; these differ by their weights only.
    Every round is a step of the `work`.
    """
    work = work or Work()
    names = tuned_names(tasks)
    bounds = [gain_bounds(task, names) for task in tasks]
    nothing = np.zeros((len(names), len(names)))
    problems = [
        _Problem(index, coordinates, nothing) for index, points in enumerate(starts) for coordinates in points
    ]
    objectives = one_each(objective, len(tasks))
    # The call's size is that of the first round, so that later rounds with fewer problems use its program.
    advance = _stepper(tasks, names, bounds, objectives, len(tasks) * max(map(len, starts)), work)
    # Sorted by expected duration, problems of one call take about equally long.
    order = np.argsort(
        [-float(np.max(task.model.expected_duration(task.scenarios))) for task in tasks], kind="stable"
    )
    rank = {int(task): index for index, task in enumerate(order)}
    problems.sort(key=lambda problem: rank[problem.task])
    done, probed = 0, tasks[0].probed
    while done < steps:
        going = [problem for problem in problems if problem.status == STEP_LIMIT]
        if not going:
            break
        several = probed or (done == 0 and max(map(len, starts)) > PROMISING)
        limit = min(steps - done, FIRST_ROUND if several else LONGEST)
        work.say(f"{len(going)} of {len(problems)} starts, {limit} steps")
        before = [problem.loss for problem in going]
        advanced = work.step("round", list[_Advanced], lambda going=going, limit=limit: advance(going, limit))
        for problem, state in zip(going, advanced, strict=True):
            _take(problem, state)
        done += limit
        if probed and done > FIRST_ROUND:
            _settle(going, before)
        if done < steps and not probed:
            _give_up(problems)
    return [
        [_finished(p, names, bounds[index], tasks[index]) for p in problems if p.task == index]
        for index in range(len(tasks))
    ]


def _settle(problems: list[_Problem], before: list[float]) -> None:
    """Mark problems as converged whose value fell by less than `ENOUGH` in the round."""
    for problem, loss in zip(problems, before, strict=True):
        if problem.status == STEP_LIMIT and problem.loss > (1 - ENOUGH) ** 2 * loss:
            problem.status = STATUSES.index("converged")


def _give_up(problems: list[_Problem]) -> None:
    """Give up all but the `PROMISING` best starts of each task."""
    by_task: dict[int, list[_Problem]] = {}
    for problem in problems:
        by_task.setdefault(problem.task, []).append(problem)
    for of_task in by_task.values():
        for problem in sorted(of_task, key=lambda problem: problem.loss)[PROMISING:]:
            if problem.status == STEP_LIMIT:
                problem.status = GIVEN_UP


def inverse_hessian(
    curvature: Float[np.ndarray, "gains gains"], value: float
) -> Float[np.ndarray, "gains gains"]:
    """Return the inverse Hessian of the relative objective, from J^T J of the loss.

    It is the shape of the region in which the objective rises little, limited to a standard deviation of a
    quarter of the box.
    """
    # Where derivatives overflow, the shape is unknown.
    curvature = np.where(np.all(np.isfinite(curvature)), curvature, 0.0)
    loss = (value / SCALE) ** 2 / 2
    return np.linalg.inv(curvature / (2 * max(loss, 1e-12)) + 16 * np.eye(len(curvature)))


def _finished(problem: _Problem, names: tuple[str, ...], bounds: Bounds, task: TuneTask) -> Start:
    history = [float(value) for value in SCALE * np.sqrt(2 * np.array(problem.history))]
    status = problem.status if isinstance(problem.status, str) else STATUSES[problem.status]
    gains = {k: float(gain) for k, gain in gains_at(task, names, bounds, problem.coordinates).items()}
    return Start(status, len(history), history[-1], history, gains, problem.coordinates, problem.curvature)


def prepare_solver(
    tasks: list[TuneTask], starts: int, objective: Objective | Sequence[Objective] = RMS
) -> None:
    """Compile the program of `solve_tasks` into the compile cache."""
    names = tuned_names(tasks)
    bounds = [gain_bounds(task, names) for task in tasks]
    nothing = np.zeros(len(names))
    problems = [_Problem(index, nothing, nothing) for index in range(len(tasks)) for _ in range(starts)]
    static, call = _calls(tasks, names, bounds, one_each(objective, len(tasks)), len(problems))
    first = problems[: _size(len(problems))]
    program_cache.prepare(_advance, static, call(first, 1), _folder(tasks))


def _stepper(tasks, names, bounds, objectives, number, work: Work):
    """Return a function that advances problems by up to `limit` steps and returns their states."""
    static, call = _calls(tasks, names, bounds, objectives, number)
    size, runs, folder = _size(number), step_runs(tasks, names), _folder(tasks)

    def advance(problems: list[_Problem], limit: int) -> list[_Advanced]:
        advanced = []
        for begin in range(0, len(problems), size):
            members = problems[begin : begin + size]
            solution = jax.device_get(program_cache.run(_advance, static, call(members, limit), folder))
            positions = np.argsort(sharded(size))[: len(members)]
            advanced += [_advanced(solution, int(position)) for position in positions]
            work.ran(runs * sum(len(state.history) for state in advanced[begin:]))
        return advanced

    return advance


def _folder(tasks: list[TuneTask]) -> Any:
    """Return the folder of cached programs, None with user-registered contact laws."""
    return None if any(_has_user_law(task.scenarios) for task in tasks) else program_folder()


def _has_user_law(scenarios: Any) -> bool:
    """Return whether six-axis scenarios, which carry their contact laws, have a user-registered one."""
    groups = getattr(scenarios, "groups", ())
    return any(not type(group.law).__module__.startswith("jaxhil.") for group in groups)


def step_runs(tasks: list[TuneTask], names: tuple[str, ...]) -> int:
    """Return the number of simulated runs of one step of one start."""
    return (1 + len(names)) * tasks[0].lanes


def _size(number: int) -> int:
    """Return the number of problems in one call, for `number` problems in total."""
    return FEW if number <= FEW else MANY


def sharded(size: int) -> np.ndarray:
    """Return the index of the problem at each position of a call.

    Problems, sorted by duration, are dealt to the devices in turn; positions of a device are adjacent.
    """
    devices = math.gcd(jax.device_count(), size)
    return np.arange(size).reshape(-1, devices).T.ravel()


def _calls(tasks, names, bounds, objectives, number):
    """Return the program's static part, and a function of problems and steps that returns its arguments."""
    loop = common_loop([task.loop for task in tasks])
    fixed = [{k: v for k, v in task.literature.items() if k not in names} for task in tasks]
    weights = [objective.weights for objective in objectives]
    rows = [(_in_order(t), f, w, b) for t, f, w, b in zip(tasks, fixed, weights, bounds, strict=True)]
    table = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *rows)
    size = _size(number)
    lanes = tasks[0].lanes
    terms = common_terms(objectives, tasks[0].probed, tasks[0].contacts)
    static = (tasks[0].model, loop, names, terms), LONGEST, max(1, TILE // lanes)

    def call(members: list[_Problem], limit: int):
        order = sharded(size)
        # Positions that only fill the call hold copies of the first problem, and simulate nothing.
        filled = [members[i] if i < len(members) else members[0] for i in order]
        idle = order[:, None] >= len(members)
        index = np.array([p.task for p in filled])
        starts = np.stack([p.coordinates for p in filled])
        scenarios, *columns = jax.tree.map(itemgetter(index), table)
        return tasks[0].model.at_rest(scenarios, idle), *columns, starts, np.array(limit)

    return static, call


def _in_order(task: TuneTask) -> Any:
    """Return the task's scenarios, sorted by duration if they have probes, which run in chunks."""
    if not task.probed:
        return task.scenarios
    # The time limit is proportional to the duration of the contacts.
    longest = np.asarray(task.scenarios.time_limit)[::LANES_PER_SCENARIO]
    order = np.argsort(-longest, kind="stable")
    lanes = (LANES_PER_SCENARIO * order[:, None] + np.arange(LANES_PER_SCENARIO)).ravel()
    return jax.tree.map(lambda leaf: np.asarray(leaf)[..., lanes], task.scenarios)


def _advanced(solution: Solution, i: int) -> _Advanced:
    return _Advanced(
        np.asarray(solution.coordinates[i]),
        np.asarray(solution.curvature[i]),
        float(solution.loss[i]),
        np.asarray(solution.history[i])[: max(int(solution.steps[i]), 1)],
        int(solution.status[i]),
    )


def _take(problem: _Problem, state: _Advanced) -> None:
    before = problem.history[-1] if problem.history else np.inf
    problem.history.extend(np.minimum.accumulate(np.append(before, state.history))[1:].tolist())
    problem.status = state.status
    # Every round starts with cautious steps, none of which ends worse than it began.
    if np.isfinite(state.loss):
        problem.coordinates, problem.curvature = np.clip(state.coordinates, 0, 1), state.curvature


def _advance(static: tuple[Any, int, int], arguments: Any) -> Solution:
    # The import is slow, and a cached program does not need it.
    from tuning.optimisation.levenberg_marquardt import solve

    problem, longest, tile = static
    model, loop, *_ = problem
    scenarios, fixed, weights, bounds, starts, limit = arguments

    rigs = jax.vmap(lambda scenarios: model.prepared(loop, scenarios))(scenarios)
    problems = Problem(rigs, fixed, weights)
    return solve(residuals, problem, problems, bounds, starts, limit, longest=longest, tile=tile)
