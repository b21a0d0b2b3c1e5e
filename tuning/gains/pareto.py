"""The trade-off of restitution error against something else: gains for a ladder of weights.

A compensator that leads the measured force amplifies its noise. Tuned with a larger `Objective.noise_weight`
it is quieter, and less accurate: each weight gives a point of the front. What passes the noise on as it is
still may have to choose between accuracy and the peak of its command (`Objective.command_weight`), or between
accuracy and transparency (`Objective.transparency_weight`).
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np

from jaxhil.mechanism.file import to_builtins
from jaxhil.simulation.evaluation import Outcome
from tuning.caches.pieces import NOTHING_KEPT, Pieces
from tuning.gains.objective import Objective, contact_terms, objective_value
from tuning.gains.pareto_search import (
    NOISE,
    PEAK,
    TRANSPARENCY,
    Axis,
    amplification,
    ladder_runs,
    solve_ladders,
    weighed,
)
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, alike, build_task
from tuning.gains.tune import ErrorFigures, TuneResult, block_name, figures
from tuning.gains.tune_all import BLOCK
from tuning.gains.validation import Validation, build_validation, judged_runs, split_nominal
from tuning.gains.work import Work
from tuning.statistics.bootstrap import ErrorIntervals, error_intervals
from tuning.statistics.intervals import Estimate
from tuning.transparency.probes import probe_figures

DIGITS = 4  # significant ones, in which points are compared


class Point(NamedTuple):
    """Gains on the way between accuracy and the axis's cost, judged on fresh scenarios."""

    gains: dict[str, float]  # all of the compensator's
    weight: float | None  # of the axis [1], that they were tuned with; None: tuned otherwise
    # on the axis [1]: the amplification A of the force sensor's noise, the 99th percentile of the peak
    # command over the reference's, or the rms error of the transparency probes
    cost: float
    error: float  # the objective without the axis's term [1]
    figures: ErrorFigures  # of fresh scenarios
    nominal: ErrorFigures  # those of the nominal run
    intervals: ErrorIntervals  # 95 % intervals of `figures`
    on_front: bool  # whether no other point beats it (`dominated`)
    transparency: dict[str, Estimate] | None = None  # transparency, slope and peak, if probed

    @property
    def place(self) -> tuple[float, float]:
        """Error and cost, to the digits that a table has."""
        return float(f"{self.error:.{DIGITS}g}"), float(f"{self.cost:.{DIGITS}g}")


class Front(NamedTuple):
    """What can be had of accuracy and of the axis's cost."""

    points: list[Point]  # in the order of their weights, the first without
    literature: Point  # the literature's gains
    tuned: Point  # those tuned before
    axis: Axis = NOISE  # what accuracy is traded against


def dominated(places: Sequence[tuple[float, float]]) -> list[bool]:
    """Of each place (error, amplification) whether another is better in one and no worse in the other."""
    return [
        any(e <= error and a <= noise and (e, a) != (error, noise) for e, a in places)
        for error, noise in places
    ]


def fronts(
    results: Sequence[TuneResult],
    number: int,
    work: Work | None = None,
    axis: Axis = NOISE,
    pieces: Pieces = NOTHING_KEPT,
) -> Iterator[tuple[int, Front]]:
    """(index, front of `number` points) of mechanisms that were tuned by one compensator with the same
    settings, as they are done. Transparency is traded by those whose settings judge it. Each front is a piece
    of those kept."""
    work = work or Work()
    settings = results[0].settings if results else TuneSettings()
    tasks = [
        build_task(r.mechanism, r.compensator, settings.scenarios, settings.seed, probed=settings.probed)
        for r in results
    ]
    groups = alike([task.loop for task in tasks], [task.scenarios for task in tasks])
    blocks = [group[begin : begin + BLOCK] for group in groups for begin in range(0, len(group), BLOCK)]
    expected = [_expected_runs([tasks[index] for index in block], settings, number) for block in blocks]
    for place, block in enumerate(blocks):
        work.later = sum(expected[place + 1 :])
        some, tuned = [tasks[index] for index in block], [results[index] for index in block]
        work.name = block_name(some)
        made = _kept_or_made(some, tuned, number, settings, work, axis, pieces)
        yield from zip(block, made, strict=True)


def _kept_or_made(
    tasks: list[TuneTask],
    tuned: list[TuneResult],
    number: int,
    settings: TuneSettings,
    work: Work,
    axis: Axis,
    pieces: Pieces,
) -> list[Front]:
    """The fronts of mechanisms of one program, kept from before or made now."""
    if not pieces.keeps:
        return _fronts_of(tasks, tuned, number, settings, work, axis)
    inputs = [
        *("pareto", number, axis, settings, tuned[0].compensator),
        [(to_builtins(one.mechanism), one.gains, one.starts) for one in tuned],
    ]
    names = [f"pareto {one.mechanism.name}" for one in tuned]
    kept = [pieces.read(name, (inputs, i), Front) for i, name in enumerate(names)]
    if all(kept):
        work.keep("front as kept", _expected_runs(tasks, settings, number))
        return kept
    work.journal = pieces.journal(names[0], inputs)
    made = _fronts_of(tasks, tuned, number, settings, work, axis)
    for i, (name, front) in enumerate(zip(names, made, strict=True)):
        pieces.write(name, (inputs, i), front)
    work.journal.finish()
    return made


def _fronts_of(
    tasks: list[TuneTask],
    tuned: list[TuneResult],
    number: int,
    settings: TuneSettings,
    work: Work,
    axis: Axis,
) -> list[Front]:
    work.begin(f"accuracy against {axis.name}, {number} points", _expected_runs(tasks, settings, number))
    validation = build_validation(tasks, settings.validation, settings.seed, work)
    points = solve_ladders(validation, tuned, number, settings, axis)
    work.begin(f"judging {number} points", _judging_runs(tasks, settings, number))
    return _judge(validation, tuned, points, settings, axis)


def _expected_runs(tasks: list[TuneTask], settings: TuneSettings, number: int) -> int:
    return ladder_runs(tasks, number, settings) + _judging_runs(tasks, settings, number)


def _judging_runs(tasks: list[TuneTask], settings: TuneSettings, number: int) -> int:
    """The literature's gains and those tuned before are judged too."""
    return (number + 2) * len(tasks) * judged_runs(settings.validation, tasks[0].probed)


def _judge(
    validation: Validation,
    tuned: list[TuneResult],
    points: list[list[tuple[float, dict[str, float]]]],
    settings: TuneSettings,
    axis: Axis,
) -> list[Front]:
    """The points of every task on fresh scenarios, the literature's gains and those tuned before beside."""
    plans = [
        [*own, (None, task.literature), (None, one.gains)]
        for task, one, own in zip(validation.tasks, tuned, points, strict=True)
    ]
    # One set of gains of every task at a time, as they were judged when they were tuned.
    outcomes = [validation.judge([gains for _, gains in row]) for row in zip(*plans, strict=True)]
    fronts = []
    for index, (plan, own) in enumerate(zip(plans, zip(*outcomes, strict=True), strict=True)):
        judged = [
            _point(validation, index, settings.objective, axis, weight, gains, *both)
            for (weight, gains), both in zip(plan, own, strict=True)
        ]
        *made, literature, before = judged
        beaten = dominated([one.place for one in made])
        made = [one._replace(on_front=not lost) for one, lost in zip(made, beaten, strict=True)]
        fronts.append(Front(made, literature, before, axis))
    return fronts


def _point(
    validation: Validation,
    index: int,
    objective: Objective,
    axis: Axis,
    weight: float | None,
    gains: dict[str, float],
    outcome: Outcome,
    with_probes: Outcome | None,
) -> Point:
    task, probed = validation.tasks[index], validation.probed[index]
    fresh, nominal = split_nominal(outcome)
    quiet = amplification(task.mechanism, task.compensator, gains)
    errors = np.asarray(contact_terms(fresh)[0])[fresh.wanted]
    every, probe_errors = fresh, None
    if with_probes is not None:
        every = with_probes
        probes = jax.tree.map(lambda leaf: leaf[..., 1:], with_probes)
        probe_errors = np.asarray(contact_terms(probes)[0])[probes.wanted]
    excesses, chatter = (np.asarray(term)[every.wanted] for term in contact_terms(every)[1:])
    cost = quiet
    if axis == PEAK:
        cost = float(np.percentile(fresh.peak_ratio[fresh.good], 99)) if fresh.good.any() else math.nan
    elif axis == TRANSPARENCY:
        cost = math.nan if probe_errors is None else float(np.sqrt(np.mean(probe_errors**2)))
    rest = weighed(objective, axis, 0.0)
    return Point(
        gains=gains,
        weight=weight,
        cost=cost,
        error=objective_value(rest, errors, excesses, quiet, chatter, probe_errors),
        figures=figures(fresh),
        nominal=figures(nominal),
        intervals=error_intervals(fresh.error, fresh.good),
        on_front=False,
        transparency=probe_figures(probed, with_probes) if probed and with_probes else None,
    )
