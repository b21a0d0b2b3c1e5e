"""The best gains of many tasks: scan, descend by derivatives from several starts, go on where they disagree.

The first batch of starts holds the literature's gains and the best points of a scan. Where its starts do not
end at the same value there may be something better: further batches start at the best points of other scans,
until several starts agree on the best. How many minima there are is not known; that the best one was met
again and again is the sign that few are left. Contacts begin and end at ticks: the objective has kinks, on
which a descent may stop, so that the best is then improved without derivatives.

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
from jaxhil.simulation.environment import float64, program_folder
from tuning.gains.metrics_function import ALLOWED
from tuning.gains.objective import RMS, Objective, one_each
from tuning.gains.quiet import begin_at, is_quiet, least_error, loudness_of, quietest, tolerance_of
from tuning.gains.rounds import Start, inverse_hessian, prepare_solver, solve_tasks, step_runs
from tuning.gains.scan import SCENARIOS, scan, scan_evaluations
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, tuned_names
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import polish

KINKED = 3  # times as many evaluations without derivatives for a user's function
BATCHES = 4  # of starts, at most
SURE = 3  # starts that have to agree: two may have met in a poor basin
AGREED = 0.005  # relative difference of values that count as the same minimum
# The same where scenarios have probes: another draw of the scenarios would change the value by more.
PROBED_AGREED = 0.02
FREEING, FREEING_REACH = 24, 0.2  # generations of the search from a start that is stuck, its first reach
REACH, CANDIDATES = 0.1, 16  # of the search without derivatives: first standard deviation, points at a time

Objectives = Objective | Sequence[Objective]  # that of all tasks, or one of each


class MultistartResult(NamedTuple):
    """What was found for a task."""

    best: Start | None  # the best of its starts, improved without derivatives; None if all failed
    starts: list[Start]  # all of them, batch by batch
    # of the objective, that it took. A Jacobian over P gains counts as 1 + P of them, a point of a scan as
    # the share of the scenarios it may be tried on.
    evaluations: int
    # of the search for quieter gains, whose value the best start has; None where there was none
    quiet: Objective | None = None


@dataclass
class _Search:
    """The starts of one task so far, and the evaluations they took."""

    starts: list[Start] = field(default_factory=list)
    evaluations: int = 0


def find_gains(
    validation: Validation,
    settings: TuneSettings,
    first: Sequence[Sequence[Mapping[str, float]]] | None = None,
    meanwhile: Callable[[], object] = lambda: None,
) -> list[MultistartResult]:
    """The best gains of every task of `validation`.

    `first` has, of each task, gains to start at, in the places of the last starts of its first batch, never
    of the literature's. One start alone is the literature's, and the only batch. `meanwhile` is done while
    the solver's program compiles.
    """
    tasks, quiet = validation.tasks, is_quiet(validation.tasks[0], settings)
    objective = least_error(settings.objective) if quiet else settings.objective
    settings = replace(settings, objective=objective)
    probed = tasks[0].probed
    agreed = PROBED_AGREED if probed else AGREED
    searches = [_Search() for _ in tasks]
    _check_function(validation, objective)
    going = _solve_batches(validation, settings, first, agreed, searches, meanwhile)
    if probed or objective.function is not None:
        for i, own in enumerate(searches):
            own.starts, more = _freed(validation, i, own.starts, agreed, settings.seed, objective)
            own.evaluations += more
    # Where starts agree to that, the rest of the way down is within what scenarios decide.
    polishing = 0 if probed and not going else settings.polish * len(validation.names)
    if objective.function is not None:
        # It may have kinks everywhere, as a largest magnitude has.
        polishing *= KINKED
    objectives, ends = one_each(objective, len(tasks)), [own.starts for own in searches]
    quieter = _quieten(validation, settings, first, searches) if quiet else {}
    for i, (own, found) in quieter.items():
        objectives[i], ends[i] = own, found
    if polishing:
        runs = polishing * len(tasks) * tasks[0].lanes
        validation.work.begin("searching on without derivatives", runs)
    best = finish(validation, ends, polishing, settings.seed, objectives)
    return [
        MultistartResult(
            top,
            own.starts,
            own.evaluations + (polishing if top else 0),
            objectives[i] if i in quieter else None,
        )
        for i, (top, own) in enumerate(zip(best, searches, strict=True))
    ]


def _quieten(
    validation: Validation,
    settings: TuneSettings,
    first: Sequence[Sequence[Mapping[str, float]]] | None,
    searches: list[_Search],
) -> dict[int, tuple[Objective, list[Start]]]:
    """Search from the gains of least error for quieter ones, of every task whose error is within the limit;
    the objective of each such task, and the ends of its starts.

    As many starts as in the first batch of the first search, so that its program serves.
    """
    tasks, objective = validation.tasks, settings.objective
    best = [ranked[0] if (ranked := _ranked(own.starts)) else None for own in searches]
    tolerance = tolerance_of(objective.limit, tasks[0].number)
    accurate = {i: top for i, top in enumerate(best) if top and top.rms <= tolerance}
    if not accurate:
        return {}
    number, steps = _starts_of_batch(settings, first), settings.steps
    begun = [np.empty((0, len(validation.names)))] * len(tasks)
    objectives = [objective] * len(tasks)
    for i, top in accurate.items():
        begun[i] = begin_at(searches[i].starts, number)
        objectives[i] = quietest(objective, tasks[i].number, loudness_of(validation, i, top, objective))
    runs = len(accurate) * number * steps * step_runs(tasks, validation.names)
    validation.work.begin(f"searching for quieter gains, {len(accurate)} of {len(tasks)} mechanisms", runs)
    ended = solve_tasks(tasks, begun, steps, objectives, validation.work)
    for i in accurate:
        searches[i].evaluations += (1 + len(validation.names)) * sum(start.steps for start in ended[i])
    return {i: (objectives[i], ended[i]) for i in accurate}


def _starts_of_batch(settings: TuneSettings, first: Sequence[Sequence[Mapping[str, float]]] | None) -> int:
    """Return the number of starts of a batch: as asked for, and the literature's beside those given."""
    return max(settings.starts, 1 + max(map(len, first))) if first else settings.starts


def expected_runs(tasks: list[TuneTask], settings: TuneSettings) -> int:
    """Simulated runs that a search takes, of tasks that are alike, where starts agree and none ends early."""
    names, lanes = tuned_names(tasks), tasks[0].lanes
    scanning = settings.scanned * min(SCENARIOS, lanes) if settings.starts > 1 else 0
    solve = settings.starts * settings.steps * step_runs(tasks, names)
    return len(tasks) * (scanning + solve + settings.polish * len(names) * lanes)


def _solve_batches(
    validation, settings, first, agreed, searches: list[_Search], meanwhile: Callable[[], object]
) -> list[int]:
    """Solve batch after batch of starts; the tasks whose starts do not agree even so."""
    tasks, objective, work = validation.tasks, settings.objective, validation.work
    given = [len(own) for own in first] if first else [0 for _ in tasks]
    number = _starts_of_batch(settings, first)
    chosen = _while_compiling(
        validation,
        number,
        objective,
        lambda: choose_starts(validation, number, settings.seed, objective, first, settings.scanned),
        meanwhile,
    )
    going = list(range(len(tasks)))
    for batch in range(BATCHES if number > 1 else 1):
        if batch > 0:
            text = f"batch {batch + 1} of starts, {len(going)} of {len(tasks)} mechanisms"
            work.begin(text, expected_runs([tasks[i] for i in going], settings))
            seed = settings.seed, batch
            chosen = [np.empty((0, len(validation.names)))] * len(tasks)
            scans = scan(validation, going, number, seed, objective, settings.scanned)
            for i, points in zip(going, scans, strict=True):
                chosen[i] = points
        ended = solve_tasks(tasks, chosen, settings.steps, objective, work)
        for i in going:
            own = searches[i]
            own.starts += _exactly(validation, i, ended[i], objective)
            own.evaluations += (1 + len(validation.names)) * sum(start.steps for start in ended[i])
            if batch > 0 or number > 1 + given[i]:
                own.evaluations += scan_evaluations(validation, number, settings.scanned)
        going = [i for i in going if not _agree(searches[i].starts, agreed)]
        if not going:
            break
    return going


def choose_starts(
    validation: Validation,
    starts: int,
    seed: int,
    objective: Objectives = RMS,
    first: Sequence[Sequence[Mapping[str, float]]] | None = None,
    scanned: int = TuneSettings.scanned,
) -> list[Float[np.ndarray, "starts gains"]]:
    """Points of the unit box to start from, of every task: the literature's gains, then the best of a scan
    that lie apart from each other. `first` has, of each task, gains that take the places of the last of
    these, never of the literature's."""
    tasks = range(len(validation.tasks))
    given = [validation.coordinates(i, first[i] if first else ()) for i in tasks]
    usual = [max(starts - len(own), 1) for own in given]
    literature = [validation.coordinates(i, [validation.tasks[i].literature]) for i in tasks]
    if max(usual) > 1:
        further = scan(validation, list(tasks), max(usual) - 1, seed, objective, scanned, literature)
        literature = [np.concatenate(both) for both in zip(literature, further, strict=True)]
    return [np.concatenate([literature[i][: usual[i]], given[i]]) for i in tasks]


def finish(
    validation: Validation,
    solved: list[list[Start]],
    evaluations: int,
    seed: int,
    objective: Objectives = RMS,
) -> list[Start | None]:
    """The best start of every task, none if all failed, improved without derivatives
    (`tuning.optimisation.derivative_free.polish`) by so many evaluations each."""
    best = [ranked[0] if (ranked := _ranked(own)) else None for own in solved]
    some = [i for i, top in enumerate(best) if top]
    if not some or evaluations == 0:
        return best
    tops = [top for top in best if top]
    found = polish(
        lambda points: validation.losses(objective, some, points),
        np.stack([top.coordinates for top in tops]),
        evaluations,
        candidates=CANDIDATES,
        reach=REACH,
        covariance=np.stack([inverse_hessian(top.curvature, top.rms) for top in tops]),
        seed=seed,
    )
    for i, top, point, loss in zip(some, tops, found.point, found.loss, strict=True):
        best[i] = _moved(validation, i, top, point, loss)
    return best


def _check_function(validation: Validation, objective: Objective) -> None:
    """The user's function, if there is one, is a number for the literature's gains. Raises `InputError`."""
    if objective.function is None:
        return
    tasks = range(len(validation.tasks))
    objective.function.check(validation.tasks[0].contacts, validation.tasks[0].number)
    literature = [validation.coordinates(i, [validation.tasks[i].literature]) for i in tasks]
    for value in validation.losses(objective, list(tasks), np.stack(literature))[:, 0]:
        if not np.isfinite(value):
            raise InputError(f"objective: found {value:g} for the literature's gains, allowed {ALLOWED}")


def _freed(
    validation: Validation, task: int, starts: list[Start], agreed: float, seed: int, objective: Objectives
) -> tuple[list[Start], int]:
    """The starts, those that ended further above the best searched on from there without derivatives, and the
    evaluations that took.

    Where the correction's limit begins to bind the objective has a kink, and the solver stays there.
    """
    ranked = _ranked(starts)
    stuck = [i for i, start in enumerate(starts) if ranked and start.rms > (1 + agreed) * ranked[0].rms]
    if not stuck:
        return starts, 0
    number = CANDIDATES * FREEING

    def losses(points):
        flat = points.reshape(1, -1, points.shape[-1])
        return validation.losses(objective, [task], flat)[0].reshape(points.shape[:-1])

    at = np.stack([starts[i].coordinates for i in stuck])
    found = polish(losses, at, number, candidates=CANDIDATES, reach=FREEING_REACH, seed=seed)
    freed = list(starts)
    for i, point, loss in zip(stuck, found.point, found.loss, strict=True):
        freed[i] = _moved(validation, task, starts[i], point, loss)
    return freed, number * len(stuck)


def _exactly(validation: Validation, task: int, starts: list[Start], objective: Objective) -> list[Start]:
    """Starts with the value of the objective itself where the solver lowered a norm in its place."""
    if objective.name == "rms" or not starts:
        return starts
    values = validation.losses(objective, [task], np.stack([start.coordinates for start in starts])[None])[0]
    return [start._replace(rms=float(value)) for start, value in zip(starts, values, strict=True)]


def _while_compiling(
    validation: Validation, number: int, objective: Objective, work: Callable, more: Callable[[], object]
):
    """Do some work, and then more, while the solver's program compiles: each takes one core. Only one program
    runs: programs on several devices could wait for one another for ever."""
    if program_folder() is None:
        return work()
    with ThreadPoolExecutor(1) as beside:
        ready = beside.submit(_prepare, validation, number, objective)
        done = work()
        more()
        ready.result()
        return done


def _prepare(validation: Validation, number: int, objective: Objectives) -> None:
    # A thread has jax's settings from the process, not from the caller.
    with float64():
        prepare_solver(validation.tasks, number, objective)


def _moved(validation: Validation, task: int, start: Start, point: np.ndarray, loss: float) -> Start:
    """The start where a search from it ended; itself where that found nothing better."""
    if (point == start.coordinates).all():
        return start
    history = [*start.history, float(loss)]
    gains = validation.gains(task, point)
    return start._replace(rms=float(loss), gains=gains, coordinates=point, history=history)


def _ranked(starts: list[Start]) -> list[Start]:
    return sorted((start for start in starts if np.isfinite(start.rms)), key=lambda start: start.rms)


def _agree(starts: list[Start], agreed: float) -> bool:
    """Whether enough of the best starts do."""
    ranked = _ranked(starts)
    return len(ranked) >= SURE and ranked[SURE - 1].rms <= (1 + agreed) * ranked[0].rms
