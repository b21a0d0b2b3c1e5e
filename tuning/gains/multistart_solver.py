"""Gradient-based solution of many tuning tasks, each from several starts, in rounds of solver steps.

One start of one task is a problem. One call of the compiled program advances a fixed number of problems by a
round of steps. Each round distributes the unconverged problems to calls again, so that slow problems do not
delay fast ones. After the first, short round only the best starts of each task continue.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxhil.simulation import cached_programs
from jaxhil.simulation.tile_size import find_tile_size
from tuning.gains.objective import (
    RESIDUAL_SCALE,
    RMS_OBJECTIVE,
    Objective,
    SolverProblem,
    compute_residuals,
    join_terms,
    list_objectives,
)
from tuning.gains.search_progress import SearchProgress
from tuning.gains.tasks import TuneTask, build_gain_bounds, convert_to_gains, join_loops, list_tuned_gains
from tuning.optimisation.solution import SOLVER_STATUSES, SolverResult
from tuning.optimisation.unit_box import GainBounds
from tuning.transparency.probes import LANES_PER_SCENARIO

MIN_PROBLEMS_PER_CALL, MAX_PROBLEMS_PER_CALL = 4, 32  # limits of the number of problems per call
# Number of lanes that a processor's core computes together; more would exceed its cache.
LANES_PER_TILE = 64
STEPS_BEFORE_SELECTION = 8  # solver steps of the first round
MAX_CONTINUED_STARTS = 3  # number of starts per task that continue after the first round
MAX_STEPS_PER_CALL = 32  # largest number of solver steps in one call
# With probes, minimum relative improvement of the objective in a round; below it, a start has converged.
MIN_RELATIVE_IMPROVEMENT = 0.005
STEP_LIMIT = SOLVER_STATUSES.index("step limit")
GIVEN_UP = "given up"


class StartResult(NamedTuple):
    """Gains and objective that the solver reached from one start."""

    status: str  # reason why the solver stopped
    steps: int  # number of solver steps
    rms: float  # final objective [1], the smooth norm of `tuning.gains.objective`
    history: list[float]  # objective after every step [1]
    gains: dict[str, float]  # all gains of the compensator
    coordinates: np.ndarray = np.empty(0)  # unit coordinates of the gains that are tuned in at least one task
    # J^T J, where J is the Jacobian of the residuals with respect to the unit coordinates
    curvature: np.ndarray = np.empty((0, 0))


class _SolverState(NamedTuple):
    """State of the solver after a round of steps from one start."""

    coordinates: np.ndarray  # unit coordinates of the gains
    curvature: np.ndarray  # J^T J at the coordinates
    loss: float  # loss at the coordinates
    history: np.ndarray  # loss after every step
    status: int  # index into `SOLVER_STATUSES`


@dataclasses.dataclass
class _StartState:
    """Progress of the solver from one start, over all rounds."""

    task: int  # index of the task
    coordinates: np.ndarray  # current unit coordinates of the gains
    curvature: np.ndarray  # J^T J at the coordinates
    status: int | str = STEP_LIMIT  # index into `SOLVER_STATUSES`, or `GIVEN_UP`
    history: list[float] = dataclasses.field(default_factory=list)  # loss after every step

    @property
    def loss(self) -> float:
        return self.history[-1] if self.history and np.isfinite(self.history[-1]) else np.inf


def solve_tasks(
    tasks: list[TuneTask],
    starts: list[Float[np.ndarray, "starts gains"]],
    steps: int,
    objective: Objective | Sequence[Objective] = RMS_OBJECTIVE,
    work: SearchProgress | None = None,
) -> list[list[StartResult]]:
    """Run the solver from every start of tasks that share a program; return the results of each task.

    `starts` holds, for each task, unit coordinates of the gains that are tuned in at least one task. The
    final objective of a start never exceeds its first one. `objective` is common to all tasks, or a list with
    one per task; these may differ only in their weights. `work` saves a checkpoint after every round.
    """
    work = work or SearchProgress()
    names = list_tuned_gains(tasks)
    bounds = [build_gain_bounds(task, names) for task in tasks]
    nothing = np.zeros((len(names), len(names)))
    problems = [
        _StartState(index, coordinates, nothing)
        for index, points in enumerate(starts)
        for coordinates in points
    ]
    objectives = list_objectives(objective, len(tasks))
    # Every call has as many lanes as the first round needs, so that all rounds use one compiled program.
    advance = _build_stepper(tasks, names, bounds, objectives, len(tasks) * max(map(len, starts)), work)
    # After sorting by expected duration, the problems of one call take about equally long.
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
        several = probed or (done == 0 and max(map(len, starts)) > MAX_CONTINUED_STARTS)
        limit = min(steps - done, STEPS_BEFORE_SELECTION if several else MAX_STEPS_PER_CALL)
        work.say(f"{len(going)} of {len(problems)} starts, {limit} steps")
        before = [problem.loss for problem in going]
        advanced = work.step(
            "round", list[_SolverState], lambda going=going, limit=limit: advance(going, limit)
        )
        for problem, state in zip(going, advanced, strict=True):
            _update_start(problem, state)
        done += limit
        if probed and done > STEPS_BEFORE_SELECTION:
            _mark_converged(going, before)
        if done < steps and not probed:
            _stop_poor_starts(problems)
    return [
        [_build_result(p, names, bounds[index], tasks[index]) for p in problems if p.task == index]
        for index in range(len(tasks))
    ]


def _mark_converged(problems: list[_StartState], before: list[float]) -> None:
    """Mark a problem as converged if its objective fell by less than `MIN_RELATIVE_IMPROVEMENT` in a round.

    `before` holds the loss of each problem before the round.
    """
    for problem, loss in zip(problems, before, strict=True):
        if problem.status == STEP_LIMIT and problem.loss > (1 - MIN_RELATIVE_IMPROVEMENT) ** 2 * loss:
            problem.status = SOLVER_STATUSES.index("converged")


def _stop_poor_starts(problems: list[_StartState]) -> None:
    """Give up all but the `MAX_CONTINUED_STARTS` best starts of each task."""
    by_task: dict[int, list[_StartState]] = {}
    for problem in problems:
        by_task.setdefault(problem.task, []).append(problem)
    for of_task in by_task.values():
        for problem in sorted(of_task, key=lambda problem: problem.loss)[MAX_CONTINUED_STARTS:]:
            if problem.status == STEP_LIMIT:
                problem.status = GIVEN_UP


def compute_inverse_hessian(
    curvature: Float[np.ndarray, "gains gains"], value: float
) -> Float[np.ndarray, "gains gains"]:
    """Return the inverse Hessian of objective / `value` with respect to the gains' unit coordinates.

    `value` is the objective at the current gains. `curvature` is J^T J with the Jacobian J of the residuals.
    The inverse Hessian describes the region in which the objective rises little. No eigenvalue exceeds
    (1/4)^2: the standard deviation of a gain is at most a quarter of its range.
    """
    # If a derivative has overflowed, the curvature is unknown and replaced by 0.
    curvature = np.where(np.all(np.isfinite(curvature)), curvature, 0.0)
    loss = (value / RESIDUAL_SCALE) ** 2 / 2
    return np.linalg.inv(curvature / (2 * max(loss, 1e-12)) + 16 * np.eye(len(curvature)))


def _build_result(
    problem: _StartState, names: tuple[str, ...], bounds: GainBounds, task: TuneTask
) -> StartResult:
    history = [float(value) for value in RESIDUAL_SCALE * np.sqrt(2 * np.array(problem.history))]
    status = problem.status if isinstance(problem.status, str) else SOLVER_STATUSES[problem.status]
    gains = {k: float(gain) for k, gain in convert_to_gains(task, names, bounds, problem.coordinates).items()}
    return StartResult(
        status, len(history), history[-1], history, gains, problem.coordinates, problem.curvature
    )


def lower_solver(
    tasks: list[TuneTask], starts: int, objective: Objective | Sequence[Objective] = RMS_OBJECTIVE
) -> Callable[[], None]:
    """Lower the program of `solve_tasks`; return a function that compiles and caches it."""
    names = list_tuned_gains(tasks)
    bounds = [build_gain_bounds(task, names) for task in tasks]
    nothing = np.zeros(len(names))
    problems = [_StartState(index, nothing, nothing) for index in range(len(tasks)) for _ in range(starts)]
    static, call = _build_call(tasks, names, bounds, list_objectives(objective, len(tasks)), len(problems))
    first = problems[: _choose_call_size(len(problems))]
    return cached_programs.lower_cached(
        _solve_call, static, call(first, 1), options=tasks[0].model.derivative_options
    )


def _build_stepper(tasks, names, bounds, objectives, number, work: SearchProgress):
    """Return a function (problems, limit) that makes up to `limit` solver steps and returns new states."""
    static, call = _build_call(tasks, names, bounds, objectives, number)
    size, runs = _choose_call_size(number), count_step_runs(tasks, names)
    options = tasks[0].model.derivative_options

    def advance(problems: list[_StartState], limit: int) -> list[_SolverState]:
        advanced = []
        for begin in range(0, len(problems), size):
            members = problems[begin : begin + size]
            stepped = cached_programs.run_cached(_solve_call, static, call(members, limit), options=options)
            solution = jax.device_get(stepped)
            positions = np.argsort(assign_to_devices(size))[: len(members)]
            advanced += [_extract_state(solution, int(position)) for position in positions]
            work.report_runs(runs * sum(len(state.history) for state in advanced[begin:]))
        return advanced

    return advance


def count_step_runs(tasks: list[TuneTask], names: tuple[str, ...]) -> int:
    """Return the number of simulated runs in one solver step of one start."""
    return (1 + len(names)) * tasks[0].lanes


def _choose_call_size(number: int) -> int:
    return MIN_PROBLEMS_PER_CALL if number <= MIN_PROBLEMS_PER_CALL else MAX_PROBLEMS_PER_CALL


def assign_to_devices(size: int) -> np.ndarray:
    """Return an order (indices) of a call's problems, such that all devices need about equal times.

    The problems, which are sorted by duration, are assigned to the devices in turn. The problems of a device
    are adjacent in the returned order.
    """
    devices = math.gcd(jax.device_count(), size)
    return np.arange(size).reshape(-1, devices).T.ravel()


def _build_call(tasks, names, bounds, objectives, number):
    """Return the static arguments of `_solve_call`, and a function that builds the other arguments."""
    loop = join_loops([task.loop for task in tasks])
    fixed = [{k: v for k, v in task.literature.items() if k not in names} for task in tasks]
    weights = [objective.weights for objective in objectives]
    rows = [(_sort_by_duration(t), f, w, b) for t, f, w, b in zip(tasks, fixed, weights, bounds, strict=True)]
    table = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *rows)
    size = _choose_call_size(number)
    lanes = tasks[0].lanes
    terms = join_terms(objectives, tasks[0].probed, tasks[0].contacts)
    model, scenarios = tasks[0].model, tasks[0].scenarios
    # The Jacobian needs one more copy of the state for each gain, which the size of a tile must account for.
    tile = find_tile_size(
        size * lanes, LANES_PER_TILE, lambda: (1 + len(names)) * model.count_lane_bytes(loop, scenarios)
    )
    static = (model, loop, names, terms), MAX_STEPS_PER_CALL, max(1, tile // lanes)

    def call(members: list[_StartState], limit: int):
        order = assign_to_devices(size)
        # Unused places in the batch hold copies of the first problem, which are not simulated.
        filled = [members[i] if i < len(members) else members[0] for i in order]
        idle = order[:, None] >= len(members)
        index = np.array([p.task for p in filled])
        starts = np.stack([p.coordinates for p in filled])
        scenarios, *columns = jax.tree.map(itemgetter(index), table)
        return model.at_rest(scenarios, idle), *columns, starts, np.array(limit)

    return static, call


def _sort_by_duration(task: TuneTask) -> Any:
    """Return the task's scenarios, sorted by duration if they have probes.

    Scenarios with probes are simulated in groups (tiles). After sorting, all scenarios of a tile take a
    similar time.
    """
    if not task.probed:
        return task.scenarios
    # The time limit increases with the duration of the contacts.
    longest = np.asarray(task.scenarios.time_limit)[::LANES_PER_SCENARIO]
    order = np.argsort(-longest, kind="stable")
    lanes = (LANES_PER_SCENARIO * order[:, None] + np.arange(LANES_PER_SCENARIO)).ravel()
    return jax.tree.map(lambda leaf: np.asarray(leaf)[..., lanes], task.scenarios)


def _extract_state(solution: SolverResult, i: int) -> _SolverState:
    return _SolverState(
        np.asarray(solution.coordinates[i]),
        np.asarray(solution.curvature[i]),
        float(solution.loss[i]),
        np.asarray(solution.history[i])[: max(int(solution.steps[i]), 1)],
        int(solution.status[i]),
    )


def _update_start(problem: _StartState, state: _SolverState) -> None:
    before = problem.history[-1] if problem.history else np.inf
    problem.history.extend(np.minimum.accumulate(np.append(before, state.history))[1:].tolist())
    problem.status = state.status
    # No step of the solver increases the loss.
    if np.isfinite(state.loss):
        problem.coordinates, problem.curvature = np.clip(state.coordinates, 0, 1), state.curvature


def _solve_call(static: tuple[Any, int, int], arguments: Any) -> SolverResult:
    # This slow import is needed only if the program is not in the cache.
    from tuning.optimisation.levenberg_marquardt import solve_least_squares

    problem, longest, tile = static
    model, loop, *_ = problem
    scenarios, fixed, weights, bounds, starts, limit = arguments

    rigs = jax.vmap(lambda scenarios: model.prepared(loop, scenarios))(scenarios)
    problems = SolverProblem(rigs, fixed, weights)
    return solve_least_squares(
        compute_residuals, problem, problems, bounds, starts, limit, longest=longest, tile=tile
    )
