"""Estimation of the cutoff frequency of a force sensor's filter whose kind and order the prior states.

The cutoff is estimated together with delay, surface position and coefficients, like the time constant of a
first-order lag (`sensor_lag`). The time constant here is the inverse of the angular cutoff frequency. If the
contacts hardly determine it, the prior's value is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import optimize

from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.law_choice import CoarseFit, search_coarsely, search_precisely
from tuning.identification.sensor_lag import (
    DELAY_GRID_SIZE,
    MAX_TIME_CONSTANT,
    SensorLag,
    compute_posterior_at_lag,
    join_posteriors,
    place_nodes,
)
from tuning.identification.structure_choice import MAX_RELATIVE_STD

TRIAL_RATIO = 1.6  # ratio of successive time constants in a first search
MIN_TIME_CONSTANT_PERIODS = 0.1  # smallest time constant, in control periods
RELATIVE_TOLERANCE = 0.02  # tolerance of the best time constant
FIRST_DELAY_STD = 2e-4  # s, standard deviation of the delay that determines the width of a first grid


def estimate_stated_filter(
    problem: ContactProblem, near: tuple[float, float] | None, seed: int = 0
) -> SensorLag:
    """Estimate all contact parameters, and the time constant of the sensor's filter stated in the prior.

    Args:
        problem: Contact problem with the filter and the time constant of the prior.
        near: Approximate delay [s] and surface position [m] with this filter, or None.
        seed: Seed of the random numbers.

    Returns:
        The time constant with the posterior. If the contacts hardly determine the time constant, all draws
        have the prior's value.
    """
    stated, modes = problem.time_constant, problem.readings.modes
    first = search_coarsely(problem, None if near is None else (*near, np.inf))
    fits: dict[float, tuple[ContactProblem, CoarseFit]] = {stated: (problem, first)}

    def at(value: float) -> tuple[ContactProblem, CoarseFit]:
        if value not in fits:
            nearest = min(fits, key=lambda other: abs(np.log(other / value)))
            delay, plane, misfit = fits[nearest][1]
            # At low frequencies, the filter acts like a delay.
            delay = delay + (nearest - value) * modes.delay
            delay = float(np.clip(delay, problem.min_delay, MAX_FORCE_DELAY))
            changed = problem.changed(problem.law, value, delay)
            fits[value] = changed, search_precisely(changed, (delay, plane, misfit))
        return fits[value]

    def misfit(value: float) -> float:
        return at(value)[1][2]

    least = MIN_TIME_CONSTANT_PERIODS * problem.motion.period
    best = _find_best(misfit, stated, (min(least, stated), max(MAX_TIME_CONSTANT, stated)))
    nodes = place_nodes(lambda value: at(value)[1], best, misfit(best), least)
    first_posterior = compute_posterior_at_lag(*at(best), FIRST_DELAY_STD, seed, DELAY_GRID_SIZE)
    delay_std = float(first_posterior.draws[:, 0].std())
    posteriors = [compute_posterior_at_lag(*at(node), delay_std, seed, DELAY_GRID_SIZE) for node in nodes]
    lag = join_posteriors(nodes, posteriors, seed)
    if lag.posterior.draws[:, -1].std() < MAX_RELATIVE_STD * best:
        return lag
    alone = compute_posterior_at_lag(*at(stated), delay_std, seed, DELAY_GRID_SIZE)
    draws = np.column_stack([alone.draws, np.full(len(alone.draws), stated)])
    return SensorLag(stated, replace(alone, names=lag.posterior.names, draws=draws), alone.evidence)


def _find_best(misfit: Callable[[float], float], start: float, limits: tuple[float, float]) -> float:
    """Search from `start` for a time constant [s] within the limits that minimises the misfit."""
    best = start
    while True:
        bounds = max(best / TRIAL_RATIO, limits[0]), min(best * TRIAL_RATIO, limits[1])
        better = min(bounds, key=misfit)
        if not misfit(better) < misfit(best):
            break
        best = better
    optimum: Any = optimize.minimize_scalar(
        misfit, bounds=bounds, method="bounded", options={"xatol": RELATIVE_TOLERANCE * best}
    )
    return float(optimum.x) if optimum.fun < misfit(best) else best
