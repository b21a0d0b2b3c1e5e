"""Confidence intervals of a probability of failure.

There is one interval for each kind of sampling, which covers the true probability with at least the stated
level:

- *a fixed number of independent scenarios*: `binomial_interval`, which is exact;
- *as many scenarios as necessary* until the interval is narrow enough: an exact interval is no longer exact
  if it is computed repeatedly, since one stops at a favourable moment. `confidence_sequence` covers at all
  numbers simultaneously, thus at any stopping rule; `SequentialState` stores its state;
- *a few independent scramblings of a Sobol sequence*: `replicate_interval`. The points of a scrambling depend
  on each other, so that no binomial distribution applies; the interval uses the spread of the scramblings,
  which are independent;
- *independent repetitions of a method for rare failures*: `lognormal_interval`.

All are pure functions of counts, which broadcast, and need only NumPy and SciPy.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

CONFIDENCE_LEVEL = 0.95
BETA_PRIOR = 0.5  # both parameters of the mixing beta distribution (Jeffreys; Krichevsky and Trofimov)
MIN_STUDENT_FAILURES = (
    100  # failures (or successes) of all replicates below which Student's interval alone is not used
)
_BISECTION_STEPS = 62  # steps of bisection, which reduce a bracket of 1500 to rounding


class Estimate(NamedTuple):
    """Estimate with its confidence interval: numbers, or arrays of one shape, in one unit."""

    value: Any  # estimate
    low: Any  # lower end of the interval, NaN without interval
    high: Any  # upper end of the interval, NaN without interval

    @property
    def width(self) -> np.ndarray:
        return self.high - self.low


class SequentialState(NamedTuple):
    """State of a running sweep."""

    failures: int = 0  # number of failures so far
    number: int = 0  # number of scenarios so far
    low: float = 0.0  # lower end of the interval
    high: float = 1.0  # upper end of the interval
    level: float = CONFIDENCE_LEVEL  # confidence level of the interval


def binomial_interval(failures: ArrayLike, number: ArrayLike, level: float = CONFIDENCE_LEVEL) -> Estimate:
    """Return the exact interval of the probability for `failures` among `number` independent scenarios.

    At its ends p, the probability of at least, or at most, as many failures is (1 - level) / 2; the ends are
    quantiles of beta distributions (Clopper and Pearson 1934). It covers with at least `level` for every p if
    `number` was fixed in advance. Without scenarios it is 0 to 1, with estimate nan. Raise ValueError unless
    0 <= failures <= number and 0 < level < 1.
    """
    failures, number = _check_counts(failures, number, level)
    tail = (1.0 - level) / 2.0
    passes = number - failures
    # A beta distribution with parameter 0 does not exist; the end is then 0 or 1.
    low = np.where(failures > 0, special.betaincinv(np.maximum(failures, 1.0), passes + 1.0, tail), 0.0)
    high = np.where(passes > 0, special.betainccinv(failures + 1.0, np.maximum(passes, 1.0), tail), 1.0)
    return Estimate(_compute_share(failures, number), low, high)


def confidence_sequence(failures: ArrayLike, number: ArrayLike, level: float = CONFIDENCE_LEVEL) -> Estimate:
    """Return an interval that covers, with at least `level`, at all numbers of scenarios simultaneously.

    For s failures among n, the true probability p, the beta function B and a = `BETA_PRIOR`,

        M_n(p) = B(a + s, a + n - s) / (B(a, a) p^s (1 - p)^(n - s))

    is the likelihood ratio between a beta mixture of probabilities and p, a nonnegative martingale that
    starts at 1. By Ville's inequality it reaches 1 / (1 - level) at any time with probability at most
    1 - level, so that {p: M_n(p) < 1 / (1 - level)} covers at any stopping rule. -log M_n is concave in p, so
    that the set is an interval; bisection in log(p / (1 - p)) gives its ends. Its width is 1.8 times that of
    the exact interval at n = 1000, 2.3 times at a million. Raise ValueError as `binomial_interval` does.

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
    return Estimate(share, low, high)


def update_sequence(running: SequentialState, failures: int, number: int) -> SequentialState:
    """Return `running` after `number` further scenarios, of which `failures` failed.

    The interval is the intersection of all intervals so far, which covers as well, since these cover
    simultaneously. The order of the scenarios must not depend on their outcome: use their index, not the
    order in which they finish, since failures may finish sooner. An empty intersection has probability at
    most 1 - level; the interval then starts again from the newest one. Raise ValueError as
    `binomial_interval` does.
    """
    failures, number = running.failures + failures, running.number + number
    _, low, high = confidence_sequence(failures, number, running.level)
    common = max(running.low, float(low)), min(running.high, float(high))
    low, high = common if common[0] <= common[1] else (float(low), float(high))
    return running._replace(failures=failures, number=number, low=low, high=high)


def is_narrow_enough(running: SequentialState, width: float) -> bool:
    """Return whether the interval is at most `width` wide."""
    return running.high - running.low <= width


def estimate_sequence_scenarios(probability: float, width: float, level: float = CONFIDENCE_LEVEL) -> int:
    """Estimate the number of scenarios, 1 to 2**62, at which `confidence_sequence` is `width` wide.

    `probability` is the expected share of failures; progress bars use the result. Raise ValueError unless
    0 <= probability <= 1, width > 0 and 0 < level < 1.
    """
    if not (0 <= probability <= 1 and width > 0):
        raise ValueError(f"probability, width: found {probability}, {width}, expected 0 to 1, above 0")
    numbers = np.unique(np.round(2.0 ** np.arange(0, 62.01, 0.05)))
    failures = np.round(probability * numbers)
    is_narrow = confidence_sequence(failures, numbers, level).width <= width
    # The rounded failures make the width fluctuate, so that the last number that is too small decides.
    return int(numbers[min(np.max(np.nonzero(~is_narrow)[0], initial=-1) + 1, len(numbers) - 1)])


def estimate_deciding_scenarios(
    failures: int, number: int, allowed: float, level: float = CONFIDENCE_LEVEL
) -> int | None:
    """Estimate the number of scenarios at which `binomial_interval` lies on one side of `allowed`.

    The share of failures is assumed to remain as it is so far, or 0 without scenarios. Return None if a
    billion scenarios are not enough. Raise ValueError as `binomial_interval` does.
    """
    _check_counts(failures, number, level)
    share = failures / number if number else 0.0
    numbers = np.unique(np.ceil(1.01 ** np.arange(2083)))
    _, low, high = binomial_interval(np.round(share * numbers), numbers, level)
    is_decided = high <= allowed if share <= allowed else low > allowed
    # The rounded failures make the ends fluctuate, so that the last number that is too small decides.
    index = np.max(np.nonzero(~is_decided)[0], initial=-1) + 1
    return int(numbers[index]) if index < len(numbers) else None


def replicate_interval(failures: ArrayLike, number: int, level: float = CONFIDENCE_LEVEL) -> Estimate:
    """Return the interval of the probability from independent scramblings of a Sobol sequence.

    `failures` (..., replicates) are counts among `number` points each. Each share of failures has mean p, so
    that Student's interval

        mean +- t sd / sqrt(replicates)

    is valid if the mean is normal. Three cases widen it:

    - Counts are integers. If the sequence is so even that each scrambling counts one of the two integers
      around n p, all R may show the same one. With the distance d of n p from it, this has the probability
      (1 - d)^R, at most (1 - level) / 2 for d >= 1 - ((1 - level) / 2)^(1/R). This d over n is the least half
      width.
    - Fewer than `MIN_STUDENT_FAILURES` failures (or successes) are too skewed for Student's distribution. The
        interval then
      also contains the exact binomial interval of all points. That interval is conservative if the counts
      spread less than those of independent points; if they spread more, Student's interval is the wider one.
    - Without any failure there is no spread. If counts spread no more than those of independent points, a
      scrambling has no failure with probability at most 1 / (1 + n p / (1 - p)) (Cantelli's inequality), and
      all R with its Rth power, so that p is below c / (n + c), c = ((1 - level) / 2)^(-1/R) - 1. The case
      without any success is analogous.

    Raise ValueError for less than two replicates, and as `binomial_interval` does. Source on randomised
    replicates: Owen 1997, "Scrambled net variance for integrals of smooth functions".
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
    return Estimate(mean, low, high)


def lognormal_interval(
    estimates: np.ndarray, reached: np.ndarray, least: np.ndarray, level: float = CONFIDENCE_LEVEL
) -> tuple[float, float]:
    """Return the interval of the mean of a lognormal distribution from independent samples of it.

    With the mean m and the variance s^2 of the logarithms of the R `estimates` (replicates,), and Student's
    quantile t with R - 1 degrees of freedom, the interval is

        exp(m + s^2 / 2 +- t sqrt(s^2 / R + s^4 / (2 (R - 1)))),

    clipped at 1 (Cox's method as modified by Olsson 2005, "Confidence intervals for the mean of a log-normal
    distribution"). Under the root, s^2 is at least the mean square of the coefficients of variation `least`
    (replicates,). Student's interval of the estimates would neglect their skewness; that of their logarithms
    would cover the median, which is below the mean. If an estimate is 0, the interval begins at 0 and ends at
    the upper end of Student's interval, in which the upper bounds `reached` (replicates,) replace the zeros.
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
    """Return the counts as broadcast arrays. Raise ValueError if a count or the level is out of range."""
    failures, number = np.broadcast_arrays(np.asarray(failures, float), np.asarray(number, float))
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: found {level}, expected between 0 and 1")
    if not np.all((failures >= 0) & (failures <= number)):
        raise ValueError("failures: found less than 0 or more than scenarios, expected 0 to their number")
    return failures, number


def _compute_share(failures: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the share of failures, nan without scenarios."""
    return np.where(number > 0, failures / np.maximum(number, 1.0), np.nan)


def _bisect_boundary(outside, beyond: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Return by bisection the point from `within` towards `beyond` at which `outside` becomes true."""
    for _ in range(_BISECTION_STEPS):
        middle = 0.5 * (beyond + within)
        is_outside = outside(middle)
        beyond, within = np.where(is_outside, middle, beyond), np.where(is_outside, within, middle)
    return beyond
