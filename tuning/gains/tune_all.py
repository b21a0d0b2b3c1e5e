"""Tuning of many mechanisms: block after block here, or side by side by the workers of a cluster.

What is found of each is kept at once, and until then every step of a search here, where there is a place
for it (`tuning.caches.pieces`).
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

BLOCK = 16  # mechanisms tuned and judged together: what is done when work is interrupted is kept


class _Block(NamedTuple):
    """Mechanisms that are tuned together."""

    tasks: list[TuneTask]  # one a mechanism
    near: list[list[Tuned]]  # of each, what its last starts take their gains from


class _Kept(NamedTuple):
    """What of a result does not follow from what was asked for; its fields, and outcomes as arrays."""

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
    """Tune the gains of `compensator` for `mechanism`; the `work` hears how far it is."""
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
    """(index, result) of every mechanism, as they are done: like ones together, in one program.

    The gains of the nearest of those `tuned` before, with the same compensator, are a start for each, and so
    are those of the nearest of the first block for the others: in the places of the last other starts, never
    of the literature's. Unlike mechanisms of one `common` program are tuned together in it.

    Each result is a piece of those kept, under its mechanism's name. It follows from all mechanisms that are
    tuned together: the last bits of each depend on the others. With a `scheduler`, the workers of a cluster
    tune the blocks.
    """
    work, found = work or Work(), []
    tasks = _tasks(mechanisms, compensator, settings, common)
    indices = [
        group[begin : begin + BLOCK]
        for group in _groups(tasks, settings)
        for begin in range(0, len(group), BLOCK)
    ]
    left = sum(runs_of_block([tasks[i] for i in own], settings) for own in indices)
    afterwards = work.later
    for some in (indices[:1], indices[1:]):
        sources = [known for known in (tuned, found) if known]
        sources = sources[: max(settings.starts - 1, 1 if tuned else 0)]
        blocks = [
            _Block([tasks[i] for i in own], [near_to(mechanisms[i], sources) for i in own]) for own in some
        ]
        work.later = afterwards + left
        if scheduler is None:
            computed = _here(blocks, settings, work, pieces)
        else:
            computed = _on_cluster(scheduler, blocks, settings, work, pieces)
        for place, results in computed:
            if not found:
                found = [
                    Tuned(one.mechanism, one.gains, one.mechanism.name)
                    for one in results
                    if isinstance(one.mechanism, Mechanism)
                ]
            yield from zip(some[place], results, strict=True)
        left -= sum(runs_of_block(block.tasks, settings) for block in blocks)


def _tasks(
    mechanisms: Sequence[AnyMechanism], compensator: str, settings: TuneSettings, common: CommonProgram | None
) -> list[TuneTask]:
    asked = settings.scenarios, settings.seed, common, settings.setting, settings.probed
    return [build_task(mechanism, compensator, *asked) for mechanism in mechanisms]


def _groups(tasks: list[TuneTask], settings: TuneSettings) -> list[list[int]]:
    """Indices of what one program serves; a user's function also gets as many contacts of all."""
    groups = alike([task.loop for task in tasks], [task.scenarios for task in tasks])
    if settings.objective.function is None:
        return groups
    numbers = {task.contacts for task in tasks}
    split = ([i for i in group if tasks[i].contacts == number] for group in groups for number in numbers)
    return [group for group in split if group]


def _here(
    blocks: list[_Block], settings: TuneSettings, work: Work, pieces: Pieces
) -> Iterator[tuple[int, list[TuneResult]]]:
    """(place, results) of every block, one after the other."""
    for place, block in enumerate(blocks):
        runs = runs_of_block(block.tasks, settings)
        work.later -= runs
        work.name = block_name(block.tasks)
        results = _kept(block, settings, pieces)
        if results is not None:
            work.keep("as kept", runs)
        else:
            if pieces.keeps:
                work.journal = pieces.journal(_names(block)[0], _inputs(block, settings))
            results = tune_block(block.tasks, settings, work, block.near)
            _keep(block, settings, pieces, map(_to_keep, results))
            work.journal.finish()
        yield place, results


def _on_cluster(
    scheduler: str, blocks: list[_Block], settings: TuneSettings, work: Work, pieces: Pieces
) -> Iterator[tuple[int, list[TuneResult]]]:
    """(place, results) of every block, in the order in which workers finish them."""
    missing = []
    for place, block in enumerate(blocks):
        runs = runs_of_block(block.tasks, settings)
        results = _kept(block, settings, pieces)
        if results is not None:
            work.later -= runs
            work.keep("as kept", runs)
            yield place, results
            continue
        mechanisms = [task.mechanism for task in block.tasks]
        first = block.tasks[0]
        missing.append(Piece(place, (mechanisms, first.compensator, settings, first.common, block.near)))
    what = f"tune-{digest_of([_inputs(block, settings) for block in blocks])[:16]}"
    work.begin("on the cluster", 0.0)
    for place, content in on_workers(scheduler, tune_to_keep, missing, setting(), what):
        block, kept = blocks[place], decode(content, list[_Kept])
        runs = runs_of_block(block.tasks, settings)
        work.later -= runs
        work.name = block_name(block.tasks)
        work.begin("tuned on the cluster", runs)
        work.ran(runs)
        _keep(block, settings, pieces, kept)
        yield place, _restored(block, kept, settings)


def tune_to_keep(
    mechanisms: list[AnyMechanism],
    compensator: str,
    settings: TuneSettings,
    common: CommonProgram | None,
    near: list[list[Tuned]],
) -> bytes:
    """What is to be kept of a block's results, on a worker."""
    tasks = _tasks(mechanisms, compensator, settings, common)
    return encode([_to_keep(one) for one in tune_block(tasks, settings, Work(), near)])


def _inputs(block: _Block, settings: TuneSettings) -> list[Any]:
    """All that a block's results follow from."""
    first = block.tasks[0]
    return [
        *("tune", first.compensator, [to_builtins(task.mechanism) for task in block.tasks]),
        *(settings, first.common),
        [[(to_builtins(one.mechanism), one.gains, one.source) for one in own] for own in block.near],
    ]


def _names(block: _Block) -> list[str]:
    return [f"tune {task.mechanism.name}" for task in block.tasks]


def _kept(block: _Block, settings: TuneSettings, pieces: Pieces) -> list[TuneResult] | None:
    """A block's results as kept from before; None if one is missing."""
    if not pieces.keeps:
        return None
    inputs = _inputs(block, settings)
    kept = [pieces.read(name, (inputs, i), _Kept) for i, name in enumerate(_names(block))]
    return _restored(block, kept, settings) if all(kept) else None


def _keep(block: _Block, settings: TuneSettings, pieces: Pieces, results: Iterable[_Kept]) -> None:
    if pieces.keeps:
        inputs = _inputs(block, settings)
        for i, (name, one) in enumerate(zip(_names(block), results, strict=True)):
            pieces.write(name, (inputs, i), one)


def _to_keep(result: TuneResult) -> _Kept:
    values = {name: getattr(result, name) for name in _Kept._fields}
    outcomes = {key: [*one.metrics, *one[1:]] for key, one in result.outcomes.items()}
    return _Kept(**{**values, "outcomes": outcomes})


def _restored(block: _Block, kept: list[_Kept], settings: TuneSettings) -> list[TuneResult]:
    number, results = len(Metrics._fields), []
    for task, near, one in zip(block.tasks, block.near, kept, strict=True):
        arrays: dict[str, list[Any]] = {**one.outcomes}
        outcomes = {key: Outcome(Metrics(*own[:number]), *own[number:]) for key, own in arrays.items()}
        result = TuneResult(
            **{**one._asdict(), "outcomes": outcomes},
            compensator=task.compensator,
            mechanism=task.mechanism,
            literature=task.literature,
            scenarios=fresh_scenarios(task, settings.validation, settings.seed),
            settings=settings,
            first=tuple(near),
        )
        results.append(result)
    return results
