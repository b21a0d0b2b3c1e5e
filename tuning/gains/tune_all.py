"""Tuning of many mechanisms, block by block in this process or in parallel by the workers of a cluster.

Each result is cached when it is complete, and before that every step of a search in this process, if there is
a cache (`tuning.caches.pieces`).
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxhil.mechanism.file import AnyMechanism, to_builtins
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.outcome import Outcome
from tuning.caches.cluster import Piece, on_workers
from tuning.caches.pieces import NOTHING_KEPT, Pieces, decode, digest_of, encode
from tuning.caches.worker import setting
from tuning.gains.common_program import CommonProgram
from tuning.gains.global_search import GlobalComparison
from tuning.gains.rounds import Start
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, alike, build_task
from tuning.gains.transfer import Tuned, near_to
from tuning.gains.tune import ErrorFigures, Freedom, TuneResult, block_name, runs_of_block, tune_block
from tuning.gains.validation import fresh_scenarios
from tuning.gains.work import Work
from tuning.statistics.bootstrap import ErrorIntervals
from tuning.statistics.intervals import Estimate

BLOCK = 16  # mechanisms tuned and evaluated together; an interruption loses at most one block


class _Block(NamedTuple):
    """Mechanisms that are tuned together."""

    tasks: list[TuneTask]  # one per mechanism
    near: list[list[Tuned]]  # per mechanism, the origins of the gains of its last starts


class _Kept(NamedTuple):
    """Cached part of a `TuneResult`: the fields that the inputs do not determine, with outcomes as arrays."""

    gains: dict[str, float]
    figures: dict[str, ErrorFigures]
    nominal: dict[str, ErrorFigures]
    starts: list[Start]
    outcomes: dict[str, list[np.ndarray]]
    timings: dict[str, float]
    intervals: ErrorIntervals | None
    freedom: dict[str, Freedom]
    global_comparison: GlobalComparison | None
    transparency: dict[str, dict[str, Estimate]]
    without_noise: ErrorFigures | None
    quiet: bool


def tune(
    mechanism: AnyMechanism, compensator: str, settings: TuneSettings, work: Work | None = None
) -> TuneResult:
    """Tune the gains of `compensator` for `mechanism`; `work` reports the progress."""
    return next(tune_all([mechanism], compensator, settings, work))[1]


def tune_all(
    mechanisms: Sequence[AnyMechanism],
    compensator: str,
    settings: TuneSettings,
    work: Work | None = None,
    tuned: Sequence[Tuned] = (),
    common: CommonProgram | None = None,
    pieces: Pieces = NOTHING_KEPT,
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
    work, first_block = work or Work(), []
    tasks = _tasks(mechanisms, compensator, settings, common)
    indices = [
        group[begin : begin + BLOCK]
        for group in _groups(tasks, settings)
        for begin in range(0, len(group), BLOCK)
    ]
    left = sum(runs_of_block([tasks[i] for i in members], settings) for members in indices)
    afterwards = work.later
    for groups in (indices[:1], indices[1:]):
        sources = [source for source in (tuned, first_block) if source]
        sources = sources[: max(settings.starts - 1, 1 if tuned else 0)]
        blocks = [
            _Block([tasks[i] for i in members], [near_to(mechanisms[i], sources) for i in members])
            for members in groups
        ]
        work.later = afterwards + left
        if scheduler is None:
            computed = _here(blocks, settings, work, pieces)
        else:
            computed = _on_cluster(scheduler, blocks, settings, work, pieces)
        for index, results in computed:
            if not first_block:
                first_block = [
                    Tuned(result.mechanism, result.gains, result.mechanism.name)
                    for result in results
                    if isinstance(result.mechanism, Mechanism)
                ]
            yield from zip(groups[index], results, strict=True)
        left -= sum(runs_of_block(block.tasks, settings) for block in blocks)


def _tasks(
    mechanisms: Sequence[AnyMechanism], compensator: str, settings: TuneSettings, common: CommonProgram | None
) -> list[TuneTask]:
    asked = settings.scenarios, settings.seed, common, settings.setting, settings.probed
    return [build_task(mechanism, compensator, *asked) for mechanism in mechanisms]


def _groups(tasks: list[TuneTask], settings: TuneSettings) -> list[list[int]]:
    """Group the indices of tasks that share a program and, with a user's function, the number of contacts."""
    groups = alike([task.loop for task in tasks], [task.scenarios for task in tasks])
    if settings.objective.function is None:
        return groups
    numbers = {task.contacts for task in tasks}
    split = ([i for i in group if tasks[i].contacts == number] for group in groups for number in numbers)
    return [group for group in split if group]


def _here(
    blocks: list[_Block], settings: TuneSettings, work: Work, pieces: Pieces
) -> Iterator[tuple[int, list[TuneResult]]]:
    """Yield (index, results) of every block, in order."""
    for index, block in enumerate(blocks):
        runs = runs_of_block(block.tasks, settings)
        work.later -= runs
        work.name = block_name(block.tasks)
        results = _read(block, settings, pieces)
        if results is not None:
            work.keep("as kept", runs)
        else:
            if pieces.keeps:
                work.journal = pieces.journal(_names(block)[0], _inputs(block, settings))
            results = tune_block(block.tasks, settings, work, block.near)
            _write(block, settings, pieces, map(_to_keep, results))
            work.journal.finish()
        yield index, results


def _on_cluster(
    scheduler: str, blocks: list[_Block], settings: TuneSettings, work: Work, pieces: Pieces
) -> Iterator[tuple[int, list[TuneResult]]]:
    """Yield (index, results) of every block, in the order in which workers finish them."""
    missing = []
    for index, block in enumerate(blocks):
        runs = runs_of_block(block.tasks, settings)
        results = _read(block, settings, pieces)
        if results is not None:
            work.later -= runs
            work.keep("as kept", runs)
            yield index, results
            continue
        mechanisms = [task.mechanism for task in block.tasks]
        first = block.tasks[0]
        missing.append(Piece(index, (mechanisms, first.compensator, settings, first.common, block.near)))
    what = f"tune-{digest_of([_inputs(block, settings) for block in blocks])[:16]}"
    work.begin("on the cluster", 0.0)
    for index, content in on_workers(scheduler, tune_to_keep, missing, setting(), what):
        block, cached = blocks[index], decode(content, list[_Kept])
        runs = runs_of_block(block.tasks, settings)
        work.later -= runs
        work.name = block_name(block.tasks)
        work.begin("tuned on the cluster", runs)
        work.ran(runs)
        _write(block, settings, pieces, cached)
        yield index, _restored(block, cached, settings)


def tune_to_keep(
    mechanisms: list[AnyMechanism],
    compensator: str,
    settings: TuneSettings,
    common: CommonProgram | None,
    near: list[list[Tuned]],
) -> bytes:
    """Return the encoded part of a block's results that is cached; called on a worker."""
    tasks = _tasks(mechanisms, compensator, settings, common)
    return encode([_to_keep(result) for result in tune_block(tasks, settings, Work(), near)])


def _inputs(block: _Block, settings: TuneSettings) -> list[Any]:
    """Return all inputs that determine a block's results."""
    first = block.tasks[0]
    return [
        *("tune", first.compensator, [to_builtins(task.mechanism) for task in block.tasks]),
        *(settings, first.common),
        [[(to_builtins(t.mechanism), t.gains, t.source) for t in neighbours] for neighbours in block.near],
    ]


def _names(block: _Block) -> list[str]:
    return [f"tune {task.mechanism.name}" for task in block.tasks]


def _read(block: _Block, settings: TuneSettings, pieces: Pieces) -> list[TuneResult] | None:
    """Read a block's results from the cache; return None if one is missing."""
    if not pieces.keeps:
        return None
    inputs = _inputs(block, settings)
    cached = [pieces.read(name, (inputs, i), _Kept) for i, name in enumerate(_names(block))]
    return _restored(block, cached, settings) if all(cached) else None


def _write(block: _Block, settings: TuneSettings, pieces: Pieces, results: Iterable[_Kept]) -> None:
    if pieces.keeps:
        inputs = _inputs(block, settings)
        for i, (name, result) in enumerate(zip(_names(block), results, strict=True)):
            pieces.write(name, (inputs, i), result)


def _to_keep(result: TuneResult) -> _Kept:
    values = {name: getattr(result, name) for name in _Kept._fields}
    outcomes = {key: [*outcome.metrics, *outcome[1:]] for key, outcome in result.outcomes.items()}
    return _Kept(**{**values, "outcomes": outcomes})


def _restored(block: _Block, parts: list[_Kept], settings: TuneSettings) -> list[TuneResult]:
    number, results = len(Metrics._fields), []
    for task, near, cached in zip(block.tasks, block.near, parts, strict=True):
        arrays: dict[str, list[Any]] = {**cached.outcomes}
        outcomes = {key: Outcome(Metrics(*a[:number]), *a[number:]) for key, a in arrays.items()}
        result = TuneResult(
            **{**cached._asdict(), "outcomes": outcomes},
            compensator=task.compensator,
            mechanism=task.mechanism,
            literature=task.literature,
            scenarios=fresh_scenarios(task, settings.validation, settings.seed),
            settings=settings,
            first=tuple(near),
        )
        results.append(result)
    return results
