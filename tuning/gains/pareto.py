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

from jaxhil.mechanism.file import to_plain_data
from jaxhil.simulation.outcome import Outcome
from tuning.caches.checkpoints import NO_CHECKPOINTS, Checkpoints, compute_digest, decode_value, encode_value
from tuning.caches.cluster import WorkUnit, run_on_workers
from tuning.caches.worker import get_process_setting
from tuning.gains.objective import Objective, compute_contact_terms, evaluate_objective
from tuning.gains.pareto_search import (
    NOISE_CRITERION,
    PEAK_CRITERION,
    TRANSPARENCY_CRITERION,
    ParetoCriterion,
    compute_noise_amplification,
    estimate_ladder_runs,
    replace_weight,
    solve_weight_ladders,
)
from tuning.gains.search_progress import SearchProgress
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, build_task, group_by_program
from tuning.gains.tune import ErrorMetrics, TuneResult, compute_error_metrics, describe_group
from tuning.gains.tune_all import MAX_GROUP_SIZE
from tuning.gains.validation import Validation, build_validation, count_evaluated_runs, split_nominal
from tuning.statistics.bootstrap import ErrorIntervals, compute_error_intervals
from tuning.statistics.intervals import IntervalEstimate
from tuning.transparency.probes import compute_probe_metrics

TABLE_DIGITS = 4  # significant digits in which points are compared


class ParetoPoint(NamedTuple):
    """Gains of one weight of the trade-off, evaluated on fresh scenarios."""

    gains: dict[str, float]  # all gains of the compensator
    weight: float | None  # weight of the axis [1] in tuning; None for other gains
    # value on the axis [1]: the amplification A of the force sensor's noise, the 99th percentile of the peak
    # command over the ideal contact's, or the rms error of the transparency probes
    cost: float
    error: float  # objective without the axis's term [1]
    figures: ErrorMetrics  # metrics on the fresh scenarios
    nominal: ErrorMetrics  # metrics of the nominal run
    intervals: ErrorIntervals  # 95 % intervals of `compute_error_metrics`
    on_front: bool  # whether no other point dominates it (`find_dominated`)
    transparency: dict[str, IntervalEstimate] | None = None  # transparency, slope and peak, if probed

    @property
    def place(self) -> tuple[float, float]:
        """Return error and cost, rounded to the digits of a table."""
        return float(f"{self.error:.{TABLE_DIGITS}g}"), float(f"{self.cost:.{TABLE_DIGITS}g}")


class _FrontGroup(NamedTuple):
    """Mechanisms whose fronts are computed together, in one program."""

    tasks: list[TuneTask]  # one per mechanism
    tuned: list[TuneResult]  # tuning result of each mechanism
    number: int  # number of points
    axis: ParetoCriterion

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
            [(to_plain_data(result.mechanism), result.gains, result.starts) for result in self.tuned],
        ]

    @property
    def runs(self) -> int:
        """Return the approximate number of simulated runs."""
        searched = estimate_ladder_runs(self.tasks, self.number, self.settings)
        return searched + _count_evaluation_runs(self.tasks, self.settings, self.number)


class ParetoFront(NamedTuple):
    """Pareto front of error and the axis's cost for one mechanism."""

    points: list[ParetoPoint]  # in the order of their weights, the first of which is 0
    literature: ParetoPoint  # the literature's gains
    tuned: ParetoPoint  # the gains of the earlier tuning
    axis: ParetoCriterion = NOISE_CRITERION  # criterion traded against the error


def find_dominated(places: Sequence[tuple[float, float]]) -> list[bool]:
    """Return for each (error, cost) whether another one is better in one and no worse in the other."""
    return [
        any(e <= error and a <= noise and (e, a) != (error, noise) for e, a in places)
        for error, noise in places
    ]


def compute_fronts(
    results: Sequence[TuneResult],
    number: int,
    work: SearchProgress | None = None,
    axis: ParetoCriterion = NOISE_CRITERION,
    pieces: Checkpoints = NO_CHECKPOINTS,
    scheduler: str | None = None,
) -> Iterator[tuple[int, ParetoFront]]:
    """Yield (index, front of `number` points) of tuned mechanisms, in the order in which they finish.

    All were tuned with one compensator and the same settings; transparency needs settings that evaluate it.
    Each front is cached in `pieces`. With a `scheduler`, the workers of a cluster compute the fronts.
    """
    work = work or SearchProgress()
    tasks = _build_tasks(results)
    groups = group_by_program([task.loop for task in tasks], [task.scenarios for task in tasks])
    members = [
        group[begin : begin + MAX_GROUP_SIZE]
        for group in groups
        for begin in range(0, len(group), MAX_GROUP_SIZE)
    ]
    blocks = [
        _FrontGroup([tasks[i] for i in group], [results[i] for i in group], number, axis) for group in members
    ]
    work.runs_after_group = sum(block.runs for block in blocks)
    if scheduler is None:
        computed = _compute_locally(blocks, work, pieces)
    else:
        computed = _compute_on_cluster(scheduler, blocks, work, pieces)
    for index, block_fronts in computed:
        yield from zip(members[index], block_fronts, strict=True)


def _build_tasks(results: Sequence[TuneResult]) -> list[TuneTask]:
    return [
        build_task(
            r.mechanism, r.compensator, r.settings.scenarios, r.settings.seed, probed=r.settings.probed
        )
        for r in results
    ]


def _compute_locally(
    blocks: list[_FrontGroup], work: SearchProgress, pieces: Checkpoints
) -> Iterator[tuple[int, list[ParetoFront]]]:
    """Yield (index, fronts) of every block, in order."""
    for index, block in enumerate(blocks):
        work.runs_after_group -= block.runs
        work.name = describe_group(block.tasks)
        block_fronts = _read_fronts(block, pieces)
        if block_fronts is not None:
            work.keep("front as kept", block.runs)
        else:
            if pieces.is_enabled:
                work.journal = pieces.journal(block.names[0], block.inputs)
            block_fronts = _compute_group_fronts(block, work)
            _write_fronts(block, pieces, block_fronts)
            work.journal.finish()
        yield index, block_fronts


def _compute_on_cluster(
    scheduler: str, blocks: list[_FrontGroup], work: SearchProgress, pieces: Checkpoints
) -> Iterator[tuple[int, list[ParetoFront]]]:
    """Yield (index, fronts) of every block, in the order in which workers finish them."""
    missing = []
    for index, block in enumerate(blocks):
        block_fronts = _read_fronts(block, pieces)
        if block_fronts is None:
            # Outcomes and scenarios serve plots only, and are too large to send.
            light = [replace(result, outcomes={}, scenarios=None) for result in block.tuned]
            missing.append(WorkUnit(index, (light, block.number, block.axis)))
            continue
        work.runs_after_group -= block.runs
        work.keep("front as kept", block.runs)
        yield index, block_fronts
    what = f"pareto-{compute_digest([block.inputs for block in blocks])[:16]}"
    work.begin("on the cluster", 0.0)
    for index, content in run_on_workers(
        scheduler, compute_and_encode_fronts, missing, get_process_setting(), what
    ):
        block, block_fronts = blocks[index], decode_value(content, list[ParetoFront])
        work.runs_after_group -= block.runs
        work.name = describe_group(block.tasks)
        work.begin("front from the cluster", block.runs)
        work.report_runs(block.runs)
        _write_fronts(block, pieces, block_fronts)
        yield index, block_fronts


def compute_and_encode_fronts(tuned: list[TuneResult], number: int, axis: ParetoCriterion) -> bytes:
    """Return the encoded fronts of mechanisms of one program; called on a worker."""
    return encode_value(
        _compute_group_fronts(_FrontGroup(_build_tasks(tuned), tuned, number, axis), SearchProgress())
    )


def _read_fronts(block: _FrontGroup, pieces: Checkpoints) -> list[ParetoFront] | None:
    """Read a block's fronts from the cache; return None if one is missing."""
    if not pieces.is_enabled:
        return None
    block_fronts = [pieces.read(name, (block.inputs, i), ParetoFront) for i, name in enumerate(block.names)]
    return block_fronts if all(block_fronts) else None


def _write_fronts(block: _FrontGroup, pieces: Checkpoints, block_fronts: list[ParetoFront]) -> None:
    if pieces.is_enabled:
        for i, (name, front) in enumerate(zip(block.names, block_fronts, strict=True)):
            pieces.write(name, (block.inputs, i), front)


def _compute_group_fronts(block: _FrontGroup, work: SearchProgress) -> list[ParetoFront]:
    tasks, tuned, number, axis = block
    settings = block.settings
    work.begin(f"accuracy against {axis.name}, {number} points", block.runs)
    validation = build_validation(tasks, settings.validation, settings.seed, work)
    points = solve_weight_ladders(validation, tuned, number, settings, axis)
    work.begin(f"judging {number} points", _count_evaluation_runs(tasks, settings, number))
    return _evaluate_fronts(validation, tuned, points, settings, axis)


def _count_evaluation_runs(tasks: list[TuneTask], settings: TuneSettings, number: int) -> int:
    """Return the runs to evaluate the points, the literature's gains and the earlier gains."""
    return (number + 2) * len(tasks) * count_evaluated_runs(settings.validation, tasks[0].probed)


def _evaluate_fronts(
    validation: Validation,
    tuned: list[TuneResult],
    points: list[list[tuple[float, dict[str, float]]]],
    settings: TuneSettings,
    axis: ParetoCriterion,
) -> list[ParetoFront]:
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
            _evaluate_point(validation, index, settings.objective, axis, weight, gains, *pair)
            for (weight, gains), pair in zip(plan, pairs, strict=True)
        ]
        beaten = find_dominated([point.place for point in evaluated])
        evaluated = [
            p._replace(on_front=not is_beaten) for p, is_beaten in zip(evaluated, beaten, strict=True)
        ]
        fronts.append(ParetoFront(evaluated, literature, before, axis))
    return fronts


def _evaluate_point(
    validation: Validation,
    index: int,
    objective: Objective,
    axis: ParetoCriterion,
    weight: float | None,
    gains: dict[str, float],
    outcome: Outcome,
    with_probes: Outcome | None,
) -> ParetoPoint:
    task, probed = validation.tasks[index], validation.probed[index]
    fresh, nominal = split_nominal(outcome)
    noise = compute_noise_amplification(task.mechanism, task.compensator, gains)
    errors = np.asarray(compute_contact_terms(fresh)[0])[fresh.wanted]
    scenarios, probe_errors = fresh, None
    if with_probes is not None:
        scenarios = with_probes
        probes = jax.tree.map(lambda leaf: leaf[..., 1:], with_probes)
        probe_errors = np.asarray(compute_contact_terms(probes)[0])[probes.wanted]
    excesses, chatter = (np.asarray(term)[scenarios.wanted] for term in compute_contact_terms(scenarios)[1:])
    cost = noise
    if axis == PEAK_CRITERION:
        cost = float(np.percentile(fresh.peak_ratio[fresh.good], 99)) if fresh.good.any() else math.nan
    elif axis == TRANSPARENCY_CRITERION:
        cost = math.nan if probe_errors is None else float(np.sqrt(np.mean(probe_errors**2)))
    without_axis = replace_weight(objective, axis, 0.0)
    return ParetoPoint(
        gains=gains,
        weight=weight,
        cost=cost,
        error=float(evaluate_objective(without_axis, errors, excesses, noise, chatter, probe_errors)),
        figures=compute_error_metrics(fresh),
        nominal=compute_error_metrics(nominal),
        intervals=compute_error_intervals(fresh.error, fresh.good),
        on_front=False,
        transparency=compute_probe_metrics(probed, with_probes) if probed and with_probes else None,
    )
