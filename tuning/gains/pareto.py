"""Pareto fronts of restitution error against a second criterion, from gains for a ladder of weights.

A compensator with phase lead amplifies the noise of the measured force. With a larger
`Objective.noise_weight` its command is quieter and less accurate; each weight gives a point of the front.
Other criteria are the peak of the command (`Objective.command_weight`) and transparency
(`Objective.transparency_weight`).
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

DIGITS = 4  # significant digits in which points are compared


class Point(NamedTuple):
    """Gains of one weight of the trade-off, evaluated on fresh scenarios."""

    gains: dict[str, float]  # all gains of the compensator
    weight: float | None  # weight of the axis [1] in tuning; None for other gains
    # value on the axis [1]: the amplification A of the force sensor's noise, the 99th percentile of the peak
    # command over the ideal contact's, or the rms error of the transparency probes
    cost: float
    error: float  # objective without the axis's term [1]
    figures: ErrorFigures  # metrics on the fresh scenarios
    nominal: ErrorFigures  # metrics of the nominal run
    intervals: ErrorIntervals  # 95 % intervals of `figures`
    on_front: bool  # whether no other point dominates it (`dominated`)
    transparency: dict[str, Estimate] | None = None  # transparency, slope and peak, if probed

    @property
    def place(self) -> tuple[float, float]:
        """Return error and cost, rounded to the digits of a table."""
        return float(f"{self.error:.{DIGITS}g}"), float(f"{self.cost:.{DIGITS}g}")


class _Block(NamedTuple):
    """Mechanisms whose fronts are computed together, in one program."""

    tasks: list[TuneTask]  # one per mechanism
    tuned: list[TuneResult]  # tuning result of each mechanism
    number: int  # number of points
    axis: Axis

    @property
    def settings(self) -> TuneSettings:
        """Return the settings with which all mechanisms were tuned."""
        return self.tuned[0].settings

    @property
    def names(self) -> list[str]:
        """Return the names of the pieces."""
        return [f"pareto {result.mechanism.name}" for result in self.tuned]

    @property
    def inputs(self) -> list[Any]:
        """Return all inputs that determine the fronts."""
        return [
            *("pareto", self.number, self.axis, self.settings, self.tuned[0].compensator),
            [(to_builtins(result.mechanism), result.gains, result.starts) for result in self.tuned],
        ]

    @property
    def runs(self) -> int:
        """Return the approximate number of simulated runs."""
        searched = ladder_runs(self.tasks, self.number, self.settings)
        return searched + _evaluation_runs(self.tasks, self.settings, self.number)


class Front(NamedTuple):
    """Pareto front of error and the axis's cost for one mechanism."""

    points: list[Point]  # in the order of their weights, the first of which is 0
    literature: Point  # the literature's gains
    tuned: Point  # the gains of the earlier tuning
    axis: Axis = NOISE  # criterion traded against the error


def dominated(places: Sequence[tuple[float, float]]) -> list[bool]:
    """Return for each (error, cost) whether another one is better in one and no worse in the other."""
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
    """Yield (index, front of `number` points) of tuned mechanisms, in the order in which they finish.

    All were tuned with one compensator and the same settings; transparency needs settings that evaluate it.
    Each front is cached in `pieces`. With a `scheduler`, the workers of a cluster compute the fronts.
    """
    work = work or Work()
    tasks = _tasks(results)
    groups = alike([task.loop for task in tasks], [task.scenarios for task in tasks])
    members = [group[begin : begin + BLOCK] for group in groups for begin in range(0, len(group), BLOCK)]
    blocks = [
        _Block([tasks[i] for i in group], [results[i] for i in group], number, axis) for group in members
    ]
    work.later = sum(block.runs for block in blocks)
    if scheduler is None:
        computed = _here(blocks, work, pieces)
    else:
        computed = _on_cluster(scheduler, blocks, work, pieces)
    for index, block_fronts in computed:
        yield from zip(members[index], block_fronts, strict=True)


def _tasks(results: Sequence[TuneResult]) -> list[TuneTask]:
    return [
        build_task(
            r.mechanism, r.compensator, r.settings.scenarios, r.settings.seed, probed=r.settings.probed
        )
        for r in results
    ]


def _here(blocks: list[_Block], work: Work, pieces: Pieces) -> Iterator[tuple[int, list[Front]]]:
    """Yield (index, fronts) of every block, in order."""
    for index, block in enumerate(blocks):
        work.later -= block.runs
        work.name = block_name(block.tasks)
        block_fronts = _read(block, pieces)
        if block_fronts is not None:
            work.keep("front as kept", block.runs)
        else:
            if pieces.keeps:
                work.journal = pieces.journal(block.names[0], block.inputs)
            block_fronts = _fronts_of(block, work)
            _write(block, pieces, block_fronts)
            work.journal.finish()
        yield index, block_fronts


def _on_cluster(
    scheduler: str, blocks: list[_Block], work: Work, pieces: Pieces
) -> Iterator[tuple[int, list[Front]]]:
    """Yield (index, fronts) of every block, in the order in which workers finish them."""
    missing = []
    for index, block in enumerate(blocks):
        block_fronts = _read(block, pieces)
        if block_fronts is None:
            # Outcomes and scenarios serve plots only, and are too large to send.
            light = [replace(result, outcomes={}, scenarios=None) for result in block.tuned]
            missing.append(Piece(index, (light, block.number, block.axis)))
            continue
        work.later -= block.runs
        work.keep("front as kept", block.runs)
        yield index, block_fronts
    what = f"pareto-{digest_of([block.inputs for block in blocks])[:16]}"
    work.begin("on the cluster", 0.0)
    for index, content in on_workers(scheduler, fronts_to_keep, missing, setting(), what):
        block, block_fronts = blocks[index], decode(content, list[Front])
        work.later -= block.runs
        work.name = block_name(block.tasks)
        work.begin("front from the cluster", block.runs)
        work.ran(block.runs)
        _write(block, pieces, block_fronts)
        yield index, block_fronts


def fronts_to_keep(tuned: list[TuneResult], number: int, axis: Axis) -> bytes:
    """Return the encoded fronts of mechanisms of one program; called on a worker."""
    return encode(_fronts_of(_Block(_tasks(tuned), tuned, number, axis), Work()))


def _read(block: _Block, pieces: Pieces) -> list[Front] | None:
    """Read a block's fronts from the cache; return None if one is missing."""
    if not pieces.keeps:
        return None
    block_fronts = [pieces.read(name, (block.inputs, i), Front) for i, name in enumerate(block.names)]
    return block_fronts if all(block_fronts) else None


def _write(block: _Block, pieces: Pieces, block_fronts: list[Front]) -> None:
    if pieces.keeps:
        for i, (name, front) in enumerate(zip(block.names, block_fronts, strict=True)):
            pieces.write(name, (block.inputs, i), front)


def _fronts_of(block: _Block, work: Work) -> list[Front]:
    tasks, tuned, number, axis = block
    settings = block.settings
    work.begin(f"accuracy against {axis.name}, {number} points", block.runs)
    validation = build_validation(tasks, settings.validation, settings.seed, work)
    points = solve_ladders(validation, tuned, number, settings, axis)
    work.begin(f"judging {number} points", _evaluation_runs(tasks, settings, number))
    return _evaluate(validation, tuned, points, settings, axis)


def _evaluation_runs(tasks: list[TuneTask], settings: TuneSettings, number: int) -> int:
    """Return the runs to evaluate the points, the literature's gains and the earlier gains."""
    return (number + 2) * len(tasks) * judged_runs(settings.validation, tasks[0].probed)


def _evaluate(
    validation: Validation,
    tuned: list[TuneResult],
    points: list[list[tuple[float, dict[str, float]]]],
    settings: TuneSettings,
    axis: Axis,
) -> list[Front]:
    """Evaluate the points, the literature's gains and the earlier gains of every task on fresh scenarios."""
    plans = [
        [*ladder, (None, task.literature), (None, result.gains)]
        for task, result, ladder in zip(validation.tasks, tuned, points, strict=True)
    ]
    # One set of gains of every task at a time, as in the evaluation after tuning.
    outcomes = [validation.judge([gains for _, gains in row]) for row in zip(*plans, strict=True)]
    fronts = []
    for index, (plan, pairs) in enumerate(zip(plans, zip(*outcomes, strict=True), strict=True)):
        *evaluated, literature, before = [
            _point(validation, index, settings.objective, axis, weight, gains, *pair)
            for (weight, gains), pair in zip(plan, pairs, strict=True)
        ]
        beaten = dominated([point.place for point in evaluated])
        evaluated = [
            p._replace(on_front=not is_beaten) for p, is_beaten in zip(evaluated, beaten, strict=True)
        ]
        fronts.append(Front(evaluated, literature, before, axis))
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
    noise = amplification(task.mechanism, task.compensator, gains)
    errors = np.asarray(contact_terms(fresh)[0])[fresh.wanted]
    scenarios, probe_errors = fresh, None
    if with_probes is not None:
        scenarios = with_probes
        probes = jax.tree.map(lambda leaf: leaf[..., 1:], with_probes)
        probe_errors = np.asarray(contact_terms(probes)[0])[probes.wanted]
    excesses, chatter = (np.asarray(term)[scenarios.wanted] for term in contact_terms(scenarios)[1:])
    cost = noise
    if axis == PEAK:
        cost = float(np.percentile(fresh.peak_ratio[fresh.good], 99)) if fresh.good.any() else math.nan
    elif axis == TRANSPARENCY:
        cost = math.nan if probe_errors is None else float(np.sqrt(np.mean(probe_errors**2)))
    without_axis = weighed(objective, axis, 0.0)
    return Point(
        gains=gains,
        weight=weight,
        cost=cost,
        error=float(objective_value(without_axis, errors, excesses, noise, chatter, probe_errors)),
        figures=figures(fresh),
        nominal=figures(nominal),
        intervals=error_intervals(fresh.error, fresh.good),
        on_front=False,
        transparency=probe_figures(probed, with_probes) if probed and with_probes else None,
    )
