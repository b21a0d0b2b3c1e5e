"""Subset simulation: probability of rare failures, down to 1e-6, with a confidence interval.

A probability of 1e-6 is the product of six conditional probabilities of 0.1. Each of them belongs to a level;
the levels have increasing thresholds of the performance. The scenarios of a level come from Markov chains,
which start at the worst scenarios of the previous level and stay above its threshold (Au and Beck 2001,
"Estimation of small failure probabilities in high dimensions by subset simulation"). In standard-normal
space, a chain proposes the step from u to

    v = sqrt(1 - sigma^2) u + sigma z,    z standard normal.

The step is accepted if the performance stays above the threshold. sigma is adapted to an acceptance rate of
0.44 (Papaioannou, Betz, Zwirglmaier, Straub 2015, "MCMC algorithms for subset simulation").

The whole algorithm runs several times, as independent replicates in one batch. The interval follows from the
spread of the replicates' estimates. The usual formula for the coefficient of variation of a single run
includes the correlation along the chains, but assumes that chains and levels are independent. They are not,
because all chains start from the same few scenarios. Therefore the formula is 10 to 20 % too small for a
plane limit state, and far too small if a run can lose one of several failure regions. A single run cannot
detect such a loss. Replicates can detect it, unless nearly all of them lose the region.

The distribution of the estimates is skewed, nearly lognormal. Its mean is the probability, with a relative
bias of the order of 1 / samples (with 1000 samples, 3 % at 1e-4 and 6 % at 1e-6). The interval is therefore
that of the mean of a lognormal distribution. Its variance is at least that of the formula, because the
estimates of a few replicates may agree by chance.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import special

from tuning.statistics.intervals import CONFIDENCE_LEVEL, binomial_interval, lognormal_interval

PerformanceFunction = Callable[[np.ndarray], np.ndarray]

LEVEL_PROBABILITY = 0.1  # probability of each level [1]; 0.1 to 0.3 are about equally efficient
CHAIN_LENGTH = round(1.0 / LEVEL_PROBABILITY)  # number of scenarios in each Markov chain, including its start
TARGET_ACCEPTANCE = 0.44  # acceptance rate to which sigma is adapted (Papaioannou et al. 2015) [1]
INITIAL_SIGMA, MIN_SIGMA = 0.6, 1e-4  # initial and smallest step size sigma of the Markov chains [1]
MAX_LEVELS = 12  # default limit on the number of levels; the smallest probability is about 1e-12
MAX_WORST_SCENARIOS = 10  # largest number of worst scenarios in the result


class SubsetSimulation(NamedTuple):
    """Probability of failure with its interval, and the worst scenarios, from a subset simulation."""

    probability: float  # estimated probability of failure
    low: float  # lower bound of the probability
    high: float  # upper bound of the probability
    # coefficient of variation of `probability`, from the spread of the replicates' estimates
    coefficient_of_variation: float
    # coefficient of variation of `probability`, from the formula for single runs
    formula_coefficient_of_variation: float
    estimates: np.ndarray  # estimated probability of each replicate, (replicates,)
    # coefficient of variation of each replicate's estimate, from the formula for single runs, (replicates,)
    formula_coefficients: np.ndarray
    # threshold of each level, (levels, replicates); the last is the limit; NaN for levels that were not
    # needed
    thresholds: np.ndarray
    evaluations: int  # number of evaluated scenarios
    worst_points: np.ndarray  # standard normals of the worst scenarios, worst first, (worst, inputs)
    worst_values: np.ndarray  # performance of the worst scenarios, infinite if not finite, (worst,)


class _SubsetState(NamedTuple):
    """State of a subset simulation at one level (threshold of the performance), for all replicates."""

    points: np.ndarray  # standard normals of the level's scenarios, (steps, replicates, chains, inputs)
    values: np.ndarray  # performance of these scenarios, (steps, replicates, chains)
    reached: np.ndarray  # probability that the performance is above the last threshold, (replicates,)
    log_sigma: np.ndarray  # logarithm of the step size sigma, (replicates,)
    variance: np.ndarray  # squared coefficient of variation from the formula for single runs, (replicates,)
    open: np.ndarray  # whether the replicate needs another level, (replicates,)
    estimates: np.ndarray  # estimated probability of the replicates that have ended, (replicates,)


class _WorstScenarios(NamedTuple):
    """Worst scenarios that have been evaluated so far, worst first."""

    points: np.ndarray  # standard normals of the scenarios, (worst, inputs)
    values: np.ndarray  # performance of the scenarios, (worst,)
    evaluations: int  # number of scenarios that have been evaluated


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
    """Estimate by subset simulation the probability of performance(u) > limit for standard normal numbers u.

    The method fails if the performance does not show how close a scenario is to failure. Examples are
    plateaus, and regions of failure toward which the performance does not rise. A second region of failure
    may become relevant only above the thresholds that lead to the first region (Breitung 2019, "The geometry
    of limit state function graphs and subset simulation: counterexamples"). Most replicates then miss the
    second region, and the interval is too narrow. A sign of this is a `coefficient_of_variation` far above
    `formula_coefficient_of_variation`. More samples help. If a replicate ends without a failure, the lower
    bound of the interval is 0, and the upper bound uses the probability that this replicate has reached.

    Args:
        performance: function that returns the performance (batch,) of scenarios, which are given as standard
            normals (batch, inputs). Each call has replicates * samples / 10 scenarios. A value that is not
            finite counts as a failure.
        inputs: number of standard normals in a scenario, 1 or more.
        limit: limit of the performance, finite; a larger performance is a failure.
        seed: seed of the random numbers, 0 or more.
        samples: number of scenarios for each level and replicate, a multiple of 10.
        replicates: number of independent replicates, 2 or more.
        level: confidence level, between 0 and 1.
        levels: largest number of levels; the smallest probability is about 10^-levels.

    Returns:
        Probability of failure with its interval, and the worst scenarios.

    Raises:
        ValueError: If an argument is out of its range.
    """
    _check_arguments(inputs, limit, seed, samples, replicates, level, levels)
    rng = np.random.default_rng(seed)
    # A scenario fails if its performance is at least the next floating-point number above the limit.
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
    """Convert standard normals to uniform random numbers above 0 and below 1."""
    return np.clip(special.ndtr(normals), np.finfo(float).tiny, 1.0 - 2.0**-53)


def _build_result(
    state: _SubsetState, thresholds: list[np.ndarray], worst: _WorstScenarios, failing: float, level: float
) -> SubsetSimulation:
    formula = np.sqrt(state.variance)
    if len(thresholds) == 1:
        # With one level, all scenarios are independent, and the exact interval applies.
        _, low, high = binomial_interval(np.sum(state.values >= failing), state.values.size, level)
    else:
        low, high = lognormal_interval(state.estimates, state.reached, formula, level)
    mean = np.mean(state.estimates)
    spread = np.std(state.estimates, ddof=1) / np.sqrt(len(formula))
    # In a replicate without a failure, the formula is infinite and the estimate is 0.
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
    """Return the next threshold of each replicate, (replicates,), and the updated state.

    The probability in the state is multiplied by the conditional probability of reaching the threshold.

    The threshold is the performance that a tenth of the scenarios reach. If a tenth or more fail, it is
    `failing`, the smallest performance that is a failure. If fewer than a tenth exceed the smallest
    performance (a plateau), the threshold is the second smallest performance. It is also `failing` if all
    scenarios have the same performance, and at the last level. A replicate with this threshold ends.
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
        # For a replicate without a failure, `reached` remains an upper bound of the probability.
        reached=np.where(state.open & (share > 0.0), state.reached * share, state.reached),
        variance=np.where(state.open, state.variance + squared, state.variance),
        open=state.open & ~ends,
        estimates=estimates,
    )


def _compute_chain_correlation(exceeds: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the relative increase of `share`'s variance by correlation along the chains, (replicates,).

    This is gamma of Au and Beck 2001, eq. 27-29: the sum over the lags k of 2 (1 - k / steps) rho(k). rho is
    the autocorrelation of `exceeds`, (steps, replicates, chains), along the chains. `exceeds` states which
    scenarios reach the threshold, and `share` is their fraction.
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
    """Run the Markov chains of a subset simulation's next level, which stay above each replicate's threshold.

    The step size sigma of a replicate is adapted to the acceptance rate of its chains, as in Papaioannou et
    al. 2015. A replicate is an independent repetition of the estimate. Replicates that have ended are
    simulated too, but their results are not used.
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
    """Return the indices of the scenarios at which the chains of a replicate start, (chains,).

    The scenarios that reach the threshold are used in random order, and repeatedly if there are too few. The
    indices refer to the flattened `values`, (steps, chains).
    """
    reaching = np.nonzero(values.ravel() >= threshold)[0]
    chains = values.shape[1]
    if not len(reaching):
        # The replicate has ended without a failure, so that the choice has no effect.
        return np.arange(chains)
    return rng.permutation(np.resize(rng.permutation(reaching), chains))


def _evaluate_points(
    performance: PerformanceFunction, points: np.ndarray, worst: _WorstScenarios
) -> tuple[np.ndarray, _WorstScenarios]:
    """Evaluate scenarios, (replicates, chains, inputs), and update the worst scenarios.

    Return the performance, (replicates, chains), and the worst scenarios. A performance that is not finite
    becomes infinity. Among equally bad scenarios, the one nearest to the origin is the worst, because it is
    the most probable.
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
        "level": (level, 0.0 < level < 1.0, "a number between 0 and 1"),
        "levels": (levels, levels >= 1, "1 or more"),
    }
    for name, (found, good, words) in allowed.items():
        if not good:
            raise ValueError(f"{name}: found {found!r}, expected {words}")
