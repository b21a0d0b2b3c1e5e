"""Multistart search for the best gains of many tasks.

A start is a set of gains from which the gradient-based solver descends. The first batch of starts holds the
literature's gains and the best points of a scan. If the descents do not reach the same minimum, further
batches start at the best points of other scans, until several descents have reached the best value. It is
then likely that there is no better minimum. Contacts begin and end at ticks, so that the objective has kinks
at which a descent may stop; a derivative-free search therefore improves the best point.

Source: multistart until a minimum recurs, Boender and Rinnooy Kan, "Bayesian stopping rules for multistart
global optimization methods" (1987).
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxhil.errors import InputError
from jaxhil.simulation.jax_environment import program_folder, use_float64
from tuning.gains.direct_search import estimate_direct_runs, is_search_direct, search_directly
from tuning.gains.metrics_function import FUNCTION_REQUIREMENT
from tuning.gains.multistart_solver import (
    StartResult,
    compute_inverse_hessian,
    count_step_runs,
    lower_solver,
    solve_tasks,
)
from tuning.gains.objective import RMS_OBJECTIVE, Objective, list_objectives
from tuning.gains.quiet_gains import (
    build_least_error_objective,
    build_quiet_objective,
    choose_quiet_starts,
    compute_command_excess,
    compute_training_tolerance,
    is_quiet_search_needed,
)
from tuning.gains.scan import SCAN_SCENARIOS, count_scan_evaluations, scan_gain_ranges
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, list_tuned_gains
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import polish

# factor on the evaluations of the derivative-free search if the objective is a user's function
NONSMOOTH_POLISH_FACTOR = 3
MAX_START_BATCHES = 4  # largest number of batches of starts
MIN_AGREEING_STARTS = 3  # starts that must reach the best value; two can reach the same poor minimum
AGREEMENT_TOLERANCE = 0.005  # largest relative difference between values of the same minimum
# Largest relative difference with transparency probes, whose errors vary more between draws of scenarios.
PROBED_AGREEMENT_TOLERANCE = 0.02
# derivative-free search from a stuck start: generations, initial standard deviation in unit coordinates
RESTART_GENERATIONS, RESTART_STD = 24, 0.2
# final derivative-free search: initial standard deviation in unit coordinates, points per generation
POLISH_STD, CANDIDATES_PER_GENERATION = 0.1, 16

Objectives = Objective | Sequence[Objective]  # one objective for all tasks, or one per task


class MultistartResult(NamedTuple):
    """Result of the search for one task."""

    best: StartResult | None  # best start, improved by a derivative-free search; None if all starts failed
    starts: list[StartResult]  # all starts, in the order of their batches
    # Number of evaluations of the objective. A Jacobian with respect to P gains counts as 1 + P. A point of a
    # scan, which uses only some of the scenarios, counts as their share.
    evaluations: int
    objective: Objective | None = None  # objective of the last search, if it is not that of the settings
    quiet: bool = False  # whether the last search was for quieter gains


@dataclass
class _SearchState:
    """Results of a task's finished starts, and the number of evaluations of the objective so far."""

    starts: list[StartResult] = field(default_factory=list)
    evaluations: int = 0


def find_gains(
    validation: Validation,
    settings: TuneSettings,
    first: Sequence[Sequence[Mapping[str, float]]] | None = None,
    meanwhile: Callable[[], object] = lambda: None,
) -> list[MultistartResult]:
    """Search for the best gains of every task of `validation`.

    `first` holds, for each task, known good gains that replace the last starts of the first batch, but never
    the literature's gains. If `settings.starts` is 1, the only start is at the literature's gains.
    `meanwhile` is called while the solver compiles.
    """
    tasks, quiet = validation.tasks, is_quiet_search_needed(validation.tasks[0], settings)
    objective = build_least_error_objective(settings.objective) if quiet else settings.objective
    settings = replace(settings, objective=objective)
    probed = tasks[0].probed
    agreed = PROBED_AGREEMENT_TOLERANCE if probed else AGREEMENT_TOLERANCE
    searches = [_SearchState() for _ in tasks]
    _check_function(validation, objective)
    if is_search_direct(tasks[0]) and not quiet:
        return _search_without_derivatives(validation, settings, first, meanwhile)
    unfinished = _solve_batches(validation, settings, first, agreed, searches, meanwhile)
    if probed or objective.function is not None:
        for i, search in enumerate(searches):
            search.starts, more = _restart_stuck_starts(
                validation, i, search.starts, agreed, settings.seed, objective
            )
            search.evaluations += more
    # With probes, if the starts agree, polishing changes the objective less than new scenarios would.
    polishing = 0 if probed and not unfinished else settings.polish * len(validation.names)
    if objective.function is not None:
        # A user's function may have many kinks, for example if it is the maximum of several metrics.
        polishing *= NONSMOOTH_POLISH_FACTOR
    objectives, ends = list_objectives(objective, len(tasks)), [search.starts for search in searches]
    quieter = _search_quieter_gains(validation, settings, first, searches) if quiet else {}
    for i, (quiet_objective, quiet_starts) in quieter.items():
        objectives[i], ends[i] = quiet_objective, quiet_starts
    if polishing:
        runs = polishing * len(tasks) * tasks[0].lanes
        validation.work.begin("final search without derivatives", runs)
    best = polish_best_starts(validation, ends, polishing, settings.seed, objectives)
    return [
        MultistartResult(
            top,
            search.starts,
            search.evaluations + (polishing if top else 0),
            objectives[i] if i in quieter else None,
            quiet=i in quieter,
        )
        for i, (top, search) in enumerate(zip(best, searches, strict=True))
    ]


def _search_without_derivatives(
    validation: Validation,
    settings: TuneSettings,
    first: Sequence[Sequence[Mapping[str, float]]] | None,
    meanwhile: Callable[[], object],
) -> list[MultistartResult]:
    meanwhile()
    return [
        MultistartResult(next(iter(_rank_starts(starts)), None), starts, evaluations, objective)
        for starts, objective, evaluations in search_directly(validation, settings, first)
    ]


def _search_quieter_gains(
    validation: Validation,
    settings: TuneSettings,
    first: Sequence[Sequence[Mapping[str, float]]] | None,
    searches: list[_SearchState],
) -> dict[int, tuple[Objective, list[StartResult]]]:
    """Search for quieter gains, starting from the most accurate gains of each task.

    Tasks whose least error exceeds the limit are skipped. There are at most as many starts as in the first
    batch, so that the compiled program is reused. The keys of the result are indices of tasks. Its values
    are the objective for quiet gains, and the results of the starts.
    """
    tasks, objective = validation.tasks, settings.objective
    best = [ranked[0] if (ranked := _rank_starts(search.starts)) else None for search in searches]
    tolerance = compute_training_tolerance(objective.limit, tasks[0].number)
    accurate = {i: top for i, top in enumerate(best) if top and top.rms <= tolerance}
    if not accurate:
        return {}
    number, steps = _count_batch_starts(settings, first), settings.steps
    begun = [np.empty((0, len(validation.names)))] * len(tasks)
    objectives = [objective] * len(tasks)
    for i, top in accurate.items():
        begun[i] = choose_quiet_starts(searches[i].starts, number)
        objectives[i] = build_quiet_objective(
            objective, tasks[i].number, compute_command_excess(validation, i, top, objective)
        )
    runs = len(accurate) * number * steps * count_step_runs(tasks, validation.names)
    validation.work.begin(f"searching for quieter gains, {len(accurate)} of {len(tasks)} mechanisms", runs)
    ended = solve_tasks(tasks, begun, steps, objectives, validation.work)
    for i in accurate:
        searches[i].evaluations += (1 + len(validation.names)) * sum(start.steps for start in ended[i])
    return {i: (objectives[i], ended[i]) for i in accurate}


def _count_batch_starts(settings: TuneSettings, first: Sequence[Sequence[Mapping[str, float]]] | None) -> int:
    """Return the number of starts in a batch, at least one more than any task has gains in `first`."""
    return max(settings.starts, 1 + max(map(len, first))) if first else settings.starts


def estimate_search_runs(tasks: list[TuneTask], settings: TuneSettings) -> int:
    """Return the number of simulated runs if one batch of starts suffices and every start makes all steps."""
    if is_search_direct(tasks[0]):
        return estimate_direct_runs(tasks, settings.steps)
    names, lanes = list_tuned_gains(tasks), tasks[0].lanes
    scanning = settings.scanned * min(SCAN_SCENARIOS, lanes) if settings.starts > 1 else 0
    solve = settings.starts * settings.steps * count_step_runs(tasks, names)
    return len(tasks) * (scanning + solve + settings.polish * len(names) * lanes)


def _solve_batches(
    validation, settings, first, agreed, searches: list[_SearchState], meanwhile: Callable[[], object]
) -> list[int]:
    """Solve batches of starts; return the tasks in which too few starts agree on the best value."""
    tasks, objective, work = validation.tasks, settings.objective, validation.work
    numbers = [len(gains) for gains in first] if first else [0 for _ in tasks]
    number = _count_batch_starts(settings, first)
    chosen = _run_while_compiling(
        validation,
        number,
        objective,
        lambda: choose_starts(validation, number, settings.seed, objective, first, settings.scanned),
        meanwhile,
    )
    unfinished = list(range(len(tasks)))
    for batch in range(MAX_START_BATCHES if number > 1 else 1):
        if batch > 0:
            text = f"batch {batch + 1} of starts, {len(unfinished)} of {len(tasks)} mechanisms"
            work.begin(text, estimate_search_runs([tasks[i] for i in unfinished], settings))
            seed = settings.seed, batch
            chosen = [np.empty((0, len(validation.names)))] * len(tasks)
            scans = scan_gain_ranges(validation, unfinished, number, seed, objective, settings.scanned)
            for i, points in zip(unfinished, scans, strict=True):
                chosen[i] = points
        ended = solve_tasks(tasks, chosen, settings.steps, objective, work)
        for i in unfinished:
            search = searches[i]
            search.starts += _recompute_exact_values(validation, i, ended[i], objective)
            search.evaluations += (1 + len(validation.names)) * sum(start.steps for start in ended[i])
            if batch > 0 or number > 1 + numbers[i]:
                search.evaluations += count_scan_evaluations(validation, number, settings.scanned)
        unfinished = [i for i in unfinished if not _is_minimum_repeated(searches[i].starts, agreed)]
        if not unfinished:
            break
    return unfinished


def choose_starts(
    validation: Validation,
    starts: int,
    seed: int,
    objective: Objectives = RMS_OBJECTIVE,
    first: Sequence[Sequence[Mapping[str, float]]] | None = None,
    scanned: int = TuneSettings.scanned,
) -> list[Float[np.ndarray, "starts gains"]]:
    """Choose the solver's starts for every task: the literature's gains, then the best points of a scan.

    `first` holds, for each task, gains that replace the last points of the scan.
    """
    tasks = range(len(validation.tasks))
    prior = [validation.coordinates(i, first[i] if first else ()) for i in tasks]
    usual = [max(starts - len(points), 1) for points in prior]
    literature = [validation.coordinates(i, [validation.tasks[i].literature]) for i in tasks]
    if max(usual) > 1:
        further = scan_gain_ranges(
            validation, list(tasks), max(usual) - 1, seed, objective, scanned, literature
        )
        literature = [np.concatenate(both) for both in zip(literature, further, strict=True)]
    return [np.concatenate([literature[i][: usual[i]], prior[i]]) for i in tasks]


def polish_best_starts(
    validation: Validation,
    solved: list[list[StartResult]],
    evaluations: int,
    seed: int,
    objective: Objectives = RMS_OBJECTIVE,
) -> list[StartResult | None]:
    """Improve every task's best solver result by a derivative-free search with `evaluations` evaluations.

    The search is `tuning.optimisation.derivative_free.polish`. A task without a valid result yields None.
    """
    best = [ranked[0] if (ranked := _rank_starts(starts)) else None for starts in solved]
    indices = [i for i, top in enumerate(best) if top]
    if not indices or evaluations == 0:
        return best
    tops = [top for top in best if top]
    polished = polish(
        lambda points: validation.losses(objective, indices, points),
        np.stack([top.coordinates for top in tops]),
        evaluations,
        candidates=CANDIDATES_PER_GENERATION,
        reach=POLISH_STD,
        covariance=np.stack([compute_inverse_hessian(top.curvature, top.rms) for top in tops]),
        seed=seed,
    )
    for i, top, point, loss in zip(indices, tops, polished.point, polished.loss, strict=True):
        best[i] = _move_start(validation, i, top, point, loss)
    return best


def _check_function(validation: Validation, objective: Objective) -> None:
    """Raise `InputError` if a user's objective function is not finite for the literature's gains."""
    if objective.function is None:
        return
    tasks = range(len(validation.tasks))
    objective.function.check(validation.tasks[0].contacts, validation.tasks[0].number)
    literature = [validation.coordinates(i, [validation.tasks[i].literature]) for i in tasks]
    for value in validation.losses(objective, list(tasks), np.stack(literature))[:, 0]:
        if not np.isfinite(value):
            raise InputError(
                f"objective: found a function that returns {value:g} for the literature's gains, expected "
                f"{FUNCTION_REQUIREMENT}"
            )


def _restart_stuck_starts(
    validation: Validation,
    task: int,
    starts: list[StartResult],
    agreed: float,
    seed: int,
    objective: Objectives,
) -> tuple[list[StartResult], int]:
    """Improve every solver result that is worse than the best one, by a derivative-free search.

    A result is worse if its objective is larger by more than the fraction `agreed`. The solver can get stuck
    at the kink of the objective where the compensator's correction reaches its limit. Return all results,
    and the number of evaluations of the search.
    """
    ranked = _rank_starts(starts)
    stuck = [i for i, start in enumerate(starts) if ranked and start.rms > (1 + agreed) * ranked[0].rms]
    if not stuck:
        return starts, 0
    number = CANDIDATES_PER_GENERATION * RESTART_GENERATIONS

    def losses(points):
        flat = points.reshape(1, -1, points.shape[-1])
        return validation.losses(objective, [task], flat)[0].reshape(points.shape[:-1])

    at = np.stack([starts[i].coordinates for i in stuck])
    polished = polish(losses, at, number, candidates=CANDIDATES_PER_GENERATION, reach=RESTART_STD, seed=seed)
    freed = list(starts)
    for i, point, loss in zip(stuck, polished.point, polished.loss, strict=True):
        freed[i] = _move_start(validation, task, starts[i], point, loss)
    return freed, number * len(stuck)


def _recompute_exact_values(
    validation: Validation, task: int, starts: list[StartResult], objective: Objective
) -> list[StartResult]:
    """Replace the objective in each solver result, which contains the smooth norm, by the exact objective."""
    if objective.name == "rms" or not starts:
        return starts
    values = validation.losses(objective, [task], np.stack([start.coordinates for start in starts])[None])[0]
    return [start._replace(rms=float(value)) for start, value in zip(starts, values, strict=True)]


def _run_while_compiling(
    validation: Validation, number: int, objective: Objective, work: Callable, more: Callable[[], object]
):
    """Call `work`, then `more`, while a second thread compiles the solver; return the result of `work`.

    The second thread only compiles: running programs on several devices from two threads could deadlock.
    The solver takes longest to compile. It is therefore lowered, which prepares compilation, before `work`
    begins. Without a folder for compiled programs, call only `work`.
    """
    if program_folder() is None:
        return work()
    compile_solver = lower_solver(validation.tasks, number, objective)
    with ThreadPoolExecutor(1) as compiler:
        ready = compiler.submit(_call_with_float64, compile_solver)
        result = work()
        more()
        ready.result()
        return result


def _call_with_float64(function: Callable[[], None]) -> None:
    # A new thread starts with the process's JAX settings, without the float64 setting of the calling thread.
    with use_float64():
        function()


def _move_start(
    validation: Validation, task: int, start: StartResult, point: np.ndarray, loss: float
) -> StartResult:
    """Replace gains and loss of a solver result by those of `point`, at which a further search ended."""
    if (point == start.coordinates).all():
        return start
    history = [*start.history, float(loss)]
    gains = validation.gains(task, point)
    return start._replace(rms=float(loss), gains=gains, coordinates=point, history=history)


def _rank_starts(starts: list[StartResult]) -> list[StartResult]:
    return sorted((start for start in starts if np.isfinite(start.rms)), key=lambda start: start.rms)


def _is_minimum_repeated(starts: list[StartResult], agreed: float) -> bool:
    """Return whether the `MIN_AGREEING_STARTS` best objectives differ by at most the fraction `agreed`."""
    ranked = _rank_starts(starts)
    return (
        len(ranked) >= MIN_AGREEING_STARTS
        and ranked[MIN_AGREEING_STARTS - 1].rms <= (1 + agreed) * ranked[0].rms
    )
