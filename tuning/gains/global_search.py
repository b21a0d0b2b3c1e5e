"""How far tuned gains are from the best there is: a search of the whole box on the same objective.

It knows nothing of what tuning found, and takes `FACTOR` times as many evaluations.
"""

from typing import NamedTuple

import numpy as np

from tuning.gains.multistart import Found
from tuning.gains.objective import Objective
from tuning.gains.validation import Trial
from tuning.optimisation.derivative_free import certify

FACTOR = 50
LANES = 8192  # side by side, which is quicker than few at a time


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
    found: Found,
    objective: Objective,
    seed: int,
    factor: int = FACTOR,
) -> Certified | None:
    """Search the box of one task with `factor` times the evaluations that tuning took; none where all starts
    failed."""
    if found.best is None:
        return None

    def losses(points):
        return trial.losses(objective, [task], points[None], lanes=LANES)[0]

    everywhere = certify(losses, len(trial.names), factor * found.evaluations, seed=seed + 1)
    tuned = float(losses(found.best.shares[None])[0])
    gains = trial.gains(task, everywhere.free)
    above = tuned / everywhere.loss - 1 if everywhere.loss > 0 else np.inf
    return Certified(tuned, everywhere.loss, above, found.evaluations, everywhere.evaluations, gains)
