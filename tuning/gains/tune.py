"""Tuning of mechanisms: scenarios, starts, solve, and judgement on scenarios that tuning never saw."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from jaxhil.laws.compensators import compensator_of
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.rig_models import rig_model
from jaxhil.simulation.outcome import Outcome
from tuning.gains.global_search import FACTOR, GlobalComparison, compare_with_global_search
from tuning.gains.multistart import MultistartResult, expected_runs, find_gains
from tuning.gains.objective import SCALE
from tuning.gains.rounds import Start
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, has_sensor_noise
from tuning.gains.transfer import Tuned, carry_over
from tuning.gains.validation import (
    Validation,
    build_validation,
    judged_runs,
    split_nominal,
)
from tuning.gains.work import Work
from tuning.optimisation.sensitivity import sensitivity
from tuning.statistics.bootstrap import ErrorIntervals, error_intervals
from tuning.statistics.intervals import Estimate
from tuning.transparency.probes import probe_figures


class ErrorFigures(NamedTuple):
    """What is said of the restitution errors e - e* of all contacts of a batch."""

    rms: float  # root mean square of |e - e*| [1]
    p99: float  # 99th percentile of it [1]
    max: float  # maximum of it [1]
    mean: float  # of e - e* [1]
    diverging: float  # share of contacts with e > e* [1]
    peak_ratio: float  # largest |F_c| over the reference's peak force [1]
    chatter: float  # root mean square of the chatter [1] (`jaxhil.simulation.evaluation.Outcome`)
    failed: int  # contacts that did not end
    # 99th percentile of the largest real force over the ideal contact's peak force [1]
    peak_force_ratio: float = math.nan
    # 1st and 99th percentile of the time with a real force over the ideal contact's duration [1]
    duration_ratio: tuple[float, float] = (math.nan, math.nan)
    # share of the contacts beyond the bounds on either (`jaxhil.simulation.contact_bounds`) [1]
    unlike: float = 0.0


class Freedom(NamedTuple):
    """How far a gain may move before the loss rises by a hundredth, as a share of its range."""

    alone: float  # the others held
    together: float  # the others moved along, at their best


@dataclass(frozen=True)
class TuneResult:
    """What tuning found for one mechanism; "before" is no compensation."""

    compensator: str  # what was tuned
    mechanism: AnyMechanism  # for what it was
    gains: dict[str, float]  # all of the compensator's, as tuned
    literature: dict[str, float]  # by the literature's rule
    figures: dict[str, ErrorFigures]  # of "before", "literature" and "tuned" on the same fresh scenarios
    nominal: dict[str, ErrorFigures]  # the same figures of the nominal run
    starts: list[Start]  # every start of the solver
    outcomes: dict[str, Outcome]  # on the fresh scenarios, for plots
    scenarios: Any  # the fresh ones, for plots
    settings: TuneSettings  # how it was tuned
    timings: dict[str, float] = field(default_factory=dict)  # seconds by stage
    intervals: ErrorIntervals | None = None  # 95 % intervals of the tuned figures
    first: tuple[Tuned, ...] = ()  # what the last starts of the first batch took their gains from
    freedom: dict[str, Freedom] = field(default_factory=dict)  # how far each tuned gain may move
    global_comparison: GlobalComparison | None = None  # how far from the best anywhere, if that was searched
    # transparency, slope and peak of each, where the scenarios are probed
    transparency: dict[str, dict[str, Estimate]] = field(default_factory=dict)
    # of the tuned gains on the same fresh scenarios without the sensors' noise; None where there is none
    without_noise: ErrorFigures | None = None
    quiet: bool = False  # whether these are the quietest gains within the limit, not those of least error

    @property
    def usual_starts(self) -> int:
        """Starts before those that began at gains known before: the rest of the first batch."""
        return max(self.settings.starts, 1 + len(self.first)) - len(self.first)


def tune_block(
    tasks: list[TuneTask], settings: TuneSettings, work: Work, near: list[list[Tuned]]
) -> list[TuneResult]:
    """What is found for mechanisms of one program, each of which starts from gains `near` it as well."""
    clock, validation = _Clock(), build_validation(tasks, settings.validation, settings.seed, work)
    judging, beforehand = _judging_runs(tasks, settings), _known_runs(tasks, settings)
    work.later += judging - beforehand
    known: dict[str, list] = {}
    found = work.step(
        "search",
        list[MultistartResult],
        lambda: _search(validation, settings, near, lambda: known.update(_judge_known(validation))),
    )
    work.later -= judging - beforehand
    clock.lap("tune")
    work.begin(f"judging on {settings.validation} fresh scenarios", judging - (beforehand if known else 0))
    best = [one.best.gains if one.best else task.literature for one, task in zip(found, tasks, strict=True)]
    judged = {**(known or _judge_known(validation)), "tuned": validation.judge(best)}
    noisy = [has_sensor_noise(task.mechanism) for task in tasks]
    noiseless = validation.judge(best, noise=False) if any(noisy) else []
    clock.lap("judge")
    comparisons: list[GlobalComparison | None] = [None for _ in tasks]
    if settings.global_search and settings.setting is None:
        for i, one in enumerate(found):
            left = FACTOR * tasks[0].lanes * sum(later.evaluations for later in found[i:])
            work.begin(f"searching everywhere, {i + 1} of {len(found)}", left)
            comparisons[i] = work.step(
                "search everywhere",
                GlobalComparison | None,
                lambda i=i, one=one: compare_with_global_search(validation, i, one, settings),
            )
        clock.lap("certify")
    results = []
    for i, task in enumerate(tasks):
        split = {key: split_nominal(every[i][0]) for key, every in judged.items()}
        fresh = {key: outcome for key, (outcome, _) in split.items()}
        result = TuneResult(
            compensator=task.compensator,
            mechanism=task.mechanism,
            gains=best[i],
            literature=task.literature,
            figures={key: figures(outcome) for key, outcome in fresh.items()},
            nominal={key: figures(nominal) for key, (_, nominal) in split.items()},
            starts=found[i].starts,
            outcomes=fresh,
            scenarios=validation.fresh[i],
            settings=settings,
            timings=clock.laps,
            intervals=error_intervals(fresh["tuned"].error, fresh["tuned"].good),
            first=tuple(near[i]),
            freedom=_freedom(task, validation.names, found[i].best),
            global_comparison=comparisons[i],
            transparency=_transparency(validation, i, {key: every[i][1] for key, every in judged.items()}),
            without_noise=figures(split_nominal(noiseless[i][0])[0]) if noisy[i] else None,
            quiet=found[i].quiet is not None,
        )
        results.append(result)
    return results


def runs_of_block(tasks: list[TuneTask], settings: TuneSettings) -> float:
    """Simulated runs that a block takes, about."""
    return _search_runs(tasks, settings) + _judging_runs(tasks, settings)


def block_name(tasks: Sequence[TuneTask]) -> str:
    """What messages call mechanisms that are tuned together."""
    return tasks[0].mechanism.name if len(tasks) == 1 else f"{len(tasks)} mechanisms"


def _search_runs(tasks: list[TuneTask], settings: TuneSettings) -> int:
    searched = settings.setting is None and any(task.tuned for task in tasks)
    return expected_runs(tasks, settings) if searched else 0


def _judging_runs(tasks: list[TuneTask], settings: TuneSettings) -> float:
    """Those of the judgement and, if one is asked for, of the search everywhere."""
    noisy = any(has_sensor_noise(task.mechanism) for task in tasks)
    judged = (2.0 if noisy else 1.5) * _known_runs(tasks, settings)
    everywhere = FACTOR * _search_runs(tasks, settings) if settings.global_search else 0
    return judged + everywhere


def _known_runs(tasks: list[TuneTask], settings: TuneSettings) -> int:
    """Those of the judgement that do not wait for what is found."""
    return 2 * len(tasks) * judged_runs(settings.validation, tasks[0].probed)


def _search(
    validation: Validation,
    settings: TuneSettings,
    near: list[list[Tuned]],
    meanwhile: Callable[[], object],
) -> list[MultistartResult]:
    """The best gains of every task; none where there are none to tune, or a setting is judged as it is. What
    is done `meanwhile`, as the solver compiles, is the judgement of what is known beforehand."""
    tasks = validation.tasks
    if settings.setting is not None or not any(task.tuned for task in tasks):
        return [MultistartResult(None, [], 0) for _ in tasks]
    compensator = tasks[0].compensator
    text = f"tuning {compensator} on {tasks[0].number} scenarios each"
    validation.work.begin(text, expected_runs(tasks, settings) + _known_runs(tasks, settings))
    first = [
        [carry_over(compensator, one.gains, one.mechanism, task.mechanism) for one in own]
        for task, own in zip(tasks, near, strict=True)
    ]
    return find_gains(validation, settings, first, meanwhile)


def _judge_known(validation: Validation) -> dict[str, list]:
    """What `Validation.judge` says of no compensation and of the literature's gains, known beforehand."""
    literature = [task.literature for task in validation.tasks]
    plain = [uncompensated(validation.tasks[0].compensator, gains) for gains in literature]
    return {
        "before": validation.judge([gains for _, gains in plain], plain[0][0]),
        "literature": validation.judge(literature),
    }


def _transparency(
    validation: Validation, task: int, outcomes: Mapping[str, Outcome | None]
) -> dict[str, dict[str, Estimate]]:
    """Of a task under several gains, where its scenarios have probes."""
    probed = validation.probed[task]
    if probed is None:
        return {}
    return {key: probe_figures(probed, own) for key, own in outcomes.items() if own is not None}


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
        return ErrorFigures(
            rms=nan, p99=nan, max=nan, mean=nan, diverging=nan, peak_ratio=nan, chatter=nan, failed=failed
        )
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
        **_real_contacts(outcome),
    )


def _real_contacts(outcome: Outcome) -> dict[str, Any]:
    """Return what `ErrorFigures` says of the real contacts beside the ideal ones."""
    good = outcome.good
    lowest, highest = np.nanpercentile(outcome.duration_ratio[good], (1, 99))
    return {
        "peak_force_ratio": float(np.nanpercentile(outcome.peak_force_ratio[good], 99)),
        "duration_ratio": (float(lowest), float(highest)),
        "unlike": float(np.mean(outcome.unlike[good])),
    }


def figures_of_parts(result: TuneResult) -> dict[str, dict[str, ErrorFigures]]:
    """Return the metrics of each error by itself, by its name; nothing where there is but one error."""
    model = rig_model(result.mechanism)
    if len(model.errors) == 1:
        return {}
    parts: dict[str, dict[str, ErrorFigures]] = {}
    for key, outcome in result.outcomes.items():
        for name, part in model.by_error(outcome).items():
            parts.setdefault(name, {})[key] = figures(part)
    return parts


def uncompensated(compensator: str, gains: dict[str, float]) -> tuple[str, dict[str, float]]:
    """Compensator and gains that pass the measured force on unchanged: what "before" is judged with.

    Neutral gains need no program of their own. In the place of a law that has none stands no compensation.
    """
    if all(gain.neutral is None for gain in compensator_of(compensator).gains):
        return "none", {}
    return compensator, neutral_gains(compensator, gains)


def neutral_gains(compensator: str, gains: dict[str, float]) -> dict[str, float]:
    """The gains, neutral where they can be."""
    neutral = {
        gain.name: gain.neutral for gain in compensator_of(compensator).gains if gain.neutral is not None
    }
    return {**gains, **neutral}


class _Clock:
    def __init__(self):
        self.laps, self._last = {}, time.perf_counter()

    def lap(self, name):
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now
