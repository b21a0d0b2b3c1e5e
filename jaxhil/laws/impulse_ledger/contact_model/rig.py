"""Contact model: a piecewise-linear force-penetration model with dissipation, fitted while contact lasts.

    f(x, v, x_m) = preload + sum_j hinge_j max(0, x - kappa_j)
                   + (damping + depth_damping x/REACH) v - unloading (x_m - x)
                   + friction v/sqrt(v^2 + SLOW^2)                              at x > 0, else 0

x is the depth, v the speed and x_m the largest depth so far. All values are scaled by the approach speed v0
and the equivalent mass M: depth x/v0 [s], speed v/v0 [1], force F/(M v0) [1/s]. The slope at a depth is the
sum of the hinges of smaller knots, so that slopes which change by independent amounts from knot to knot have
a diagonal prior covariance. The parameters theta are estimated by recursive least squares.

A force that is older than specified by d adds d k(x) (1 - v) to the readings, k being the slope; d is the
last parameter. A damper looks like a newer force, so that d is used only once contact is over
(`estimate_delay`). Then the posterior is a mixture of two models, with and without dissipation, weighted by
prior odds and evidence. The larger the squared innovations, the less the readings count.

Sources: recursive least squares, Ljung, "System Identification" (1999), section 11.2; a parameter that is
zero with a given probability, Mitchell and Beauchamp, "Bayesian variable selection in linear regression"
(1988); moments of a factor that is not normal, Minka, "Expectation propagation" (2001); the probability of a
model by the density at zero, Dickey, "The weighted likelihood ratio" (1971).
"""

from collections.abc import Sequence
from itertools import pairwise
from math import exp, log, pi, sqrt
from typing import Annotated

from jaxhil.rig.types import Count, Positive

KNOTS = (0.0, 0.003, 0.008, 0.015, 0.024, 0.034, 0.046, 0.06, 0.076, 0.1, 0.12)  # s; the slope changes there
HINGES = len(KNOTS)
PARAMETERS = HINGES + 6
DAMPING, DEPTH_DAMPING, UNLOADING, FRICTION, PRELOAD, DELAY = range(HINGES, PARAMETERS)
DISSIPATIVE = (DAMPING, DEPTH_DAMPING, UNLOADING)  # parameters that are zero or positive
CONCLUDED = (*DISSIPATIVE, DELAY)  # parameters that are conditioned during contact
DELAY_PARAMETERS = (*CONCLUDED, 0, PRELOAD)  # parameters in the estimate of the delay
WANDER = 0.03  # s; over this depth the slope changes by one prior standard deviation
REACH = 0.03  # s; depth at which depth_damping counts like damping
SLOW = 0.03  # speed at which friction changes its sign
# Prior variance of each parameter but the delay: index of its standard deviation in `Spreads`, and factor.
SPREAD_INDICES = (0, *[1] * (HINGES - 1), 2, 3, 4, 5, 6)
FACTORS = (1.0, *[(deeper - depth) / WANDER for depth, deeper in pairwise(KNOTS)], *[1.0] * 5)
ZERO_PROBABILITY = 0.75  # prior probability that a dissipative parameter is zero
ODDS = ZERO_PROBABILITY / (2.0 * (1.0 - ZERO_PROBABILITY)) * sqrt(2.0 * pi)
ELASTIC_ODDS = 19.0  # prior odds of contact without dissipation
WIDE_STIFFNESS = (200.0, 300.0)  # 1/s^2; prior mean and spread of the first slope in `estimate_delay`
SURPLUS = 1.4  # factor of the readings' variance, because the misfits of one contact are correlated
EXACT = 1e18  # precision of a parameter that is known
LEAST_VARIANCE = 1e-12  # of a dissipative parameter; with less it counts as known
Vector = Annotated[list[float], PARAMETERS]
Matrix = Annotated[list[list[float]], PARAMETERS, PARAMETERS]
Spreads = Annotated[list[float], 7]


def features(depth: float, speed: float, deepest: float, delay_effect: float) -> Vector:
    """Return the features phi, so that the force is phi.theta; zeros out of contact.

    Arguments are depth [s], speed [1], largest depth so far [s] and effect of the delay, k (1 - v) [1/s^2].
    """
    if not depth > 0.0:
        return [0.0] * PARAMETERS
    phi = [depth - knot if depth > knot else 0.0 for knot in KNOTS]
    back = depth - deepest
    turning = speed / sqrt(speed * speed + SLOW * SLOW)
    return [*phi, speed, depth * speed / REACH, back if back < 0.0 else 0.0, turning, 1.0, delay_effect]


def force(theta: Sequence[float], depth: float, speed: float, deepest: float) -> float:
    """Return the force [1/s] of the parameters `theta`, which is phi.theta without a delay."""
    if not depth > 0.0:
        return 0.0
    total = theta[PRELOAD]
    for hinge, knot in zip(theta, KNOTS, strict=False):
        if not depth > knot:
            break
        total += hinge * (depth - knot)
    back = depth - deepest
    total += (theta[DAMPING] + theta[DEPTH_DAMPING] * depth / REACH) * speed
    if back < 0.0:
        total += theta[UNLOADING] * back
    return total + theta[FRICTION] * (speed / sqrt(speed * speed + SLOW * SLOW))


def slope(theta: Sequence[float], depth: float) -> float:
    """Return the slope [1/s^2] at a depth [s], at least 0."""
    total = 0.0
    for hinge, knot in zip(theta, KNOTS, strict=False):
        if not depth > knot:
            break
        total += hinge
    return total if total > 0.0 else 0.0


class ContactModel:
    """Estimate of the parameters theta.

    Attributes:
        mean: posterior mean, dissipative parameters of either sign.
        covariance: posterior covariance.
        theta: posterior mean, dissipative parameters zero or positive.
        count: number of readings.
    """

    __slots__ = ("_prior_mean", "_squares", "_variances", "count", "covariance", "mean", "theta")
    covariance: Matrix
    mean: Vector
    theta: Vector

    def restart(self, stiffness: float, spreads: Spreads, delay_variance: float) -> None:
        """Return to the prior.

        `stiffness` [1/s^2] is the prior mean of the slope at depth 0; `spreads` are the standard deviations
        of that slope [1/s^2], of its change over `WANDER` [1/s^2], of damping [1/s], depth damping [1/s],
        unloading [1/s^2], friction [1/s] and preload [1/s]; `delay_variance` is in s^2.
        """
        variances = [0.0] * PARAMETERS
        for j in range(DELAY):
            spread = spreads[SPREAD_INDICES[j]]
            variances[j] = spread * spread * FACTORS[j]
        variances[DELAY] = delay_variance
        prior = [0.0] * PARAMETERS
        prior[0] = stiffness
        self._variances = variances
        self._prior_mean = prior
        self.mean = prior
        self.theta = prior
        self.covariance = [[0.0] * PARAMETERS for _ in range(PARAMETERS)]
        for j, variance in enumerate(variances):
            self.covariance[j][j] = variance
        self._squares = 0.0  # sum of squared innovations over their variances
        self.count = 0.0

    def learn(self, phi: Vector, force: float, variance: float) -> None:
        """Update the estimate with one reading of the force [1/s] whose noise has this variance [1/s^2]."""
        covariance = self.covariance
        column = [dot(row, phi) for row in covariance]
        total = variance + dot(phi, column)
        if not total > 0.0:
            return  # rounding has spoilt the covariance
        share = 1.0 / total
        error = force - dot(phi, self.mean)
        self.mean = [mean + entry * (share * error) for mean, entry in zip(self.mean, column, strict=True)]
        for row, entry in zip(covariance, column, strict=True):
            scaled = share * entry
            row[:] = [old - scaled * factor for old, factor in zip(row, column, strict=True)]
        self._squares += share * (error * error)
        self.count += 1.0

    def conclude(self, delay: float) -> None:
        """Compute `theta` for a known delay [s]."""
        theta = list(self.mean)
        rows = [list(self.covariance[j]) for j in CONCLUDED]
        observe(theta, rows, len(DISSIPATIVE), DELAY, EXACT * delay, EXACT)
        self._dissipate(theta, rows, DAMPING, True)
        for j in range(DAMPING, PRELOAD):
            theta[j] = theta[j] if theta[j] > 0.0 else 0.0
        self.theta = theta

    def estimate_delay(self, preload: float, preload_spread: float) -> tuple[float, float]:
        """Return mean [s] and variance [s^2] of the delay after a contact.

        `preload` and `preload_spread` [1/s] are mean and standard deviation of the force at the onset.
        """
        mean = [self.mean[j] for j in DELAY_PARAMETERS]
        rows = [[self.covariance[i][j] for j in DELAY_PARAMETERS] for i in DELAY_PARAMETERS]
        last = len(DISSIPATIVE)  # index of the delay
        # The prior for control reduces the slope of a stiff contact, which would look like a damper.
        for index in range(last + 1, last + 3):
            j = DELAY_PARAMETERS[index]
            value = WIDE_STIFFNESS[0] if j == 0 else preload
            spread = WIDE_STIFFNESS[1] if j == 0 else preload_spread
            old, new = 1.0 / max(self._variances[j], LEAST_VARIANCE), 1.0 / (spread * spread)
            observe(mean, rows, index, index, new * value - old * self._prior_mean[j], new - old)
        excess = SURPLUS * max(self._squares / max(self.count, 1.0), 1.0)
        lossy = list(mean)
        lossy_rows = [list(row) for row in rows]
        self._dissipate(lossy, lossy_rows, 0, False)
        evidence = 0.0
        for index in range(last):
            variance = max(rows[index][index], LEAST_VARIANCE)
            ratio = max(self._variances[DAMPING + index], LEAST_VARIANCE) / variance
            evidence += 0.5 * (log(ratio) - mean[index] * mean[index] / (variance * excess))
            observe(mean, rows, index, index, 0.0, EXACT)
        odds = exp(min(max(evidence, -50.0), 50.0))  # of elastic contact by the readings alone
        share = ELASTIC_ODDS * odds / (1.0 + ELASTIC_ODDS * odds)
        difference = mean[last] - lossy[last]
        delay = lossy[last] + share * difference
        share = odds / (1.0 + odds)  # the variance does not rely on the prior odds
        variance = lossy_rows[last][last] + share * (rows[last][last] - lossy_rows[last][last])
        variance += share * (1.0 - share) * (difference * difference)
        prior_variance = self._variances[DELAY]
        if not 0.0 < variance < prior_variance:
            return 0.0, prior_variance
        weakened = 1.0 / (1.0 / prior_variance + (1.0 / variance - 1.0 / prior_variance) / (excess * excess))
        return weakened * delay / variance / (excess * excess), weakened

    def _dissipate(self, mean: list[float], rows: list[list[float]], first: Count, certain: bool) -> None:
        """Make dissipative parameters zero or positive, in place, in mean and rows of the covariance.

        They have the first rows, and the indices from `first` on. If `certain`, they are known afterwards.
        """
        for row in range(len(DISSIPATIVE)):
            index = first + row
            variance = max(rows[row][index], LEAST_VARIANCE)
            expected, left = zero_or_positive(mean[index], variance, self._variances[DAMPING + row])
            old, new = 1.0 / variance, EXACT if certain else 1.0 / max(left, 1.0 / EXACT)
            observe(mean, rows, row, index, new * expected - old * mean[index], new - old)


def observe(
    mean: list[float], rows: list[list[float]], row: Count, index: Count, information: float, precision: float
) -> None:
    """Update mean and rows of the covariance, in place, by an observation of one parameter.

    The parameter has a `row` and an `index` in mean and rows. An observed value with a variance has the
    precision 1/variance and the information value/variance; negative ones remove a prior.
    """
    observed = list(rows[row])
    total = 1.0 + precision * observed[index]
    if not total > 0.0:
        return
    gain = (information - precision * mean[index]) / total
    mean[:] = [value + entry * gain for value, entry in zip(mean, observed, strict=True)]
    for target in rows:
        weight = precision / total * target[index]
        target[:] = [value - weight * entry for value, entry in zip(target, observed, strict=True)]


def zero_or_positive(mean: float, variance: Positive, prior_variance: float) -> tuple[float, float]:
    """Return posterior mean and variance of a parameter that is zero with `ZERO_PROBABILITY` or positive.

    `mean` and `variance` are those of the posterior without this constraint. Boyd's bound of Mills' ratio,
    pi/((pi - 1) t + sqrt(t^2 + 2 pi)), approximates the tail of the normal distribution.
    """
    spread = sqrt(variance)
    ratio = mean / spread
    size = abs(ratio)
    mills = pi / ((pi - 1.0) * size + sqrt(size * size + 2.0 * pi))
    density = exp(-0.5 * (size * size)) / sqrt(2.0 * pi)
    hazard = density / (1.0 - density * mills) if ratio > 0.0 else 1.0 / mills
    share = 1.0 / (1.0 + ODDS * sqrt(prior_variance / variance) * hazard)
    positive = ratio + hazard
    expected = share * spread * positive
    return expected, share * variance * (1.0 + ratio * positive) - expected * expected


def dot(left: Sequence[float], right: Sequence[float]) -> float:
    """Return the sum of products, added from the first to the last."""
    total = 0.0
    for first, second in zip(left, right, strict=True):
        total += first * second
    return total
