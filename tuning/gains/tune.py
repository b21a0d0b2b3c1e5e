"""Tuning of mechanisms: scenarios, starts, solve, and judgement on scenarios that tuning never saw."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import numpy as np

from jaxhil.compensators import COMPENSATORS
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.evaluation import Outcome
from jaxhil.simulation.scenario import Scenario
from tuning.gains.common_program import CommonProgram
from tuning.gains.global_search import GlobalComparison, compare_with_global_search
from tuning.gains.multistart import SCANNED, MultistartResult, find_gains
from tuning.gains.objective import RMS, SCALE, Objective
from tuning.gains.rounds import Start
from tuning.gains.tasks import TuneTask, alike, build_task
from tuning.gains.transfer import Tuned, carry_over, nearest
from tuning.gains.validation import Validation
from tuning.optimisation.sensitivity import sensitivity
from tuning.statistics.bootstrap import ErrorIntervals, error_intervals
from tuning.statistics.intervals import Estimate
from tuning.transparency.probes import probe_figures

BLOCK = 16  # mechanisms tuned and judged together: what is done when work is interrupted is kept


@dataclass(frozen=True)
class TuneSettings:
    """Numbers of scenarios to tune on (None: `tuning.gains.tasks` knows), of starts of a lot
    (`tuning.gains.multistart`), of solver steps, of scenarios to judge on; the seed; what to minimise;
    evaluations without derivatives at the end, for each gain; whether to search the whole box for something
    better; points looked at before a lot of starts; a setting of the compensator that is only judged, as it
    is; whether transparency is judged also where the objective does not weigh it."""

    scenarios: int | None = None
    starts: int = 4
    steps: int = 25
    validation: int = 511
    seed: int = 0
    objective: Objective = RMS
    polish: int = 160
    global_search: bool = False
    scanned: int = SCANNED
    setting: str | None = None
    judge_transparency: bool = False

    @property
    def probed(self) -> bool:
        """Whether scenarios come with the copies of `tuning.transparency.probes`."""
        return self.judge_transparency or self.objective.transparency_weight > 0


class ErrorFigures(NamedTuple):
    """Over all contacts of a batch: rms, 99th percentile and maximum of |e - e*|, mean of e - e*; share of
    contacts that diverge (e > e*); largest |F_c| over the reference's peak; root of the mean square of the
    chatter (`jaxhil.simulation.evaluation.Outcome`); contacts that did not end."""

    rms: float
    p99: float
    max: float
    mean: float
    diverging: float
    peak_ratio: float
    chatter: float
    failed: int


class Freedom(NamedTuple):
    """How far a gain may move, as a share of its range, before the loss rises by a hundredth: the others
    held, and the others moved along."""

    alone: float
    together: float


@dataclass(frozen=True)
class TuneResult:
    """What tuning found: gains (all of the compensator's), the literature's; figures of "before" (no
    compensation), "literature" and "tuned" on the same fresh scenarios, and of their nominal run; every
    start; outcomes and scenarios for plots; seconds spent; 95 % confidence intervals of the tuned figures; of
    each tuned gain how far it may move (`tuning.optimisation.sensitivity`); how far from the best anywhere,
    if asked for; what the last of the starts took their gains from; where transparency counts, transparency,
    slope and peak of each on the fresh scenarios (`tuning.transparency.probes`)."""

    compensator: str
    mechanism: Mechanism
    gains: dict[str, float]
    literature: dict[str, float]
    figures: dict[str, ErrorFigures]
    nominal: dict[str, ErrorFigures]
    starts: list[Start]
    outcomes: dict[str, Outcome]
    scenarios: Scenario
    settings: TuneSettings
    timings: dict[str, float] = field(default_factory=dict)
    intervals: ErrorIntervals | None = None
    first: tuple[Tuned, ...] = ()
    freedom: dict[str, Freedom] = field(default_factory=dict)
    global_comparison: GlobalComparison | None = None
    transparency: dict[str, dict[str, Estimate]] = field(default_factory=dict)

    @property
    def usual_starts(self) -> int:
        """Starts before those that began at gains known before: the rest of the first lot."""
        return max(self.settings.starts, 1 + len(self.first)) - len(self.first)


def tune(
    mechanism: Mechanism,
    compensator: str,
    settings: TuneSettings,
    report: Callable[[str], None] = lambda text: None,
) -> TuneResult:
    """Tune the gains of `compensator` for `mechanism`; `report` hears of each stage."""
    return next(tune_all([mechanism], compensator, settings, report))[1]


def tune_all(
    mechanisms: Sequence[Mechanism],
    compensator: str,
    settings: TuneSettings,
    report: Callable[[str], None] = lambda text: None,
    tuned: Sequence[Tuned] = (),
    common: CommonProgram | None = None,
) -> Iterator[tuple[int, TuneResult]]:
    """(index, result) of every mechanism, as they are done: like ones together, in one program.

    The gains of the nearest of those `tuned` before, with the same compensator, are a start for each, and so
    are those of the nearest that an earlier block found: in the places of the last other starts, never of the
    literature's. Unlike mechanisms of one `form` are tuned together in it.
    """
    tasks = [
        build_task(
            m, compensator, settings.scenarios, settings.seed, common, settings.setting, settings.probed
        )
        for m in mechanisms
    ]
    found: list[Tuned] = []
    for group in alike([task.loop for task in tasks], [task.scenarios for task in tasks]):
        for begin in range(0, len(group), BLOCK):
            block = group[begin : begin + BLOCK]
            sources = [known for known in (tuned, found) if known]
            sources = sources[: max(settings.starts - 1, 1 if tuned else 0)]
            near = [[nearest(mechanisms[i], known) for known in sources] for i in block]
            results = _tune_block([tasks[index] for index in block], settings, report, near)
            found.extend(Tuned(one.mechanism, one.gains, one.mechanism.name) for one in results)
            yield from zip(block, results, strict=True)


def _tune_block(
    tasks: list[TuneTask],
    settings: TuneSettings,
    report: Callable[[str], None],
    near: list[list[Tuned]],
) -> list[TuneResult]:
    clock = _Clock()
    name = tasks[0].mechanism.name if len(tasks) == 1 else f"{len(tasks)} mechanisms"
    compensator = tasks[0].compensator
    validation = Validation(tasks, settings.validation, settings.seed)
    found = [MultistartResult(None, [], 0) for _ in tasks]
    if settings.setting is None and any(task.tuned for task in tasks):
        number = tasks[0].number
        report(f"{name}: tuning {compensator} on {number} scenarios each")
        first = [
            [carry_over(compensator, one.gains, one.mechanism, task.mechanism) for one in own]
            for task, own in zip(tasks, near, strict=True)
        ]
        found = find_gains(
            validation,
            settings.starts,
            settings.steps,
            settings.polish,
            settings.seed,
            settings.objective,
            first,
            lambda text: report(f"{name}: {text}"),
            settings.scanned,
        )
    best = [one.best.gains if one.best else task.literature for one, task in zip(found, tasks, strict=True)]
    clock.lap("tune")
    report(f"{name}: judging on {settings.validation} fresh scenarios")
    plain = [uncompensated(compensator, task.literature) for task in tasks]
    judged = {
        "before": validation.judge_probed([gains for _, gains in plain], plain[0][0]),
        "literature": validation.judge_probed([task.literature for task in tasks]),
        "tuned": validation.judge_probed(best),
    }
    outcomes = {key: [own for own, _ in every] for key, every in judged.items()}
    clock.lap("judge")
    comparisons: list[GlobalComparison | None] = [None for _ in tasks]
    if settings.global_search and settings.setting is None:
        comparisons = _compare_with_global_search(
            validation, settings, found, lambda text: report(f"{name}: {text}")
        )
        clock.lap("certify")
    results = []
    for i, task in enumerate(tasks):
        own = {key: every[i] for key, every in outcomes.items()}
        fresh = {key: jax.tree.map(lambda leaf: leaf[..., :-1], one) for key, one in own.items()}
        nominal = {key: jax.tree.map(lambda leaf: leaf[..., -1:], one) for key, one in own.items()}
        results.append(
            TuneResult(
                compensator=compensator,
                mechanism=task.mechanism,
                gains=best[i],
                literature=task.literature,
                figures={key: figures(outcome) for key, outcome in fresh.items()},
                nominal={key: figures(outcome) for key, outcome in nominal.items()},
                starts=found[i].starts,
                outcomes=fresh,
                scenarios=validation.fresh[i],
                settings=settings,
                timings=clock.laps,
                intervals=error_intervals(fresh["tuned"].error, fresh["tuned"].good),
                first=tuple(near[i]),
                freedom=_freedom(task, validation.names, found[i].best),
                global_comparison=comparisons[i],
                transparency=_transparency(
                    validation, i, {key: every[i][1] for key, every in judged.items()}
                ),
            )
        )
    return results


def _compare_with_global_search(
    validation: Validation, settings: TuneSettings, found: list[MultistartResult], report
) -> list[GlobalComparison | None]:
    comparisons = []
    for i, one in enumerate(found):
        report(f"searching everywhere, {i + 1} of {len(found)}")
        comparisons.append(compare_with_global_search(validation, i, one, settings.objective, settings.seed))
    return comparisons


def _transparency(
    validation: Validation, task: int, copies: Mapping[str, Outcome | None]
) -> dict[str, dict[str, Estimate]]:
    """Of a task under several gains, where its scenarios have copies."""
    probed = validation.probed[task]
    if probed is None:
        return {}
    return {key: probe_figures(probed, own) for key, own in copies.items() if own is not None}


def _freedom(task: TuneTask, names: tuple[str, ...], found: Start | None) -> dict[str, Freedom]:
    """Of the gains tuned for the task, from the solver's last J^T J."""
    moved = [i for i, name in enumerate(names) if name in {gain.name for gain in task.tuned}]
    if found is None or not moved or not np.all(np.isfinite(found.curvature)):
        return {}
    values, vectors = np.linalg.eigh(found.curvature[np.ix_(moved, moved)])
    root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
    known = sensitivity(root, (found.rms / SCALE) ** 2 / 2)
    pairs = zip(known.alone, known.together, strict=True)
    return {names[i]: Freedom(float(a), float(b)) for i, (a, b) in zip(moved, pairs, strict=True)}


def figures(outcome: Outcome) -> ErrorFigures:
    """Summary of a batch; NaN where no contact ended."""
    errors = outcome.error[outcome.good]
    failed = int(np.sum(outcome.wanted & ~outcome.good))
    if not len(errors):
        nan = float("nan")
        return ErrorFigures(nan, nan, nan, nan, nan, nan, nan, failed)
    size = np.abs(errors)
    return ErrorFigures(
        rms=float(np.sqrt(np.mean(errors**2))),
        p99=float(np.percentile(size, 99)),
        max=float(np.max(size)),
        mean=float(np.mean(errors)),
        diverging=float(np.mean(errors > 0)),
        peak_ratio=float(np.max(outcome.peak_ratio[outcome.good])),
        chatter=float(np.sqrt(np.mean(outcome.chatter[outcome.good] ** 2))),
        failed=failed,
    )


def uncompensated(compensator: str, gains: dict[str, float]) -> tuple[str, dict[str, float]]:
    """Compensator and gains that pass the measured force on unchanged: what "before" is judged with.

    Neutral gains need no program of their own. In the place of a law that has none stands no compensation.
    """
    if all(gain.neutral is None for gain in COMPENSATORS[compensator].gains):
        return "none", {}
    return compensator, neutral_gains(compensator, gains)


def neutral_gains(compensator: str, gains: dict[str, float]) -> dict[str, float]:
    """The gains, neutral where they can be."""
    neutral = {
        gain.name: gain.neutral for gain in COMPENSATORS[compensator].gains if gain.neutral is not None
    }
    return {**gains, **neutral}


class _Clock:
    def __init__(self):
        self.laps, self._last = {}, time.perf_counter()

    def lap(self, name):
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now
