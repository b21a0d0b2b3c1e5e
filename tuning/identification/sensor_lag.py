"""A lag of the force sensor beside its delay.

To first order a lag is a delay, so their sum alone is known from slow contacts, and it is what the loop
feels. A lag is added where it explains so much more that the Bayesian information criterion gains 6. Where
the touches neither ask for a lag nor rule it out, it stays part of the delay, but the draws of delay and
damping average over it (Bayesian model averaging, Hoeting et al. 1999): a lag blurs the onset, which is all
that tells the delay from damping.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize, special

from tuning.identification.contact_problem import LONGEST, Problem
from tuning.identification.contact_profile import DRAWS, Posterior
from tuning.identification.lag_profile import around
from tuning.identification.law_choice import Fitted, quick

LARGEST = 0.005  # s
TRIED = 0.0005, 0.0015, 0.004  # s, of which one gains if any does
GAIN = 6.0  # of the criterion
NODES, WIDEST = 9, 3.5  # lags at which all else is fitted, and standard deviations of the lag that they span
DELAYS, REACH = 21, 5.0  # of the grid at each lag, and standard deviations of the delay that it reaches
NARROWEST = 5e-5  # s, least standard deviation that sets this reach
FEWER_NODES, FEWER_DELAYS = 7, 15  # of the grid where a lag is not asked for
LIKELY = 0.8  # probability of a lag before the touches: nearly every amplifier has a filter
RULED_OUT = 8.0  # drop of the log likelihood from its largest, beyond which a lag is ruled out


@dataclass(frozen=True)
class Lag:
    """The sensor's time constant, and all numbers with it."""

    value: float  # s, of greatest posterior density; 0 where the lag stays part of the delay
    posterior: Posterior  # with a value, "time_constant" is the last of its names; its best is at `value`
    share: float  # posterior probability of a lag
    evidence: float  # logarithm of the posterior's integral with a lag or without, as `Posterior.evidence`


def sensor_lag(problem: Problem, posterior: Posterior, seed: int = 0) -> Lag | None:
    """Find the time constant if the readings ask for one; None where they rule a lag out."""
    delay, plane, inner = posterior.best
    fits: dict[float, Fitted] = {}

    def fit(value: float) -> Fitted:
        if value not in fits:
            start = (max(delay - value, problem.shortest), plane, inner.misfit)
            fits[value] = quick(_lagging(problem, value), start, 2)
        return fits[value]

    needed = GAIN + np.log(len(problem.kept))
    if inner.misfit - min(fit(value)[2] for value in TRIED) < 0.5 * needed:
        return _averaged(problem, posterior, fit, seed)
    period = problem.motion.period
    found: Any = optimize.minimize_scalar(
        lambda value: fit(value)[2], bounds=(0.1 * period, LARGEST), method="bounded",
        options={"xatol": 0.1 * period},
    )  # fmt: skip
    if inner.misfit - float(found.fun) < needed:
        return _averaged(problem, posterior, fit, seed)
    value, step = float(found.x), 0.1 * float(found.x)
    for _ in range(2):
        rise = np.mean([fit(value + side * step)[2] for side in (-1.0, 1.0)]) - found.fun
        std = step / np.sqrt(max(rise, 0.1))
        step = min(2.0 * std, 0.5 * value)
    nodes = value + std * np.linspace(-WIDEST, WIDEST, NODES)
    nodes = nodes[nodes > 0.1 * period]
    each = _each(problem, posterior, fit, nodes, DELAYS, seed)
    draws, picked = _joined(nodes, each, seed)
    best = int(np.argmax([one.evidence for one in each]))
    names = [*each[best].names, "time_constant"]
    joined = replace(each[best], names=names, draws=np.column_stack([draws, picked]))
    return Lag(float(nodes[best]), joined, *_weighed(posterior, each, nodes[1] - nodes[0]))


def _averaged(
    problem: Problem, posterior: Posterior, fit: Callable[[float], Fitted], seed: int
) -> Lag | None:
    """Average over a lag that may be there or not.

    The lag is uniform up to the largest one, and is added to the delay."""
    heights = np.array([posterior.best[2].misfit, *(fit(value)[2] for value in TRIED)]) / -2.0
    inside = np.flatnonzero(heights[1:] > heights.max() - RULED_OUT)
    if not len(inside):
        return None
    highest = (*TRIED, LARGEST)[inside[-1] + 1]
    step = highest / FEWER_NODES
    nodes = step * (np.arange(FEWER_NODES) + 0.5)
    each = _each(problem, posterior, fit, nodes, FEWER_DELAYS, seed)
    share, evidence = _weighed(posterior, each, step)
    draws, picked = _joined(nodes, each, seed)
    draws[:, 0] += picked
    count = round(share * DRAWS)
    mixed = np.random.default_rng([seed, 4]).permutation(
        np.concatenate([draws[:count], posterior.draws[count:]])
    )
    return Lag(0.0, replace(posterior, draws=mixed), share, evidence)


def _weighed(posterior: Posterior, each: list[Posterior], step: float) -> tuple[float, float]:
    """Return the probability of a lag, and the evidence of both together; `step` between the lags [s]."""
    integral: Any = special.logsumexp([one.evidence for one in each])
    with_lag = float(integral) + np.log(LIKELY * step / LARGEST)
    without = posterior.evidence + np.log(1.0 - LIKELY)
    return float(special.expit(with_lag - without)), float(np.logaddexp(with_lag, without))


def _each(
    problem: Problem,
    posterior: Posterior,
    fit: Callable[[float], Fitted],
    nodes: np.ndarray,
    count: int,
    seed: int,
) -> list[Posterior]:
    """The posterior at each lag, over so many delays."""
    return [with_lag(_lagging(problem, lag), fit(lag), posterior, seed, count) for lag in nodes]


def with_lag(
    problem: Problem, best: Fitted, like: Posterior, seed: int, count: int = FEWER_DELAYS
) -> Posterior:
    """Return the posterior at the problem's lag about the best fit, over `count` delays.

    They reach as far as the delay's standard deviation in a posterior `like` this one."""
    reach = REACH * max(float(like.draws[:, 0].std()), NARROWEST)
    low, high = np.clip([best[0] - reach, best[0] + reach], problem.shortest, LONGEST)
    return around(problem, np.linspace(low, high, count), best[1], seed)


def _joined(nodes: np.ndarray, each: list[Posterior], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draws over lags evenly spaced: those of every node by its weight, moved between the nodes; and their
    lags."""
    evidence = np.array([one.evidence for one in each])
    weights = np.exp(evidence - evidence.max())
    rng = np.random.default_rng([seed, 2])
    places = (np.arange(DRAWS) + rng.uniform(size=DRAWS)) / DRAWS * weights.sum()
    picked = np.minimum(np.searchsorted(np.cumsum(weights), places), len(nodes) - 1)
    step, means = nodes[1] - nodes[0], np.array([one.mean for one in each])
    slopes = np.gradient(means, step, axis=0)
    off = rng.uniform(-0.5, 0.5, DRAWS) * step
    draws = np.array([each[node].draws[i] for i, node in enumerate(picked)]) + off[:, None] * slopes[picked]
    order = rng.permutation(DRAWS)
    return draws[order], (nodes[picked] + off)[order]


def _lagging(problem: Problem, value: float) -> Problem:
    return Problem(problem.motion, problem.readings, problem.law, problem.plane, value)
