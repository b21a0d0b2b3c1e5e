"""First-order lag of the force sensor in addition to its delay.

To first order a lag is a delay, so slow contacts determine only the sum of both, which is also what the loop
experiences. A lag is added if it improves the Bayesian information criterion by 6. If the contacts neither
require nor exclude a lag, it remains part of the delay; the draws of delay and damping then average over it
(Bayesian model averaging, Hoeting et al. 1999). This matters because a lag blurs the onset, and only the
onset separates the delay from the damping.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize, special

from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_profile import POSTERIOR_DRAWS, Posterior
from tuning.identification.lag_profile import compute_posterior_near
from tuning.identification.law_choice import CoarseFit, search_coarsely

MAX_TIME_CONSTANT = 0.005  # s, longest time constant
TRIAL_TIME_CONSTANTS = 0.0005, 0.0015, 0.004  # s, time constants of a first search
MIN_CRITERION_GAIN = 6.0  # of the Bayesian information criterion, required for a lag
LAG_GRID_SIZE, LAG_HALF_WIDTH_SIGMAS = (
    9,
    3.5,
)  # lags of the grid, and its half width in standard deviations of the lag
DELAY_GRID_SIZE, DELAY_HALF_WIDTH_SIGMAS = (
    21,
    5.0,
)  # delays at each lag, and half width in standard deviations of the delay
MIN_DELAY_STD = 5e-5  # s, lower bound of that standard deviation
SMALL_LAG_GRID_SIZE, SMALL_DELAY_GRID_SIZE = 7, 15  # size of the grid if a lag is not required
PRIOR_LAG_PROBABILITY = 0.8  # prior probability of a lag: nearly every amplifier has a filter
EXCLUSION_LIKELIHOOD_DROP = (
    8.0  # drop of the log likelihood below its maximum, beyond which a lag is excluded
)

# Function that returns the problem with a lag [s] and its best delay, surface and misfit.
FitAt = Callable[[float], tuple[ContactProblem, CoarseFit]]


@dataclass(frozen=True)
class SensorLag:
    """Time constant of the force sensor, with the posterior of all parameters."""

    value: float  # s, at the greatest posterior density; 0 if the lag remains part of the delay
    posterior: Posterior  # if value > 0, its last name is "time_constant" and its best fit is at `value`
    evidence: float  # log evidence of both models together, as `Posterior.evidence`


def estimate_sensor_lag(problem: ContactProblem, posterior: Posterior, seed: int = 0) -> SensorLag | None:
    """Estimate the time constant if the readings require a lag; return None if they exclude one."""
    delay, plane, inner = posterior.best
    fits: dict[float, tuple[ContactProblem, CoarseFit]] = {}

    def at(value: float) -> tuple[ContactProblem, CoarseFit]:
        if value not in fits:
            start = (max(delay - value, problem.min_delay), plane, inner.misfit)
            lagging = problem.changed(problem.law, value)
            fits[value] = lagging, search_coarsely(lagging, start, 2)
        return fits[value]

    def fit(value: float) -> CoarseFit:
        return at(value)[1]

    needed = MIN_CRITERION_GAIN + np.log(len(problem.kept))
    if inner.misfit - min(fit(value)[2] for value in TRIAL_TIME_CONSTANTS) < 0.5 * needed:
        return _average_over_lag(problem, posterior, at, seed)
    period = problem.motion.period
    optimum: Any = optimize.minimize_scalar(
        lambda value: fit(value)[2], bounds=(0.1 * period, MAX_TIME_CONSTANT), method="bounded",
        options={"xatol": 0.1 * period},
    )  # fmt: skip
    if inner.misfit - float(optimum.fun) < needed:
        return _average_over_lag(problem, posterior, at, seed)
    value, step = float(optimum.x), 0.1 * float(optimum.x)
    for _ in range(2):
        rise = np.mean([fit(value + side * step)[2] for side in (-1.0, 1.0)]) - optimum.fun
        std = step / np.sqrt(max(rise, 0.1))
        step = min(2.0 * std, 0.5 * value)
    nodes = value + std * np.linspace(-LAG_HALF_WIDTH_SIGMAS, LAG_HALF_WIDTH_SIGMAS, LAG_GRID_SIZE)
    nodes = nodes[nodes > 0.1 * period]
    posteriors = _compute_posteriors(posterior, at, nodes, DELAY_GRID_SIZE, seed)
    draws, picked = _draw_between_lags(nodes, posteriors, seed)
    best = int(np.argmax([node.evidence for node in posteriors]))
    names = [*posteriors[best].names, "time_constant"]
    joined = replace(posteriors[best], names=names, draws=np.column_stack([draws, picked]))
    return SensorLag(float(nodes[best]), joined, _weigh_lag(posterior, posteriors, nodes[1] - nodes[0])[1])


def _average_over_lag(
    problem: ContactProblem, posterior: Posterior, at: FitAt, seed: int
) -> SensorLag | None:
    """Average over the models with and without a lag; return None if the readings exclude a lag.

    The lag has a uniform prior up to `MAX_TIME_CONSTANT` and is added to the delay.
    """
    heights = (
        np.array([posterior.best[2].misfit, *(at(value)[1][2] for value in TRIAL_TIME_CONSTANTS)]) / -2.0
    )
    inside = np.flatnonzero(heights[1:] > heights.max() - EXCLUSION_LIKELIHOOD_DROP)
    if not len(inside):
        return None
    highest = (*TRIAL_TIME_CONSTANTS, MAX_TIME_CONSTANT)[inside[-1] + 1]
    step = highest / SMALL_LAG_GRID_SIZE
    nodes = step * (np.arange(SMALL_LAG_GRID_SIZE) + 0.5)
    posteriors = _compute_posteriors(posterior, at, nodes, SMALL_DELAY_GRID_SIZE, seed)
    share, evidence = _weigh_lag(posterior, posteriors, step)
    draws, picked = _draw_between_lags(nodes, posteriors, seed)
    draws[:, 0] += picked
    count = round(share * POSTERIOR_DRAWS)
    mixed = np.random.default_rng([seed, 4]).permutation(
        np.concatenate([draws[:count], posterior.draws[count:]])
    )
    return SensorLag(0.0, replace(posterior, draws=mixed), evidence)


def _weigh_lag(posterior: Posterior, posteriors: list[Posterior], step: float) -> tuple[float, float]:
    """Return the posterior probability of a lag and the evidence of both models; `step` between lags [s]."""
    integral: Any = special.logsumexp([node.evidence for node in posteriors])
    with_lag = float(integral) + np.log(PRIOR_LAG_PROBABILITY * step / MAX_TIME_CONSTANT)
    without = posterior.evidence + np.log(1.0 - PRIOR_LAG_PROBABILITY)
    return float(special.expit(with_lag - without)), float(np.logaddexp(with_lag, without))


def _compute_posteriors(
    posterior: Posterior, at: FitAt, nodes: np.ndarray, count: int, seed: int
) -> list[Posterior]:
    """Return the posterior at each lag, over `count` delays."""
    return [compute_posterior_at_lag(*at(lag), posterior, seed, count) for lag in nodes]


def compute_posterior_at_lag(
    problem: ContactProblem, best: CoarseFit, like: Posterior, seed: int, count: int = SMALL_DELAY_GRID_SIZE
) -> Posterior:
    """Return the posterior at the problem's lag about the best fit, over `count` delays.

    The half width of the grid is `DELAY_HALF_WIDTH_SIGMAS` standard deviations of the delay in the posterior
    `like`.
    """
    reach = DELAY_HALF_WIDTH_SIGMAS * max(float(like.draws[:, 0].std()), MIN_DELAY_STD)
    low, high = np.clip([best[0] - reach, best[0] + reach], problem.min_delay, MAX_FORCE_DELAY)
    return compute_posterior_near(problem, np.linspace(low, high, count), best[1], seed)


def _draw_between_lags(
    nodes: np.ndarray, posteriors: list[Posterior], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return draws over evenly spaced lags, and the lag [s] of each draw.

    Each lag contributes draws by its weight; they are interpolated between the lags.
    """
    evidence = np.array([node.evidence for node in posteriors])
    weights = np.exp(evidence - evidence.max())
    rng = np.random.default_rng([seed, 2])
    places = (
        (np.arange(POSTERIOR_DRAWS) + rng.uniform(size=POSTERIOR_DRAWS)) / POSTERIOR_DRAWS * weights.sum()
    )
    picked = np.minimum(np.searchsorted(np.cumsum(weights), places), len(nodes) - 1)
    step, means = nodes[1] - nodes[0], np.array([node_posterior.mean for node_posterior in posteriors])
    slopes = np.gradient(means, step, axis=0)
    shift = rng.uniform(-0.5, 0.5, POSTERIOR_DRAWS) * step
    draws = (
        np.array([posteriors[node].draws[i] for i, node in enumerate(picked)])
        + shift[:, None] * slopes[picked]
    )
    order = rng.permutation(POSTERIOR_DRAWS)
    return draws[order], (nodes[picked] + shift)[order]
