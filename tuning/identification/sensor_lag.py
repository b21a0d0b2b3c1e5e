"""A lag of the force sensor beside its delay: only where the touches tell the two apart.

To first order a lag is a delay, so their sum alone is known from slow contacts, and it is what the loop
feels. A lag is added where it explains so much more that the Bayesian information criterion gains 6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize

from tuning.identification.contact_problem import Problem
from tuning.identification.contact_profile import DRAWS, Posterior, around
from tuning.identification.law_choice import Fitted, quick

LARGEST = 0.005  # s
TRIED = 0.0005, 0.0015, 0.004  # s, of which one gains if any does
GAIN = 6.0  # of the criterion
NODES, WIDEST = 9, 3.5  # lags at which all else is fitted, and standard deviations of the lag that they span
DELAYS, REACH = 21, 5.0  # of the grid at each lag, and standard deviations of the delay that it reaches


@dataclass(frozen=True)
class Lag:
    """The sensor's time constant, and all numbers with it."""

    value: float  # s, of greatest posterior density
    posterior: Posterior  # "time_constant" the last of its names; its best is at `value`


def sensor_lag(problem: Problem, posterior: Posterior, seed: int = 0) -> Lag | None:
    """The time constant where the readings ask for one, else None."""
    delay, plane, inner = posterior.best
    fits: dict[float, Fitted] = {}

    def fit(value: float) -> Fitted:
        if value not in fits:
            start = (max(delay - value, problem.shortest), plane, inner.misfit)
            fits[value] = quick(_lagging(problem, value), start, 2)
        return fits[value]

    needed = GAIN + np.log(len(problem.kept))
    if inner.misfit - min(fit(value)[2] for value in TRIED) < 0.5 * needed:
        return None
    period = problem.motion.period
    found: Any = optimize.minimize_scalar(
        lambda value: fit(value)[2], bounds=(0.1 * period, LARGEST), method="bounded",
        options={"xatol": 0.1 * period},
    )  # fmt: skip
    if inner.misfit - float(found.fun) < needed:
        return None
    value, step = float(found.x), 0.1 * float(found.x)
    for _ in range(2):
        rise = np.mean([fit(value + side * step)[2] for side in (-1.0, 1.0)]) - found.fun
        std = step / np.sqrt(max(rise, 0.1))
        step = min(2.0 * std, 0.5 * value)
    nodes = value + std * np.linspace(-WIDEST, WIDEST, NODES)
    nodes = nodes[nodes > 0.1 * period]
    spread = REACH * float(posterior.draws[:, 0].std()) * np.linspace(-1.0, 1.0, DELAYS)
    each = []
    for one in nodes:
        at, plane, _ = fit(one)
        delays = np.unique(np.maximum(at + spread, problem.shortest))
        each.append(around(_lagging(problem, one), delays, plane, seed))
    return _joined(nodes, each, seed)


def _joined(nodes: np.ndarray, each: list[Posterior], seed: int) -> Lag:
    """The posterior over lags evenly spaced: draws of every node by its weight, moved between the nodes."""
    evidence = np.array([one.evidence for one in each])
    weights = np.exp(evidence - evidence.max())
    rng = np.random.default_rng([seed, 2])
    places = (np.arange(DRAWS) + rng.uniform(size=DRAWS)) / DRAWS * weights.sum()
    picked = np.minimum(np.searchsorted(np.cumsum(weights), places), len(nodes) - 1)
    step, means = nodes[1] - nodes[0], np.array([one.mean for one in each])
    slopes = np.gradient(means, step, axis=0)
    off = rng.uniform(-0.5, 0.5, DRAWS) * step
    draws = np.array([each[node].draws[i] for i, node in enumerate(picked)]) + off[:, None] * slopes[picked]
    draws = rng.permutation(np.column_stack([draws, nodes[picked] + off]))
    best = each[int(np.argmax(weights))]
    return Lag(
        float(nodes[np.argmax(weights)]),
        replace(best, names=[*best.names, "time_constant"], draws=draws),
    )


def _lagging(problem: Problem, value: float) -> Problem:
    return Problem(problem.motion, problem.readings, problem.law, problem.plane, value)
