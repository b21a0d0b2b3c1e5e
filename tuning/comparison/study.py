"""The comparison itself: each law tuned to its own best, all judged on the same scenarios and probes.

Laws are dealt out to as many processes as there are cores, each with one device: compiling takes most of the
time, and one process compiles on one core. A figure depends on neither.
"""

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxhil.mechanism import Mechanism
from tuning.comparison.figures import Figure

LITERATURE, TUNED = "literature", "tuned"
SEED = 0xFA1  # of the scenarios to judge on: tuning and its own validation never see them


@dataclass(frozen=True)
class Settings:
    """Numbers of scenarios to tune on (None: `tuning.problems` knows), of starts and steps of the solver, of
    evaluations without derivatives for each gain; of scenarios to judge on; the error beyond which a contact
    counts as a failure; the seed."""

    scenarios: int | None = None
    starts: int = 2
    steps: int = 16
    polish: int = 20
    judged: int = 256
    limit: float = 0.01
    seed: int = 0


class LawFigures(NamedTuple):
    """Of one law on one mechanism: gains by "literature" and "tuned", and what is said of each. A law that
    has no gains is only there with the literature's."""

    law: str
    mechanism: str
    gains: dict[str, dict[str, float]]
    figures: dict[str, dict[str, Figure]]


def compare(
    mechanisms: Sequence[Mechanism],
    laws: Sequence[str],
    settings: Settings,
    processes: int,
    report: Callable[[str], None] = lambda text: None,
) -> Iterator[list[LawFigures]]:
    """What is found of each law on every mechanism, a law at a time, as they are done."""
    if processes < 2 or len(laws) < 2:
        for law in laws:
            report(law)
            yield judge_law(list(mechanisms), law, settings)
        return
    # A fresh interpreter each: jax does not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(laws)), context, _begin) as pool:
        try:
            running = {pool.submit(judge_law, list(mechanisms), law, settings): law for law in laws}
            for done in as_completed(running):
                report(running[done])
                yield done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def judge_law(mechanisms: list[Mechanism], law: str, settings: Settings) -> list[LawFigures]:
    """All figures of one law on every mechanism."""
    from tuning.forms import forms

    found: dict[int, LawFigures] = {}
    for group, form in forms(mechanisms):
        own = _judge_group([mechanisms[i] for i in group], law, form, settings)
        found.update(zip(group, own, strict=True))
    return [found[i] for i in range(len(mechanisms))]


def _begin() -> None:
    """A worker: one device, so that as many workers as there are cores share the machine."""
    import os
    import signal

    # The parent hears of an interruption, and ends the workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    given = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{given} --xla_force_host_platform_device_count=1".strip()
    from tuning.environment import prepare

    prepare()


def _judge_group(mechanisms: list[Mechanism], law: str, form: Any, settings: Settings) -> list[LawFigures]:
    """Of the mechanisms of one form."""
    from jaxhil.compensators import literature_gains
    from tuning.comparison.runs import Judge
    from tuning.tune import Settings as Tuning
    from tuning.tune import tune_all

    gains = [{LITERATURE: literature_gains(mechanism, law)} for mechanism in mechanisms]
    if gains[0][LITERATURE]:
        tuning = Tuning(
            settings.scenarios,
            settings.starts,
            settings.steps,
            validation=31,
            seed=settings.seed,
            polish=settings.polish,
        )
        for index, result in tune_all(mechanisms, law, tuning, form=form):
            gains[index][TUNED] = result.gains
    found = []
    for mechanism, own in zip(mechanisms, gains, strict=True):
        judge = Judge(mechanism, law, form, settings.judged, settings.seed + SEED)
        figures = {
            which: judge.figures(one, settings.limit, settings.seed) for which, one in own.items()
        }
        found.append(LawFigures(law, mechanism.name, own, figures))
    return found


def finite(figure: Figure) -> bool:
    """Whether there is such a figure."""
    return bool(np.isfinite(figure.value))
