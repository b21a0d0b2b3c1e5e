"""How much better gains could be: the whole box is searched on the same objective, and the best compared.

The search knows nothing of what tuning found, and takes `FACTOR` times as many evaluations.
"""

from typing import NamedTuple

import numpy as np

from tuning.gains.multistart import MultistartResult
from tuning.gains.settings import TuneSettings
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import search_globally

FACTOR = 50
LANES = 8192  # side by side, which is quicker than few at a time


class GlobalComparison(NamedTuple):
    """Tuned gains beside the best found anywhere."""

    tuned: float  # value of the objective [1]
    best: float  # that of the best [1]
    above: float  # by what share of the best value the tuned one lies above it; negative: below
    spent: int  # evaluations of tuning, a Jacobian over P gains counted as 1 + P
    evaluations: int  # those of the search
    gains: dict[str, float]  # the best ones


def compare_with_global_search(
    validation: Validation,
    task: int,
    found: MultistartResult,
    settings: TuneSettings,
    factor: int = FACTOR,
) -> GlobalComparison | None:
    """Search the box of one task with `factor` times the evaluations that tuning took; none where all starts
    failed."""
    if found.best is None:
        return None

    def losses(points):
        return validation.losses(found.quiet or settings.objective, [task], points[None], lanes=LANES)[0]

    budget = factor * found.evaluations
    everywhere = search_globally(losses, len(validation.names), budget, seed=settings.seed + 1)
    tuned = float(losses(found.best.coordinates[None])[0])
    gains = validation.gains(task, everywhere.point)
    best = float(everywhere.loss)
    above = tuned / best - 1 if best > 0 else np.inf
    return GlobalComparison(tuned, best, above, found.evaluations, everywhere.evaluations, gains)
