"""The comparison itself: each law tuned to its own best, all judged on the same scenarios and probes.

Laws, and groups of mechanisms that share a program, go to as many processes as there are cores, each with
few devices: compiling takes most of the time, and one process compiles on one core. No figure depends on
which process computes it. What is found of a law on a group is kept at once, where there is a place for it
(`tuning.caches.pieces`).
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

from jaxhil.errors import one_line
from jaxhil.mechanism.file import to_builtins
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.environment import DEVICES, FEWEST_DEVICES, prepare
from tuning.caches.cluster import Piece, on_workers
from tuning.caches.pieces import NOTHING_KEPT, Pieces, digest_of
from tuning.caches.worker import setting
from tuning.statistics.intervals import Estimate

LITERATURE, TUNED = "literature", "tuned"
SEED = 0xFA1  # of the scenarios to judge on: tuning and its own validation never see them
SECONDS = 1.0  # between two messages of a process

Tell = Callable[[str, float], None]


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
    """Of one law on one mechanism; a law without gains to tune, or with settings for any mechanism, is not
    there with tuned gains."""

    law: str
    mechanism: str
    gains: dict[str, dict[str, float]]  # by "literature", names of settings and "tuned"
    figures: dict[str, dict[str, Estimate]]  # what is said of each (`tuning.transparency.figures`)

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of the settings that it was judged with beside its nominal gains."""
        return tuple(which for which in self.figures if which not in (LITERATURE, TUNED))


class Failed(NamedTuple):
    """A law that could not be judged on some mechanisms, and why; the others are none the worse for it."""

    law: str
    reason: str


Judged = tuple[list[Any], str, list[LawFigures] | Failed]  # a group's scenes, a law, what was found


def compare(
    mechanisms: Sequence[Mechanism],
    laws: Sequence[str],
    settings: CompareSettings,
    processes: int,
    tell: Callable[[str, float, float], None] = lambda text, done, kept: None,
    pieces: Pieces = NOTHING_KEPT,
    scheduler: str | None = None,
) -> Iterator[LawFigures | Failed]:
    """What is found of each law on every mechanism, as it is done: in so many processes or, with 0 of them,
    one after the other in this one, where an error ends all; with a `scheduler`, by the workers of a cluster.
    `tell` is called with what is going on, how many results are there, shares of those under way counted, and
    how many were kept from before."""
    kept = _kept(mechanisms, laws, settings, pieces) if pieces.resumes else []
    yield from kept
    there = {(one.mechanism, one.law) for one in kept}
    # Of a group and a law all mechanisms are kept or none.
    left = [m for m in mechanisms if any((m.name, law) not in there for law in laws)]
    if not left:
        return

    def told(text: str, done: float) -> None:
        tell(text, len(kept) + done, len(kept))

    told(f"{len(kept)} results as kept, contacts in space" if kept else "contacts in space", 0)

    def missing(scenes: list[list[Any]]) -> list[tuple[list[Any], str]]:
        """Those with the most to compile first, so that no process is left with one of them at the end."""
        order = sorted(laws, key=_gains, reverse=True) if processes or scheduler else laws
        return [(own, law) for own in scenes for law in order if (own[0].mechanism.name, law) not in there]

    if scheduler is not None:
        computed = _on_cluster(scheduler, missing(build_scenes(left, settings)), settings, told)
    elif processes == 0:
        computed = _one_by_one(missing(build_scenes(left, settings)), settings, told)
    else:
        computed = _in_processes(processes, left, settings, missing, told)
    for group, law, found in computed:
        if isinstance(found, Failed):
            yield found
            continue
        pieces.write(*_piece([scene.mechanism for scene in group], law, settings), found)
        yield from found


def _kept(
    mechanisms: Sequence[Mechanism], laws: Sequence[str], settings: CompareSettings, pieces: Pieces
) -> list[LawFigures]:
    """What an earlier comparison kept."""
    from tuning.gains.common_program import common_programs

    groups = [[mechanisms[i] for i in group] for group, _ in common_programs(mechanisms)]
    read = (pieces.read(*_piece(own, law, settings), list[LawFigures]) for own in groups for law in laws)
    return [one for found in read for one in found or ()]


def _piece(group: list[Mechanism], law: str, settings: CompareSettings) -> tuple[str, Any]:
    """Name and inputs of what is found of a law on mechanisms that share a program."""
    return f"compare {law} {group[0].name}", ("compare", law, [to_builtins(one) for one in group], settings)


def _one_by_one(
    tasks: list[tuple[list[Any], str]], settings: CompareSettings, tell: Tell
) -> Iterator[Judged]:
    done = 0
    for group, law in tasks:

        def told(text: str, share: float, group=group, done=done) -> None:
            tell(text, done + share * len(group))

        yield group, law, judge_law(group, law, settings, told)
        done += len(group)


def _on_cluster(
    scheduler: str, tasks: list[tuple[list[Any], str]], settings: CompareSettings, tell: Tell
) -> Iterator[Judged]:
    pieces = [Piece(i, (group, law, settings)) for i, (group, law) in enumerate(tasks)]
    inputs = [_piece([scene.mechanism for scene in group], law, settings) for group, law in tasks]
    done, what = 0, f"compare-{digest_of(inputs)[:16]}"
    tell(f"{len(tasks)} pieces on the cluster", done)
    for i, found in on_workers(scheduler, judge_or_say_why, pieces, setting(), what):
        group, law = tasks[i]
        done += len(group)
        tell(law, done)
        yield group, law, found


def judge_or_say_why(group: list[Any], law: str, settings: CompareSettings) -> list[LawFigures] | Failed:
    """`judge_law`; where it cannot be done, why."""
    try:
        return judge_law(group, law, settings)
    except Exception as error:
        return _failed(law, error)


def _failed(law: str, error: BaseException) -> Failed:
    return Failed(law, one_line(f"{type(error).__name__}: {error}", 200))


def _in_processes(
    processes: int,
    mechanisms: list[Mechanism],
    settings: CompareSettings,
    missing: Callable[[list[list[Any]]], list[tuple[list[Any], str]]],
    tell: Tell,
) -> Iterator[Judged]:
    # A fresh interpreter each: jax does not survive a fork.
    context = multiprocessing.get_context("spawn")
    heard = context.SimpleQueue()
    with ProcessPoolExecutor(processes, context, _begin, (heard,)) as pool:
        try:
            tasks = missing(pool.submit(build_scenes, mechanisms, settings).result())
            running = {pool.submit(_judge, i, *task, settings): i for i, task in enumerate(tasks)}
            shares = [0.0 for _ in tasks]
            while running:
                ended, _ = wait(running, SECONDS, return_when=FIRST_COMPLETED)
                while not heard.empty():
                    i, text, shares[i] = heard.get()
                    tell(text, sum(one * len(tasks[k][0]) for k, one in enumerate(shares)))
                for future in ended:
                    i = running.pop(future)
                    error = future.exception()
                    shares[i] = 1.0
                    yield *tasks[i], _failed(tasks[i][1], error) if error else future.result()
        except BaseException:
            # What they compute nobody waits for.
            for child in multiprocessing.active_children():
                child.terminate()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _gains(law: str) -> int:
    """How many there are: the more, the longer it takes."""
    from jaxhil.rig import COMPENSATORS

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


def judge_law(
    scenes: list[Any], law: str, settings: CompareSettings, tell: Tell = lambda text, share: None
) -> list[LawFigures]:
    """All figures of one law on mechanisms of one program, tuned together. `tell` is called with what is
    going on and the share that is done."""
    from jaxhil.laws.compensators import COMPENSATORS, literature_gains
    from tuning.benchmark.runs import judge_gains, lanes_judged
    from tuning.gains.settings import TuneSettings
    from tuning.gains.tune_all import tune_all
    from tuning.gains.work import Work

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
    # Settings are for any mechanism: what they leave is what such a law leaves.
    tuned = settings.tuned and not COMPENSATORS[law].settings
    tuned = tuned and any(
        gain.tuned(mechanism) for gain in COMPENSATORS[law].gains for mechanism in mechanisms
    )
    work = Work(lambda text, share, _: tell(f"{law}, {text}", share))
    lanes = {scene.mechanism.name: lanes_judged(scene) for scene in scenes}
    work.later = (1 + len(others) + tuned) * sum(lanes.values())
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
        for index, result in tune_all(mechanisms, law, tuning, work, common=scenes[0].common):
            gains[index][TUNED] = result.gains
    found = []
    for scene, own in zip(scenes, gains, strict=True):
        figures = {}
        for which, one in own.items():
            work.say(f"{scene.mechanism.name}: judging {which} gains")
            figures[which] = judge_gains(scene, law, one, settings.limit, settings.seed)
            work.ran(lanes[scene.mechanism.name])
        found.append(LawFigures(law, scene.mechanism.name, own, figures))
    return found


def _judge(number: int, scenes: list[Any], law: str, settings: CompareSettings) -> list[LawFigures]:
    """`judge_law` in a worker, which tells the parent of it, once in a while."""
    last = 0.0

    def tell(text: str, share: float) -> None:
        nonlocal last
        if (now := time.monotonic()) - last >= SECONDS:
            last = now
            _heard.put((number, text, share))

    return judge_law(scenes, law, settings, tell)


_heard: Any = None  # the parent's queue, in a worker


def _begin(heard: Any) -> None:
    """A worker: few devices, so that as many workers as there are cores share the machine."""
    global _heard
    _heard = heard
    # The parent hears of an interruption, and ends the workers; one that is killed cannot.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    given = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{given} {DEVICES}={FEWEST_DEVICES}".strip()
    prepare()


def _end_with_parent() -> None:
    """End this process when its parent has ended, whatever ended it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
