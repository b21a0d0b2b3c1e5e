"""The verdict of a sweep: a probability of failure, with an interval that a reviewer accepts.

Three ways to sample, three intervals, each covering the true probability with at least the level it states:

- *a fixed number of independent scenarios*: `binomial_interval`, exact;
- *as many as it takes*, looking again and again until the interval is narrow enough: an exact interval looked
  at repeatedly is no longer exact, since one stops at a lucky moment. `confidence_sequence` covers at all
  numbers at once, so at whichever one stops; `Running` carries it from look to look;
- *a few independent scramblings of a Sobol sequence*: `replicate_interval`. Points of one scrambling depend
  on each other, so no binomial law holds; the scramblings are independent of each other, and their spread
  tells.

And `lognormal_interval` for the estimates of independent repeats of a method for rare failures.

Pure functions of counts, which broadcast; NumPy and SciPy alone.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

LEVEL = 0.95
PRIOR = 0.5  # both parameters of the mixing beta distribution: Jeffreys' and Krichevsky-Trofimov's choice
FEW = 100  # failures (or successes) of all replicates below which Student's law is not trusted alone
_STEPS = 62  # of bisection, from a bracket of 1500 down to rounding


class Estimate(NamedTuple):
    """An estimate and its interval, all in one unit: numbers, or arrays of one shape."""

    value: Any  # the estimate itself
    low: Any  # lower end of the interval, NaN where there is none
    high: Any  # upper end

    @property
    def width(self) -> np.ndarray:
        return self.high - self.low


class Running(NamedTuple):
    """What a sweep under way knows."""

    failures: int = 0  # among the scenarios so far
    number: int = 0  # of scenarios so far
    low: float = 0.0  # lower end of the interval
    high: float = 1.0  # upper end
    level: float = LEVEL  # of the interval


def binomial_interval(failures: ArrayLike, number: ArrayLike, level: float = LEVEL) -> Estimate:
    """Exact interval of the probability behind `failures` among `number` independent scenarios.

    Its ends are the p at which as many failures or more, or as many or fewer, have probability
    (1 - level) / 2: quantiles of beta distributions (Clopper and Pearson 1934). It covers with at least
    `level` for every p, when `number` was fixed beforehand. No scenarios: 0 to 1, with estimate nan. Raises
    ValueError unless 0 <= failures <= number and 0 < level < 1.
    """
    failures, number = _counts(failures, number, level)
    tail = (1.0 - level) / 2.0
    passes = number - failures
    # A parameter of 0 has no beta distribution: there the end is 0 or 1.
    low = np.where(failures > 0, special.betaincinv(np.maximum(failures, 1.0), passes + 1.0, tail), 0.0)
    high = np.where(passes > 0, special.betainccinv(failures + 1.0, np.maximum(passes, 1.0), tail), 1.0)
    return Estimate(_share(failures, number), low, high)


def confidence_sequence(failures: ArrayLike, number: ArrayLike, level: float = LEVEL) -> Estimate:
    """Interval that covers, with at least `level`, at all numbers of scenarios at once.

    For s failures among n and the true probability p, with B the beta function and a = `PRIOR`,

        M_n(p) = B(a + s, a + n - s) / (B(a, a) p^s (1 - p)^(n - s))

    is the likelihood of what was seen under a beta mixture of probabilities over that under p: a nonnegative
    martingale that starts from 1. By Ville's inequality it ever reaches 1 / (1 - level) with probability at
    most 1 - level, so that {p: M_n(p) < 1 / (1 - level)} covers at any stopping rule. -log M_n is concave in
    p: the set is an interval, found by bisection in log(p / (1 - p)). Robbins 1970, "Statistical methods
    related to the law of the iterated logarithm"; Howard, Ramdas, McAuliffe, Sekhon 2021, "Time-uniform,
    nonparametric, nonasymptotic confidence sequences". Its price is a width 1.8 times that of the exact
    interval at n = 1000, 2.3 times at a million. Raises ValueError as `binomial_interval` does.
    """
    failures, number = _counts(failures, number, level)
    passes = number - failures
    log_mixture = special.betaln(PRIOR + failures, PRIOR + passes) - special.betaln(PRIOR, PRIOR)
    least = log_mixture + np.log1p(-level)

    def outside(logit):
        return failures * special.log_expit(logit) + passes * special.log_expit(-logit) <= least

    share = _share(failures, number)
    middle = np.clip(special.logit(np.nan_to_num(share, nan=0.5)), -750.0, 750.0)
    low = np.where(failures > 0, special.expit(_boundary(outside, np.full_like(middle, -750.0), middle)), 0.0)
    high = np.where(passes > 0, special.expit(_boundary(outside, np.full_like(middle, 750.0), middle)), 1.0)
    return Estimate(share, low, high)


def updated(running: Running, failures: int, number: int) -> Running:
    """`running` after a look at `number` further scenarios, `failures` of them failed.

    The interval is the intersection of all looks', which covers as they do, all at once. Scenarios must come
    in an order that knows nothing of their outcome (by index, say, not as they finish: failures may finish
    sooner). An empty intersection has probability at most 1 - level; there the last look's interval starts
    over. Raises ValueError as `binomial_interval` does.
    """
    failures, number = running.failures + failures, running.number + number
    _, low, high = confidence_sequence(failures, number, running.level)
    narrow = max(running.low, float(low)), min(running.high, float(high))
    low, high = narrow if narrow[0] <= narrow[1] else (float(low), float(high))
    return running._replace(failures=failures, number=number, low=low, high=high)


def enough(running: Running, width: float) -> bool:
    """Whether the interval is as narrow as wanted."""
    return running.high - running.low <= width


def scenarios_needed(probability: float, width: float, level: float = LEVEL) -> int:
    """About how many scenarios it takes until `confidence_sequence` is `width` wide, 1 to 2**62.

    At the given share of failures; for a bar of progress. Raises ValueError unless 0 <= probability <= 1,
    width > 0 and 0 < level < 1.
    """
    if not (0 <= probability <= 1 and width > 0):
        raise ValueError(f"probability, width: found {probability}, {width}, allowed 0 to 1, above 0")
    numbers = np.unique(np.round(2.0 ** np.arange(0, 62.01, 0.05)))
    failures = np.round(probability * numbers)
    narrow = confidence_sequence(failures, numbers, level).width <= width
    # Rounding makes the width waver: the last number too few counts.
    return int(numbers[min(np.max(np.nonzero(~narrow)[0], initial=-1) + 1, len(numbers) - 1)])


def number_to_decide(failures: int, number: int, allowed: float, level: float = LEVEL) -> int | None:
    """About how many scenarios it takes, at the share of failures seen so far, until `binomial_interval` lies
    below `allowed`, or above it if that is where the share lies; None if a billion do not do.

    Without scenarios so far the share is taken for 0. Raises ValueError as `binomial_interval` does.
    """
    _counts(failures, number, level)
    share = failures / number if number else 0.0
    numbers = np.unique(np.ceil(1.01 ** np.arange(2083)))
    _, low, high = binomial_interval(np.round(share * numbers), numbers, level)
    decided = high <= allowed if share <= allowed else low > allowed
    # Rounding makes the ends waver: the last number too few counts.
    enough = np.max(np.nonzero(~decided)[0], initial=-1) + 1
    return int(numbers[enough]) if enough < len(numbers) else None


def replicate_interval(failures: ArrayLike, number: int, level: float = LEVEL) -> Estimate:
    """Interval of the probability from independent scramblings of a Sobol sequence.

    `failures` (..., replicates) among `number` points each. Each share of failures has mean p, so Student's

        mean +- t sd / sqrt(replicates)

    holds as far as their mean is normal. Where it is not, the interval is made wider:

    - Counts are whole. A sequence so even that each scrambling counts one of the two whole numbers around
      n p may show one of them only. With d the distance of n p from it, all R show it with probability
      (1 - d)^R, at most (1 - level) / 2 for d from 1 - ((1 - level) / 2)^(1/R): the least half width, over n.
    - Fewer than `FEW` failures (or successes) are too skewed for Student's law: the interval then contains
      the exact binomial one of all points too. An even sequence's counts spread less than independent
      points', for which that is exact; counts that spread more make Student's interval the wider one.
    - No failure at all shows no spread. If counts spread no more than independent points', a scrambling has
      none with probability at most 1 / (1 + n p / (1 - p)) (Cantelli's inequality), all R with the Rth power:
      p is below c / (n + c), c = ((1 - level) / 2)^(-1/R) - 1. No success likewise.

    Owen 1997 ("Scrambled net variance for integrals of smooth functions") on randomised replicates and
    spread. Raises ValueError for less than two replicates, and as `binomial_interval` does.
    """
    failures, _ = _counts(failures, number, level)
    replicates = failures.shape[-1] if failures.ndim else 0
    if replicates < 2:
        raise ValueError(f"replicates: found {replicates}, allowed 2 or more")
    tail = (1.0 - level) / 2.0
    mean = np.mean(failures, axis=-1) / number
    spread = np.std(failures, axis=-1, ddof=1) / number / np.sqrt(replicates)
    least = (1.0 - tail ** (1.0 / replicates)) / number
    half = np.maximum(special.stdtrit(replicates - 1, 1.0 - tail) * spread, least)
    low, high = np.maximum(mean - half, 0.0), np.minimum(mean + half, 1.0)

    total, points = np.sum(failures, axis=-1), float(number * replicates)
    few = np.minimum(total, points - total) < FEW
    _, exact_low, exact_high = binomial_interval(total, points, level)
    low = np.where(few, np.minimum(low, exact_low), low)
    high = np.where(few, np.maximum(high, exact_high), high)

    odds = tail ** (-1.0 / replicates) - 1.0
    unseen = odds / (number + odds)
    high = np.where(total == 0, np.maximum(high, unseen), high)
    low = np.where(total == points, np.minimum(low, 1.0 - unseen), low)
    return Estimate(mean, low, high)


def lognormal_interval(
    estimates: np.ndarray, reached: np.ndarray, least: np.ndarray, level: float = LEVEL
) -> tuple[float, float]:
    """Interval of the mean of a lognormal distribution from independent `estimates` (replicates,) drawn of
    it.

    With m and s^2 mean and variance of their R logarithms and t Student's quantile of R - 1 degrees,

        exp(m + s^2 / 2 +- t sqrt(s^2 / R + s^4 / (2 (R - 1)))),

    under the root not less for s^2 than the mean square of `least` (replicates,), coefficients of variation;
    cut at 1 (Cox's method as modified by Olsson 2005, "Confidence intervals for the mean of a log-normal
    distribution"). An interval of Student's for the estimates themselves would neglect their skewness, one
    for their logarithms would cover the median, which lies below. Where an estimate is 0 the interval begins
    at 0 and ends where Student's ends with what was `reached`, (replicates,) >= estimates, in the place of
    zeros.
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


def _counts(failures: ArrayLike, number: ArrayLike, level: float) -> tuple[np.ndarray, np.ndarray]:
    failures, number = np.broadcast_arrays(np.asarray(failures, float), np.asarray(number, float))
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: found {level}, allowed between 0 and 1")
    if not np.all((failures >= 0) & (failures <= number)):
        raise ValueError("failures: found less than 0 or more than scenarios, allowed 0 to their number")
    return failures, number


def _share(failures: np.ndarray, number: np.ndarray) -> np.ndarray:
    return np.where(number > 0, failures / np.maximum(number, 1.0), np.nan)


def _boundary(outside, beyond: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Where `outside` begins between `within`, which is not, and `beyond`; on its outer side."""
    for _ in range(_STEPS):
        middle = 0.5 * (beyond + within)
        out = outside(middle)
        beyond, within = np.where(out, middle, beyond), np.where(out, within, middle)
    return beyond
