"""Tuning of mechanisms that share a compiled program, and evaluation of the gains on fresh scenarios."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from jaxhil.laws.compensators import axes_of, get_compensator
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation.outcome import Outcome
from tuning.gains.global_search import EVALUATION_FACTOR, GlobalComparison, compare_with_global_search
from tuning.gains.multistart import MultistartResult, estimate_search_runs, find_gains
from tuning.gains.multistart_solver import StartResult
from tuning.gains.objective import RESIDUAL_SCALE
from tuning.gains.search_progress import SearchProgress
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, has_sensor_noise
from tuning.gains.transfer import EarlierGains, transfer_gains
from tuning.gains.validation import (
    Validation,
    build_validation,
    count_evaluated_runs,
    split_nominal,
)
from tuning.optimisation.sensitivity import compute_gain_tolerance
from tuning.statistics.bootstrap import ErrorIntervals, compute_error_intervals
from tuning.statistics.intervals import IntervalEstimate
from tuning.transparency.probes import compute_probe_metrics


class ErrorMetrics(NamedTuple):
    """Metrics of all contacts in a batch of scenarios: restitution errors e - e*, forces and durations."""

    rms: float  # root mean square of e - e* [1]
    p99: float  # 99th percentile of |e - e*| [1]
    max: float  # maximum of |e - e*| [1]
    mean: float  # mean of e - e* [1]
    diverging: float  # fraction of contacts with e > e* [1]
    peak_ratio: float  # largest ratio of the peak command to the ideal contact's peak force [1]
    chatter: float  # root mean square of the chatter [1] (`jaxhil.simulation.outcome.Outcome`)
    failed: int  # number of contacts that did not end
    # 99th percentile of the real peak force divided by the ideal contact's peak force [1]
    peak_force_ratio: float = math.nan
    # 1st and 99th percentiles of the contact duration divided by the ideal contact's duration [1]
    duration_ratio: tuple[float, float] = (math.nan, math.nan)
    # fraction of contacts whose force or duration ratio violates `jaxhil.simulation.contact_bounds` [1]
    unlike: float = 0.0


class GainTolerance(NamedTuple):
    """Change of a gain, as a fraction of its range, that raises the solver's loss (sum of squares) by 1 %."""

    alone: float  # change if all other gains are fixed [1]
    together: float  # change if all other gains are readjusted to minimise the loss [1]


@dataclass(frozen=True)
class TuneResult:
    """Result of tuning a compensator for one mechanism.

    The keys of `figures`, `nominal`, `outcomes` and `transparency` are "before" (no compensation),
    "literature" (gains by the literature's rule) and "tuned".
    """

    compensator: str  # name of the compensator
    mechanism: AnyMechanism  # mechanism for which the gains were tuned
    gains: dict[str, float]  # all gains of the compensator after tuning
    literature: dict[str, float]  # values of all gains by the published rule of the compensator
    # metrics of the verdict's error (`RigModel.verdict_error`) in scenarios that were not used for tuning
    figures: dict[str, ErrorMetrics]
    nominal: dict[str, ErrorMetrics]  # metrics of the nominal run
    starts: list[StartResult]  # results of all starts of the solver
    outcomes: dict[str, Outcome]  # outcomes of the fresh scenarios, for plots
    scenarios: Any  # fresh scenarios, for plots
    settings: TuneSettings  # settings of the tuning
    timings: dict[str, float] = field(default_factory=dict)  # duration of each stage [s]
    intervals: ErrorIntervals | None = None  # 95 % confidence intervals of the "tuned" metrics
    first: tuple[EarlierGains, ...] = ()  # earlier gains that replaced the last starts of the first batch
    tolerances: dict[str, GainTolerance] = field(default_factory=dict)  # tolerance of each tuned gain
    global_comparison: GlobalComparison | None = None  # None if no global search was requested
    # transparency, its slope and its peak; empty if the scenarios have no probes
    transparency: dict[str, dict[str, IntervalEstimate]] = field(default_factory=dict)
    # metrics of the tuned gains on the fresh scenarios without sensor noise; None if no sensor has noise
    without_noise: ErrorMetrics | None = None
    quiet: bool = False  # whether the gains are the quietest within the limit, instead of the most accurate

    @property
    def usual_starts(self) -> int:
        """Return the number of starts in the first batch, without the starts at earlier gains (`first`)."""
        if get_compensator(self.compensator, axes_of(self.mechanism)).tuned_without_derivatives:
            return 1
        return max(self.settings.starts, 1 + len(self.first)) - len(self.first)


def tune_group(
    tasks: list[TuneTask], settings: TuneSettings, work: SearchProgress, near: list[list[EarlierGains]]
) -> list[TuneResult]:
    """Tune mechanisms that share a program, and evaluate the gains on fresh scenarios.

    `near` holds, for each mechanism, earlier gains of similar mechanisms, which serve as additional starts.
    """
    clock, validation = _StageClock(), build_validation(tasks, settings.validation, settings.seed, work)
    evaluating, precomputed = _count_evaluation_runs(tasks, settings), _count_baseline_runs(tasks, settings)
    work.runs_after_group += evaluating - precomputed
    baselines: dict[str, list] = {}
    searched = work.step(
        "search",
        list[MultistartResult],
        lambda: _search_gains(
            validation, settings, near, lambda: baselines.update(_evaluate_baselines(validation))
        ),
    )
    work.runs_after_group -= evaluating - precomputed
    clock.lap("tune")
    left = evaluating - (precomputed if baselines else 0)
    work.begin(f"evaluating on {settings.validation} fresh scenarios", left)
    pairs = zip(searched, tasks, strict=True)
    best = [result.best.gains if result.best else task.literature for result, task in pairs]
    evaluated = {**(baselines or _evaluate_baselines(validation)), "tuned": validation.evaluate(best)}
    noisy = [has_sensor_noise(task.mechanism) for task in tasks]
    noiseless = validation.evaluate(best, noise=False) if any(noisy) else []
    clock.lap("judge")
    comparisons: list[GlobalComparison | None] = [None for _ in tasks]
    if settings.global_search and settings.setting is None:
        comparisons = _compare_globally(validation, searched, settings)
        clock.lap("certify")
    results = []
    for i, task in enumerate(tasks):
        select = task.model.select_verdict_error
        split = {key: split_nominal(outcomes[i][0]) for key, outcomes in evaluated.items()}
        fresh = {key: outcome for key, (outcome, _) in split.items()}
        decisive: dict[str, Any] = {key: select(outcome) for key, outcome in fresh.items()}
        result = TuneResult(
            compensator=task.compensator,
            mechanism=task.mechanism,
            gains=best[i],
            literature=task.literature,
            figures={key: compute_error_metrics(outcome) for key, outcome in decisive.items()},
            nominal={key: compute_error_metrics(select(nominal)) for key, (_, nominal) in split.items()},
            starts=searched[i].starts,
            outcomes=fresh,
            scenarios=validation.fresh[i],
            settings=settings,
            timings=clock.laps,
            intervals=compute_error_intervals(decisive["tuned"].error, decisive["tuned"].good),
            first=tuple(near[i]),
            tolerances=_compute_tolerances(task, validation.names, searched[i].best),
            global_comparison=comparisons[i],
            transparency=_compute_transparency(
                validation, i, {key: pairs[i][1] for key, pairs in evaluated.items()}
            ),
            without_noise=compute_error_metrics(select(split_nominal(noiseless[i][0])[0]))
            if noisy[i]
            else None,
            quiet=searched[i].quiet,
        )
        results.append(result)
    return results


def _compare_globally(
    validation: Validation, searched: list[MultistartResult], settings: TuneSettings
) -> list[GlobalComparison | None]:
    work, comparisons = validation.work, []
    for i, result in enumerate(searched):
        left = (
            EVALUATION_FACTOR * validation.tasks[0].lanes * sum(later.evaluations for later in searched[i:])
        )
        work.begin(f"global search, {i + 1} of {len(searched)}", left)

        def compare(i: int = i, result: MultistartResult = result) -> GlobalComparison | None:
            return compare_with_global_search(validation, i, result, settings)

        comparisons.append(work.step("search everywhere", GlobalComparison | None, compare))
    return comparisons


def estimate_group_runs(tasks: list[TuneTask], settings: TuneSettings) -> float:
    """Return the approximate number of simulated runs of `tune_group`."""
    return _count_search_runs(tasks, settings) + _count_evaluation_runs(tasks, settings)


def describe_group(tasks: Sequence[TuneTask]) -> str:
    """Return a description for messages: the mechanism's name, or the number of mechanisms."""
    return tasks[0].mechanism.name if len(tasks) == 1 else f"{len(tasks)} mechanisms"


def _count_search_runs(tasks: list[TuneTask], settings: TuneSettings) -> int:
    searched = settings.setting is None and any(task.tuned for task in tasks)
    return estimate_search_runs(tasks, settings) if searched else 0


def _count_evaluation_runs(tasks: list[TuneTask], settings: TuneSettings) -> float:
    """Return the number of runs for the evaluation and, if requested, the global search."""
    noisy = any(has_sensor_noise(task.mechanism) for task in tasks)
    evaluation = (2.0 if noisy else 1.5) * _count_baseline_runs(tasks, settings)
    global_search = EVALUATION_FACTOR * _count_search_runs(tasks, settings) if settings.global_search else 0
    return evaluation + global_search


def _count_baseline_runs(tasks: list[TuneTask], settings: TuneSettings) -> int:
    """Return the number of runs for both baselines: no compensation, and the literature's gains."""
    return 2 * len(tasks) * count_evaluated_runs(settings.validation, tasks[0].probed)


def _search_gains(
    validation: Validation,
    settings: TuneSettings,
    near: list[list[EarlierGains]],
    meanwhile: Callable[[], object],
) -> list[MultistartResult]:
    """Search for the best gains of every task; call `meanwhile` while the solver compiles.

    The results are empty if no gain is tunable, or if the settings specify one of the fixed sets of gains.
    """
    tasks = validation.tasks
    if settings.setting is not None or not any(task.tuned for task in tasks):
        return [MultistartResult(None, [], 0) for _ in tasks]
    compensator = tasks[0].compensator
    text = f"tuning {compensator} on {tasks[0].number} scenarios each"
    validation.work.begin(text, estimate_search_runs(tasks, settings) + _count_baseline_runs(tasks, settings))
    first = [
        [transfer_gains(compensator, tuned.gains, tuned.mechanism, task.mechanism) for tuned in neighbours]
        for task, neighbours in zip(tasks, near, strict=True)
    ]
    return find_gains(validation, settings, first, meanwhile)


def _evaluate_baselines(validation: Validation) -> dict[str, list]:
    """Evaluate the mechanisms without compensation ("before") and with the literature's gains."""
    literature = [task.literature for task in validation.tasks]
    task = validation.tasks[0]
    plain = [remove_compensation(task.compensator, gains, task.model.axes) for gains in literature]
    return {
        "before": validation.evaluate([gains for _, gains in plain], plain[0][0]),
        "literature": validation.evaluate(literature),
    }


def _compute_transparency(
    validation: Validation, task: int, outcomes: Mapping[str, Outcome | None]
) -> dict[str, dict[str, IntervalEstimate]]:
    probed = validation.probed[task]
    if probed is None:
        return {}
    return {
        key: compute_probe_metrics(probed, outcome)
        for key, outcome in outcomes.items()
        if outcome is not None
    }


def _compute_tolerances(
    task: TuneTask, names: tuple[str, ...], best: StartResult | None
) -> dict[str, GainTolerance]:
    """Return the tolerance of each tuned gain by name; empty if the solver gave no finite curvature."""
    moved = [i for i, name in enumerate(names) if name in {gain.name for gain in task.tuned}]
    if best is None or not moved or not best.curvature.size or not np.all(np.isfinite(best.curvature)):
        return {}
    values, vectors = np.linalg.eigh(best.curvature[np.ix_(moved, moved)])
    root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
    tolerances = compute_gain_tolerance(root, (best.rms / RESIDUAL_SCALE) ** 2 / 2)
    pairs = zip(tolerances.alone, tolerances.together, strict=True)
    return {names[i]: GainTolerance(float(a), float(b)) for i, (a, b) in zip(moved, pairs, strict=True)}


def compute_error_metrics(outcome: Outcome) -> ErrorMetrics:
    """Compute the error metrics of a batch of scenarios; they are NaN if no contact ended."""
    errors = outcome.error[outcome.good]
    failed = int(np.sum(outcome.is_scheduled & ~outcome.good))
    if not len(errors):
        nan = float("nan")
        return ErrorMetrics(
            rms=nan, p99=nan, max=nan, mean=nan, diverging=nan, peak_ratio=nan, chatter=nan, failed=failed
        )
    size = np.abs(errors)
    return ErrorMetrics(
        rms=float(np.sqrt(np.mean(errors**2))),
        p99=float(np.percentile(size, 99)),
        max=float(np.max(size)),
        mean=float(np.mean(errors)),
        diverging=float(np.mean(errors > 0)),
        peak_ratio=float(np.max(outcome.peak_ratio[outcome.good])),
        chatter=float(np.sqrt(np.mean(outcome.chatter[outcome.good] ** 2))),
        failed=failed,
        **_compare_real_contacts(outcome),
    )


def _compare_real_contacts(outcome: Outcome) -> dict[str, Any]:
    """Return the fields of `ErrorMetrics` that compare the real contacts with the ideal contacts."""
    good = outcome.good
    lowest, highest = np.nanpercentile(outcome.duration_ratio[good], (1, 99))
    return {
        "peak_force_ratio": float(np.nanpercentile(outcome.peak_force_ratio[good], 99)),
        "duration_ratio": (float(lowest), float(highest)),
        "unlike": float(np.mean(outcome.is_unlike_ideal[good])),
    }


def compute_metrics_by_error(result: TuneResult) -> dict[str, dict[str, ErrorMetrics]]:
    """Return metrics[error][set of gains] for the energy and twist errors; empty for one axis."""
    model = choose_rig_model(result.mechanism)
    if len(model.errors) == 1:
        return {}
    parts: dict[str, dict[str, ErrorMetrics]] = {}
    for key, outcome in result.outcomes.items():
        for name, part in model.by_error(outcome).items():
            parts.setdefault(name, {})[key] = compute_error_metrics(part)
    return parts


def remove_compensation(
    compensator: str, gains: dict[str, float], axes: int = 1
) -> tuple[str, dict[str, float]]:
    """Return a compensator and gains that leave the measured force unchanged.

    The compensator remains and its gains become neutral, so that no other compiled program is needed. A
    compensator without neutral gains is replaced by "none".
    """
    specifications = get_compensator(compensator, axes).gains
    if not any(gain.neutral is not None for gain in specifications):
        return "none", {}
    return compensator, neutralise_gains(compensator, gains, axes)


def neutralise_gains(compensator: str, gains: dict[str, float], axes: int = 1) -> dict[str, float]:
    """Replace every gain that has a neutral value by this value."""
    neutral = {
        gain.name: gain.neutral
        for gain in get_compensator(compensator, axes).gains
        if gain.neutral is not None
    }
    return {**gains, **neutral}


class _StageClock:
    """Stop watch that stores the duration [s] of each named stage."""

    def __init__(self):
        self.laps, self._last = {}, time.perf_counter()

    def lap(self, name):
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now
