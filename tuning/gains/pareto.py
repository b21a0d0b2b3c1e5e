"""The trade-off of restitution error against something else: gains for a ladder of weights.

A compensator that leads the measured force amplifies its noise. Tuned with a larger `Objective.noise_weight`
it is quieter, and less accurate: each weight gives a point of the front. What passes the noise on as it is
still may have to choose between accuracy and the peak of its command (`Objective.command_weight`), or between
accuracy and transparency (`Objective.transparency_weight`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxhil.mechanism.file import to_builtins
from jaxhil.simulation.outcome import Outcome
from tuning.caches.cluster import Piece, on_workers
from tuning.caches.pieces import NOTHING_KEPT, Pieces, decode, digest_of, encode
from tuning.caches.worker import setting
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


class _Block(NamedTuple):
    """Mechanisms whose fronts are found together, in one program."""

    tasks: list[TuneTask]  # one a mechanism
    tuned: list[TuneResult]  # what was tuned of each
    number: int  # of points
    axis: Axis

    @property
    def settings(self) -> TuneSettings:
        """How all were tuned."""
        return self.tuned[0].settings

    @property
    def names(self) -> list[str]:
        """Of the pieces."""
        return [f"pareto {one.mechanism.name}" for one in self.tuned]

    @property
    def inputs(self) -> list[Any]:
        """All that the fronts follow from."""
        return [
            *("pareto", self.number, self.axis, self.settings, self.tuned[0].compensator),
            [(to_builtins(one.mechanism), one.gains, one.starts) for one in self.tuned],
        ]

    @property
    def runs(self) -> int:
        """Simulated ones that it takes, about."""
        searched = ladder_runs(self.tasks, self.number, self.settings)
        return searched + _judging_runs(self.tasks, self.settings, self.number)


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
    scheduler: str | None = None,
) -> Iterator[tuple[int, Front]]:
    """(index, front of `number` points) of mechanisms that were tuned by one compensator with the same
    settings, as they are done. Transparency is traded by those whose settings judge it. Each front is a piece
    of those kept. With a `scheduler`, the workers of a cluster compute those of mechanisms of one program."""
    work = work or Work()
    tasks = _tasks(results)
    groups = alike([task.loop for task in tasks], [task.scenarios for task in tasks])
    places = [group[begin : begin + BLOCK] for group in groups for begin in range(0, len(group), BLOCK)]
    blocks = [_Block([tasks[i] for i in own], [results[i] for i in own], number, axis) for own in places]
    work.later = sum(block.runs for block in blocks)
    if scheduler is None:
        computed = _here(blocks, work, pieces)
    else:
        computed = _on_cluster(scheduler, blocks, work, pieces)
    for place, made in computed:
        yield from zip(places[place], made, strict=True)


def _tasks(results: Sequence[TuneResult]) -> list[TuneTask]:
    return [
        build_task(
            r.mechanism, r.compensator, r.settings.scenarios, r.settings.seed, probed=r.settings.probed
        )
        for r in results
    ]


def _here(blocks: list[_Block], work: Work, pieces: Pieces) -> Iterator[tuple[int, list[Front]]]:
    """(place, fronts) of every block, one after the other."""
    for place, block in enumerate(blocks):
        work.later -= block.runs
        work.name = block_name(block.tasks)
        made = _kept(block, pieces)
        if made is not None:
            work.keep("front as kept", block.runs)
        else:
            if pieces.keeps:
                work.journal = pieces.journal(block.names[0], block.inputs)
            made = _fronts_of(block, work)
            _keep(block, pieces, made)
            work.journal.finish()
        yield place, made


def _on_cluster(
    scheduler: str, blocks: list[_Block], work: Work, pieces: Pieces
) -> Iterator[tuple[int, list[Front]]]:
    """(place, fronts) of every block, in the order in which workers finish them."""
    missing = []
    for place, block in enumerate(blocks):
        made = _kept(block, pieces)
        if made is None:
            # Runs and scenarios are for plots, and many.
            light = [replace(one, outcomes={}, scenarios=None) for one in block.tuned]
            missing.append(Piece(place, (light, block.number, block.axis)))
            continue
        work.later -= block.runs
        work.keep("front as kept", block.runs)
        yield place, made
    what = f"pareto-{digest_of([block.inputs for block in blocks])[:16]}"
    work.begin("on the cluster", 0.0)
    for place, content in on_workers(scheduler, fronts_to_keep, missing, setting(), what):
        block, made = blocks[place], decode(content, list[Front])
        work.later -= block.runs
        work.name = block_name(block.tasks)
        work.begin("front from the cluster", block.runs)
        work.ran(block.runs)
        _keep(block, pieces, made)
        yield place, made


def fronts_to_keep(tuned: list[TuneResult], number: int, axis: Axis) -> bytes:
    """The fronts of mechanisms of one program, on a worker."""
    return encode(_fronts_of(_Block(_tasks(tuned), tuned, number, axis), Work()))


def _kept(block: _Block, pieces: Pieces) -> list[Front] | None:
    """A block's fronts as kept from before; None if one is missing."""
    if not pieces.keeps:
        return None
    kept = [pieces.read(name, (block.inputs, i), Front) for i, name in enumerate(block.names)]
    return kept if all(kept) else None


def _keep(block: _Block, pieces: Pieces, made: list[Front]) -> None:
    if pieces.keeps:
        for i, (name, front) in enumerate(zip(block.names, made, strict=True)):
            pieces.write(name, (block.inputs, i), front)


def _fronts_of(block: _Block, work: Work) -> list[Front]:
    tasks, tuned, number, axis = block
    settings = block.settings
    work.begin(f"accuracy against {axis.name}, {number} points", block.runs)
    validation = build_validation(tasks, settings.validation, settings.seed, work)
    points = solve_ladders(validation, tuned, number, settings, axis)
    work.begin(f"judging {number} points", _judging_runs(tasks, settings, number))
    return _judge(validation, tuned, points, settings, axis)


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
        error=float(objective_value(rest, errors, excesses, quiet, chatter, probe_errors)),
        figures=figures(fresh),
        nominal=figures(nominal),
        intervals=error_intervals(fresh.error, fresh.good),
        on_front=False,
        transparency=probe_figures(probed, with_probes) if probed and with_probes else None,
    )
