"""Search for the gains of Pareto fronts (`tuning.gains.pareto`), one set of gains per weight.

The weights of a front are in ascending order and are called a ladder. One compiled program solves all weights
of all mechanisms on the training scenarios. In each further pass, the gains of each weight are also starts
for the next smaller and the next larger weight. The search ends when no point improves. For a compensator
that is tuned without derivatives, a derivative-free search begins at the best gains of each weight instead.
"""

import dataclasses
import math
from itertools import chain
from typing import NamedTuple

import numpy as np

from jaxhil.laws.compensators import COMPENSATORS
from tuning.gains.contact_terms import FAILED_CONTACT_ERROR
from tuning.gains.direct_search import estimate_direct_runs, is_search_direct, search_from
from tuning.gains.multistart import choose_starts
from tuning.gains.multistart_solver import StartResult, count_step_runs, solve_tasks
from tuning.gains.noise import compute_noise_amplification, has_noise_trade_off
from tuning.gains.objective import Objective
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, list_tuned_gains
from tuning.gains.tune import TuneResult
from tuning.gains.validation import Validation

# Ends of a ladder: weight times second criterion of the accurate gains, divided by their error [1]. The first
# ladder extends to a larger weight, because smaller weights lead to no quiet, inaccurate gains.
LADDER_ENDS, FIRST_LADDER_ENDS = (0.5, 10.0), (1.0, 100.0)
MAX_ACCURATE_ERROR_RATIO = 1.05  # largest error of accurate gains, divided by the least error
MIN_NOISE_EXCESS = 0.1  # lower bound, in a ladder's scale, of the noise amplification minus 1
MAX_NEIGHBOUR_SEARCHES = 4  # largest number of passes that start from the gains of neighbouring weights
MIN_IMPROVEMENT = 1e-3  # minimum relative improvement of a point that leads to a further pass


class ParetoCriterion(NamedTuple):
    """Second criterion of a Pareto front, beside the restitution error."""

    name: str  # name on the command line
    weight: str  # name of the field of `Objective` that weights the criterion
    cost: str  # name in JSON files
    words: str  # name in sentences
    least: float  # lower bound, in a ladder's scale, of the criterion's term [1]


NOISE_CRITERION = ParetoCriterion(
    "noise", "noise_weight", "noise_amplification", "amplification of sensor noise", MIN_NOISE_EXCESS
)
PEAK_CRITERION = ParetoCriterion(
    "peak", "command_weight", "peak_p99", "peak command / ideal peak force (99th percentile)", 0.1
)
TRANSPARENCY_CRITERION = ParetoCriterion(
    "transparency", "transparency_weight", "honesty_error", "error with pushes or other damping (rms)", 1e-3
)
PARETO_CRITERIA = {axis.name: axis for axis in (NOISE_CRITERION, PEAK_CRITERION, TRANSPARENCY_CRITERION)}


def choose_default_criterion(compensator: str, axes: int = 1) -> ParetoCriterion | None:
    """Return the second criterion of a compensator's Pareto fronts if the user names none.

    The criterion is noise amplification if the amplification depends on the gains. If it does not, the
    criterion is the peak command for a compensator that predicts contacts, and None for any other. With six
    axes, the criterion is the peak command.
    """
    if axes != 1:
        return PEAK_CRITERION
    if has_noise_trade_off(compensator):
        return NOISE_CRITERION
    return PEAK_CRITERION if COMPENSATORS[compensator].anticipates else None


def build_weight_ladder(
    number: int,
    error: float,
    excess: float,
    ends: tuple[float, float] = LADDER_ENDS,
    least: float = MIN_NOISE_EXCESS,
) -> np.ndarray:
    """Return a ladder (number,) of weights [1]: 0, then logarithmically spaced positive weights.

    The positive weights extend from `ends[0] * error / excess` to `ends[1] * error / excess`. At the gains
    that minimise the objective J alone, `error` is J and `excess` is the second criterion, for example the
    noise amplification minus 1. If `excess` is below `least`, `least` replaces it.
    """
    light, heavy = ends
    weights = np.geomspace(heavy, light, number - 1)[::-1] * error / max(excess, least)
    return np.concatenate([[0.0], weights])


class _LadderCandidate(NamedTuple):
    """Candidate gains for a point of a Pareto front, with both criteria on the training scenarios."""

    gains: dict[str, float]
    error: float  # objective J without the second criterion's term [1]
    # term of the second criterion for a weight of 1 [1]: the noise amplification minus 1 (at least 0), the
    # rms of the excess peak commands, or the rms of the probes' errors
    excess: float

    def value(self, weight: float) -> float:
        """Return the objective J [1] if the second criterion has the weight `weight`."""
        return math.hypot(self.error, weight * self.excess)


def solve_weight_ladders(
    validation: Validation,
    tuned: list[TuneResult],
    number: int,
    settings: TuneSettings,
    axis: ParetoCriterion = NOISE_CRITERION,
) -> list[list[tuple[float, dict[str, float]]]]:
    """Search for the best gains for each weight of each task; return the pairs (weight, gains) by task."""
    unit = settings.objective.unit(axis.weight)
    weight = unit * getattr(settings.objective, axis.weight)
    pools = [
        _collect_candidates(validation, i, axis, settings.objective, weight, result.starts)
        for i, result in enumerate(tuned)
    ]
    ladders = []
    for turn in range(1 + MAX_NEIGHBOUR_SEARCHES):
        # Each pass improves the least error and the excess at this error, which determine the ladder.
        ends = LADDER_ENDS if turn > 0 else FIRST_LADDER_ENDS
        ladders = [_build_fitting_ladder(pool, number, ends, axis) for pool in pools]
        before = [_pick_candidates(pool, weights) for pool, weights in zip(pools, ladders, strict=True)]
        objectives = [
            [replace_weight(settings.objective, axis, weight) for weight in weights] for weights in ladders
        ]
        starts = (
            _choose_neighbour_starts(validation, before)
            if turn > 0 or is_search_direct(validation.tasks[0])
            else _choose_first_starts(validation, tuned, objectives, settings)
        )
        results = _solve_points(validation, starts, objectives, settings, axis)
        pools = [pool + new for pool, new in zip(pools, results, strict=True)]
        after = [_pick_candidates(pool, weights) for pool, weights in zip(pools, ladders, strict=True)]
        if turn > 0 and not _has_improved(before, after, ladders):
            break
    return [
        [
            (float(weight) / unit, point.gains)
            for weight, point in zip(weights, _pick_candidates(pool, weights), strict=True)
        ]
        for pool, weights in zip(pools, ladders, strict=True)
    ]


def estimate_ladder_runs(tasks: list[TuneTask], number: int, settings: TuneSettings) -> int:
    """Estimate the number of simulated runs of `solve_weight_ladders` with the maximum number of passes."""
    if is_search_direct(tasks[0]):
        return (1 + MAX_NEIGHBOUR_SEARCHES) * number * estimate_direct_runs(tasks, settings.steps)
    starts = max(settings.starts, 2) + MAX_NEIGHBOUR_SEARCHES * 2
    return len(tasks) * number * starts * settings.steps * count_step_runs(tasks, list_tuned_gains(tasks))


def _build_fitting_ladder(
    pool: list[_LadderCandidate], number: int, ends: tuple[float, float], axis: ParetoCriterion
) -> np.ndarray:
    least = min(candidate.error for candidate in pool)
    accurate = min(
        (candidate for candidate in pool if candidate.error <= MAX_ACCURATE_ERROR_RATIO * least),
        key=lambda candidate: candidate.excess,
    )
    return build_weight_ladder(number, accurate.error, accurate.excess, ends, axis.least)


def replace_weight(objective: Objective, axis: ParetoCriterion, weight: float) -> Objective:
    """Return a copy of the objective in which the second criterion has the weight `weight`.

    `weight` is the error [1] that counts as much as a value of 1 of the criterion's term.
    """
    return dataclasses.replace(objective, **{axis.weight: float(weight) / objective.unit(axis.weight)})


def _choose_first_starts(
    validation: Validation, tuned: list[TuneResult], objectives: list[list[Objective]], settings: TuneSettings
) -> list[list[np.ndarray]]:
    """Choose starting gains for each weight of each task: those of `choose_starts`, and the tuned gains."""
    number, first = max(settings.starts, 2), [[result.gains] for result in tuned]
    by_point = [
        choose_starts(validation, number, settings.seed, of_point, first)
        for of_point in zip(*objectives, strict=True)
    ]
    return [list(starts) for starts in zip(*by_point, strict=True)]


def _choose_neighbour_starts(
    validation: Validation, picked: list[list[_LadderCandidate]]
) -> list[list[np.ndarray]]:
    """Choose starting gains for each weight of each task: the best gains of this and adjacent weights.

    A search without derivatives needs only the gains that are best for this weight.
    """
    number = 1 if is_search_direct(validation.tasks[0]) else None
    return [
        [validation.coordinates(task, gains[:number]) for gains in _collect_neighbour_gains(points)]
        for task, points in enumerate(picked)
    ]


def _solve_points(
    validation: Validation, starts, objectives, settings, axis: ParetoCriterion
) -> list[list[_LadderCandidate]]:
    """Search for the best gains for all weights of all tasks; return each task's results as candidates."""
    number, points, flat = len(objectives[0]), list(chain(*starts)), list(chain(*objectives))
    tasks = [task for task in validation.tasks for _ in range(number)]
    if is_search_direct(tasks[0]):
        solved = [
            [search_from(validation, index // number, start, objective, settings) for start in of_point]
            for index, (of_point, objective) in enumerate(zip(points, flat, strict=True))
        ]
    else:
        solved = solve_tasks(tasks, points, settings.steps, flat, validation.work)
    candidates = [
        _collect_candidates(
            validation,
            index // number,
            axis,
            settings.objective,
            objective.unit(axis.weight) * getattr(objective, axis.weight),
            ended,
        )
        for index, (objective, ended) in enumerate(zip(flat, solved, strict=True))
    ]
    return [list(chain(*candidates[i : i + number])) for i in range(0, len(candidates), number)]


def _collect_candidates(
    validation: Validation,
    index: int,
    axis: ParetoCriterion,
    objective: Objective,
    weight: float,
    starts: list[StartResult],
) -> list[_LadderCandidate]:
    """Convert the solver's results for one task and one weight into candidates."""
    task = validation.tasks[index]
    if axis == NOISE_CRITERION:
        return _collect_noise_candidates(task, weight, starts)
    solved = [start for start in starts if math.isfinite(start.rms)]
    if not solved:
        return [_LadderCandidate(task.literature, FAILED_CONTACT_ERROR, 0.0)]
    coordinates = validation.coordinates(index, [start.gains for start in solved])[None]
    without, beside = (
        validation.losses(replace_weight(objective, axis, w), [index], coordinates)[0] for w in (0.0, 1.0)
    )
    excess = np.sqrt(np.maximum(0, beside**2 - without**2))
    return [
        _LadderCandidate(start.gains, float(e), float(x))
        for start, e, x in zip(solved, without, excess, strict=True)
    ]


def _collect_noise_candidates(
    task: TuneTask, weight: float, starts: list[StartResult]
) -> list[_LadderCandidate]:
    """Convert the solver's results into candidates if the second criterion is noise amplification."""
    candidates = []
    for start in starts:
        excess = max(0.0, compute_noise_amplification(task.mechanism, task.compensator, start.gains) - 1)
        if math.isfinite(start.rms) and math.isfinite(excess):
            error = math.sqrt(max(0.0, start.rms**2 - (weight * excess) ** 2))
            candidates.append(_LadderCandidate(start.gains, error, excess))
    return candidates or [_LadderCandidate(task.literature, FAILED_CONTACT_ERROR, 0.0)]


def _pick_candidates(pool: list[_LadderCandidate], weights: np.ndarray) -> list[_LadderCandidate]:
    return [min(pool, key=lambda candidate, weight=weight: candidate.value(weight)) for weight in weights]


def _collect_neighbour_gains(picked: list[_LadderCandidate]) -> list[list[dict[str, float]]]:
    """Return for each weight the distinct gains picked for this weight and for the adjacent weights."""
    neighbourhoods = []
    for index, point in enumerate(picked):
        near = [point, *picked[max(index - 1, 0) : index], *picked[index + 1 : index + 2]]
        neighbourhoods.append([near[i].gains for i in range(len(near)) if near[i] not in near[:i]])
    return neighbourhoods


def _has_improved(
    before: list[list[_LadderCandidate]], after: list[list[_LadderCandidate]], ladders: list[np.ndarray]
) -> bool:
    return any(
        new.value(weight) < (1 - MIN_IMPROVEMENT) * old.value(weight)
        for olds, news, weights in zip(before, after, ladders, strict=True)
        for old, new, weight in zip(olds, news, weights, strict=True)
    )
