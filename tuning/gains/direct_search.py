"""Search without derivatives for the best gains, for compensators whose derivatives take long to compile.

The search is CMA-ES (`tuning.optimisation.derivative_free.polish`). It begins at the literature's gains, and
needs only the program that also evaluates the tuned gains.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxhil.laws.compensators import get_compensator
from tuning.gains.multistart_solver import STEP_LIMIT, StartResult
from tuning.gains.objective import Objective
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import polish
from tuning.optimisation.solution import SOLVER_STATUSES

CANDIDATES_PER_GENERATION = 16
INITIAL_STD = 0.1  # initial standard deviation of the candidates in unit coordinates


class DirectSearchResult(NamedTuple):
    """Results of the search without derivatives for one task."""

    starts: list[StartResult]  # result of each start: the literature's gains, then earlier gains
    objective: Objective  # objective that the search minimised; it includes the limit on the training error
    evaluations: int  # number of evaluations of the objective


def is_search_direct(task: TuneTask) -> bool:
    """Return whether the gains of a task's compensator are tuned without derivatives."""
    return get_compensator(task.compensator, task.model.axes).tuned_without_derivatives


def estimate_direct_runs(tasks: Sequence[TuneTask], steps: int) -> int:
    """Return the number of simulated runs that `search_directly` needs if `first` is empty."""
    return len(tasks) * steps * CANDIDATES_PER_GENERATION * tasks[0].lanes


def search_directly(
    validation: Validation, settings: TuneSettings, first: Sequence[Sequence[Mapping[str, float]]] | None
) -> list[DirectSearchResult]:
    """Search for the best gains of every task, from the literature's gains and from the gains in `first`.

    A search has `settings.steps` generations. If `settings.bounded` is true, the search penalises gains with
    a larger error in the training scenarios than the literature's gains. Without this penalty, the much
    larger errors of transparency could outweigh the errors of the scenarios.
    """
    return [
        _search_task(validation, i, settings, [task.literature, *(first[i] if first else ())])
        for i, task in enumerate(validation.tasks)
    ]


def _search_task(
    validation: Validation, task: int, settings: TuneSettings, gains: Sequence[Mapping[str, float]]
) -> DirectSearchResult:
    starts, objective = validation.coordinates(task, gains), settings.objective
    if settings.bounded:
        objective = _bound_error(validation, task, objective, starts[:1])
    searched = [search_from(validation, task, start, objective, settings) for start in starts]
    return DirectSearchResult(searched, objective, sum(r.steps for r in searched) * CANDIDATES_PER_GENERATION)


def _bound_error(
    validation: Validation, task: int, objective: Objective, literature: Float[np.ndarray, "1 gains"]
) -> Objective:
    """Return the objective with `error_bound` set to the error that the literature's gains leave."""
    metric = replace(
        objective, command_weight=0.0, noise_weight=0.0, chatter_weight=0.0, transparency_weight=0.0
    )
    return replace(objective, error_bound=float(validation.losses(metric, [task], literature[None])[0, 0]))


def search_from(
    validation: Validation,
    task: int,
    start: Float[np.ndarray, "gains"],
    objective: Objective,
    settings: TuneSettings,
) -> StartResult:
    """Search for the best gains of a task from one start; `settings.steps` is the number of generations."""
    history: list[float] = []

    def losses(points: Float[np.ndarray, "candidates gains"]) -> Float[np.ndarray, "candidates"]:
        values = validation.losses(objective, [task], points[None])[0]
        history.append(min([*history[-1:], float(np.min(values, where=np.isfinite(values), initial=np.inf))]))
        return values

    evaluations = settings.steps * CANDIDATES_PER_GENERATION

    def search() -> StartResult:
        result = polish(
            losses,
            start,
            evaluations,
            candidates=CANDIDATES_PER_GENERATION,
            reach=INITIAL_STD,
            seed=settings.seed,
        )
        return StartResult(
            status=SOLVER_STATUSES[STEP_LIMIT],
            steps=len(history),
            rms=history[-1],
            history=history,
            gains=validation.gains(task, result.point),
            coordinates=result.point,
        )

    return validation.work.step("direct search", StartResult, search)
