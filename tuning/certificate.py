"""How far tuned gains are from the best there is: a search of the whole box on the same objective.

It knows nothing of what tuning found, and takes `FACTOR` times as many evaluations.
"""

from typing import NamedTuple

import numpy as np

from tuning.objective import Objective
from tuning.rounds import SCANNED, Start
from tuning.search import certify
from tuning.trial import Trial

FACTOR = 50


class Certified(NamedTuple):
    """Value of the objective of the tuned gains and of the best found anywhere; by what share of the latter
    the former lies above it (below: negative); evaluations of tuning, a Jacobian over P gains counted as
    1 + P, and of the search; the gains of the best."""

    tuned: float
    best: float
    above: float
    spent: int
    evaluations: int
    gains: dict[str, float]


def certified(
    trial: Trial,
    task: int,
    found: Start,
    starts: list[Start],
    objective: Objective,
    polish: int,
    seed: int,
    factor: int = FACTOR,
) -> Certified:
    """Search the box of one task with `factor` times the evaluations that tuning took."""
    number = len(trial.names)
    spent = evaluations(found, starts, number, polish)

    def losses(points):
        return trial.losses(objective, [task], points[None])[0]

    everywhere = certify(losses, number, factor * spent, seed=seed + 1)
    tuned = float(losses(found.shares[None])[0])
    gains = trial.gains(task, everywhere.free)
    above = tuned / everywhere.loss - 1 if everywhere.loss > 0 else np.inf
    return Certified(tuned, everywhere.loss, above, spent, everywhere.evaluations, gains)


def evaluations(found: Start, starts: list[Start], gains: int, polish: int) -> int:
    """Evaluations that tuning took for one task: the scan, the steps, the polish if there was one."""
    scanned = max(SCANNED, 2 * len(starts)) if len(starts) > 1 else 0
    stepped = sum(start.steps for start in starts) * (1 + gains)
    polished = all(found.shares is not start.shares for start in starts)
    return scanned + stepped + polish * polished
