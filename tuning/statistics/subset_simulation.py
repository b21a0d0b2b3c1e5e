"""Subset simulation of rare failures, with probabilities down to 1e-6 and confidence intervals.

A probability of 1e-6 is a product of six conditional probabilities of 0.1, one for each of a sequence of
levels with increasing thresholds. The scenarios of a level come from Markov chains that start at the worst
scenarios of the previous level and stay above its threshold (Au and Beck 2001, "Estimation of small failure
probabilities in high dimensions by subset simulation"). A chain moves by conditional sampling in
standard-normal space,

    v = sqrt(1 - sigma^2) u + sigma z,    z standard normal,

which is accepted if the performance stays above the threshold; sigma is adapted to an acceptance rate of 0.44
(Papaioannou, Betz, Zwirglmaier, Straub 2015, "MCMC algorithms for subset simulation").

The whole algorithm runs `replicates` times, independently and in one batch. The interval comes from the
spread of their estimates. The usual formula for the coefficient of variation of one run includes the
correlation along the chains (the factors gamma), but assumes that chains and levels are independent. They are
not, since they descend from the same few scenarios. The formula is 10 to 20 % too small for a plane limit
state, and far too small if a run can lose one of several failure regions. A single run cannot detect such a
loss; replicates can, unless nearly all lose the region.

The estimates are skewed, nearly lognormal, and their mean is the probability with a bias of the order of
1 / samples (with 1000 samples, 3 % at 1e-4 and 6 % at 1e-6). The interval is therefore that of the mean of a
lognormal distribution. Its spread is at least that of the formula, because a few replicates may agree by
chance.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import special

from tuning.statistics.intervals import CONFIDENCE_LEVEL, binomial_interval, lognormal_interval

PerformanceFunction = Callable[[np.ndarray], np.ndarray]

LEVEL_PROBABILITY = 0.1  # conditional probability of each level; the optimum is flat between 0.1 and 0.3
CHAIN_LENGTH = round(1.0 / LEVEL_PROBABILITY)  # scenarios of each chain, with its start
TARGET_ACCEPTANCE = 0.44  # acceptance rate to which sigma is adapted
INITIAL_SIGMA, MIN_SIGMA = 0.6, 1e-4
MAX_LEVELS = 12  # default limit on the number of levels
MAX_WORST_SCENARIOS = 10  # number of worst scenarios in the result


class SubsetSimulation(NamedTuple):
    """Result of a subset simulation."""

    probability: float  # estimated probability of failure
    low: float  # lower end of its interval
    high: float  # upper end of its interval
    coefficient_of_variation: float  # that of `probability`, from the spread of the replicates' estimates
    formula_coefficient_of_variation: float  # the same by the formula for single runs
    estimates: np.ndarray  # estimate of each replicate, (replicates,)
    formula_coefficients: np.ndarray  # coefficient of variation of each by the formula, (replicates,)
    thresholds: np.ndarray  # (levels, replicates); the last is the limit, nan for levels that were not needed
    evaluations: int  # number of evaluations of the performance
    worst_points: np.ndarray  # standard normals of the worst distinct scenarios, worst first, (worst, inputs)
    worst_values: np.ndarray  # their performance, infinite if not finite, (worst,)


class _SubsetState(NamedTuple):
    """State of all replicates at one level."""

    points: np.ndarray  # (steps, replicates, chains, inputs), above the replicate's last threshold
    values: np.ndarray  # their performance, (steps, replicates, chains)
    reached: np.ndarray  # probability of the last threshold, (replicates,)
    log_sigma: np.ndarray  # log(sigma) of the proposals, (replicates,)
    variance: np.ndarray  # sum of squared coefficients of variation so far, (replicates,)
    open: np.ndarray  # whether a further level is needed, (replicates,)
    estimates: np.ndarray  # estimate of the replicates that are not `open`, (replicates,)


class _WorstScenarios(NamedTuple):
    """Worst distinct scenarios so far."""

    points: np.ndarray  # (worst, inputs)
    values: np.ndarray  # (worst,)
    evaluations: int  # number of evaluations so far


def subset_simulation(
    performance: PerformanceFunction,
    inputs: int,
    limit: float,
    seed: int,
    samples: int = 1000,
    replicates: int = 10,
    level: float = CONFIDENCE_LEVEL,
    levels: int = MAX_LEVELS,
) -> SubsetSimulation:
    """Estimate the probability that performance(u) > limit, for `inputs` independent standard normals u.

    Subset simulation fails if the performance does not show how close a scenario is to failure (plateaus,
    islands of failure without a slope towards them). If a second failure region becomes relevant only beyond
    the thresholds that lead to the first (Breitung 2019, "The geometry of limit state function graphs and
    subset simulation: counterexamples"), most replicates miss it: the interval then covers less than stated,
    and more samples help. A coefficient of variation far above the formula's indicates this. If a replicate
    ends without a failure, the interval reaches from 0 to a bound with the probability that it reached.

    Args:
        performance: function from (batch, inputs) to (batch,), called with replicates * samples / 10 points;
            a value that is not finite counts as a failure.
        inputs: number of standard normals, 1 or more.
        limit: limit of the performance, finite.
        seed: seed of the random numbers, 0 or more; the same seed gives the same result.
        samples: number of scenarios per level and replicate, a multiple of 10.
        replicates: number of independent runs, 2 or more.
        level: confidence level, between 0 and 1.
        levels: largest number of levels; the smallest probability is about 10^-levels.

    Raises:
        ValueError: if an argument is out of its range.
    """
    _check_arguments(inputs, limit, seed, samples, replicates, level, levels)
    rng = np.random.default_rng(seed)
    # A scenario fails if it reaches the next number above the limit.
    failing = float(np.nextafter(limit, np.inf))
    worst = _WorstScenarios(np.empty((0, inputs)), np.empty(0), 0)

    points = rng.standard_normal((CHAIN_LENGTH, replicates, samples // CHAIN_LENGTH, inputs))
    values = np.empty(points.shape[:-1])
    for step in range(CHAIN_LENGTH):
        values[step], worst = _evaluate_points(performance, points[step], worst)
    zero = np.zeros(replicates)
    state = _SubsetState(
        points, values, zero + 1.0, zero + np.log(INITIAL_SIGMA), zero, np.ones(replicates, bool), zero
    )
    thresholds = []
    while np.any(state.open):
        running = state.open
        last = len(thresholds) + 1 == levels
        threshold, state = _choose_level(state, failing, independent=not thresholds, last=last)
        thresholds.append(np.where(running, np.minimum(threshold, limit), np.nan))
        if np.any(state.open):
            state, worst = _run_chains(state, threshold, performance, worst, rng)

    return _build_result(state, thresholds, worst, failing, level)


def convert_to_uniform(normals: np.ndarray) -> np.ndarray:
    """Convert standard normals to uniform numbers above 0 and below 1, for the inputs' quantile functions."""
    return np.clip(special.ndtr(normals), np.finfo(float).tiny, 1.0 - 2.0**-53)


def _build_result(
    state: _SubsetState, thresholds: list[np.ndarray], worst: _WorstScenarios, failing: float, level: float
) -> SubsetSimulation:
    """Return the result of all replicates after their last level."""
    formula = np.sqrt(state.variance)
    if len(thresholds) == 1:
        # All scenarios are independent, so that the exact interval applies.
        _, low, high = binomial_interval(np.sum(state.values >= failing), state.values.size, level)
    else:
        low, high = lognormal_interval(state.estimates, state.reached, formula, level)
    mean = np.mean(state.estimates)
    spread = np.std(state.estimates, ddof=1) / np.sqrt(len(formula))
    # Without a failure the formula is infinite and the estimate is 0.
    weighted = state.estimates * np.where(state.estimates > 0.0, formula, 0.0)
    combined = np.sqrt(np.sum(weighted**2)) / len(formula)
    return SubsetSimulation(
        probability=float(mean),
        low=float(low),
        high=float(high),
        coefficient_of_variation=float(spread / mean) if mean > 0 else np.inf,
        formula_coefficient_of_variation=float(combined / mean) if mean > 0 else np.inf,
        estimates=state.estimates,
        formula_coefficients=formula,
        thresholds=np.array(thresholds),
        evaluations=worst.evaluations,
        worst_points=worst.points,
        worst_values=worst.values,
    )


def _choose_level(
    state: _SubsetState, failing: float, independent: bool, last: bool
) -> tuple[np.ndarray, _SubsetState]:
    """Return the next threshold of each replicate, (replicates,), and the state with its probability.

    The threshold is the value that a tenth of the points reach, or `failing` if more than a tenth reach that,
    or the second least value if fewer than a tenth exceed the least one, so that plateaus are passed. Without
    a second value, or at the last level, the replicate ends with its current failures.
    """
    steps, replicates, chains = state.values.shape
    flat = np.sort(np.moveaxis(state.values, 1, 0).reshape(replicates, -1), axis=1)
    least, tenth = flat[:, 0], flat[:, -chains]
    above = np.where(flat > least[:, None], flat, np.inf).min(axis=1)
    stuck = flat[:, -1] == least
    threshold = np.where(tenth > least, tenth, np.where(stuck, failing, above))
    threshold = np.full(replicates, failing) if last else np.minimum(threshold, failing)
    exceeds = state.values >= threshold[:, None]
    share = np.mean(exceeds, axis=(0, 2))
    correlation = np.zeros(replicates) if independent else _compute_chain_correlation(exceeds, share)
    with np.errstate(divide="ignore"):
        squared = (1.0 - share) * (1.0 + correlation) / (share * steps * chains)
    ends = state.open & (threshold >= failing)
    estimates = np.where(ends, state.reached * share, state.estimates)
    return threshold, state._replace(
        # A replicate without a failure keeps `reached` as the upper bound of its probability.
        reached=np.where(state.open & (share > 0.0), state.reached * share, state.reached),
        variance=np.where(state.open, state.variance + squared, state.variance),
        open=state.open & ~ends,
        estimates=estimates,
    )


def _compute_chain_correlation(exceeds: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return gamma of Au and Beck 2001, eq. 27-29, the increase of the variance by correlation along chains.

    It is 2 sum_k (1 - k / steps) rho(k) over the lags k, with the autocorrelation rho of the indicator
    `exceeds`, (steps, replicates, chains).
    """
    steps = exceeds.shape[0]
    centred = exceeds - share[:, None]
    variance = share * (1.0 - share)
    covariances = [np.mean(centred[lag:] * centred[: steps - lag], axis=(0, 2)) for lag in range(1, steps)]
    weights = 1.0 - np.arange(1, steps) / steps
    total = 2.0 * np.sum(weights[:, None] * np.array(covariances), axis=0)
    return np.where(variance > 0.0, total / np.where(variance > 0.0, variance, 1.0), 0.0)


def _run_chains(
    state: _SubsetState,
    threshold: np.ndarray,
    performance: PerformanceFunction,
    worst: _WorstScenarios,
    rng: np.random.Generator,
) -> tuple[_SubsetState, _WorstScenarios]:
    """Run the Markov chains of the next level, which stay above the threshold of their replicate.

    sigma adapts to the acceptance rate of all chains of its replicate, with decreasing steps, as in
    Papaioannou et al. 2015. The chains of replicates that have ended also run, without effect.
    """
    steps, replicates, _, inputs = state.points.shape
    seeds = np.stack([_choose_chain_starts(state.values[:, r], threshold[r], rng) for r in range(replicates)])
    rows = np.arange(replicates)[:, None]
    points = np.moveaxis(state.points, 1, 0).reshape(replicates, -1, inputs)[rows, seeds]
    values = np.moveaxis(state.values, 1, 0).reshape(replicates, -1)[rows, seeds]
    all_points, all_values = [points], [values]
    log_sigma = state.log_sigma
    for step in range(1, steps):
        sigma = np.exp(log_sigma)[:, None, None]
        proposed = np.sqrt(1.0 - sigma**2) * points + sigma * rng.standard_normal(points.shape)
        proposed_values, worst = _evaluate_points(performance, proposed, worst)
        accepted = proposed_values >= threshold[:, None]
        points = np.where(accepted[..., None], proposed, points)
        values = np.where(accepted, proposed_values, values)
        all_points.append(points)
        all_values.append(values)
        excess = np.mean(accepted, axis=1) - TARGET_ACCEPTANCE
        log_sigma = np.clip(log_sigma + excess / np.sqrt(step), np.log(MIN_SIGMA), 0.0)
    return state._replace(
        points=np.stack(all_points), values=np.stack(all_values), log_sigma=log_sigma
    ), worst


def _choose_chain_starts(values: np.ndarray, threshold: float, rng: np.random.Generator) -> np.ndarray:
    """Return the indices of the points (steps, chains) at which a replicate's chains start, in random order.

    Each point that reaches the threshold is used once, or several times if there are fewer than chains.
    """
    reaching = np.nonzero(values.ravel() >= threshold)[0]
    chains = values.shape[1]
    if not len(reaching):
        # The replicate has ended without a failure, so that any points will do.
        return np.arange(chains)
    return rng.permutation(np.resize(rng.permutation(reaching), chains))


def _evaluate_points(
    performance: PerformanceFunction, points: np.ndarray, worst: _WorstScenarios
) -> tuple[np.ndarray, _WorstScenarios]:
    """Evaluate points (replicates, chains, inputs), infinite if not finite, and update the worst scenarios.

    Among equally bad scenarios, the one nearest to the origin ranks as the worst, since it is the likeliest.
    """
    batch = points.reshape(-1, points.shape[-1])
    values = np.asarray(performance(batch), float)
    values = np.where(np.isfinite(values), values, np.inf)
    candidates = np.concatenate([worst.points, batch])
    candidate_values = np.concatenate([worst.values, values])
    order = np.lexsort((np.sum(candidates**2, axis=1), -candidate_values))[:MAX_WORST_SCENARIOS]
    total = worst.evaluations + len(values)
    return values.reshape(points.shape[:-1]), _WorstScenarios(
        candidates[order], candidate_values[order], total
    )


def _check_arguments(inputs, limit, seed, samples, replicates, level, levels) -> None:
    """Raise ValueError if an argument of `subset_simulation` is out of its range."""
    allowed = {
        "inputs": (inputs, inputs >= 1, "1 or more"),
        "limit": (limit, np.isfinite(limit), "a finite number"),
        "seed": (seed, seed >= 0, "0 or more"),
        "samples": (
            samples,
            samples > 0 and samples % CHAIN_LENGTH == 0,
            f"a multiple of {CHAIN_LENGTH} above 0",
        ),
        "replicates": (replicates, replicates >= 2, "2 or more"),
        "level": (level, 0.0 < level < 1.0, "between 0 and 1"),
        "levels": (levels, levels >= 1, "1 or more"),
    }
    for name, (found, good, words) in allowed.items():
        if not good:
            raise ValueError(f"{name}: found {found!r}, expected {words}")
