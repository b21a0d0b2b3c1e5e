"""Probabilities of rare failures, down to 1e-6, by subset simulation, with an interval that covers.

A probability of 1e-6 is a product of six of 0.1: of failing the worst tenth, of failing the worst tenth of
those, and so on. Each level's scenarios come from Markov chains that start at the worst of the level before
and stay above its threshold (Au and Beck 2001, "Estimation of small failure probabilities in high dimensions
by subset simulation"). A chain moves by conditional sampling in standard-normal space,

    v = sqrt(1 - sigma^2) u + sigma z,    z standard normal,

accepted where the performance stays above the threshold, with sigma adapted to an acceptance of 0.44
(Papaioannou, Betz, Zwirglmaier, Straub 2015, "MCMC algorithms for subset simulation").

The whole algorithm runs `replicates` times, independently and side by side, and the interval comes from the
spread of their estimates. The usual formula for one run's coefficient of variation knows the correlation
along the chains (the factors gamma), but takes chains and levels to be independent of each other, which they
are not: they descend from the same few scenarios. It is too small by a tenth to a fifth on a plane, and by
far more where a run may lose one of several failure regions, which no single run can notice. Replicates do,
unless nearly all lose it. Their estimates are skewed, close to lognormal, with the probability as their mean
but for a bias of the order of 1 / samples (with 1000, 3 % at 1e-4 and 6 % at 1e-6): the interval is the one
for the mean of a lognormal distribution, with the formula's coefficient as the least spread, lest a few
replicates agree by chance.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import special

from tuning.statistics.intervals import LEVEL, binomial_interval, lognormal_interval

Performance = Callable[[np.ndarray], np.ndarray]

SHARE = 0.1  # conditional probability of each level: the optimum is flat between 0.1 and 0.3
STEPS = round(1.0 / SHARE)  # scenarios of each chain, its start included
ACCEPTANCE = 0.44
FIRST_SIGMA, LEAST_SIGMA = 0.6, 1e-4
LEVELS = 12  # at most
WORST = 10


class SubsetSimulation(NamedTuple):
    """What subset simulation found."""

    probability: float  # of failing
    low: float  # end of its interval
    high: float  # end of its interval
    coefficient_of_variation: float  # of `probability`, from the spread of the replicates' estimates
    formula_coefficient_of_variation: float  # the same by the formula for single runs
    estimates: np.ndarray  # of each, (replicates,)
    formula_coefficients: np.ndarray  # of variation of each by that formula, (replicates,)
    thresholds: np.ndarray  # (levels, replicates), the last one the limit; nan where fewer levels were needed
    evaluations: int  # of the performance
    worst_points: np.ndarray  # normals of the worst distinct scenarios met, worst first, (worst, inputs)
    worst_values: np.ndarray  # their performance, infinite where not finite, (worst,)


class _State(NamedTuple):
    """All replicates at one level."""

    points: np.ndarray  # (steps, replicates, chains, inputs), above the replicate's last threshold
    values: np.ndarray  # their performance, (steps, replicates, chains)
    reached: np.ndarray  # per replicate, probability of the last threshold
    log_sigma: np.ndarray  # per replicate, of the proposals
    variance: np.ndarray  # per replicate, sum of squared coefficients of variation so far
    open: np.ndarray  # per replicate, whether another level is to be run
    estimates: np.ndarray  # per replicate, where none is


class _Worst(NamedTuple):
    """The worst distinct scenarios met so far."""

    points: np.ndarray  # (worst, inputs)
    values: np.ndarray  # (worst,)
    evaluations: int  # so far


def subset_simulation(
    performance: Performance,
    inputs: int,
    limit: float,
    seed: int,
    samples: int = 1000,
    replicates: int = 10,
    level: float = LEVEL,
    levels: int = LEVELS,
) -> SubsetSimulation:
    """Probability that performance(u) > limit, for u of `inputs` independent standard normals.

    `performance` maps (batch, inputs) to (batch,), always with a batch of replicates * samples / 10; what is
    not finite counts as failed. `samples` per level and replicate, `levels` at most, so that it reaches down
    to about 10^-levels. The same seed gives the same result.

    Where the performance says nothing of how close a scenario is to failing (plateaus, islands of failure
    without a slope towards them) no such method finds its way. Where it misleads, and a second way to fail
    takes over only beyond the thresholds that lead to the first (Breitung 2019, "The geometry of limit state
    function graphs and subset simulation: counterexamples"), most replicates miss it: the interval then
    covers less than stated, and more samples help. A coefficient of variation far above the formula's is the
    sign. A replicate that ends without a failure makes the interval reach from 0 to what that replicate did
    reach. Raises ValueError unless inputs >= 1, seed >= 0, samples is a multiple of 10 above 0, replicates >=
    2, levels >= 1, 0 < level < 1 and the limit is finite.
    """
    _check(inputs, limit, seed, samples, replicates, level, levels)
    rng = np.random.default_rng(seed)
    # The least number beyond the limit: what reaches it has failed.
    failing = float(np.nextafter(limit, np.inf))
    worst = _Worst(np.empty((0, inputs)), np.empty(0), 0)

    points = rng.standard_normal((STEPS, replicates, samples // STEPS, inputs))
    values = np.empty(points.shape[:-1])
    for step in range(STEPS):
        values[step], worst = _evaluated(performance, points[step], worst)
    zero = np.zeros(replicates)
    state = _State(
        points, values, zero + 1.0, zero + np.log(FIRST_SIGMA), zero, np.ones(replicates, bool), zero
    )
    thresholds = []
    while np.any(state.open):
        running = state.open
        last = len(thresholds) + 1 == levels
        threshold, state = _levelled(state, failing, independent=not thresholds, last=last)
        thresholds.append(np.where(running, np.minimum(threshold, limit), np.nan))
        if np.any(state.open):
            state, worst = _chained(state, threshold, performance, worst, rng)

    return _summary(state, thresholds, worst, failing, level)


def to_uniform(normals: np.ndarray) -> np.ndarray:
    """The uniform numbers of standard normals, above 0 and below 1, for the inputs' quantile functions."""
    return np.clip(special.ndtr(normals), np.finfo(float).tiny, 1.0 - 2.0**-53)


def _summary(
    state: _State, thresholds: list[np.ndarray], worst: _Worst, failing: float, level: float
) -> SubsetSimulation:
    """What the replicates, all at their end, say together."""
    formula = np.sqrt(state.variance)
    if len(thresholds) == 1:
        # Independent scenarios, all of them: the exact interval.
        _, low, high = binomial_interval(np.sum(state.values >= failing), state.values.size, level)
    else:
        low, high = lognormal_interval(state.estimates, state.reached, formula, level)
    mean = np.mean(state.estimates)
    spread = np.std(state.estimates, ddof=1) / np.sqrt(len(formula))
    # Without a failure the formula is infinite, and the estimate says so.
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


def _levelled(state: _State, failing: float, independent: bool, last: bool) -> tuple[np.ndarray, _State]:
    """The next threshold of each replicate, (replicates,), and the state with what it takes to reach it.

    The threshold is the value that a tenth of the points reach; `failing` if more reach that; and the second
    least value if all have the least, so that plateaus are passed. Without a second one, or at the last
    level, the replicate ends with the failures it has.
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
    correlation = np.zeros(replicates) if independent else _correlation(exceeds, share)
    with np.errstate(divide="ignore"):
        squared = (1.0 - share) * (1.0 + correlation) / (share * steps * chains)
    ends = state.open & (threshold >= failing)
    estimates = np.where(ends, state.reached * share, state.estimates)
    return threshold, state._replace(
        # A replicate without a failure keeps what it reached: its probability is below that.
        reached=np.where(state.open & (share > 0.0), state.reached * share, state.reached),
        variance=np.where(state.open, state.variance + squared, state.variance),
        open=state.open & ~ends,
        estimates=estimates,
    )


def _correlation(exceeds: np.ndarray, share: np.ndarray) -> np.ndarray:
    """gamma of Au and Beck 2001, eq. 27-29: what the correlation along the chains adds to the variance.

    2 sum over lags k of (1 - k / steps) rho(k), of the indicator `exceeds`, (steps, replicates, chains).
    """
    steps = exceeds.shape[0]
    centred = exceeds - share[:, None]
    variance = share * (1.0 - share)
    covariances = [np.mean(centred[lag:] * centred[: steps - lag], axis=(0, 2)) for lag in range(1, steps)]
    weights = 1.0 - np.arange(1, steps) / steps
    total = 2.0 * np.sum(weights[:, None] * np.array(covariances), axis=0)
    return np.where(variance > 0.0, total / np.where(variance > 0.0, variance, 1.0), 0.0)


def _chained(
    state: _State,
    threshold: np.ndarray,
    performance: Performance,
    worst: _Worst,
    rng: np.random.Generator,
) -> tuple[_State, _Worst]:
    """Chains above the threshold, from points that are; those of replicates at their end run along idly.

    sigma follows the acceptance of all chains of its replicate, ever less, as in Papaioannou et al. 2015.
    """
    steps, replicates, _, inputs = state.points.shape
    seeds = np.stack([_seeds(state.values[:, r], threshold[r], rng) for r in range(replicates)])
    which = np.arange(replicates)[:, None]
    points = np.moveaxis(state.points, 1, 0).reshape(replicates, -1, inputs)[which, seeds]
    values = np.moveaxis(state.values, 1, 0).reshape(replicates, -1)[which, seeds]
    all_points, all_values = [points], [values]
    log_sigma = state.log_sigma
    for step in range(1, steps):
        sigma = np.exp(log_sigma)[:, None, None]
        proposed = np.sqrt(1.0 - sigma**2) * points + sigma * rng.standard_normal(points.shape)
        proposed_values, worst = _evaluated(performance, proposed, worst)
        accepted = proposed_values >= threshold[:, None]
        points = np.where(accepted[..., None], proposed, points)
        values = np.where(accepted, proposed_values, values)
        all_points.append(points)
        all_values.append(values)
        excess = np.mean(accepted, axis=1) - ACCEPTANCE
        log_sigma = np.clip(log_sigma + excess / np.sqrt(step), np.log(LEAST_SIGMA), 0.0)
    return state._replace(
        points=np.stack(all_points), values=np.stack(all_values), log_sigma=log_sigma
    ), worst


def _seeds(values: np.ndarray, threshold: float, rng: np.random.Generator) -> np.ndarray:
    """Where the chains of a replicate begin: as many of its points (steps, chains) as chains, in random
    order.

    Each once if there are enough that reach the threshold; else, after a plateau, several chains from one.
    """
    reaching = np.nonzero(values.ravel() >= threshold)[0]
    chains = values.shape[1]
    if not len(reaching):
        # A replicate at its end, without a failure.
        return np.arange(chains)
    return rng.permutation(np.resize(rng.permutation(reaching), chains))


def _evaluated(performance: Performance, points: np.ndarray, worst: _Worst) -> tuple[np.ndarray, _Worst]:
    """Values of points (replicates, chains, inputs), infinite where not finite, and the worst with them.

    Of equally bad scenarios, the one nearest the origin is the worst: it is the likeliest.
    """
    batch = points.reshape(-1, points.shape[-1])
    values = np.asarray(performance(batch), float)
    values = np.where(np.isfinite(values), values, np.inf)
    candidates = np.concatenate([worst.points, batch])
    candidate_values = np.concatenate([worst.values, values])
    order = np.lexsort((np.sum(candidates**2, axis=1), -candidate_values))[:WORST]
    total = worst.evaluations + len(values)
    return values.reshape(points.shape[:-1]), _Worst(candidates[order], candidate_values[order], total)


def _check(inputs, limit, seed, samples, replicates, level, levels) -> None:
    allowed = {
        "inputs": (inputs, inputs >= 1, "1 or more"),
        "limit": (limit, np.isfinite(limit), "a finite number"),
        "seed": (seed, seed >= 0, "0 or more"),
        "samples": (samples, samples > 0 and samples % STEPS == 0, f"a multiple of {STEPS} above 0"),
        "replicates": (replicates, replicates >= 2, "2 or more"),
        "level": (level, 0.0 < level < 1.0, "between 0 and 1"),
        "levels": (levels, levels >= 1, "1 or more"),
    }
    for name, (found, good, words) in allowed.items():
        if not good:
            raise ValueError(f"{name}: found {found!r}, allowed {words}")
