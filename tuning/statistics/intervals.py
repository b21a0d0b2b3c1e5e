"""Confidence intervals of a probability of failure.

There is one interval for each kind of sampling. Each interval covers the true probability with at least the
stated confidence level:

- *a fixed number of independent scenarios*: `binomial_interval`, which is exact;
- *as many scenarios as necessary* for an interval of a given width: an exact interval that is computed
  repeatedly is no longer exact, because sampling stops at a favourable moment. `confidence_sequence` is valid
  for all numbers of scenarios simultaneously, and therefore for every stopping rule. `SequentialState` stores
  its state;
- *a few independent scramblings of a Sobol sequence*: `replicate_interval`. The points of one scrambling are
  not independent, so that the binomial distribution does not apply. The interval uses the spread between the
  scramblings, which are independent;
- *independent replicates of a simulation of rare failures*: `lognormal_interval`.

All functions accept arrays of counts, which are broadcast, and need only NumPy and SciPy.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

CONFIDENCE_LEVEL = 0.95
BETA_PRIOR = 0.5  # both parameters of the beta mixture [1], as in Jeffreys' prior
# Least numbers of failures and successes in all replicates for which Student's interval alone is valid.
MIN_STUDENT_FAILURES = 100
_BISECTION_STEPS = 62  # number of bisections; they reduce an interval of length 1500 to a rounding error


class IntervalEstimate(NamedTuple):
    """Estimated value with its confidence interval, as numbers or as arrays of the same shape."""

    value: Any  # estimated value
    low: Any  # lower bound of the interval; NaN without an interval
    high: Any  # upper bound of the interval; NaN without an interval

    @property
    def width(self) -> np.ndarray:
        return self.high - self.low


class SequentialState(NamedTuple):
    """Counts and confidence interval of a sweep that adds scenarios until the interval is narrow enough."""

    failures: int = 0  # number of failures so far
    number: int = 0  # number of scenarios so far
    low: float = 0.0  # lower bound of the probability of failure
    high: float = 1.0  # upper bound of the probability of failure
    level: float = CONFIDENCE_LEVEL  # confidence level of the interval


def binomial_interval(
    failures: ArrayLike, number: ArrayLike, level: float = CONFIDENCE_LEVEL
) -> IntervalEstimate:
    """Return the exact interval of the probability for `failures` among `number` independent scenarios.

    This is the interval of Clopper and Pearson (1934), whose bounds are quantiles of beta distributions. If
    `number` was fixed in advance, the interval covers every true probability with at least the confidence
    `level`. Without scenarios, the interval is 0 to 1 and the estimate is NaN.

    Raise ValueError unless 0 <= failures <= number and 0 < level < 1.
    """
    failures, number = _check_counts(failures, number, level)
    tail = (1.0 - level) / 2.0
    passes = number - failures
    # A beta distribution cannot have the parameter 0; in this case the bound is 0 or 1.
    low = np.where(failures > 0, special.betaincinv(np.maximum(failures, 1.0), passes + 1.0, tail), 0.0)
    high = np.where(passes > 0, special.betainccinv(failures + 1.0, np.maximum(passes, 1.0), tail), 1.0)
    return IntervalEstimate(_compute_share(failures, number), low, high)


def confidence_sequence(
    failures: ArrayLike, number: ArrayLike, level: float = CONFIDENCE_LEVEL
) -> IntervalEstimate:
    """Return an interval of the probability of failure that is valid for every stopping rule.

    The intervals for all numbers of scenarios cover the true probability simultaneously, with at least the
    confidence `level`. Consider s failures among n scenarios, with the true probability p, the beta function
    B and a = `BETA_PRIOR`. Then

        M_n(p) = B(a + s, a + n - s) / (B(a, a) p^s (1 - p)^(n - s))

    is the likelihood ratio of a beta mixture of probabilities and p. It is a nonnegative martingale that
    starts at 1. By Ville's inequality, the probability that it ever reaches 1 / (1 - level) is at most 1 -
    level. The interval is therefore the set {p: M_n(p) < 1 / (1 - level)}. Its bounds are computed by
    bisection in log(p / (1 - p)). The interval is 1.8 times as wide as the exact interval for n = 1000, and
    2.3 times as wide for a million.

    Raise ValueError unless 0 <= failures <= number and 0 < level < 1.

    Source: Robbins 1970, "Statistical methods related to the law of the iterated logarithm"; Howard, Ramdas,
    McAuliffe, Sekhon 2021, "Time-uniform, nonparametric, nonasymptotic confidence sequences".
    """
    failures, number = _check_counts(failures, number, level)
    passes = number - failures
    log_mixture = special.betaln(BETA_PRIOR + failures, BETA_PRIOR + passes) - special.betaln(
        BETA_PRIOR, BETA_PRIOR
    )
    least = log_mixture + np.log1p(-level)

    def outside(logit):
        return failures * special.log_expit(logit) + passes * special.log_expit(-logit) <= least

    share = _compute_share(failures, number)
    middle = np.clip(special.logit(np.nan_to_num(share, nan=0.5)), -750.0, 750.0)
    low = np.where(
        failures > 0, special.expit(_bisect_boundary(outside, np.full_like(middle, -750.0), middle)), 0.0
    )
    high = np.where(
        passes > 0, special.expit(_bisect_boundary(outside, np.full_like(middle, 750.0), middle)), 1.0
    )
    return IntervalEstimate(share, low, high)


def update_sequence(running: SequentialState, failures: int, number: int) -> SequentialState:
    """Add `number` scenarios with `failures` failures to the state of a sequential sweep.

    The new interval is the intersection of all intervals of `confidence_sequence` so far. It has the same
    confidence level, because these intervals are valid simultaneously. If the intersection is empty, which
    has a probability of at most 1 - level, the newest interval replaces it.

    The order of the scenarios must not depend on their outcome: add them by index and not as they finish,
    because failures may finish sooner. Raise ValueError unless 0 <= failures <= number.
    """
    failures, number = running.failures + failures, running.number + number
    _, low, high = confidence_sequence(failures, number, running.level)
    common = max(running.low, float(low)), min(running.high, float(high))
    low, high = common if common[0] <= common[1] else (float(low), float(high))
    return running._replace(failures=failures, number=number, low=low, high=high)


def is_narrow_enough(running: SequentialState, width: float) -> bool:
    """Return whether the interval of a sequential sweep is at most `width` wide."""
    return running.high - running.low <= width


def estimate_sequence_scenarios(probability: float, width: float, level: float = CONFIDENCE_LEVEL) -> int:
    """Estimate how many scenarios `confidence_sequence` needs until its interval is `width` wide.

    `probability` is the expected probability of failure. The result, from 1 to 2**62, is for progress
    displays. Raise ValueError unless 0 <= probability <= 1, width > 0 and 0 < level < 1.
    """
    if not (0 <= probability <= 1 and width > 0):
        raise ValueError(
            f"probability, width: found {probability}, {width}, expected probability 0 to 1, width > 0"
        )
    numbers = np.unique(np.round(2.0 ** np.arange(0, 62.01, 0.05)))
    failures = np.round(probability * numbers)
    is_narrow = confidence_sequence(failures, numbers, level).width <= width
    # The width fluctuates because failures are rounded. Return the number after the last one that is too
    # small.
    return int(numbers[min(np.max(np.nonzero(~is_narrow)[0], initial=-1) + 1, len(numbers) - 1)])


def estimate_deciding_scenarios(
    failures: int, number: int, allowed: float, level: float = CONFIDENCE_LEVEL
) -> int | None:
    """Estimate how many scenarios are needed to decide whether the failure probability is at most `allowed`.

    The fraction of failures is assumed to stay failures / number, or 0 if `number` is 0. With the estimated
    number of scenarios, `binomial_interval` lies entirely below or entirely above `allowed`. Return None if a
    billion scenarios are not enough. Raise ValueError unless 0 <= failures <= number and 0 < level < 1.
    """
    _check_counts(failures, number, level)
    share = failures / number if number else 0.0
    numbers = np.unique(np.ceil(1.01 ** np.arange(2083)))
    _, low, high = binomial_interval(np.round(share * numbers), numbers, level)
    is_decided = high <= allowed if share <= allowed else low > allowed
    # The bounds fluctuate because failures are rounded. Return the number after the last one that is too
    # small.
    index = np.max(np.nonzero(~is_decided)[0], initial=-1) + 1
    return int(numbers[index]) if index < len(numbers) else None


def replicate_interval(failures: ArrayLike, number: int, level: float = CONFIDENCE_LEVEL) -> IntervalEstimate:
    """Return the interval of the probability of failure from independent scramblings of a Sobol sequence.

    `failures`, (..., R), are the numbers of failures in R scramblings (replicates) with n = `number` points
    each. The fraction of failures in each scrambling has the mean p. Student's interval,

        mean +- t sd / sqrt(R),

    is therefore valid if the fractions are normally distributed. In three cases the interval is wider:

    - *Counts are integers.* The sequence may be so even that every scrambling counts one of the two integers
      next to n p. Then all R counts may be equal by chance, although n p differs from them by d. The
      probability of this event is (1 - d)^R, which is at most (1 - level) / 2 if d >= 1 - ((1 - level) /
      2)^(1/R). The half width of the interval is at least this d, divided by n.
    - *There are few failures (or successes),* less than `MIN_STUDENT_FAILURES`. The distribution of the
      fractions is then too skewed for Student's interval. The interval also includes the exact binomial
      interval of all points. The binomial interval is conservative if the counts spread less than those of
      independent points; if the counts spread more, Student's interval is wider.
    - *There is no failure,* and therefore no spread. If the counts spread no more than those of independent
      points, one scrambling has no failure with a probability of at most 1 / (1 + n p / (1 - p)) (Cantelli's
      inequality). The probability for R scramblings is the Rth power. Therefore p is below c / (n + c), with
      c = ((1 - level) / 2)^(-1/R) - 1. The case without any success is analogous.

    Raise ValueError for less than two replicates, and unless 0 <= failures <= number and 0 < level < 1.

    Source on randomised replicates: Owen 1997, "Scrambled net variance for integrals of smooth functions".
    """
    failures, _ = _check_counts(failures, number, level)
    replicates = failures.shape[-1] if failures.ndim else 0
    if replicates < 2:
        raise ValueError(f"replicates: found {replicates}, expected 2 or more")
    tail = (1.0 - level) / 2.0
    mean = np.mean(failures, axis=-1) / number
    spread = np.std(failures, axis=-1, ddof=1) / number / np.sqrt(replicates)
    least = (1.0 - tail ** (1.0 / replicates)) / number
    half = np.maximum(special.stdtrit(replicates - 1, 1.0 - tail) * spread, least)
    low, high = np.maximum(mean - half, 0.0), np.minimum(mean + half, 1.0)

    total, points = np.sum(failures, axis=-1), float(number * replicates)
    few = np.minimum(total, points - total) < MIN_STUDENT_FAILURES
    _, exact_low, exact_high = binomial_interval(total, points, level)
    low = np.where(few, np.minimum(low, exact_low), low)
    high = np.where(few, np.maximum(high, exact_high), high)

    odds = tail ** (-1.0 / replicates) - 1.0
    unseen = odds / (number + odds)
    high = np.where(total == 0, np.maximum(high, unseen), high)
    low = np.where(total == points, np.minimum(low, 1.0 - unseen), low)
    return IntervalEstimate(mean, low, high)


def lognormal_interval(
    estimates: np.ndarray, reached: np.ndarray, least: np.ndarray, level: float = CONFIDENCE_LEVEL
) -> tuple[float, float]:
    """Return the lower and the upper bound of the mean of a lognormal distribution.

    m and s^2 are the mean and the variance of the logarithms of R independent `estimates`, and t is Student's
    quantile with R - 1 degrees of freedom. The interval is

        exp(m + s^2 / 2 +- t sqrt(s^2 / R + s^4 / (2 (R - 1)))),

    clipped at 1 (Cox's method as modified by Olsson 2005, "Confidence intervals for the mean of a log-normal
    distribution"). Under the root, s^2 is at least the mean square of `least`. Student's interval of the
    estimates would neglect their skewness. Student's interval of their logarithms would cover the median,
    which is below the mean. If an estimate is 0, the lower bound is 0, and the upper bound is that of
    Student's interval with `reached` instead of the zeros.

    Args:
        estimates: independent estimates of a probability, (R,).
        reached: upper bound of the probability for each estimate that is 0, (R,).
        least: smallest coefficient of variation of each estimate [1], (R,).
        level: confidence level, between 0 and 1.
    """
    number = len(estimates)
    student = special.stdtrit(number - 1, 0.5 + level / 2.0)
    if np.any(estimates <= 0.0):
        bounds = np.where(estimates > 0.0, estimates, reached)
        high = np.mean(bounds) + student * np.std(bounds, ddof=1) / np.sqrt(number)
        return 0.0, float(min(high, 1.0))
    logarithms = np.log(estimates)
    variance = np.var(logarithms, ddof=1)
    centre = np.mean(logarithms) + variance / 2.0
    variance = max(variance, np.mean(least**2))
    half = student * np.sqrt(variance / number + variance**2 / (2.0 * (number - 1)))
    return float(min(np.exp(centre - half), 1.0)), float(min(np.exp(centre + half), 1.0))


def _check_counts(failures: ArrayLike, number: ArrayLike, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the counts as broadcast arrays; raise ValueError if a count or the level is out of range."""
    failures, number = np.broadcast_arrays(np.asarray(failures, float), np.asarray(number, float))
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: found {level}, expected a number between 0 and 1")
    if not np.all((failures >= 0) & (failures <= number)):
        raise ValueError("failures: found a number below 0 or above `number`, expected 0 to `number`")
    return failures, number


def _compute_share(failures: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the fraction of failures; NaN without scenarios."""
    return np.where(number > 0, failures / np.maximum(number, 1.0), np.nan)


def _bisect_boundary(outside, beyond: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Find by bisection the point at which `outside` changes from false (`within`) to true (`beyond`)."""
    for _ in range(_BISECTION_STEPS):
        middle = 0.5 * (beyond + within)
        is_outside = outside(middle)
        beyond, within = np.where(is_outside, middle, beyond), np.where(is_outside, within, middle)
    return beyond
