"""Comparison of tuned gains with the best gains of a global search on the same objective.

The search covers the whole range of every gain and does not start from the tuned gains. It evaluates the
objective `EVALUATION_FACTOR` times as often as tuning did.
"""

from typing import NamedTuple

import numpy as np

from tuning.gains.multistart import MultistartResult
from tuning.gains.settings import TuneSettings
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import search_globally

EVALUATION_FACTOR = 50
MIN_LANES_PER_CALL = 8192  # minimum number of lanes in a call; large calls take less time per lane


class GlobalComparison(NamedTuple):
    """Objective of the tuned gains and of the best gains of a global search."""

    tuned: float  # objective of the tuned gains [1]
    best: float  # objective of the best gains of the search [1]
    above: float  # relative excess of the tuned objective, tuned / best - 1 [1]
    spent: int  # number of evaluations in tuning; a Jacobian with respect to P gains counts as 1 + P
    evaluations: int  # number of evaluations in the global search
    gains: dict[str, float]  # best gains of the search


def compare_with_global_search(
    validation: Validation,
    task: int,
    found: MultistartResult,
    settings: TuneSettings,
    factor: int = EVALUATION_FACTOR,
) -> GlobalComparison | None:
    """Compare tuned gains with a global search that makes `factor` times as many evaluations as tuning.

    Return None if tuning found no gains.
    """
    if found.best is None:
        return None

    def losses(points):
        return validation.losses(
            found.objective or settings.objective, [task], points[None], lanes=MIN_LANES_PER_CALL
        )[0]

    budget = factor * found.evaluations
    search = search_globally(losses, len(validation.names), budget, seed=settings.seed + 1)
    tuned = float(losses(found.best.coordinates[None])[0])
    gains = validation.gains(task, search.point)
    best = float(search.loss)
    above = tuned / best - 1 if best > 0 else np.inf
    return GlobalComparison(tuned, best, above, found.evaluations, search.evaluations, gains)
