"""Ours in the comparison: the one place to change where tuning finds its gains in another way.

`ours` takes all starts at once, as tuning does, and says of each what it had found after how many rollouts
and seconds; `warm_up` compiles what it will run. Nothing else of this file is used elsewhere.
"""

import time

import jax
import numpy as np
from jaxtyping import Float
from search_case import Case, several
from search_methods import Trace

from tuning.objective import RMS, common_terms, residuals
from tuning.optimiser import Solution, solve
from tuning.problems import spread_points
from tuning.rounds import AGREED, FIRST_ROUND, REACH
from tuning.search import apart, polish

SCANNED, DESCENTS, GO_ON = 64, 6, 3  # points looked at, those descended from, those that go on; of a start
STEPS = 25  # of Levenberg-Marquardt
POLISH = 160  # evaluations, of a start whose descents do not agree
LONGEST = 32  # steps that the program is made for


def ours(case: Case, starts: Float[np.ndarray, "starts gains"], warming: bool = False) -> list[Trace]:
    """What tuning does, from every start (in the unit box) on its own: look around, descend by
    Levenberg-Marquardt in two rounds, polish without derivatives where the descents disagree.

    A trace has an entry for every step of a start's descents and for the stages before and after. Its seconds
    are those of the batch over the number of starts; the steps of a round, which is one program, count as
    equally long.
    """
    number, gains = starts.shape
    begin = time.perf_counter()
    stages = _Stages(number, begin)

    points = np.stack([spread_points(start, SCANNED, seed) for seed, start in enumerate(starts)])
    values = case.losses(points.reshape(-1, gains)).reshape(number, -1)
    stages.add(np.full(number, SCANNED), np.min(values, axis=1))
    order = np.argsort(values, axis=1)
    first = np.concatenate(
        [apart(own[ranks], None, DESCENTS) for own, ranks in zip(points, order, strict=True)]
    )
    found = _descend(case, first, 1 if warming else FIRST_ROUND)
    loss = np.asarray(found.loss).reshape(number, DESCENTS)
    stages.add_steps(1 + gains, found)
    best = np.argsort(loss, axis=1)[:, :GO_ON] + DESCENTS * np.arange(number)[:, None]
    found = _descend(case, found.shares[best.reshape(-1)], 1 if warming else STEPS - FIRST_ROUND)
    loss = np.asarray(found.loss).reshape(number, GO_ON)
    stages.add_steps(1 + gains, found)

    # AGREED is of the rms error, the root of the loss.
    unsure = np.ptp(loss, axis=1) > 2 * AGREED * np.min(loss, axis=1)
    if unsure.any():
        rows = (np.argmin(loss, axis=1) + GO_ON * np.arange(number))[unsure]
        scale = 2 * np.min(loss, axis=1)[unsure]
        shape = np.linalg.inv(np.asarray(found.curvature)[rows] / scale[:, None, None] + 16 * np.eye(gains))

        def losses(points):
            return case.losses(points.reshape(-1, gains)).reshape(points.shape[:-1])

        last = polish(
            losses, np.asarray(found.shares)[rows], 1 if warming else POLISH, reach=REACH, covariance=shape
        )
        polished = np.full(number, np.inf)
        polished[unsure] = last.loss
        stages.add(POLISH * unsure, polished)
    return stages.traces()


def warm_up(case: Case, starts: Float[np.ndarray, "starts gains"]) -> None:
    """Compile what `ours` runs for as many starts."""
    ours(case, starts, warming=True)


def _descend(case: Case, shares, steps) -> Solution:
    problems, bounds = several((case.problem, case.bounds), len(shares))
    static = case.loop, case.names, common_terms([RMS])
    shares = np.clip(shares, 0, 1)
    return jax.device_get(
        solve(residuals, static, problems, bounds, shares, np.array(steps), LONGEST, tile=1)
    )


class _Stages:
    """Of every start rollouts, seconds and best loss after each stage."""

    def __init__(self, number: int, begin: float):
        self.number, self.begin = number, begin
        self.rollouts, self.seconds, self.best = [], [], []

    def add(self, rollouts, best) -> None:
        before = self.rollouts[-1] if self.rollouts else 0
        self.rollouts.append(before + rollouts)
        self.seconds.append((time.perf_counter() - self.begin) / self.number)
        self.best.append(np.minimum(best, self.best[-1] if self.best else np.inf))

    def add_steps(self, rollouts: int, found: Solution) -> None:
        """Descents of all starts, as many of each: an entry for every step."""
        begin = self.seconds[-1]
        end = (time.perf_counter() - self.begin) / self.number
        steps = np.asarray(found.steps).reshape(self.number, -1)
        history = np.asarray(found.history).reshape(*steps.shape, -1)
        before, last = 0, max(1, int(np.max(steps)))
        for step in range(1, last + 1):
            taken = rollouts * np.minimum(steps, step).sum(axis=1)
            self.add(taken - before, np.min(history[..., step - 1], axis=1))
            self.seconds[-1] = begin + (end - begin) * step / last
            before = taken

    def traces(self) -> list[Trace]:
        rollouts, best = np.array(self.rollouts, float), np.array(self.best)
        return [Trace(rollouts[:, i], np.array(self.seconds), best[:, i]) for i in range(self.number)]
