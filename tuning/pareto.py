"""The trade-off of restitution error against amplification of sensor noise: gains for a ladder of weights.

A compensator that leads the measured force amplifies its noise. Tuned with a larger `Objective.noise_weight`
it is quieter, and less accurate: each weight gives a point of the front. All weights of all mechanisms are
problems of one program, on the scenarios that the mechanisms were tuned on. Points help each other: gains
found for one weight are what its neighbours on the ladder begin at next, until none gets better.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.compensators import COMPENSATORS, Compensator, Constants
from jaxhil.evaluation import Outcome
from jaxhil.mechanism import Mechanism
from tuning.box import to_shares
from tuning.finding import choose_starts
from tuning.objective import FAILED, Objective, contact_terms, objective_value
from tuning.problems import Task, alike, build_task
from tuning.rounds import Start, solve_tasks
from tuning.trial import Trial
from tuning.trust import Intervals, interval
from tuning.tune import BLOCK, Figures, Result, Settings, figures

# The ladder's ends: how many times the noise of accurate gains weighs what their error does. The first one
# reaches further: what is quiet without being accurate is a start that the solver does not come by itself.
ENDS, FIRST_ENDS = (0.5, 10.0), (1.0, 100.0)
ACCURATE = 1.05  # error, over the least that is known, of gains that still are accurate
LEAST_EXCESS = 0.1  # amplification beyond 1 that the ladder is made for where there is next to none
DIGITS = 4  # significant ones, to which points are told apart
PASSES = 4  # in which points begin at what their neighbours found
IMPROVED = 1e-3  # by which a point gets better in a pass that is not the last


class Point(NamedTuple):
    """Gains, the noise weight [1] they were tuned with (None: otherwise), the amplification A of the force
    sensor's noise [1], the objective without its noise term [1] on fresh scenarios; figures of these and of
    the nominal run, confidence intervals; whether no other point beats it (`dominated`)."""

    gains: dict[str, float]
    noise_weight: float | None
    amplification: float
    error: float
    figures: Figures
    nominal: Figures
    intervals: Intervals
    on_front: bool

    @property
    def place(self) -> tuple[float, float]:
        """Error and amplification, to the digits that a table has."""
        return float(f"{self.error:.{DIGITS}g}"), float(f"{self.amplification:.{DIGITS}g}")


class Front(NamedTuple):
    """Points in the order of their weights, the first without; the literature's gains and those tuned before
    beside them."""

    points: list[Point]
    literature: Point
    tuned: Point


def has_trade_off(compensator: str) -> bool:
    """Whether a compensator's gains change how much sensor noise it passes on."""
    return type(COMPENSATORS[compensator]).noise_amplification is not Compensator.noise_amplification


def amplification(mechanism: Mechanism, compensator: str, gains: Mapping[str, float]) -> float:
    """A [1], nominally: `Compensator.noise_amplification`."""
    period, clearance = mechanism.rig.control_period, mechanism.contact.clearance
    constants = Constants(jnp.asarray(period), jnp.asarray(clearance))
    values = {name: jnp.asarray(value) for name, value in gains.items()}
    return float(COMPENSATORS[compensator].noise_amplification(values, constants))


def ladder(number: int, error: float, excess: float, ends: tuple[float, float] = ENDS) -> np.ndarray:
    """(number,) noise weights [1]: 0, then evenly on a logarithmic scale.

    `error` and `excess` are J and A - 1 of accurate gains: the weights at the ends make their noise term so
    many times their error.
    """
    light, heavy = ends
    weights = np.geomspace(heavy, light, number - 1)[::-1] * error / max(excess, LEAST_EXCESS)
    return np.concatenate([[0.0], weights])


def dominated(places: Sequence[tuple[float, float]]) -> list[bool]:
    """Of each place (error, amplification) whether another is better in one and no worse in the other."""
    return [
        any(e <= error and a <= noise and (e, a) != (error, noise) for e, a in places)
        for error, noise in places
    ]


def fronts(
    results: Sequence[Result], number: int, report: Callable[[str], None] = lambda text: None
) -> Iterator[tuple[int, Front]]:
    """(index, front of `number` points) of mechanisms that were tuned by one compensator with the same
    settings, as they are done."""
    settings = results[0].settings if results else Settings()
    tasks = [build_task(r.mechanism, r.compensator, settings.scenarios, settings.seed) for r in results]
    for group in alike([task.loop for task in tasks], [task.scenarios for task in tasks]):
        for begin in range(0, len(group), BLOCK):
            block = group[begin : begin + BLOCK]
            some, tuned = [tasks[index] for index in block], [results[index] for index in block]
            name = some[0].mechanism.name if len(some) == 1 else f"{len(some)} mechanisms"
            report(f"{name}: accuracy against noise, {number} points")
            trial = Trial(some, settings.validation, settings.seed)
            points = _solve(trial, tuned, number, settings, lambda text, name=name: report(f"{name}: {text}"))
            report(f"{name}: judging {number} points")
            yield from zip(block, _judge(trial, tuned, points, settings), strict=True)


class _Found(NamedTuple):
    """Gains of a mechanism, and what they reach on its training scenarios: J without its noise term, and
    max(0, A - 1)."""

    gains: dict[str, float]
    error: float
    excess: float

    def value(self, noise_weight: float) -> float:
        """J for a weight."""
        return math.hypot(self.error, noise_weight * self.excess)


def _solve(
    trial: Trial, tuned: list[Result], number: int, settings: Settings, report: Callable[[str], None]
) -> list[list[tuple[float, dict[str, float]]]]:
    """Noise weight and gains of every point of every task."""
    weight = settings.objective.noise_weight
    pools = [_found(task, weight, one.starts) for task, one in zip(trial.tasks, tuned, strict=True)]
    ladders = []
    for turn in range(1 + PASSES):
        # How accurate gains can be, and how quiet those are, is known better every time.
        ends = ENDS if turn > 0 else FIRST_ENDS
        ladders = [_fitting_ladder(pool, number, ends) for pool in pools]
        before = [_picked(pool, weights) for pool, weights in zip(pools, ladders, strict=True)]
        objectives = [[_weighed(settings, weight) for weight in weights] for weights in ladders]
        starts = _around(trial, before) if turn > 0 else _anywhere(trial, tuned, objectives, settings)
        found = _search(trial.tasks, starts, objectives, settings, report)
        pools = [pool + new for pool, new in zip(pools, found, strict=True)]
        after = [_picked(pool, weights) for pool, weights in zip(pools, ladders, strict=True)]
        if turn > 0 and not _improved(before, after, ladders):
            break
    return [
        [(float(weight), one.gains) for weight, one in zip(weights, _picked(pool, weights), strict=True)]
        for pool, weights in zip(pools, ladders, strict=True)
    ]


def _fitting_ladder(pool: list[_Found], number: int, ends: tuple[float, float]) -> np.ndarray:
    least = min(one.error for one in pool)
    accurate = min((one for one in pool if one.error <= ACCURATE * least), key=lambda one: one.excess)
    return ladder(number, accurate.error, accurate.excess, ends)


def _weighed(settings: Settings, weight: float) -> Objective:
    return dataclasses.replace(settings.objective, noise_weight=float(weight))


def _anywhere(
    trial: Trial, tuned: list[Result], objectives: list[list[Objective]], settings: Settings
) -> list[list[np.ndarray]]:
    """Shares that every point of each task begins at: the usual ones for its weight, and those tuned
    before."""
    number, first = max(settings.starts, 2), [[one.gains] for one in tuned]
    by_point = [
        choose_starts(trial, number, settings.seed, own, first) for own in zip(*objectives, strict=True)
    ]
    return [list(own) for own in zip(*by_point, strict=True)]


def _around(trial: Trial, picked: list[list[_Found]]) -> list[list[np.ndarray]]:
    """Shares that every point of each task begins at: what it and its neighbours found."""
    return [
        [
            to_shares(np.array([[gains[name] for name in trial.names] for gains in several]), bounds)
            for several in _neighbourhoods(own)
        ]
        for own, bounds in zip(picked, trial.bounds, strict=True)
    ]


def _search(tasks, starts, objectives, settings, report) -> list[list[_Found]]:
    """What all starts of all points of each task end with."""
    number = len(objectives[0])
    every = [task for task in tasks for _ in range(number)]
    own = list(chain(*objectives))
    solved = solve_tasks(every, list(chain(*starts)), settings.steps, own, report)
    weights = [objective.noise_weight for objective in own]
    found = [_found(*one) for one in zip(every, weights, solved, strict=True)]
    return [list(chain(*found[i : i + number])) for i in range(0, len(found), number)]


def _found(task: Task, weight: float, starts: list[Start]) -> list[_Found]:
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


def _judge(
    trial: Trial,
    tuned: list[Result],
    points: list[list[tuple[float, dict[str, float]]]],
    settings: Settings,
) -> list[Front]:
    """The points of every task on fresh scenarios, the literature's gains and those tuned before beside."""
    plans = [
        [*own, (None, task.literature), (None, one.gains)]
        for task, one, own in zip(trial.tasks, tuned, points, strict=True)
    ]
    # One set of gains of every task at a time, as they were judged when they were tuned.
    outcomes = [trial.judge([gains for _, gains in row]) for row in zip(*plans, strict=True)]
    fronts = []
    for task, plan, own in zip(trial.tasks, plans, zip(*outcomes, strict=True), strict=True):
        judged = [
            _point(task, settings.objective, weight, gains, outcome)
            for (weight, gains), outcome in zip(plan, own, strict=True)
        ]
        *made, literature, before = judged
        beaten = dominated([one.place for one in made])
        made = [one._replace(on_front=not lost) for one, lost in zip(made, beaten, strict=True)]
        fronts.append(Front(made, literature, before))
    return fronts


def _point(task: Task, objective: Objective, weight: float | None, gains, outcome: Outcome) -> Point:
    fresh, nominal = (
        jax.tree.map(lambda leaf, cut=cut: leaf[..., cut], outcome) for cut in (slice(-1), slice(-1, None))
    )
    errors, excesses, chatter = (np.asarray(term)[fresh.wanted] for term in contact_terms(fresh))
    return Point(
        gains=gains,
        noise_weight=weight,
        amplification=amplification(task.mechanism, task.compensator, gains),
        error=objective_value(objective, errors, excesses, chatter=chatter),
        figures=figures(fresh),
        nominal=figures(nominal),
        intervals=interval(fresh.error, fresh.good),
        on_front=False,
    )
