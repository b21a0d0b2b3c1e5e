"""The comparison itself: each law tuned to its own best, all judged on the same scenarios and probes.

Laws, and groups of mechanisms that share a program, go to as many processes as there are cores, each with
one device: compiling takes most of the time, and one process compiles on one core. No figure depends on
which process computes it.
"""

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any, NamedTuple

from jaxhil.errors import one_line
from jaxhil.mechanism.structs import Mechanism
from tuning.statistics.intervals import Estimate

LITERATURE, TUNED = "literature", "tuned"
SEED = 0xFA1  # of the scenarios to judge on: tuning and its own validation never see them


@dataclass(frozen=True)
class CompareSettings:
    """Settings of a comparison."""

    scenarios: int = 32  # to tune on
    starts: int = 3  # of the solver
    steps: int = 16  # of the solver, at most
    polish: int = 20  # evaluations without derivatives, for each gain
    scanned: int = 64  # points of a scan for starts
    judged: int = 256  # scenarios to judge on
    limit: float = 0.01  # error beyond which a contact counts as a failure [1]
    seed: int = 0  # of scenarios, starts and resampling
    tuned: bool = True  # whether to tune at all


class LawFigures(NamedTuple):
    """Of one law on one mechanism; a law without gains to tune is only there with the literature's."""

    law: str
    mechanism: str
    gains: dict[str, dict[str, float]]  # by "literature", names of settings and "tuned"
    figures: dict[str, dict[str, Estimate]]  # what is said of each (`tuning.transparency.figures`)


class Failed(NamedTuple):
    """A law that could not be judged on some mechanisms, and why; the others are none the worse for it."""

    law: str
    reason: str


def compare(
    mechanisms: Sequence[Mechanism],
    laws: Sequence[str],
    settings: CompareSettings,
    processes: int,
    report: Callable[[str], None] = lambda text: None,
) -> Iterator[LawFigures | Failed]:
    """What is found of each law on every mechanism, as it is done: in so many processes or, with 0 of them,
    one after the other in this one, where an error ends all."""
    if processes == 0:
        report("contacts in space")
        for group in build_scenes(list(mechanisms), settings):
            for law in laws:
                report(_progress(law, group))
                yield from judge_law(group, law, settings)
        return
    # A fresh interpreter each: jax does not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _begin) as pool:
        try:
            report("contacts in space")
            scenes = pool.submit(build_scenes, list(mechanisms), settings).result()
            tasks = [(group, law) for group in scenes for law in sorted(laws, key=_gains, reverse=True)]
            # Those with the most to compile first, so that no process is left with one of them at the end.
            running = {pool.submit(judge_law, group, law, settings): (group, law) for group, law in tasks}
            for done in as_completed(running):
                group, law = running[done]
                report(_progress(law, group))
                error = done.exception()
                if error is None:
                    yield from done.result()
                else:
                    yield Failed(law, one_line(f"{type(error).__name__}: {error}", 200))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _progress(law: str, scenes: Sequence[Any]) -> str:
    return f"{law}, {len(scenes)} mechanism{'s' if len(scenes) > 1 else ''}"


def _gains(law: str) -> int:
    """How many there are: the more, the longer it takes."""
    from jaxhil.runtime import COMPENSATORS

    return len(COMPENSATORS[law].gains)


def build_scenes(mechanisms: list[Mechanism], settings: CompareSettings) -> list[list[Any]]:
    """What the laws are judged on (`tuning.benchmark.runs.Scene`), grouped by program."""
    from tuning.benchmark.runs import build_scene
    from tuning.gains.common_program import common_programs

    seed = settings.seed + SEED
    return [
        [build_scene(mechanisms[i], common, settings.judged, seed) for i in group]
        for group, common in common_programs(mechanisms)
    ]


def judge_law(scenes: list[Any], law: str, settings: CompareSettings) -> list[LawFigures]:
    """All figures of one law on mechanisms of one program, tuned together."""
    from jaxhil.compensators import COMPENSATORS, literature_gains
    from tuning.benchmark.runs import judge_gains
    from tuning.gains.settings import TuneSettings
    from tuning.gains.tune import tune_all

    mechanisms = [scene.mechanism for scene in scenes]
    others = [
        name
        for name in COMPENSATORS[law].settings
        if any(literature_gains(one, law, name) != literature_gains(one, law) for one in mechanisms)
    ]
    gains = [
        {which or LITERATURE: literature_gains(mechanism, law, which) for which in (None, *others)}
        for mechanism in mechanisms
    ]
    moved = any(gain.tuned(mechanism) for gain in COMPENSATORS[law].gains for mechanism in mechanisms)
    if settings.tuned and moved:
        tuning = TuneSettings(
            settings.scenarios,
            settings.starts,
            settings.steps,
            validation=31,
            seed=settings.seed,
            polish=settings.polish,
            scanned=settings.scanned,
        )
        for index, result in tune_all(mechanisms, law, tuning, common=scenes[0].common):
            gains[index][TUNED] = result.gains
    found = []
    for scene, own in zip(scenes, gains, strict=True):
        figures = {
            which: judge_gains(scene, law, one, settings.limit, settings.seed) for which, one in own.items()
        }
        found.append(LawFigures(law, scene.mechanism.name, own, figures))
    return found


def _begin() -> None:
    """A worker: one device, so that as many workers as there are cores share the machine."""
    import os
    import signal

    # The parent hears of an interruption, and ends the workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    given = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{given} --xla_force_host_platform_device_count=1".strip()
    from jaxhil.simulation.environment import prepare

    prepare()
