"""Solving many tasks from many starts: a short round for all, further ones for what is worth it.

A start of a task is a problem. One compiled program takes a fixed number of problems at a time; hard ones do
not hold up easy ones, since every round deals out anew what has not converged. After the first round only the
most promising starts of a task go on.
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
TILE = 64  # lanes computed side by side on a device: more leave the cache
FIRST_ROUND = 8  # steps
PROMISING = 3  # starts of a task that go on after the first round
LONGEST = 32  # steps of one call
ENOUGH = 0.005  # by which a start with probes gets better in a round that is not its last
STEP_LIMIT = STATUSES.index("step limit")
GIVEN_UP = "given up"


class Start(NamedTuple):
    """One start of the solve."""

    status: str  # how it ended
    steps: int  # of the solver
    rms: float  # value of the objective it ended with (its norm, see `tuning.gains.objective`)
    history: list[float]  # that value after every step
    gains: dict[str, float]  # all of the compensator's
    coordinates: np.ndarray = np.empty(0)  # unit coordinates of the gains that are tuned for any of the tasks
    curvature: np.ndarray = np.empty((0, 0))  # J^T J by those, J the residuals' Jacobian


class _Advanced(NamedTuple):
    """What a round made of a start."""

    coordinates: np.ndarray  # unit coordinates
    curvature: np.ndarray  # J^T J there
    loss: float  # there
    history: np.ndarray  # loss after every step
    status: int  # index into `STATUSES`


@dataclasses.dataclass
class _Problem:
    """A start on its way."""

    task: int  # index of its task
    coordinates: np.ndarray  # unit coordinates now
    curvature: np.ndarray  # J^T J there
    status: int | str = STEP_LIMIT  # index into `STATUSES`, or why it was given up
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
    """Every start of every task; the tasks are alike (`tuning.gains.tasks.alike`). `starts` are coordinates
    of the ranges of those gains that are tuned for any of the tasks; none ends worse than it began.

    `objective` is that of all tasks, or one of each, which differ by their weights alone: tasks may be the
    same but for it. Every round is a step of the `work`.
    """
    work = work or Work()
    names = tuned_names(tasks)
    bounds = [gain_bounds(task, names) for task in tasks]
    nothing = np.zeros((len(names), len(names)))
    problems = [
        _Problem(index, coordinates, nothing) for index, own in enumerate(starts) for coordinates in own
    ]
    objectives = one_each(objective, len(tasks))
    # As many as if every task had as many starts: where few go on, the same program serves.
    advance = _stepper(tasks, names, bounds, objectives, len(tasks) * max(map(len, starts)), work)
    # Neighbours in a call take about as long.
    order = np.argsort(
        [-float(np.max(task.model.expected_duration(task.scenarios))) for task in tasks], kind="stable"
    )
    rank = {int(task): place for place, task in enumerate(order)}
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
        for problem, one in zip(going, advanced, strict=True):
            _take(problem, one)
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
    """Those whose value hardly fell in the round have converged: the scenarios decide about the rest."""
    for problem, loss in zip(problems, before, strict=True):
        if problem.status == STEP_LIMIT and problem.loss > (1 - ENOUGH) ** 2 * loss:
            problem.status = STATUSES.index("converged")


def _give_up(problems: list[_Problem]) -> None:
    """Leave each task its most promising starts."""
    by_task: dict[int, list[_Problem]] = {}
    for problem in problems:
        by_task.setdefault(problem.task, []).append(problem)
    for own in by_task.values():
        for problem in sorted(own, key=lambda problem: problem.loss)[PROMISING:]:
            if problem.status == STEP_LIMIT:
                problem.status = GIVEN_UP


def inverse_hessian(
    curvature: Float[np.ndarray, "gains gains"], value: float
) -> Float[np.ndarray, "gains gains"]:
    """That of the value of the objective, over it, from J^T J of the loss; widths at most a quarter of the
    box: the shape of the region in which the value rises by little."""
    # Where derivatives overflow, nothing is known of the shape.
    curvature = np.where(np.all(np.isfinite(curvature)), curvature, 0.0)
    loss = (value / SCALE) ** 2 / 2
    return np.linalg.inv(curvature / (2 * max(loss, 1e-12)) + 16 * np.eye(len(curvature)))


def _finished(problem: _Problem, names: tuple[str, ...], bounds: Bounds, task: TuneTask) -> Start:
    history = [float(value) for value in SCALE * np.sqrt(2 * np.array(problem.history))]
    status = problem.status if isinstance(problem.status, str) else STATUSES[problem.status]
    found = gains_at(task, names, bounds, problem.coordinates)
    gains = {name: float(gain) for name, gain in found.items()}
    return Start(status, len(history), history[-1], history, gains, problem.coordinates, problem.curvature)


def prepare_solver(
    tasks: list[TuneTask], starts: int, objective: Objective | Sequence[Objective] = RMS
) -> None:
    """Compile what `solve_tasks` will run, into the compile cache."""
    names = tuned_names(tasks)
    bounds = [gain_bounds(task, names) for task in tasks]
    nothing = np.zeros(len(names))
    problems = [_Problem(index, nothing, nothing) for index in range(len(tasks)) for _ in range(starts)]
    static, call = _calls(tasks, names, bounds, one_each(objective, len(tasks)), len(problems))
    some = problems[: _size(len(problems))]
    program_cache.prepare(_advance, static, call(some, 1), _folder(tasks))


def _stepper(tasks, names, bounds, objectives, number, work: Work):
    """A function that tells of problems where up to so many steps further lead."""
    static, call = _calls(tasks, names, bounds, objectives, number)
    size, runs, folder = _size(number), step_runs(tasks, names), _folder(tasks)

    def advance(problems: list[_Problem], limit: int) -> list[_Advanced]:
        advanced = []
        for begin in range(0, len(problems), size):
            some = problems[begin : begin + size]
            solution = jax.device_get(program_cache.run(_advance, static, call(some, limit), folder))
            places = np.argsort(sharded(size))[: len(some)]
            advanced += [_advanced(solution, int(place)) for place in places]
            work.ran(runs * sum(len(one.history) for one in advanced[begin:]))
        return advanced

    return advance


def _folder(tasks: list[TuneTask]) -> Any:
    """Where programs are kept; nowhere with contact laws whose sources are not known."""
    return None if any(_has_foreign_law(task.scenarios) for task in tasks) else program_folder()


def _has_foreign_law(scenarios: Any) -> bool:
    """Return whether six-axis scenarios, which carry their contact laws, have a user-registered one."""
    groups = getattr(scenarios, "groups", ())
    return any(not type(group.law).__module__.startswith("jaxhil.") for group in groups)


def step_runs(tasks: list[TuneTask], names: tuple[str, ...]) -> int:
    """Simulated runs that a step of one start takes."""
    return (1 + len(names)) * tasks[0].lanes


def _size(number: int) -> int:
    """Problems in one call, of so many in all."""
    return FEW if number <= FEW else MANY


def sharded(size: int) -> np.ndarray:
    """Which problem is in each place of a call: in turn for each device, whose places are side by side, so
    that all of them have as many of the long ones."""
    devices = math.gcd(jax.device_count(), size)
    return np.arange(size).reshape(-1, devices).T.ravel()


def _calls(tasks, names, bounds, objectives, number):
    """Static part and, as a function of some problems and a number of steps, arguments of the program."""
    loop = common_loop([task.loop for task in tasks])
    fixed = [{k: v for k, v in task.literature.items() if k not in names} for task in tasks]
    weights = [one.weights for one in objectives]
    each = [(_in_order(t), f, w, b) for t, f, w, b in zip(tasks, fixed, weights, bounds, strict=True)]
    table = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *each)
    size = _size(number)
    lanes = tasks[0].lanes
    terms = common_terms(objectives, tasks[0].probed, tasks[0].contacts)
    static = (tasks[0].model, loop, names, terms), LONGEST, max(1, TILE // lanes)

    def call(some: list[_Problem], limit: int):
        places = sharded(size)
        # Nothing runs in the places that only fill the call.
        filled = [some[i] if i < len(some) else some[0] for i in places]
        idle = places[:, None] >= len(some)
        index = np.array([p.task for p in filled])
        starts = np.stack([p.coordinates for p in filled])
        scenarios, others, weighed, limits = jax.tree.map(itemgetter(index), table)
        return tasks[0].model.at_rest(scenarios, idle), others, weighed, limits, starts, np.array(limit)

    return static, call


def _in_order(task: TuneTask) -> Any:
    """The task's scenarios. Where each has its probes, those that take as long are neighbours."""
    if not task.probed:
        return task.scenarios
    # That is made of how long the contacts take.
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


def _take(problem: _Problem, one: _Advanced) -> None:
    before = problem.history[-1] if problem.history else np.inf
    problem.history.extend(np.minimum.accumulate(np.append(before, one.history))[1:].tolist())
    problem.status = one.status
    # A round begins anew with cautious steps; none of them is worse than where it began.
    if np.isfinite(one.loss):
        problem.coordinates, problem.curvature = np.clip(one.coordinates, 0, 1), one.curvature


def _advance(static: tuple[Any, int, int], arguments: Any) -> Solution:
    # Takes long to import, and a kept program needs none of it.
    from tuning.optimisation.levenberg_marquardt import solve

    what, longest, tile = static
    model, loop, *_ = what
    scenarios, fixed, weights, bounds, starts, limit = arguments

    rigs = jax.vmap(lambda scenarios: model.prepared(loop, scenarios))(scenarios)
    problems = Problem(rigs, fixed, weights)
    return solve(residuals, what, problems, bounds, starts, limit, longest=longest, tile=tile)
