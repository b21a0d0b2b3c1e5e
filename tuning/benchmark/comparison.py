"""Comparison of compensators, each with tuned gains, in the same scenarios with the same perturbations.

A task is one compensator and one group of mechanisms that share a compiled program. The tasks are distributed
to as many processes as there are cores. Each process uses few JAX devices, because most of the time is
compilation, which uses one core per process. Results do not depend on the process. If there is a cache, the
result of each task is stored at once (`tuning.caches.checkpoints`).
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, NamedTuple

from jaxhil.errors import to_one_line
from jaxhil.mechanism.file import AnyMechanism, to_plain_data
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.jax_environment import DEVICE_COUNT_FLAG, MIN_DEVICES, prepare_jax
from tuning.caches.checkpoints import NO_CHECKPOINTS, Checkpoints, compute_digest
from tuning.caches.cluster import WorkUnit, run_on_workers
from tuning.caches.worker import get_process_setting
from tuning.statistics.intervals import IntervalEstimate

LITERATURE_GAINS, TUNED_GAINS = "literature", "tuned"
SEED_OFFSET = 0xFA1  # added to the seed for the evaluation, so that tuning never used these scenarios
MESSAGE_INTERVAL = 1.0  # shortest time between two progress messages of a process [s]

ComparisonProgress = Callable[[str, float], None]


@dataclass(frozen=True)
class CompareSettings:
    """Settings of a comparison of compensators."""

    scenarios: int = 32  # number of training scenarios
    starts: int = 3  # number of starting points of the optimisation
    steps: int = 16  # largest number of optimisation steps from each starting point
    polish: int = 20  # number of evaluations per gain in the derivative-free search after the optimisation
    scanned: int = 64  # number of points that are scanned to find starting points
    judged: int = 256  # number of scenarios for the evaluation
    limit: float = 0.01  # restitution or twist error above which a contact counts as a failure [1]
    seed: int = 0  # seed of scenarios, starting points and bootstrap
    tuned: bool = True  # whether to tune the gains


class CompensatorMetrics(NamedTuple):
    """Metrics of one compensator on one mechanism, for each set of gains.

    The sets of gains are "literature", the compensator's settings (named sets of gains for any mechanism),
    and "tuned". A compensator without gains, or with settings, is not tuned.
    """

    compensator: str  # name of the compensator
    mechanism: str  # name of the mechanism
    gains: dict[str, dict[str, float]]  # gains by name, for each set
    figures: dict[
        str, dict[str, IntervalEstimate]
    ]  # metrics by name (`tuning.transparency.metrics`, `tuning.benchmark.six_axis_runs`), for each set
    axes: int = 1  # number of axes of the mechanism

    @property
    def settings(self) -> tuple[str, ...]:
        """Return the names of the evaluated settings: all sets but "literature" and "tuned"."""
        return tuple(which for which in self.figures if which not in (LITERATURE_GAINS, TUNED_GAINS))


class CompensatorFailure(NamedTuple):
    """Error that prevented the evaluation of a compensator on a group of mechanisms."""

    compensator: str  # name of the compensator
    reason: str  # description of the error


# Scenario sets of a group of mechanisms, name of the compensator, and result.
GroupResult = tuple[list[Any], str, list[CompensatorMetrics] | CompensatorFailure]


def compare_compensators(
    mechanisms: Sequence[AnyMechanism],
    compensators: Sequence[str],
    settings: CompareSettings,
    processes: int,
    tell: Callable[[str, float, float], None] = lambda text, done, done_before: None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    scheduler: str | None = None,
) -> Iterator[CompensatorMetrics | CompensatorFailure]:
    """Evaluate every compensator on every mechanism; yield each result when it is complete.

    Args:
        mechanisms: mechanisms to simulate, all with the same number of axes.
        compensators: names of the compensators.
        settings: settings of the comparison.
        processes: number of processes. With 0, this process computes all results, and an error ends the
            comparison.
        tell: callback, called with a description of the current work, the number of results (including
            fractions of unfinished results), and how many of these are cached.
        checkpoints: cache of results.
        scheduler: address of a cluster's scheduler, whose workers compute the results; None for no cluster.
    """
    cached = (
        _read_cached_results(mechanisms, compensators, settings, checkpoints)
        if checkpoints.is_resuming
        else []
    )
    yield from cached
    complete = {(result.mechanism, result.compensator) for result in cached}
    # The results of a compensator and a group are cached together, for all mechanisms of the group.
    left = [
        m for m in mechanisms if any((m.name, compensator) not in complete for compensator in compensators)
    ]
    if not left:
        return

    def report(text: str, done: float) -> None:
        tell(text, len(cached) + done, len(cached))

    report(f"{len(cached)} cached results, ideal contacts" if cached else "ideal contacts", 0)

    def missing(scenes: list[list[Any]]) -> list[tuple[list[Any], str]]:
        """Return the tasks without a cached result, those with the longest compilation first.

        This order balances the load of the processes.
        """
        order = compensators
        if processes or scheduler:
            axes = 6 if isinstance(left[0], SixAxisMechanism) else 1
            order = sorted(compensators, key=lambda name: _count_gains(name, axes), reverse=True)
        return [
            (g, compensator)
            for g in scenes
            for compensator in order
            if (g[0].mechanism.name, compensator) not in complete
        ]

    if scheduler is not None:
        computed = _evaluate_on_cluster(
            scheduler, missing(build_scenario_sets(left, settings)), settings, report
        )
    elif processes == 0:
        computed = _evaluate_in_order(missing(build_scenario_sets(left, settings)), settings, report)
    else:
        computed = _evaluate_in_processes(processes, left, settings, missing, report)
    for group, compensator, result in computed:
        if isinstance(result, CompensatorFailure):
            yield result
            continue
        checkpoints.write(
            *_describe_checkpoint([scene.mechanism for scene in group], compensator, settings), result
        )
        yield from result


def _read_cached_results(
    mechanisms: Sequence[AnyMechanism],
    compensators: Sequence[str],
    settings: CompareSettings,
    checkpoints: Checkpoints,
) -> list[CompensatorMetrics]:
    """Return the results that an earlier comparison with the same inputs has cached."""
    from tuning.gains.common_program import group_by_common_program

    groups = [[mechanisms[i] for i in group] for group, _ in group_by_common_program(mechanisms)]
    read = (
        checkpoints.read(*_describe_checkpoint(group, compensator, settings), list[CompensatorMetrics])
        for group in groups
        for compensator in compensators
    )
    return [result for results in read for result in results or ()]


def _describe_checkpoint(
    group: list[AnyMechanism], compensator: str, settings: CompareSettings
) -> tuple[str, Any]:
    """Return the name and the inputs under which the result of one task is cached."""
    return f"compare {compensator} {group[0].name}", (
        "compare",
        compensator,
        [to_plain_data(m) for m in group],
        settings,
    )


def _evaluate_in_order(
    tasks: list[tuple[list[Any], str]], settings: CompareSettings, tell: ComparisonProgress
) -> Iterator[GroupResult]:
    done = 0
    for group, compensator in tasks:

        def report(text: str, share: float, group=group, done=done) -> None:
            tell(text, done + share * len(group))

        yield group, compensator, evaluate_compensator(group, compensator, settings, report)
        done += len(group)


def _evaluate_on_cluster(
    scheduler: str, tasks: list[tuple[list[Any], str]], settings: CompareSettings, tell: ComparisonProgress
) -> Iterator[GroupResult]:
    units = [WorkUnit(i, (group, compensator, settings)) for i, (group, compensator) in enumerate(tasks)]
    inputs = [
        _describe_checkpoint([scene.mechanism for scene in group], compensator, settings)
        for group, compensator in tasks
    ]
    done, what = 0, f"compare-{compute_digest(inputs)[:16]}"
    tell(f"{len(tasks)} tasks on the cluster", done)
    for i, result in run_on_workers(
        scheduler, evaluate_compensator_or_failure, units, get_process_setting(), what
    ):
        group, compensator = tasks[i]
        done += len(group)
        tell(compensator, done)
        yield group, compensator, result


def evaluate_compensator_or_failure(
    group: list[Any], compensator: str, settings: CompareSettings
) -> list[CompensatorMetrics] | CompensatorFailure:
    """Call `evaluate_compensator`; if it raises an error, return the error as `CompensatorFailure`."""
    try:
        return evaluate_compensator(group, compensator, settings)
    except Exception as error:
        return _describe_failure(compensator, error)


def _describe_failure(compensator: str, error: BaseException) -> CompensatorFailure:
    return CompensatorFailure(compensator, to_one_line(f"{type(error).__name__}: {error}", 200))


def _evaluate_in_processes(
    processes: int,
    mechanisms: list[AnyMechanism],
    settings: CompareSettings,
    missing: Callable[[list[list[Any]]], list[tuple[list[Any], str]]],
    tell: ComparisonProgress,
) -> Iterator[GroupResult]:
    # JAX does not work in a forked process, so that each process starts a new interpreter.
    context = multiprocessing.get_context("spawn")
    messages = context.SimpleQueue()
    with ProcessPoolExecutor(processes, context, _initialise_worker, (messages,)) as pool:
        try:
            tasks = missing(pool.submit(build_scenario_sets, mechanisms, settings).result())
            running = {
                pool.submit(_evaluate_in_worker, i, *task, settings): i for i, task in enumerate(tasks)
            }
            shares = [0.0 for _ in tasks]
            while running:
                ended, _ = wait(running, MESSAGE_INTERVAL, return_when=FIRST_COMPLETED)
                while not messages.empty():
                    i, text, shares[i] = messages.get()
                    tell(text, sum(share * len(tasks[k][0]) for k, share in enumerate(shares)))
                for future in ended:
                    i = running.pop(future)
                    error = future.exception()
                    shares[i] = 1.0
                    yield *tasks[i], _describe_failure(tasks[i][1], error) if error else future.result()
        except BaseException:
            # The results of the running processes are no longer needed.
            for child in multiprocessing.active_children():
                child.terminate()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _count_gains(compensator: str, axes: int) -> int:
    """Return the number of a compensator's gains; with more gains, the compilation takes longer."""
    from jaxhil.rig import COMPENSATORS
    from jaxhil.rig.six_axes import SIX_AXIS_COMPENSATORS

    return len((SIX_AXIS_COMPENSATORS if axes == 6 else COMPENSATORS)[compensator].gains)


def build_scenario_sets(mechanisms: list[AnyMechanism], settings: CompareSettings) -> list[list[Any]]:
    """Build the scenario set of each mechanism.

    A scenario set is a `tuning.benchmark.runs.ScenarioSet` or, for six axes, a
    `tuning.benchmark.six_axis_runs.SixAxisScenarioSet`. Each inner list of the result contains the sets of
    mechanisms that share one compiled program.
    """
    from tuning.benchmark.runs import build_scenario_set
    from tuning.benchmark.six_axis_runs import build_six_axis_scenario_set
    from tuning.gains.common_program import group_by_common_program

    drawn = settings.judged, settings.seed + SEED_OFFSET

    def build(mechanism: AnyMechanism, common: Any) -> Any:
        if isinstance(mechanism, SixAxisMechanism):
            return build_six_axis_scenario_set(mechanism, *drawn)
        return build_scenario_set(mechanism, common, *drawn)

    return [
        [build(mechanisms[i], common) for i in group] for group, common in group_by_common_program(mechanisms)
    ]


def evaluate_compensator(
    scenes: list[Any],
    compensator: str,
    settings: CompareSettings,
    tell: ComparisonProgress = lambda text, share: None,
) -> list[CompensatorMetrics]:
    """Tune a compensator for mechanisms that share a compiled program; compute its metrics on each of them.

    `tell` is a callback, called with a description of the current work and the completed fraction.
    """
    from jaxhil.laws.compensators import axes_of, get_compensator, literature_gains
    from tuning.gains.search_progress import SearchProgress
    from tuning.gains.settings import TuneSettings
    from tuning.gains.tune_all import tune_all

    mechanisms = [scene.mechanism for scene in scenes]
    axes = axes_of(mechanisms[0])
    specification = get_compensator(compensator, axes)
    further = [
        name
        for name in specification.settings
        if any(literature_gains(m, compensator, name) != literature_gains(m, compensator) for m in mechanisms)
    ]
    gains = [
        {
            which or LITERATURE_GAINS: literature_gains(mechanism, compensator, which)
            for which in (None, *further)
        }
        for mechanism in mechanisms
    ]
    # A compensator whose settings hold for all mechanisms is not tuned.
    tuned = settings.tuned and not specification.settings
    tuned = tuned and any(gain.tuned(mechanism) for gain in specification.gains for mechanism in mechanisms)
    work = SearchProgress(lambda text, share, _: tell(f"{compensator}, {text}", share))
    lanes = {scene.mechanism.name: scene.lanes for scene in scenes}
    work.runs_after_group = (1 + len(further) + tuned) * sum(lanes.values())
    if tuned:
        tuning = TuneSettings(
            settings.scenarios,
            settings.starts,
            settings.steps,
            validation=31,
            seed=settings.seed,
            polish=settings.polish,
            scanned=settings.scanned,
        )
        for index, result in tune_all(mechanisms, compensator, tuning, work, common=scenes[0].common):
            gains[index][TUNED_GAINS] = result.gains
    results = []
    for scene, by_name in zip(scenes, gains, strict=True):
        metrics = {}
        for which, values in by_name.items():
            work.say(f"{scene.mechanism.name}: evaluating {which} gains")
            metrics[which] = scene.evaluate(compensator, values, settings.limit, settings.seed)
            work.report_runs(lanes[scene.mechanism.name])
        results.append(CompensatorMetrics(compensator, scene.mechanism.name, by_name, metrics, axes))
    return results


def _evaluate_in_worker(
    number: int, scenes: list[Any], compensator: str, settings: CompareSettings
) -> list[CompensatorMetrics]:
    """Call `evaluate_compensator` in a worker process, and send its progress to the parent process."""
    last = 0.0

    def tell(text: str, share: float) -> None:
        nonlocal last
        if (now := time.monotonic()) - last >= MESSAGE_INTERVAL:
            last = now
            _messages.put((number, text, share))

    return evaluate_compensator(scenes, compensator, settings, tell)


_messages: Any = None  # in a worker process, queue for progress messages to the parent process


def _initialise_worker(messages: Any) -> None:
    """Initialise a worker process with few JAX devices, because every core has its own worker."""
    global _messages
    _messages = messages
    # After Ctrl-C the parent process ends the workers. If the parent is killed, each worker ends itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} {DEVICE_COUNT_FLAG}={MIN_DEVICES}".strip()
    prepare_jax()


def _end_with_parent() -> None:
    """Wait until the parent process has ended, then end this process."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
