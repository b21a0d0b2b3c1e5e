"""Tuning of many mechanisms, block by block in this process or in parallel by the workers of a cluster.

Each result is cached when it is complete, and before that every step of a search in this process, if there is
a cache (`tuning.caches.checkpoints`).
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

MAX_GROUP_SIZE = 16  # mechanisms tuned and evaluated together; an interruption loses at most one block


class _TuneGroup(NamedTuple):
    """Mechanisms that are tuned together."""

    tasks: list[TuneTask]  # one per mechanism
    near: list[list[EarlierGains]]  # per mechanism, the origins of the gains of its last starts


class _CachedResult(NamedTuple):
    """Cached part of a `TuneResult`: the fields that the inputs do not determine, with outcomes as arrays."""

    gains: dict[str, float]
    figures: dict[str, ErrorMetrics]
    nominal: dict[str, ErrorMetrics]
    starts: list[StartResult]
    outcomes: dict[str, list[np.ndarray]]
    timings: dict[str, float]
    intervals: ErrorIntervals | None
    freedom: dict[str, GainTolerance]
    global_comparison: GlobalComparison | None
    transparency: dict[str, dict[str, IntervalEstimate]]
    without_noise: ErrorMetrics | None
    quiet: bool


def tune(
    mechanism: AnyMechanism, compensator: str, settings: TuneSettings, work: SearchProgress | None = None
) -> TuneResult:
    """Tune the gains of `compensator` for `mechanism`; `work` reports the progress."""
    return next(tune_all([mechanism], compensator, settings, work))[1]


def tune_all(
    mechanisms: Sequence[AnyMechanism],
    compensator: str,
    settings: TuneSettings,
    work: SearchProgress | None = None,
    tuned: Sequence[EarlierGains] = (),
    common: CommonProgram | None = None,
    pieces: Checkpoints = NO_CHECKPOINTS,
    scheduler: str | None = None,
) -> Iterator[tuple[int, TuneResult]]:
    """Yield (index, result) of every mechanism, in the order in which they finish.

    Mechanisms that share a program are tuned together; with a `common` program unlike ones share it too. The
    gains of the nearest mechanism of `tuned`, with the same compensator, replace one of the last starts of
    each mechanism, but never the literature's. So do those of the nearest mechanism of the first block in the
    other blocks.

    Each result is cached in `pieces` under its mechanism's name, for the same set of mechanisms tuned
    together, since these affect its last bits. With a `scheduler`, the workers of a cluster tune the blocks.
    """
    work, first_block = work or SearchProgress(), []
    tasks = _build_tasks(mechanisms, compensator, settings, common)
    indices = [
        group[begin : begin + MAX_GROUP_SIZE]
        for group in _group_tasks(tasks, settings)
        for begin in range(0, len(group), MAX_GROUP_SIZE)
    ]
    left = sum(estimate_group_runs([tasks[i] for i in members], settings) for members in indices)
    afterwards = work.runs_after_group
    for groups in (indices[:1], indices[1:]):
        sources = [source for source in (tuned, first_block) if source]
        sources = sources[: max(settings.starts - 1, 1 if tuned else 0)]
        blocks = [
            _TuneGroup(
                [tasks[i] for i in members], [find_nearest_of_each(mechanisms[i], sources) for i in members]
            )
            for members in groups
        ]
        work.runs_after_group = afterwards + left
        if scheduler is None:
            computed = _tune_locally(blocks, settings, work, pieces)
        else:
            computed = _tune_on_cluster(scheduler, blocks, settings, work, pieces)
        for index, results in computed:
            if not first_block:
                first_block = [
                    EarlierGains(result.mechanism, result.gains, result.mechanism.name)
                    for result in results
                    if isinstance(result.mechanism, Mechanism)
                ]
            yield from zip(groups[index], results, strict=True)
        left -= sum(estimate_group_runs(block.tasks, settings) for block in blocks)


def _build_tasks(
    mechanisms: Sequence[AnyMechanism], compensator: str, settings: TuneSettings, common: CommonProgram | None
) -> list[TuneTask]:
    asked = settings.scenarios, settings.seed, common, settings.setting, settings.probed
    return [build_task(mechanism, compensator, *asked) for mechanism in mechanisms]


def _group_tasks(tasks: list[TuneTask], settings: TuneSettings) -> list[list[int]]:
    """Group the indices of tasks that share a program and, with a user's function, the number of contacts."""
    groups = group_by_program([task.loop for task in tasks], [task.scenarios for task in tasks])
    if settings.objective.function is None:
        return groups
    numbers = {task.contacts for task in tasks}
    split = ([i for i in group if tasks[i].contacts == number] for group in groups for number in numbers)
    return [group for group in split if group]


def _tune_locally(
    blocks: list[_TuneGroup], settings: TuneSettings, work: SearchProgress, pieces: Checkpoints
) -> Iterator[tuple[int, list[TuneResult]]]:
    """Yield (index, results) of every block, in order."""
    for index, block in enumerate(blocks):
        runs = estimate_group_runs(block.tasks, settings)
        work.runs_after_group -= runs
        work.name = describe_group(block.tasks)
        results = _read_results(block, settings, pieces)
        if results is not None:
            work.keep("as kept", runs)
        else:
            if pieces.is_enabled:
                work.journal = pieces.journal(_list_names(block)[0], _list_inputs(block, settings))
            results = tune_group(block.tasks, settings, work, block.near)
            _write_results(block, settings, pieces, map(_select_cached_fields, results))
            work.journal.finish()
        yield index, results


def _tune_on_cluster(
    scheduler: str,
    blocks: list[_TuneGroup],
    settings: TuneSettings,
    work: SearchProgress,
    pieces: Checkpoints,
) -> Iterator[tuple[int, list[TuneResult]]]:
    """Yield (index, results) of every block, in the order in which workers finish them."""
    missing = []
    for index, block in enumerate(blocks):
        runs = estimate_group_runs(block.tasks, settings)
        results = _read_results(block, settings, pieces)
        if results is not None:
            work.runs_after_group -= runs
            work.keep("as kept", runs)
            yield index, results
            continue
        mechanisms = [task.mechanism for task in block.tasks]
        first = block.tasks[0]
        missing.append(WorkUnit(index, (mechanisms, first.compensator, settings, first.common, block.near)))
    what = f"tune-{compute_digest([_list_inputs(block, settings) for block in blocks])[:16]}"
    work.begin("on the cluster", 0.0)
    for index, content in run_on_workers(scheduler, tune_and_encode, missing, get_process_setting(), what):
        block, cached = blocks[index], decode_value(content, list[_CachedResult])
        runs = estimate_group_runs(block.tasks, settings)
        work.runs_after_group -= runs
        work.name = describe_group(block.tasks)
        work.begin("tuned on the cluster", runs)
        work.report_runs(runs)
        _write_results(block, settings, pieces, cached)
        yield index, _restore_results(block, cached, settings)


def tune_and_encode(
    mechanisms: list[AnyMechanism],
    compensator: str,
    settings: TuneSettings,
    common: CommonProgram | None,
    near: list[list[EarlierGains]],
) -> bytes:
    """Return the encoded part of a block's results that is cached; called on a worker."""
    tasks = _build_tasks(mechanisms, compensator, settings, common)
    return encode_value(
        [_select_cached_fields(result) for result in tune_group(tasks, settings, SearchProgress(), near)]
    )


def _list_inputs(block: _TuneGroup, settings: TuneSettings) -> list[Any]:
    """Return all inputs that determine a block's results."""
    first = block.tasks[0]
    return [
        *("tune", first.compensator, [to_plain_data(task.mechanism) for task in block.tasks]),
        *(settings, first.common),
        [[(to_plain_data(t.mechanism), t.gains, t.source) for t in neighbours] for neighbours in block.near],
    ]


def _list_names(block: _TuneGroup) -> list[str]:
    return [f"tune {task.mechanism.name}" for task in block.tasks]


def _read_results(block: _TuneGroup, settings: TuneSettings, pieces: Checkpoints) -> list[TuneResult] | None:
    """Read a block's results from the cache; return None if one is missing."""
    if not pieces.is_enabled:
        return None
    inputs = _list_inputs(block, settings)
    cached = [pieces.read(name, (inputs, i), _CachedResult) for i, name in enumerate(_list_names(block))]
    return _restore_results(block, cached, settings) if all(cached) else None


def _write_results(
    block: _TuneGroup, settings: TuneSettings, pieces: Checkpoints, results: Iterable[_CachedResult]
) -> None:
    if pieces.is_enabled:
        inputs = _list_inputs(block, settings)
        for i, (name, result) in enumerate(zip(_list_names(block), results, strict=True)):
            pieces.write(name, (inputs, i), result)


def _select_cached_fields(result: TuneResult) -> _CachedResult:
    values = {name: getattr(result, name) for name in _CachedResult._fields}
    outcomes = {key: [*outcome.metrics, *outcome[1:]] for key, outcome in result.outcomes.items()}
    return _CachedResult(**{**values, "outcomes": outcomes})


def _restore_results(
    block: _TuneGroup, parts: list[_CachedResult], settings: TuneSettings
) -> list[TuneResult]:
    number, results = len(Metrics._fields), []
    for task, near, cached in zip(block.tasks, block.near, parts, strict=True):
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
