"""Estimation of a first-order lag of the force sensor, in addition to its delay.

To first order, a lag acts like a delay. Slow contacts therefore determine only the sum of lag and delay. This
sum also determines the effect on the loop. A separate lag is estimated if it improves the Bayesian
information criterion by at least 6. If the contacts neither require nor exclude a lag, it is treated as part
of the delay. The draws of delay and damping then average over the models with and without a lag (Bayesian
model averaging, Hoeting et al. 1999). The average is needed because only the onset of contact distinguishes
delay from damping, and a lag smooths the force at the onset.
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
from tuning.identification.law_choice import CoarseFit, search_precisely

MAX_TIME_CONSTANT = 0.005  # longest time constant of a lag [s]
TRIAL_TIME_CONSTANTS = 0.0005, 0.0015, 0.004  # time constants of a first search [s]
MIN_CRITERION_GAIN = 6.0  # minimum improvement of the Bayesian information criterion by a lag
# Number of time constants in the grid, and half width of this grid in standard deviations.
LAG_GRID_SIZE, LAG_HALF_WIDTH_SIGMAS = 9, 3.5
# Number of delays at each time constant, and half width of this grid in standard deviations.
DELAY_GRID_SIZE, DELAY_HALF_WIDTH_SIGMAS = 21, 5.0
MIN_DELAY_STD = 5e-5  # minimum standard deviation of the delay that determines the width of the grid [s]
SMALL_LAG_GRID_SIZE, SMALL_DELAY_GRID_SIZE = 7, 15  # sizes of both grids if the lag is uncertain
PRIOR_LAG_PROBABILITY = 0.8  # prior probability of a lag: nearly every amplifier has a filter
# Maximum drop of the log likelihood from its maximum; a lag with a larger drop is excluded.
EXCLUSION_LIKELIHOOD_DROP = 8.0

# Function that returns the problem with a lag [s] and its best delay, surface and misfit.
FitAt = Callable[[float], tuple[ContactProblem, CoarseFit]]


@dataclass(frozen=True)
class SensorLag:
    """Estimate of the force sensor's lag, with the posterior of all contact parameters."""

    value: float  # most probable time constant [s]; 0 if the lag is treated as part of the delay
    # if value > 0, the last parameter is "time_constant", and `best` is the fit at `value`
    posterior: Posterior
    evidence: float  # log evidence of the average of the models with and without a lag


def estimate_sensor_lag(problem: ContactProblem, posterior: Posterior, seed: int = 0) -> SensorLag | None:
    """Estimate the force sensor's lag; if its existence is uncertain, average models with and without lag.

    Args:
        problem: Contact problem without a lag.
        posterior: Posterior without a lag.
        seed: Seed of the random numbers.

    Returns:
        The lag with the posterior, or None if the readings exclude a lag.
    """
    delay, plane, inner = posterior.best
    fits: dict[float, tuple[ContactProblem, CoarseFit]] = {}

    def at(value: float) -> tuple[ContactProblem, CoarseFit]:
        if value not in fits:
            start = (max(delay - value, problem.min_delay), plane, inner.misfit)
            lagging = problem.changed(problem.law, value, start[0])
            fits[value] = lagging, search_precisely(lagging, start)
        return fits[value]

    def fit(value: float) -> CoarseFit:
        return at(value)[1]

    needed = MIN_CRITERION_GAIN + np.log(len(problem.used_rows))
    if inner.misfit - min(fit(value)[2] for value in TRIAL_TIME_CONSTANTS) < 0.5 * needed:
        return _average_over_lag(problem, posterior, at, seed)
    period = problem.motion.period
    optimum: Any = optimize.minimize_scalar(
        lambda value: fit(value)[2], bounds=(0.1 * period, MAX_TIME_CONSTANT), method="bounded",
        options={"xatol": 0.1 * period},
    )  # fmt: skip
    if inner.misfit - float(optimum.fun) < needed:
        return _average_over_lag(problem, posterior, at, seed)
    nodes = place_nodes(fit, float(optimum.x), float(optimum.fun), 0.1 * period)
    posteriors = _compute_posteriors(posterior, at, nodes, DELAY_GRID_SIZE, seed)
    lag = join_posteriors(nodes, posteriors, seed)
    return replace(lag, evidence=_weigh_lag(posterior, posteriors, nodes[1] - nodes[0])[1])


def place_nodes(fit: Callable[[float], CoarseFit], value: float, misfit: float, least: float) -> np.ndarray:
    """Return evenly spaced time constants [s], up to several standard deviations from the best one.

    Args:
        fit: Function that returns the best fit with a given time constant [s].
        value: Best time constant [s].
        misfit: Chi-squared of the best fit.
        least: Smallest time constant [s] of the result.
    """
    step, std = 0.1 * value, 0.0
    for _ in range(2):
        rise = np.mean([fit(value + side * step)[2] for side in (-1.0, 1.0)]) - misfit
        std = step / np.sqrt(max(rise, 0.1))
        step = min(2.0 * std, 0.5 * value)
    nodes = value + std * np.linspace(-LAG_HALF_WIDTH_SIGMAS, LAG_HALF_WIDTH_SIGMAS, LAG_GRID_SIZE)
    return nodes[nodes > least]


def join_posteriors(nodes: np.ndarray, posteriors: list[Posterior], seed: int) -> SensorLag:
    """Combine the posteriors at the evenly spaced time constants `nodes` [s] into an estimate of the lag."""
    draws, picked = _draw_between_lags(nodes, posteriors, seed)
    evidence: Any = special.logsumexp([node.evidence for node in posteriors])
    best = int(np.argmax([node.evidence for node in posteriors]))
    names = [*posteriors[best].names, "time_constant"]
    joined = replace(posteriors[best], names=names, draws=np.column_stack([draws, picked]))
    return SensorLag(float(nodes[best]), joined, float(evidence + np.log(nodes[1] - nodes[0])))


def _average_over_lag(
    problem: ContactProblem, posterior: Posterior, at: FitAt, seed: int
) -> SensorLag | None:
    """Average the contact models with and without sensor lag; return None if the readings exclude a lag.

    The prior of the time constant is uniform up to `MAX_TIME_CONSTANT`. In the result, each draw of the
    delay includes the time constant of this draw.
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
    """Return a lag's posterior probability, and the log evidence averaged over models with and without lag.

    Args:
        posterior: Posterior without a lag.
        posteriors: Posteriors at evenly spaced time constants.
        step: Step between the time constants [s].
    """
    integral: Any = special.logsumexp([node.evidence for node in posteriors])
    with_lag = float(integral) + np.log(PRIOR_LAG_PROBABILITY * step / MAX_TIME_CONSTANT)
    without = posterior.evidence + np.log(1.0 - PRIOR_LAG_PROBABILITY)
    return float(special.expit(with_lag - without)), float(np.logaddexp(with_lag, without))


def _compute_posteriors(
    posterior: Posterior, at: FitAt, nodes: np.ndarray, count: int, seed: int
) -> list[Posterior]:
    """Return one posterior for each time constant in `nodes`, each on a grid of `count` delays."""
    delay_std = float(posterior.draws[:, 0].std())
    return [compute_posterior_at_lag(*at(lag), delay_std, seed, count) for lag in nodes]


def compute_posterior_at_lag(
    problem: ContactProblem, best: CoarseFit, delay_std: float, seed: int, count: int = SMALL_DELAY_GRID_SIZE
) -> Posterior:
    """Compute the posterior for a given lag, on a grid of delays around the best fit.

    Args:
        problem: Contact problem with the lag.
        best: Best fit with this lag.
        delay_std: Expected standard deviation of the delay [s], which determines the width of the grid.
        seed: Seed of the random numbers.
        count: Number of delays in the grid.
    """
    reach = DELAY_HALF_WIDTH_SIGMAS * max(delay_std, MIN_DELAY_STD)
    low, high = np.clip([best[0] - reach, best[0] + reach], problem.min_delay, MAX_FORCE_DELAY)
    return compute_posterior_near(problem, np.linspace(low, high, count), best[1], seed)


def _draw_between_lags(
    nodes: np.ndarray, posteriors: list[Posterior], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Draw contact parameters, and time constants [s] between the evenly spaced time constants `nodes`.

    The number of draws at each node is proportional to the probability of its posterior. A random shift then
    moves the time constant of each draw off its node; the contact parameters change in proportion.
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
