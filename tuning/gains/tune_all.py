"""Tuning of many mechanisms in groups, one after the other in this process or in parallel on a cluster.

If there is a cache (`tuning.caches.checkpoints`), the cache stores every result and, during a search in this
process, a checkpoint after every step.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxhil.mechanism.file import AnyMechanism, to_plain_data
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.outcome import Outcome
from tuning.caches.checkpoints import NO_CHECKPOINTS, Checkpoints, compute_digest, decode_value, encode_value
from tuning.caches.cluster import WorkUnit, run_on_workers
from tuning.caches.worker import get_process_setting
from tuning.gains.common_program import CommonProgram
from tuning.gains.global_search import GlobalComparison
from tuning.gains.multistart_solver import StartResult
from tuning.gains.search_progress import SearchProgress
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, build_task, group_by_program
from tuning.gains.transfer import EarlierGains, find_nearest_of_each
from tuning.gains.tune import (
    ErrorMetrics,
    GainTolerance,
    TuneResult,
    describe_group,
    estimate_group_runs,
    tune_group,
)
from tuning.gains.validation import draw_fresh_scenarios
from tuning.statistics.bootstrap import ErrorIntervals
from tuning.statistics.intervals import IntervalEstimate

MAX_GROUP_SIZE = 16  # largest number of mechanisms in a group; an interruption loses at most one group


class _TuneGroup(NamedTuple):
    """Mechanisms that are tuned together, with earlier gains as starts."""

    tasks: list[TuneTask]  # one task per mechanism
    near: list[list[EarlierGains]]  # for each mechanism, earlier gains of similar mechanisms


class _CachedResult(NamedTuple):
    """Cached fields of a `TuneResult`, with outcomes as arrays; the other fields follow from the inputs."""

    gains: dict[str, float]
    figures: dict[str, ErrorMetrics]
    nominal: dict[str, ErrorMetrics]
    starts: list[StartResult]
    outcomes: dict[str, list[np.ndarray]]
    timings: dict[str, float]
    intervals: ErrorIntervals | None
    tolerances: dict[str, GainTolerance]
    global_comparison: GlobalComparison | None
    transparency: dict[str, dict[str, IntervalEstimate]]
    without_noise: ErrorMetrics | None
    quiet: bool


def tune(
    mechanism: AnyMechanism, compensator: str, settings: TuneSettings, work: SearchProgress | None = None
) -> TuneResult:
    """Tune the gains of `compensator` for one mechanism; `work` reports the progress."""
    return next(tune_all([mechanism], compensator, settings, work))[1]


def tune_all(
    mechanisms: Sequence[AnyMechanism],
    compensator: str,
    settings: TuneSettings,
    work: SearchProgress | None = None,
    tuned: Sequence[EarlierGains] = (),
    common: CommonProgram | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    scheduler: str | None = None,
) -> Iterator[tuple[int, TuneResult]]:
    """Tune the gains of `compensator` for many mechanisms; yield (index, result) of each finished mechanism.

    Mechanisms that share a program are tuned together. Different kinds of mechanisms can share a `common`
    program. One start is at the literature's gains, and one at the gains of the most similar mechanism in
    `tuned`. Every group after the first also starts from the gains of the most similar mechanism in the first
    group.

    `checkpoints` caches each result under the mechanism's name and its group, because the other mechanisms of
    the group affect the last bits of the result. If `scheduler` is given, the workers of a cluster tune the
    groups.
    """
    work, first_group = work or SearchProgress(), []
    tasks = _build_tasks(mechanisms, compensator, settings, common)
    indices = [
        group[begin : begin + MAX_GROUP_SIZE]
        for group in _group_tasks(tasks, settings)
        for begin in range(0, len(group), MAX_GROUP_SIZE)
    ]
    left = sum(estimate_group_runs([tasks[i] for i in members], settings) for members in indices)
    work.announce(left)
    afterwards = work.runs_after_group
    for members_of_groups in (indices[:1], indices[1:]):
        sources = [source for source in (tuned, first_group) if source]
        sources = sources[: max(settings.starts - 1, 1 if tuned else 0)]
        groups = [
            _TuneGroup(
                [tasks[i] for i in members], [find_nearest_of_each(mechanisms[i], sources) for i in members]
            )
            for members in members_of_groups
        ]
        work.runs_after_group = afterwards + left
        if scheduler is None:
            computed = _tune_locally(groups, settings, work, checkpoints)
        else:
            computed = _tune_on_cluster(scheduler, groups, settings, work, checkpoints)
        for index, results in computed:
            if not first_group:
                first_group = [
                    EarlierGains(result.mechanism, result.gains, result.mechanism.name)
                    for result in results
                    if isinstance(result.mechanism, Mechanism)
                ]
            yield from zip(members_of_groups[index], results, strict=True)
        left -= sum(estimate_group_runs(group.tasks, settings) for group in groups)


def _build_tasks(
    mechanisms: Sequence[AnyMechanism], compensator: str, settings: TuneSettings, common: CommonProgram | None
) -> list[TuneTask]:
    options = settings.scenarios, settings.seed, common, settings.setting, settings.probed
    return [build_task(mechanism, compensator, *options) for mechanism in mechanisms]


def _group_tasks(tasks: list[TuneTask], settings: TuneSettings) -> list[list[int]]:
    """Group the tasks by compiled program and, for a user's objective, also by number of contacts."""
    groups = group_by_program([task.loop for task in tasks], [task.scenarios for task in tasks])
    if settings.objective.function is None:
        return groups
    numbers = {task.contacts for task in tasks}
    split = ([i for i in group if tasks[i].contacts == number] for group in groups for number in numbers)
    return [group for group in split if group]


def _tune_locally(
    groups: list[_TuneGroup], settings: TuneSettings, work: SearchProgress, checkpoints: Checkpoints
) -> Iterator[tuple[int, list[TuneResult]]]:
    """Tune each group of mechanisms in order; yield (index of the group, results)."""
    for index, group in enumerate(groups):
        runs = estimate_group_runs(group.tasks, settings)
        work.runs_after_group -= runs
        work.name = describe_group(group.tasks)
        results = _read_results(group, settings, checkpoints)
        if results is not None:
            work.keep("from the cache", runs)
        else:
            if checkpoints.is_enabled:
                work.journal = checkpoints.journal(_list_names(group)[0], _list_inputs(group, settings))
            results = tune_group(group.tasks, settings, work, group.near)
            _write_results(group, settings, checkpoints, map(_select_cached_fields, results))
            work.journal.finish()
        yield index, results


def _tune_on_cluster(
    scheduler: str,
    groups: list[_TuneGroup],
    settings: TuneSettings,
    work: SearchProgress,
    checkpoints: Checkpoints,
) -> Iterator[tuple[int, list[TuneResult]]]:
    """Tune groups of mechanisms on a cluster; yield (index of the group, results) of each finished group."""
    missing = []
    for index, group in enumerate(groups):
        runs = estimate_group_runs(group.tasks, settings)
        results = _read_results(group, settings, checkpoints)
        if results is not None:
            work.runs_after_group -= runs
            work.keep("from the cache", runs)
            yield index, results
            continue
        mechanisms = [task.mechanism for task in group.tasks]
        first = group.tasks[0]
        missing.append(WorkUnit(index, (mechanisms, first.compensator, settings, first.common, group.near)))
    what = f"tune-{compute_digest([_list_inputs(group, settings) for group in groups])[:16]}"
    work.begin("on the cluster", 0.0)
    for index, content in run_on_workers(scheduler, tune_and_encode, missing, get_process_setting(), what):
        group, cached = groups[index], decode_value(content, list[_CachedResult])
        runs = estimate_group_runs(group.tasks, settings)
        work.runs_after_group -= runs
        work.name = describe_group(group.tasks)
        work.begin("tuned on the cluster", runs)
        work.report_runs(runs)
        _write_results(group, settings, checkpoints, cached)
        yield index, _restore_results(group, cached, settings)


def tune_and_encode(
    mechanisms: list[AnyMechanism],
    compensator: str,
    settings: TuneSettings,
    common: CommonProgram | None,
    near: list[list[EarlierGains]],
) -> bytes:
    """Tune a group of mechanisms on a cluster worker; return the results' cached fields, encoded."""
    tasks = _build_tasks(mechanisms, compensator, settings, common)
    return encode_value(
        [_select_cached_fields(result) for result in tune_group(tasks, settings, SearchProgress(), near)]
    )


def _list_inputs(group: _TuneGroup, settings: TuneSettings) -> list[Any]:
    """Return all inputs that the results of a group depend on, as a key of the cache."""
    first = group.tasks[0]
    return [
        *("tune", first.compensator, [to_plain_data(task.mechanism) for task in group.tasks]),
        *(settings, first.common),
        [[(to_plain_data(t.mechanism), t.gains, t.source) for t in neighbours] for neighbours in group.near],
    ]


def _list_names(group: _TuneGroup) -> list[str]:
    return [f"tune {task.mechanism.name}" for task in group.tasks]


def _read_results(
    group: _TuneGroup, settings: TuneSettings, checkpoints: Checkpoints
) -> list[TuneResult] | None:
    if not checkpoints.is_enabled:
        return None
    inputs = _list_inputs(group, settings)
    cached = [checkpoints.read(name, (inputs, i), _CachedResult) for i, name in enumerate(_list_names(group))]
    return _restore_results(group, cached, settings) if all(cached) else None


def _write_results(
    group: _TuneGroup, settings: TuneSettings, checkpoints: Checkpoints, results: Iterable[_CachedResult]
) -> None:
    if checkpoints.is_enabled:
        inputs = _list_inputs(group, settings)
        for i, (name, result) in enumerate(zip(_list_names(group), results, strict=True)):
            checkpoints.write(name, (inputs, i), result)


def _select_cached_fields(result: TuneResult) -> _CachedResult:
    values = {name: getattr(result, name) for name in _CachedResult._fields}
    outcomes = {key: [*outcome.metrics, *outcome[1:]] for key, outcome in result.outcomes.items()}
    return _CachedResult(**{**values, "outcomes": outcomes})


def _restore_results(
    group: _TuneGroup, parts: list[_CachedResult], settings: TuneSettings
) -> list[TuneResult]:
    number, results = len(Metrics._fields), []
    for task, near, cached in zip(group.tasks, group.near, parts, strict=True):
        arrays: dict[str, list[Any]] = {**cached.outcomes}
        outcomes = {key: Outcome(Metrics(*a[:number]), *a[number:]) for key, a in arrays.items()}
        result = TuneResult(
            **{**cached._asdict(), "outcomes": outcomes},
            compensator=task.compensator,
            mechanism=task.mechanism,
            literature=task.literature,
            scenarios=draw_fresh_scenarios(task, settings.validation, settings.seed),
            settings=settings,
            first=tuple(near),
        )
        results.append(result)
    return results
