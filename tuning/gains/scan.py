"""Scan of the gains' ranges for good starts of the solver, evaluated on a few scenarios."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxhil.mechanism.structs import Mechanism
from tuning.gains.objective import Objective, list_objectives
from tuning.gains.tasks import spread_points
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import select_distant_points, select_points_at_distance

SCAN_SCENARIOS = 32  # number of scenarios on which a scan evaluates its points
PRESCREEN_SCENARIOS = 8  # number of scenarios that suffice to discard most points
POINTS_PER_CALL = 16  # number of points per task that one call evaluates on `SCAN_SCENARIOS` scenarios
ROUNDING_TOLERANCE = 1e-9  # relative rounding error of an objective


def scan_gain_ranges(
    validation: Validation,
    which: list[int],
    number: int,
    seed: int | tuple[int, ...],
    objective: Objective | Sequence[Objective],
    scanned: int,
    beside: list[np.ndarray] | None = None,
) -> list[Float[np.ndarray, "number gains"]]:
    """Scan the ranges of the gains of the tasks `which`; return the `number` best points of each task.

    The points keep a minimum distance from each other and from the points in `beside`.
    """
    centres = [validation.coordinates(i, [validation.tasks[i].literature])[0] for i in which]
    points = np.stack([spread_points(centre, max(scanned, 2 * number), seed)[1:] for centre in centres])
    for task_points, i in zip(points, which, strict=True):
        task = validation.tasks[i]
        for gain in task.tuned:
            if gain.begins is not None:
                mechanism: Any = task.mechanism
                index, begins = validation.names.index(gain.name), {gain.name: gain.begins(mechanism)}
                task_points[:, index] = validation.coordinates(i, [{**task.literature, **begins}])[0, index]
    prior = [beside[i] if beside else np.empty((0, len(validation.names))) for i in which]
    values = _evaluate_points(validation, which, points, prior, number, objective)
    order = np.argsort(values, axis=1, kind="stable")
    return [
        select_distant_points(task_points[by_value], near, len(near) + number)[len(near) :]
        for task_points, by_value, near in zip(points, order, prior, strict=True)
    ]


def _evaluate_points(
    validation, which, points, prior, number, objective
) -> Float[np.ndarray, "which points"]:
    """Evaluate the objective at the points of a scan; the value of a discarded point is infinite.

    A few scenarios yield a lower bound of the objective at each point. A point is discarded without full
    evaluation if `number` points, which are not too close to each other, are better than its bound.
    """
    share = PRESCREEN_SCENARIOS / min(SCAN_SCENARIOS, validation.tasks[0].lanes)
    if share > 0.5 or not _is_sum_of_squares(validation, which, objective):
        values = validation.losses(objective, which, points, SCAN_SCENARIOS)
        return np.where(np.isfinite(values), values, np.inf)
    least = (
        validation.losses(objective, which, points, PRESCREEN_SCENARIOS)
        * (1 - ROUNDING_TOLERANCE)
        * np.sqrt(share)
    )
    promising = np.argsort(least, axis=1, kind="stable")
    values, worst = np.full(least.shape, np.inf), np.full(len(which), np.inf)
    for begin in range(0, least.shape[1], POINTS_PER_CALL):
        tried = promising[:, begin : begin + POINTS_PER_CALL]
        going = np.flatnonzero(least[np.arange(len(which)), tried[:, 0]] <= worst)
        if not len(going):
            break
        selected = going[:, None], tried[going]
        tasks = [which[i] for i in going]
        values[selected] = validation.losses(objective, tasks, points[selected], SCAN_SCENARIOS)
        for i in going:
            ranked = points[i][np.argsort(values[i], kind="stable")]
            chosen = select_points_at_distance(ranked, prior[i], len(prior[i]) + number)
            enough = len(chosen) == len(prior[i]) + number
            worst[i] = values[i][(points[i] == chosen[-1]).all(axis=1)].min() if enough else np.inf
    return values


def _is_sum_of_squares(
    validation: Validation, which: list[int], objective: Objective | Sequence[Objective]
) -> bool:
    """Return whether the objective is a sum of squares.

    If it is, its sum over a few scenarios is a lower bound of its sum over all scenarios.
    """
    if validation.tasks[0].probed or not isinstance(validation.tasks[0].mechanism, Mechanism):
        return False
    objectives = list_objectives(objective, len(validation.tasks))
    return all(
        o.name == "rms" and o.noise_weight == 0 and not o.tolerance and o.function is None
        for o in (objectives[i] for i in which)
    )


def count_scan_evaluations(validation: Validation, number: int, scanned: int) -> int:
    """Return the cost of a scan for `number` starts, in evaluations of the objective on all scenarios."""
    scenarios = validation.tasks[0].lanes
    return -(-max(scanned, 2 * number) * min(SCAN_SCENARIOS, scenarios) // scenarios)
