"""Gains for a ladder of weights: the search behind `tuning.gains.pareto`.

All weights of all mechanisms are problems of one program, on the scenarios that the mechanisms were tuned on.
Points help each other: gains found for one weight are what its neighbours on the ladder start from next,
until none gets better.
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

# The ladder's ends: how many times the noise of accurate gains weighs what their error does. The first one
# reaches further: what is quiet without being accurate is a start that the solver does not come by itself.
ENDS, FIRST_ENDS = (0.5, 10.0), (1.0, 100.0)
ACCURATE = 1.05  # error, over the least that is known, of gains that still are accurate
LEAST_EXCESS = 0.1  # amplification beyond 1 that the ladder is made for where there is next to none
PASSES = 4  # in which points begin at what their neighbours found
IMPROVED = 1e-3  # by which a point gets better in a pass that is not the last


class Axis(NamedTuple):
    """What the error is traded against."""

    name: str  # as commands call it
    weight: str  # the field of `Objective` that weighs it
    cost: str  # its name in JSON
    words: str  # its name in a sentence
    least: float  # what the ladder of weights is made for where there is next to nothing to trade


NOISE = Axis("noise", "noise_weight", "noise_amplification", "amplification of sensor noise", LEAST_EXCESS)
PEAK = Axis("peak", "command_weight", "peak_p99", "peak command over the reference's (99th percentile)", 0.1)
TRANSPARENCY = Axis(
    "honesty", "transparency_weight", "honesty_error", "error under pushes and other damping (rms)", 1e-3
)
AXES = {axis.name: axis for axis in (NOISE, PEAK, TRANSPARENCY)}


def default_axis(compensator: str) -> Axis | None:
    """What a compensator's error is traded against unless something is asked for; None: nothing."""
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
    """(number,) weights [1], in the unit of an error: 0, then evenly on a logarithmic scale.

    `error` and `excess` are J and what is weighed, A - 1 or the like, of accurate gains: the weights at the
    ends make that term so many times their error.
    """
    light, heavy = ends
    weights = np.geomspace(heavy, light, number - 1)[::-1] * error / max(excess, least)
    return np.concatenate([[0.0], weights])


class _Found(NamedTuple):
    """Gains of a mechanism, and what they reach on its training scenarios."""

    gains: dict[str, float]
    error: float  # J without the term traded [1]
    # what its weight is of [1]: max(0, A - 1), or the rms of peaks' excess or of probes' errors
    excess: float

    def value(self, weight: float) -> float:
        """J for a weight."""
        return math.hypot(self.error, weight * self.excess)


def solve_ladders(
    validation: Validation,
    tuned: list[TuneResult],
    number: int,
    settings: TuneSettings,
    axis: Axis = NOISE,
) -> list[list[tuple[float, dict[str, float]]]]:
    """Weight, as `Objective` has it, and gains of every point of every task."""
    unit = settings.objective.unit(axis.weight)
    weight = unit * getattr(settings.objective, axis.weight)
    pools = [
        _reached(validation, i, axis, settings.objective, weight, one.starts) for i, one in enumerate(tuned)
    ]
    ladders = []
    for turn in range(1 + PASSES):
        # How accurate gains can be, and how quiet those are, is known better every time.
        ends = ENDS if turn > 0 else FIRST_ENDS
        ladders = [_fitting_ladder(pool, number, ends, axis) for pool in pools]
        before = [_picked(pool, weights) for pool, weights in zip(pools, ladders, strict=True)]
        objectives = [
            [weighed(settings.objective, axis, weight) for weight in weights] for weights in ladders
        ]
        starts = (
            _around(validation, before) if turn > 0 else _anywhere(validation, tuned, objectives, settings)
        )
        found = _search(validation, starts, objectives, settings, axis)
        pools = [pool + new for pool, new in zip(pools, found, strict=True)]
        after = [_picked(pool, weights) for pool, weights in zip(pools, ladders, strict=True)]
        if turn > 0 and not _improved(before, after, ladders):
            break
    return [
        [
            (float(weight) / unit, one.gains)
            for weight, one in zip(weights, _picked(pool, weights), strict=True)
        ]
        for pool, weights in zip(pools, ladders, strict=True)
    ]


def ladder_runs(tasks: list[TuneTask], number: int, settings: TuneSettings) -> int:
    """Simulated runs that `solve_ladders` takes, about, where points get better in every pass."""
    starts = max(settings.starts, 2) + PASSES * 2
    return len(tasks) * number * starts * settings.steps * step_runs(tasks, tuned_names(tasks))


def _fitting_ladder(pool: list[_Found], number: int, ends: tuple[float, float], axis: Axis) -> np.ndarray:
    least = min(one.error for one in pool)
    accurate = min((one for one in pool if one.error <= ACCURATE * least), key=lambda one: one.excess)
    return ladder(number, accurate.error, accurate.excess, ends, axis.least)


def weighed(objective: Objective, axis: Axis, weight: float) -> Objective:
    """Return the objective with another weight of the axis, given in the unit of an error."""
    return dataclasses.replace(objective, **{axis.weight: float(weight) / objective.unit(axis.weight)})


def _anywhere(
    validation: Validation, tuned: list[TuneResult], objectives: list[list[Objective]], settings: TuneSettings
) -> list[list[np.ndarray]]:
    """Coordinates that every point of each task begins at: the usual ones for its weight, and those tuned
    before."""
    number, first = max(settings.starts, 2), [[one.gains] for one in tuned]
    by_point = [
        choose_starts(validation, number, settings.seed, own, first) for own in zip(*objectives, strict=True)
    ]
    return [list(own) for own in zip(*by_point, strict=True)]


def _around(validation: Validation, picked: list[list[_Found]]) -> list[list[np.ndarray]]:
    """Coordinates that every point of each task begins at: what it and its neighbours found."""
    return [
        [validation.coordinates(task, several) for several in _neighbourhoods(own)]
        for task, own in enumerate(picked)
    ]


def _search(validation: Validation, starts, objectives, settings, axis: Axis) -> list[list[_Found]]:
    """What all starts of all points of each task end with."""
    number = len(objectives[0])
    every = [task for task in validation.tasks for _ in range(number)]
    own = list(chain(*objectives))
    solved = solve_tasks(every, list(chain(*starts)), settings.steps, own, validation.work)
    found = [
        _reached(
            validation,
            place // number,
            axis,
            settings.objective,
            objective.unit(axis.weight) * getattr(objective, axis.weight),
            ended,
        )
        for place, (objective, ended) in enumerate(zip(own, solved, strict=True))
    ]
    return [list(chain(*found[i : i + number])) for i in range(0, len(found), number)]


def _reached(
    validation: Validation, index: int, axis: Axis, objective: Objective, weight: float, starts: list[Start]
) -> list[_Found]:
    """What the starts of a task ended with under a weight."""
    task = validation.tasks[index]
    if axis == NOISE:
        return _found(task, weight, starts)
    kept = [start for start in starts if math.isfinite(start.rms)]
    if not kept:
        return [_Found(task.literature, FAILED, 0.0)]
    coordinates = validation.coordinates(index, [start.gains for start in kept])[None]
    without, beside = (
        validation.losses(weighed(objective, axis, w), [index], coordinates)[0] for w in (0.0, 1.0)
    )
    excess = np.sqrt(np.maximum(0, beside**2 - without**2))
    return [
        _Found(start.gains, float(e), float(x)) for start, e, x in zip(kept, without, excess, strict=True)
    ]


def _found(task: TuneTask, weight: float, starts: list[Start]) -> list[_Found]:
    found = []
    for start in starts:
        excess = max(0.0, amplification(task.mechanism, task.compensator, start.gains) - 1)
        if math.isfinite(start.rms) and math.isfinite(excess):
            error = math.sqrt(max(0.0, start.rms**2 - (weight * excess) ** 2))
            found.append(_Found(start.gains, error, excess))
    return found or [_Found(task.literature, FAILED, 0.0)]


def _picked(pool: list[_Found], weights: np.ndarray) -> list[_Found]:
    """The best of all that was found, weight by weight."""
    return [min(pool, key=lambda one, weight=weight: one.value(weight)) for weight in weights]


def _neighbourhoods(picked: list[_Found]) -> list[list[dict[str, float]]]:
    """Of each point its gains and those of the points beside it, as far as they differ."""
    several = []
    for place, own in enumerate(picked):
        beside = [own, *picked[max(place - 1, 0) : place], *picked[place + 1 : place + 2]]
        several.append([one.gains for i, one in enumerate(beside) if one not in beside[:i]])
    return several


def _improved(before: list[list[_Found]], after: list[list[_Found]], ladders: list[np.ndarray]) -> bool:
    return any(
        new.value(weight) < (1 - IMPROVED) * old.value(weight)
        for olds, news, weights in zip(before, after, ladders, strict=True)
        for old, new, weight in zip(olds, news, weights, strict=True)
    )
