"""Scans of the gains' ranges: the best of many points that lie apart, on a few scenarios."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxhil.mechanism.structs import Mechanism
from tuning.gains.objective import Objective, one_each
from tuning.gains.tasks import spread_points
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import apart, far_apart

SCENARIOS = 32  # on which the points of a scan are tried
FEW_SCENARIOS = 8  # of these, on which most are seen to be poor
AT_ONCE = 16  # points of a task, which are tried on all of them
ROUNDING = 1e-9  # what a value may lose in rounding, relative to it


def scan(
    validation: Validation,
    which: list[int],
    number: int,
    seed: int | tuple[int, ...],
    objective: Objective | Sequence[Objective],
    scanned: int,
    beside: list[np.ndarray] | None = None,
) -> list[Float[np.ndarray, "number gains"]]:
    """The best points of a scan of the tasks `which`, so many that lie apart, and from those `beside`."""
    around = [validation.coordinates(i, [validation.tasks[i].literature])[0] for i in which]
    points = np.stack([spread_points(own, max(scanned, 2 * number), seed)[1:] for own in around])
    for own, i in zip(points, which, strict=True):
        task = validation.tasks[i]
        for gain in task.tuned:
            if gain.begins is not None:
                mechanism: Any = task.mechanism
                place, begins = validation.names.index(gain.name), {gain.name: gain.begins(mechanism)}
                own[:, place] = validation.coordinates(i, [{**task.literature, **begins}])[0, place]
    known = [beside[i] if beside else np.empty((0, len(validation.names))) for i in which]
    values = _scanned(validation, which, points, known, number, objective)
    order = np.argsort(values, axis=1, kind="stable")
    return [
        apart(own[by_value], near, len(near) + number)[len(near) :]
        for own, by_value, near in zip(points, order, known, strict=True)
    ]


def _scanned(validation, which, points, known, number, objective) -> Float[np.ndarray, "which points"]:
    """Values of a scan's points; infinite where so many others that lie apart are known to be better.

    Squares are summed: over a part of the scenarios they are no more than over all, so that most points are
    seen to be poor by that part.
    """
    share = FEW_SCENARIOS / min(SCENARIOS, validation.tasks[0].lanes)
    if share > 0.5 or not _sums_squares(validation, which, objective):
        values = validation.losses(objective, which, points, SCENARIOS)
        return np.where(np.isfinite(values), values, np.inf)
    least = validation.losses(objective, which, points, FEW_SCENARIOS) * (1 - ROUNDING) * np.sqrt(share)
    promising = np.argsort(least, axis=1, kind="stable")
    values, worst = np.full(least.shape, np.inf), np.full(len(which), np.inf)
    for begin in range(0, least.shape[1], AT_ONCE):
        tried = promising[:, begin : begin + AT_ONCE]
        going = np.flatnonzero(least[np.arange(len(which)), tried[:, 0]] <= worst)
        if not len(going):
            break
        here = going[:, None], tried[going]
        tasks = [which[i] for i in going]
        values[here] = validation.losses(objective, tasks, points[here], SCENARIOS)
        for i in going:
            ranked = points[i][np.argsort(values[i], kind="stable")]
            chosen = far_apart(ranked, known[i], len(known[i]) + number)
            enough = len(chosen) == len(known[i]) + number
            worst[i] = values[i][(points[i] == chosen[-1]).all(axis=1)].min() if enough else np.inf
    return values


def _sums_squares(
    validation: Validation, which: list[int], objective: Objective | Sequence[Objective]
) -> bool:
    """Whether a part of the scenarios, in which each has as many contacts, bounds the objective below."""
    if validation.tasks[0].probed or not isinstance(validation.tasks[0].mechanism, Mechanism):
        return False
    own = [one_each(objective, len(validation.tasks))[i] for i in which]
    return all(
        one.name == "rms" and one.noise_weight == 0 and not one.tolerance and one.function is None
        for one in own
    )


def scan_evaluations(validation: Validation, number: int, scanned: int) -> int:
    """How many evaluations of all scenarios a scan of so many points for so many starts counts as."""
    scenarios = validation.tasks[0].lanes
    return -(-max(scanned, 2 * number) * min(SCENARIOS, scenarios) // scenarios)
