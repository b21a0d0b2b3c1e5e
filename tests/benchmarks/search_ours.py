"""Optimiser of jaxhil in the comparison; it must be adapted if the search of tuning changes.

`ours` takes all starting points at once, as tuning does, and returns a trace for each; `warm_up` compiles the
programs.
"""

import time
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from search_case import Case, several
from search_methods import Trace

from tuning.gains.multistart import (
    AGREEMENT_TOLERANCE,
    CANDIDATES_PER_GENERATION,
    MAX_START_BATCHES,
    MIN_AGREEING_STARTS,
    POLISH_STD,
)
from tuning.gains.multistart_solver import STEPS_BEFORE_SELECTION, compute_inverse_hessian
from tuning.gains.objective import RESIDUAL_SCALE, RMS_OBJECTIVE, compute_residuals, join_terms
from tuning.gains.tasks import spread_points
from tuning.optimisation.derivative_free import polish, select_distant_points
from tuning.optimisation.levenberg_marquardt import solve_least_squares
from tuning.optimisation.solution import SolverResult

SCANNED, DESCENTS, GO_ON = 64, 6, 3  # per batch: points scanned, descents started, descents continued
STEPS = 25  # steps of Levenberg-Marquardt
POLISH = 320  # evaluations of the polishing search
LONGEST = 32  # largest number of steps of the compiled program


def ours(case: Case, starts: Float[np.ndarray, "starts gains"], warming: bool = False) -> list[Trace]:
    """Run the search of tuning separately from every starting point in the unit box.

    The search scans points, runs Levenberg-Marquardt in two rounds, repeats this if the results disagree, and
    ends with a derivative-free polishing search. A trace has an entry for every Levenberg-Marquardt step and
    for the stages before and after. The time of the batch is divided equally among the starting points, and
    the time of a round equally among its steps.
    """
    number, gains = starts.shape
    stages = _Stages(number, time.perf_counter())
    ends = [_Ends(np.empty(0), np.empty((0, gains)), np.empty((0, gains, gains))) for _ in starts]
    going = np.arange(number)
    for batch in range(1 if warming else MAX_START_BATCHES):
        points = np.stack([spread_points(starts[i], SCANNED, (int(i), batch)) for i in going])
        values = case.losses(points.reshape(-1, gains)).reshape(len(going), -1)
        stages.add(going, SCANNED, np.min(values, axis=1))
        order = np.argsort(values, axis=1)
        first = [
            select_distant_points(own[ranks], None, DESCENTS)
            for own, ranks in zip(points, order, strict=True)
        ]
        found = _descend(
            case, np.concatenate(first), 1 if warming else STEPS_BEFORE_SELECTION, number * DESCENTS
        )
        loss = np.asarray(found.loss).reshape(len(going), DESCENTS)
        stages.add_steps(going, 1 + gains, found)
        best = np.argsort(loss, axis=1)[:, :GO_ON] + DESCENTS * np.arange(len(going))[:, None]
        left = 1 if warming else STEPS - STEPS_BEFORE_SELECTION
        found = _descend(case, found.coordinates[best.reshape(-1)], left, number * GO_ON)
        stages.add_steps(going, 1 + gains, found)
        several = [
            np.asarray(leaf).reshape(len(going), GO_ON, *leaf.shape[1:])
            for leaf in (found.loss, found.coordinates, found.curvature)
        ]
        for i, *own in zip(going, *several, strict=True):
            ends[i] = _Ends(*(np.concatenate(both) for both in zip(ends[i], own, strict=True)))
        going = going[[not _agree(ends[i].loss) for i in going]]
        if not len(going):
            break

    tops = [int(np.argmin(own.loss)) for own in ends]
    coordinates = np.stack([own.coordinates[top] for own, top in zip(ends, tops, strict=True)])
    shapes = [
        compute_inverse_hessian(own.curvature[top], RESIDUAL_SCALE * np.sqrt(2 * own.loss[top]))
        for own, top in zip(ends, tops, strict=True)
    ]

    def losses(points):
        return case.losses(points.reshape(-1, gains)).reshape(points.shape[:-1])

    last = polish(
        losses, coordinates, 1 if warming else POLISH,
        candidates=CANDIDATES_PER_GENERATION, reach=POLISH_STD, covariance=np.stack(shapes),
    )  # fmt: skip
    stages.add(np.arange(number), POLISH, last.loss)
    return stages.traces()


class _Ends(NamedTuple):
    """Results of the descents from one starting point."""

    loss: np.ndarray
    coordinates: np.ndarray
    curvature: np.ndarray


def _agree(losses: np.ndarray) -> bool:
    # The tolerance applies to the rms error, which is the square root of the loss.
    ranked = np.sort(losses)
    return bool(ranked[MIN_AGREEING_STARTS - 1] <= (1 + AGREEMENT_TOLERANCE) ** 2 * ranked[0])


def warm_up(case: Case, starts: Float[np.ndarray, "starts gains"]) -> None:
    """Compile the programs that `ours` runs for this number of starting points."""
    ours(case, starts, warming=True)
    for size in _sizes(len(starts)):
        for descents in (DESCENTS, GO_ON):
            _descend(case, np.repeat(starts[:1], size * descents, axis=0), 1, len(starts) * descents)


def _sizes(number: int) -> list[int]:
    """Return the batch sizes for which programs are compiled; small batches then take less time."""
    return [max(1, number >> halvings) for halvings in range(3)]


def _descend(case: Case, coordinates, steps, most) -> SolverResult:
    """Run the descents in the smallest program that fits; `most` is the largest batch size."""
    size = min(one for one in _sizes(most) if one >= len(coordinates))
    padded = np.concatenate([coordinates, np.repeat(coordinates[:1], size - len(coordinates), axis=0)])
    problems, bounds = several((case.problem, case.bounds), size)
    static = case.loop, case.names, join_terms([RMS_OBJECTIVE])
    result = solve_least_squares(
        compute_residuals, static, problems, bounds, np.clip(padded, 0, 1), np.array(steps), LONGEST, tile=1
    )
    return jax.tree.map(lambda leaf: leaf[: len(coordinates)], jax.device_get(result))


class _Stages:
    """Rollouts, seconds and best loss of every starting point after each stage."""

    def __init__(self, number: int, begin: float):
        self.number, self.begin = number, begin
        self.rollouts, self.seconds, self.best = [np.zeros(number)], [0.0], [np.full(number, np.inf)]

    def add(self, which, rollouts, best) -> None:
        """Add a stage of the selected starting points."""
        spent, reached = self.rollouts[-1].copy(), self.best[-1].copy()
        spent[which] += rollouts
        reached[which] = np.minimum(reached[which], best)
        self.rollouts.append(spent)
        self.best.append(reached)
        self.seconds.append((time.perf_counter() - self.begin) / self.number)

    def add_steps(self, which, rollouts: int, result: SolverResult) -> None:
        """Add an entry for every step of the descents from the selected starting points."""
        begin = self.seconds[-1]
        end = (time.perf_counter() - self.begin) / self.number
        steps = np.asarray(result.steps).reshape(len(which), -1)
        history = np.asarray(result.history).reshape(*steps.shape, -1)
        before, last = 0, max(1, int(np.max(steps)))
        for step in range(1, last + 1):
            taken = rollouts * np.minimum(steps, step).sum(axis=1)
            self.add(which, taken - before, np.min(history[..., step - 1], axis=1))
            self.seconds[-1] = begin + (end - begin) * step / last
            before = taken

    def traces(self) -> list[Trace]:
        rollouts, best = np.array(self.rollouts[1:]), np.array(self.best[1:])
        return [Trace(rollouts[:, i], np.array(self.seconds[1:]), best[:, i]) for i in range(self.number)]
