"""How far tuned gains are from the best there is: a search of the whole box on the same objective.

It knows nothing of what tuning found, and takes `FACTOR` times as many evaluations.
"""

from typing import NamedTuple

import numpy as np

from tuning.gains.multistart import MultistartResult
from tuning.gains.objective import Objective
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import search_globally

FACTOR = 50
LANES_PER_SCENARIO = 8192  # side by side, which is quicker than few at a time


class GlobalComparison(NamedTuple):
    """Value of the objective of the tuned gains and of the best found anywhere; by what share of the latter
    the former lies above it (below: negative); evaluations of tuning, a Jacobian over P gains counted as
    1 + P, and of the search; the gains of the best."""

    tuned: float
    best: float
    above: float
    spent: int
    evaluations: int
    gains: dict[str, float]


def compare_with_global_search(
    validation: Validation,
    task: int,
    found: MultistartResult,
    objective: Objective,
    seed: int,
    factor: int = FACTOR,
) -> GlobalComparison | None:
    """Search the box of one task with `factor` times the evaluations that tuning took; none where all starts
    failed."""
    if found.best is None:
        return None

    def losses(points):
        return validation.losses(objective, [task], points[None], lanes=LANES_PER_SCENARIO)[0]

    everywhere = search_globally(losses, len(validation.names), factor * found.evaluations, seed=seed + 1)
    tuned = float(losses(found.best.coordinates[None])[0])
    gains = validation.gains(task, everywhere.point)
    above = tuned / everywhere.loss - 1 if everywhere.loss > 0 else np.inf
    return GlobalComparison(tuned, everywhere.loss, above, found.evaluations, everywhere.evaluations, gains)
