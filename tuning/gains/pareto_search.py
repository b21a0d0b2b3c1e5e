"""Search of gains for a ladder of weights, used by `tuning.gains.pareto`.

All weights of all mechanisms are problems of one program, on the mechanisms' training scenarios. The gains
found for one weight are starts of its neighbours on the ladder in the next pass, until no point improves.
"""

import dataclasses
import math
from itertools import chain
from typing import NamedTuple

import numpy as np

from jaxhil.laws.compensators import COMPENSATORS
from tuning.gains.multistart import choose_starts
from tuning.gains.noise import amplification, has_trade_off
from tuning.gains.objective import FAILED, Objective
from tuning.gains.rounds import Start, solve_tasks, step_runs
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, tuned_names
from tuning.gains.tune import TuneResult
from tuning.gains.validation import Validation

# Ends of the ladder: the weighted noise of accurate gains over their error. The first ladder reaches further,
# since the solver does not find quiet, inaccurate starts otherwise.
ENDS, FIRST_ENDS = (0.5, 10.0), (1.0, 100.0)
ACCURATE = 1.05  # largest error of accurate gains over the least error found
LEAST_EXCESS = 0.1  # least amplification beyond 1 for which a ladder is computed
PASSES = 4  # largest number of passes in which points start at the gains of their neighbours
IMPROVED = 1e-3  # relative improvement of a point that causes another pass


class Axis(NamedTuple):
    """Criterion that is traded against the error."""

    name: str  # name in commands
    weight: str  # field of `Objective` that is its weight
    cost: str  # name in JSON
    words: str  # name in a sentence
    least: float  # least value of the criterion for which a ladder of weights is computed


NOISE = Axis("noise", "noise_weight", "noise_amplification", "amplification of sensor noise", LEAST_EXCESS)
PEAK = Axis("peak", "command_weight", "peak_p99", "peak command over the reference's (99th percentile)", 0.1)
TRANSPARENCY = Axis(
    "honesty", "transparency_weight", "honesty_error", "error under pushes and other damping (rms)", 1e-3
)
AXES = {axis.name: axis for axis in (NOISE, PEAK, TRANSPARENCY)}


def default_axis(compensator: str) -> Axis | None:
    """Return the default criterion that a compensator's error is traded against, None if there is none."""
    if has_trade_off(compensator):
        return NOISE
    return PEAK if COMPENSATORS[compensator].anticipates else None


def ladder(
    number: int,
    error: float,
    excess: float,
    ends: tuple[float, float] = ENDS,
    least: float = LEAST_EXCESS,
) -> np.ndarray:
    """Return weights (number,) in the unit of an error [1]: 0, then evenly spaced logarithms.

    `error` and `excess` are J and the weighted term (such as A - 1) of accurate gains. At the first and last
    positive weight that term is `ends` times the error.
    """
    light, heavy = ends
    weights = np.geomspace(heavy, light, number - 1)[::-1] * error / max(excess, least)
    return np.concatenate([[0.0], weights])


class _Candidate(NamedTuple):
    """Gains of a mechanism with their error and excess on its training scenarios."""

    gains: dict[str, float]
    error: float  # J without the axis's term [1]
    excess: float  # axis's term at weight 1 [1]: max(0, A - 1), or the rms of peak excesses or probe errors

    def value(self, weight: float) -> float:
        """Return J for a weight."""
        return math.hypot(self.error, weight * self.excess)


def solve_ladders(
    validation: Validation,
    tuned: list[TuneResult],
    number: int,
    settings: TuneSettings,
    axis: Axis = NOISE,
) -> list[list[tuple[float, dict[str, float]]]]:
    """Return (weight in the unit of `Objective`, gains) of every point of every task."""
    unit = settings.objective.unit(axis.weight)
    weight = unit * getattr(settings.objective, axis.weight)
    pools = [
        _reached(validation, i, axis, settings.objective, weight, result.starts)
        for i, result in enumerate(tuned)
    ]
    ladders = []
    for turn in range(1 + PASSES):
        # Each pass improves the estimate of the least error and of its excess, which determine the ladder.
        ends = ENDS if turn > 0 else FIRST_ENDS
        ladders = [_fitting_ladder(pool, number, ends, axis) for pool in pools]
        before = [_picked(pool, weights) for pool, weights in zip(pools, ladders, strict=True)]
        objectives = [
            [weighed(settings.objective, axis, weight) for weight in weights] for weights in ladders
        ]
        starts = (
            _around(validation, before) if turn > 0 else _anywhere(validation, tuned, objectives, settings)
        )
        results = _search(validation, starts, objectives, settings, axis)
        pools = [pool + new for pool, new in zip(pools, results, strict=True)]
        after = [_picked(pool, weights) for pool, weights in zip(pools, ladders, strict=True)]
        if turn > 0 and not _improved(before, after, ladders):
            break
    return [
        [
            (float(weight) / unit, point.gains)
            for weight, point in zip(weights, _picked(pool, weights), strict=True)
        ]
        for pool, weights in zip(pools, ladders, strict=True)
    ]


def ladder_runs(tasks: list[TuneTask], number: int, settings: TuneSettings) -> int:
    """Return the approximate simulated runs of `solve_ladders` if points improve in every pass."""
    starts = max(settings.starts, 2) + PASSES * 2
    return len(tasks) * number * starts * settings.steps * step_runs(tasks, tuned_names(tasks))


def _fitting_ladder(pool: list[_Candidate], number: int, ends: tuple[float, float], axis: Axis) -> np.ndarray:
    least = min(candidate.error for candidate in pool)
    accurate = min(
        (candidate for candidate in pool if candidate.error <= ACCURATE * least),
        key=lambda candidate: candidate.excess,
    )
    return ladder(number, accurate.error, accurate.excess, ends, axis.least)


def weighed(objective: Objective, axis: Axis, weight: float) -> Objective:
    """Return the objective with another weight of the axis, in the unit of an error."""
    return dataclasses.replace(objective, **{axis.weight: float(weight) / objective.unit(axis.weight)})


def _anywhere(
    validation: Validation, tuned: list[TuneResult], objectives: list[list[Objective]], settings: TuneSettings
) -> list[list[np.ndarray]]:
    """Return the starts of every point of each task: the usual ones for its weight, and the tuned gains."""
    number, first = max(settings.starts, 2), [[result.gains] for result in tuned]
    by_point = [
        choose_starts(validation, number, settings.seed, of_point, first)
        for of_point in zip(*objectives, strict=True)
    ]
    return [list(starts) for starts in zip(*by_point, strict=True)]


def _around(validation: Validation, picked: list[list[_Candidate]]) -> list[list[np.ndarray]]:
    """Return the starts of every point of each task: the gains of the point and of its neighbours."""
    return [
        [validation.coordinates(task, gains) for gains in _neighbourhoods(points)]
        for task, points in enumerate(picked)
    ]


def _search(validation: Validation, starts, objectives, settings, axis: Axis) -> list[list[_Candidate]]:
    """Solve from all starts of all points; return the candidates of each task."""
    number = len(objectives[0])
    tasks = [task for task in validation.tasks for _ in range(number)]
    flat = list(chain(*objectives))
    solved = solve_tasks(tasks, list(chain(*starts)), settings.steps, flat, validation.work)
    candidates = [
        _reached(
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


def _reached(
    validation: Validation, index: int, axis: Axis, objective: Objective, weight: float, starts: list[Start]
) -> list[_Candidate]:
    """Return the candidates that the starts of a task ended with under a weight."""
    task = validation.tasks[index]
    if axis == NOISE:
        return _reached_noise(task, weight, starts)
    solved = [start for start in starts if math.isfinite(start.rms)]
    if not solved:
        return [_Candidate(task.literature, FAILED, 0.0)]
    coordinates = validation.coordinates(index, [start.gains for start in solved])[None]
    without, beside = (
        validation.losses(weighed(objective, axis, w), [index], coordinates)[0] for w in (0.0, 1.0)
    )
    excess = np.sqrt(np.maximum(0, beside**2 - without**2))
    return [
        _Candidate(start.gains, float(e), float(x))
        for start, e, x in zip(solved, without, excess, strict=True)
    ]


def _reached_noise(task: TuneTask, weight: float, starts: list[Start]) -> list[_Candidate]:
    """Return the candidates of the noise axis, whose excess follows from the gains alone."""
    candidates = []
    for start in starts:
        excess = max(0.0, amplification(task.mechanism, task.compensator, start.gains) - 1)
        if math.isfinite(start.rms) and math.isfinite(excess):
            error = math.sqrt(max(0.0, start.rms**2 - (weight * excess) ** 2))
            candidates.append(_Candidate(start.gains, error, excess))
    return candidates or [_Candidate(task.literature, FAILED, 0.0)]


def _picked(pool: list[_Candidate], weights: np.ndarray) -> list[_Candidate]:
    """Return the best candidate of the pool for each weight."""
    return [min(pool, key=lambda candidate, weight=weight: candidate.value(weight)) for weight in weights]


def _neighbourhoods(picked: list[_Candidate]) -> list[list[dict[str, float]]]:
    """Return for each point its gains and the different ones of its neighbours on the ladder."""
    neighbourhoods = []
    for index, point in enumerate(picked):
        near = [point, *picked[max(index - 1, 0) : index], *picked[index + 1 : index + 2]]
        neighbourhoods.append([near[i].gains for i in range(len(near)) if near[i] not in near[:i]])
    return neighbourhoods


def _improved(
    before: list[list[_Candidate]], after: list[list[_Candidate]], ladders: list[np.ndarray]
) -> bool:
    return any(
        new.value(weight) < (1 - IMPROVED) * old.value(weight)
        for olds, news, weights in zip(before, after, ladders, strict=True)
        for old, new, weight in zip(olds, news, weights, strict=True)
    )
