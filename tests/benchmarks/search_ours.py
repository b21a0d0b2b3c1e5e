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
from tuning.optimiser import solve
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

    A trace has an entry for every stage. Its seconds are those of the batch over the number of starts.
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
    shares, loss, steps, curvature = _descend(case, first, 1 if warming else FIRST_ROUND)
    loss = loss.reshape(number, DESCENTS)
    stages.add((1 + gains) * steps.reshape(number, -1).sum(axis=1), np.min(loss, axis=1))
    best = np.argsort(loss, axis=1)[:, :GO_ON] + DESCENTS * np.arange(number)[:, None]
    shares, loss, steps, curvature = _descend(
        case, shares[best.reshape(-1)], 1 if warming else STEPS - FIRST_ROUND
    )
    loss = loss.reshape(number, GO_ON)
    stages.add((1 + gains) * steps.reshape(number, -1).sum(axis=1), np.min(loss, axis=1))

    # AGREED is of the rms error, the root of the loss.
    unsure = np.ptp(loss, axis=1) > 2 * AGREED * np.min(loss, axis=1)
    if unsure.any():
        rows = (np.argmin(loss, axis=1) + GO_ON * np.arange(number))[unsure]
        scale = 2 * np.min(loss, axis=1)[unsure]
        shape = np.linalg.inv(curvature[rows] / scale[:, None, None] + 16 * np.eye(gains))

        def losses(points):
            return case.losses(points.reshape(-1, gains)).reshape(points.shape[:-1])

        found = polish(losses, shares[rows], 1 if warming else POLISH, reach=REACH, covariance=shape)
        polished = np.full(number, np.inf)
        polished[unsure] = found.loss
        stages.add(POLISH * unsure, polished)
    return stages.traces()


def warm_up(case: Case, starts: Float[np.ndarray, "starts gains"]) -> None:
    """Compile what `ours` runs for as many starts."""
    ours(case, starts, warming=True)


def _descend(case: Case, shares, steps):
    """Shares, loss, steps and J^T J of every descent."""
    problems, bounds = several((case.problem, case.bounds), len(shares))
    static = case.loop, case.names, common_terms([RMS])
    found = jax.device_get(
        solve(residuals, static, problems, bounds, shares, np.array(steps), LONGEST, tile=1)
    )
    return np.clip(found.shares, 0, 1), np.asarray(found.loss), found.steps, np.asarray(found.curvature)


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

    def traces(self) -> list[Trace]:
        rollouts, best = np.array(self.rollouts, float), np.array(self.best)
        return [Trace(rollouts[:, i], np.array(self.seconds), best[:, i]) for i in range(self.number)]
