"""Pareto fronts of restitution error against a second criterion.

The second criterion is noise amplification, the peak of the force command or transparency. Each point of a
front is a set of gains, tuned with a different weight of the second criterion in the objective
(`Objective.noise_weight`, `command_weight` or `transparency_weight`). For example, a larger noise weight
gives a quieter, less accurate force command.
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
from tuning.gains.contact_terms import compute_contact_terms
from tuning.gains.objective import Objective, evaluate_objective
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

TABLE_DIGITS = 4  # significant digits to which points are rounded before they are compared


class ParetoPoint(NamedTuple):
    """Point of a Pareto front: gains and their metrics on fresh scenarios."""

    gains: dict[str, float]  # all gains of the compensator
    weight: float | None  # weight of the second criterion in tuning [1]; None if it was not used
    # second criterion [1]: the amplification of the force sensor's noise, the 99th percentile of the peak
    # command divided by the ideal contact's peak force, or the rms error of the transparency probes
    cost: float
    error: float  # objective without the second criterion's term [1]
    figures: ErrorMetrics  # metrics on the fresh scenarios
    nominal: ErrorMetrics  # metrics of the nominal run
    intervals: ErrorIntervals  # 95 % confidence intervals of the metrics on the fresh scenarios
    on_front: bool  # whether no other point dominates this point (`find_dominated`)
    # transparency, its slope and its peak, with confidence intervals; None for scenarios without probes
    transparency: dict[str, IntervalEstimate] | None = None

    @property
    def place(self) -> tuple[float, float]:
        """Return the error and cost [1] as they appear in tables, with `TABLE_DIGITS` significant digits."""
        return float(f"{self.error:.{TABLE_DIGITS}g}"), float(f"{self.cost:.{TABLE_DIGITS}g}")


class _FrontGroup(NamedTuple):
    """Mechanisms whose Pareto fronts one compiled program computes together."""

    tasks: list[TuneTask]  # one tuning task per mechanism
    tuned: list[TuneResult]  # earlier tuning result of each mechanism
    number: int  # number of points per front
    axis: ParetoCriterion  # second criterion of the fronts

    @property
    def settings(self) -> TuneSettings:
        return self.tuned[0].settings

    @property
    def names(self) -> list[str]:
        """Return the name of each mechanism's checkpoint."""
        return [f"pareto {result.mechanism.name}" for result in self.tuned]

    @property
    def inputs(self) -> list[Any]:
        """Return all inputs that the Pareto fronts of this group depend on, as a key of the cache."""
        return [
            *("pareto", self.number, self.axis, self.settings, self.tuned[0].compensator),
            [(to_plain_data(result.mechanism), result.gains, result.starts) for result in self.tuned],
        ]

    @property
    def runs(self) -> int:
        searched = estimate_ladder_runs(self.tasks, self.number, self.settings)
        return searched + _count_evaluation_runs(self.tasks, self.settings, self.number)


class ParetoFront(NamedTuple):
    """Pareto front of one mechanism: restitution error against a second criterion."""

    points: list[ParetoPoint]  # points in ascending order of weight; the first weight is 0
    literature: ParetoPoint  # point of the literature's gains
    tuned: ParetoPoint  # point of the gains of the earlier tuning
    axis: ParetoCriterion = NOISE_CRITERION  # second criterion


def find_dominated(places: Sequence[tuple[float, float]]) -> list[bool]:
    """Return for each pair (error, cost) whether another pair is smaller in one number and larger in none."""
    return [
        any(e <= error and a <= noise and (e, a) != (error, noise) for e, a in places)
        for error, noise in places
    ]


def compute_fronts(
    results: Sequence[TuneResult],
    number: int,
    work: SearchProgress | None = None,
    axis: ParetoCriterion = NOISE_CRITERION,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    scheduler: str | None = None,
) -> Iterator[tuple[int, ParetoFront]]:
    """Compute the Pareto fronts of tuned mechanisms; yield (index, front) as soon as a front is complete.

    All `results` have the same compensator and settings. If the second criterion `axis` is transparency, the
    settings must evaluate transparency. Each front has `number` points and is cached in `checkpoints`. If
    `scheduler` is given, the workers of a cluster compute the fronts.
    """
    work = work or SearchProgress()
    tasks = _build_tasks(results)
    members = [
        indices[begin : begin + MAX_GROUP_SIZE]
        for indices in group_by_program([task.loop for task in tasks], [task.scenarios for task in tasks])
        for begin in range(0, len(indices), MAX_GROUP_SIZE)
    ]
    groups = [
        _FrontGroup([tasks[i] for i in indices], [results[i] for i in indices], number, axis)
        for indices in members
    ]
    work.runs_after_group = sum(group.runs for group in groups)
    if scheduler is None:
        computed = _compute_locally(groups, work, checkpoints)
    else:
        computed = _compute_on_cluster(scheduler, groups, work, checkpoints)
    for index, group_fronts in computed:
        yield from zip(members[index], group_fronts, strict=True)


def _build_tasks(results: Sequence[TuneResult]) -> list[TuneTask]:
    return [
        build_task(
            r.mechanism, r.compensator, r.settings.scenarios, r.settings.seed, probed=r.settings.probed
        )
        for r in results
    ]


def _compute_locally(
    groups: list[_FrontGroup], work: SearchProgress, checkpoints: Checkpoints
) -> Iterator[tuple[int, list[ParetoFront]]]:
    """Compute the Pareto fronts of each group of mechanisms; yield (index of the group, fronts)."""
    for index, group in enumerate(groups):
        work.runs_after_group -= group.runs
        work.name = describe_group(group.tasks)
        group_fronts = _read_fronts(group, checkpoints)
        if group_fronts is not None:
            work.keep("front from the cache", group.runs)
        else:
            if checkpoints.is_enabled:
                work.journal = checkpoints.journal(group.names[0], group.inputs)
            group_fronts = _compute_group_fronts(group, work)
            _write_fronts(group, checkpoints, group_fronts)
            work.journal.finish()
        yield index, group_fronts


def _compute_on_cluster(
    scheduler: str, groups: list[_FrontGroup], work: SearchProgress, checkpoints: Checkpoints
) -> Iterator[tuple[int, list[ParetoFront]]]:
    """Compute Pareto fronts on a cluster; yield (index of the group, fronts) of each finished group."""
    missing = []
    for index, group in enumerate(groups):
        group_fronts = _read_fronts(group, checkpoints)
        if group_fronts is None:
            # Outcomes and scenarios are needed for plots only, and are too large to send to a worker.
            light = [replace(result, outcomes={}, scenarios=None) for result in group.tuned]
            missing.append(WorkUnit(index, (light, group.number, group.axis)))
            continue
        work.runs_after_group -= group.runs
        work.keep("front from the cache", group.runs)
        yield index, group_fronts
    what = f"pareto-{compute_digest([group.inputs for group in groups])[:16]}"
    work.begin("on the cluster", 0.0)
    for index, content in run_on_workers(
        scheduler, compute_and_encode_fronts, missing, get_process_setting(), what
    ):
        group, group_fronts = groups[index], decode_value(content, list[ParetoFront])
        work.runs_after_group -= group.runs
        work.name = describe_group(group.tasks)
        work.begin("front from the cluster", group.runs)
        work.report_runs(group.runs)
        _write_fronts(group, checkpoints, group_fronts)
        yield index, group_fronts


def compute_and_encode_fronts(tuned: list[TuneResult], number: int, axis: ParetoCriterion) -> bytes:
    """Compute the fronts of a group of mechanisms on a cluster worker; return the encoded fronts."""
    return encode_value(
        _compute_group_fronts(_FrontGroup(_build_tasks(tuned), tuned, number, axis), SearchProgress())
    )


def _read_fronts(group: _FrontGroup, checkpoints: Checkpoints) -> list[ParetoFront] | None:
    if not checkpoints.is_enabled:
        return None
    group_fronts = [
        checkpoints.read(name, (group.inputs, i), ParetoFront) for i, name in enumerate(group.names)
    ]
    return group_fronts if all(group_fronts) else None


def _write_fronts(group: _FrontGroup, checkpoints: Checkpoints, group_fronts: list[ParetoFront]) -> None:
    if checkpoints.is_enabled:
        for i, (name, front) in enumerate(zip(group.names, group_fronts, strict=True)):
            checkpoints.write(name, (group.inputs, i), front)


def _compute_group_fronts(group: _FrontGroup, work: SearchProgress) -> list[ParetoFront]:
    tasks, tuned, number, axis = group
    settings = group.settings
    work.begin(f"accuracy against {axis.name}, {number} points", group.runs)
    validation = build_validation(tasks, settings.validation, settings.seed, work)
    points = solve_weight_ladders(validation, tuned, number, settings, axis)
    work.begin(f"evaluating {number} points", _count_evaluation_runs(tasks, settings, number))
    return _evaluate_fronts(validation, tuned, points, settings, axis)


def _count_evaluation_runs(tasks: list[TuneTask], settings: TuneSettings, number: int) -> int:
    return (number + 2) * len(tasks) * count_evaluated_runs(settings.validation, tasks[0].probed)


def _evaluate_fronts(
    validation: Validation,
    tuned: list[TuneResult],
    points: list[list[tuple[float, dict[str, float]]]],
    settings: TuneSettings,
    axis: ParetoCriterion,
) -> list[ParetoFront]:
    """Evaluate each task's points, literature's gains and earlier tuned gains on its fresh scenarios."""
    plans = [
        [*ladder, (None, task.literature), (None, result.gains)]
        for task, result, ladder in zip(validation.tasks, tuned, points, strict=True)
    ]
    # Each call evaluates one set of gains of every task, and so uses the same compiled program as tuning.
    outcomes = [validation.evaluate([gains for _, gains in row]) for row in zip(*plans, strict=True)]
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
    fresh, nominal = split_nominal(task.model.select_verdict_error(outcome))
    noise = compute_noise_amplification(task.mechanism, task.compensator, gains)
    errors = np.asarray(compute_contact_terms(fresh)[0])[fresh.is_scheduled]
    scenarios, probe_errors = fresh, None
    if with_probes is not None:
        scenarios = with_probes
        probes = jax.tree.map(lambda leaf: leaf[..., 1:], with_probes)
        probe_errors = np.asarray(compute_contact_terms(probes)[0])[probes.is_scheduled]
    excesses, chatter = (
        np.asarray(term)[scenarios.is_scheduled] for term in compute_contact_terms(scenarios)[1:]
    )
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
