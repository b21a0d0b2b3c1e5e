"""Contact model: piecewise-linear force-penetration model with dissipation, fitted during a contact.

    f(x, v, x_m) = preload + sum_j hinge_j max(0, x - kappa_j)
                   + (damping + depth_damping x/REACH) v - unloading (x_m - x)
                   + friction v/sqrt(v^2 + MIN_SLIDING_SPEED^2)                at x > 0, else 0

f is the force, divided by mass and approach speed [1/s]. x is the depth and x_m the largest depth so far,
divided by the approach speed [s]. v is the speed, divided by the approach speed [1]. The slope at a depth x
is the sum of the hinges with knots kappa_j < x. Changes of the slope at the knots are assumed to be
independent, so that the prior covariance of the hinges is diagonal. Recursive least squares estimates the
parameters theta.

The last parameter is d, the true minus the specified delay of the force. It adds d k(x) (1 - v) to the
readings, where k is the slope. Because damping has a similar effect with the opposite sign, d is estimated
only after the contact (`estimate_delay`). Then the posterior is a mixture of two models, with and without
dissipation, weighted by prior odds and evidence. Large squared innovations reduce the weight of the readings.

Sources: recursive least squares, Ljung, "System Identification" (1999), section 11.2; prior with a point
mass at zero (spike and slab), Mitchell and Beauchamp, "Bayesian variable selection in linear regression"
(1988); moments of a non-normal factor, Minka, "Expectation propagation" (2001); Bayes factor from the density
at zero, Dickey, "The weighted likelihood ratio" (1971).
"""

from collections.abc import Sequence
from itertools import pairwise
from math import exp, log, pi, sqrt
from typing import Annotated

from jaxhil.rig.types import Count, Positive

KNOTS = (0.0, 0.003, 0.008, 0.015, 0.024, 0.034, 0.046, 0.06, 0.076, 0.1, 0.12)  # depths / approach speed [s]
HINGES = len(KNOTS)
PARAMETERS = HINGES + 6
DAMPING, DEPTH_DAMPING, UNLOADING, FRICTION, PRELOAD, DELAY = range(HINGES, PARAMETERS)
DISSIPATIVE = (DAMPING, DEPTH_DAMPING, UNLOADING)  # indices of parameters that are >= 0
CONCLUDED = (*DISSIPATIVE, DELAY)  # indices of parameters that `conclude` constrains
DELAY_PARAMETERS = (*CONCLUDED, 0, PRELOAD)  # indices of the parameters that `estimate_delay` uses
WANDER = 0.03  # depth / approach speed in which the slope changes by one prior standard deviation [s]
REACH = 0.03  # depth / approach speed at which damping and an equal depth_damping have the same effect [s]
MIN_SLIDING_SPEED = 0.03  # speed / approach speed below which friction changes sign smoothly [1]
# The prior variance of a parameter (except the delay) is a squared entry of `Spreads`, selected by
# `SPREAD_INDICES`, times the parameter's entry of `FACTORS`.
SPREAD_INDICES = (0, *[1] * (HINGES - 1), 2, 3, 4, 5, 6)
FACTORS = (1.0, *[(deeper - depth) / WANDER for depth, deeper in pairwise(KNOTS)], *[1.0] * 5)
ZERO_SIGMAS = 3.0  # a dissipative parameter below 0 by less than this is 0 [standard deviations]
ZERO_PROBABILITY = 0.75  # prior probability that a dissipative parameter is zero [1]
ODDS = ZERO_PROBABILITY / (2.0 * (1.0 - ZERO_PROBABILITY)) * sqrt(2.0 * pi)
ELASTIC_ODDS = 19.0  # prior odds of a contact without dissipation [1]
WIDE_STIFFNESS = (200.0, 300.0)  # prior mean and standard deviation of hinge 0 in `estimate_delay` [1/s^2]
SURPLUS = 1.4  # factor on the readings' variance, because the model's errors are correlated [1]
EXACT = 1e18  # 1/variance of a parameter that is known exactly
MIN_VARIANCE = 1e-12  # lower bound of a parameter's variance, avoids division by 0
Vector = Annotated[list[float], PARAMETERS]
Matrix = Annotated[list[list[float]], PARAMETERS, PARAMETERS]
Spreads = Annotated[list[float], 7]


def features(depth: float, speed: float, deepest: float, delay_effect: float) -> Vector:
    """Return the regressor phi: phi.theta is the force for the parameters theta. Out of contact, phi is 0.

    `delay_effect` [1/s^2] is the derivative of the force with respect to the delay. It is k (1 - v) for the
    slope k and the `speed` v.
    """
    if not depth > 0.0:
        return [0.0] * PARAMETERS
    phi = [depth - knot if depth > knot else 0.0 for knot in KNOTS]
    turning = speed / sqrt(speed * speed + MIN_SLIDING_SPEED * MIN_SLIDING_SPEED)
    return [*phi, speed, depth * speed / REACH, min(0.0, depth - deepest), turning, 1.0, delay_effect]


def force(theta: Sequence[float], depth: float, speed: float, deepest: float) -> float:
    """Return the contact model's force as if undelayed, divided by mass and approach speed [1/s]."""
    if not depth > 0.0:
        return 0.0
    total = theta[PRELOAD]
    for hinge, knot in zip(theta, KNOTS, strict=False):
        if not depth > knot:
            break
        total += hinge * (depth - knot)
    total += (theta[DAMPING] + theta[DEPTH_DAMPING] * depth / REACH) * speed
    if depth < deepest:
        total += theta[UNLOADING] * (depth - deepest)
    return total + theta[FRICTION] * (speed / sqrt(speed * speed + MIN_SLIDING_SPEED * MIN_SLIDING_SPEED))


def slope(theta: Sequence[float], depth: float) -> float:
    """Return the contact model's stiffness per unit mass [1/s^2], at least 0."""
    total = 0.0
    for hinge, knot in zip(theta, KNOTS, strict=False):
        if not depth > knot:
            break
        total += hinge
    return total if total > 0.0 else 0.0


def damping(theta: Sequence[float], depth: float) -> float:
    """Return the contact model's damping per unit mass [1/s]."""
    return theta[DAMPING] + theta[DEPTH_DAMPING] * depth / REACH if depth > 0.0 else 0.0


class ContactModel:
    """Recursive least-squares estimate of theta, the parameters of the contact model in this module.

    Attributes:
        mean: posterior mean without constraints.
        covariance: posterior covariance without constraints.
        theta: posterior mean with the constraint that damping and other losses are >= 0.
        count: number of readings in the estimate.
    """

    __slots__ = ("_prior_mean", "_squares", "_variances", "count", "covariance", "mean", "theta")
    covariance: Matrix
    mean: Vector
    theta: Vector

    def restart(self, stiffness: float, spreads: Spreads, delay_variance: float) -> None:
        """Set the estimate to the prior. All forces are divided by the mass and the approach speed.

        Args:
            stiffness: prior mean of the slope at depth 0 [1/s^2].
            spreads: prior standard deviations of the slope at depth 0 [1/s^2], its change over the scaled
                depth `WANDER` [1/s^2], damping [1/s], depth damping [1/s], unloading [1/s^2], friction [1/s]
                and preload [1/s].
            delay_variance: prior variance of the delay [s^2].
        """
        # `restart` runs on every tick of free flight, and this loop is faster than a comprehension.
        variances = [0.0] * PARAMETERS
        for j in range(DELAY):
            spread = spreads[SPREAD_INDICES[j]]
            variances[j] = spread * spread * FACTORS[j]
        variances[DELAY] = delay_variance
        prior = [stiffness, *[0.0] * (PARAMETERS - 1)]
        self._variances = variances
        self._prior_mean = self.mean = self.theta = prior
        self.covariance = [[0.0] * PARAMETERS for _ in range(PARAMETERS)]
        for j, variance in enumerate(variances):
            self.covariance[j][j] = variance
        self._squares = 0.0  # sum of squared innovations, each divided by its variance
        self.count = 0.0

    def learn(self, phi: Vector, force: float, variance: float) -> None:
        """Update the estimate with one force reading [1/s] and its noise variance [1/s^2].

        The reading is divided by mass and approach speed; `phi` is its regressor (`features`).
        """
        covariance = self.covariance
        column = [dot(row, phi) for row in covariance]
        total = variance + dot(phi, column)
        if not total > 0.0:
            return  # the covariance is not positive because of rounding
        share = 1.0 / total
        error = force - dot(phi, self.mean)
        self.mean = [mean + entry * (share * error) for mean, entry in zip(self.mean, column, strict=True)]
        for row, entry in zip(covariance, column, strict=True):
            scaled = share * entry
            row[:] = [old - scaled * factor for old, factor in zip(row, column, strict=True)]
        self._squares += share * (error * error)
        self.count += 1.0

    def conclude(self, delay: float) -> None:
        """Compute `theta`, the estimated parameters for a known `delay` [s] and non-negative dissipation."""
        theta = list(self.mean)
        rows = [list(self.covariance[j]) for j in CONCLUDED]
        observe(theta, rows, len(DISSIPATIVE), DELAY, EXACT * delay, EXACT)
        # Otherwise, errors of opposite sign in damping and depth damping would not cancel.
        for row in range(len(DISSIPATIVE)):
            index = DAMPING + row
            if (
                theta[index] < 0.0
                and theta[index] * theta[index] < ZERO_SIGMAS * ZERO_SIGMAS * rows[row][index]
            ):
                observe(theta, rows, row, index, 0.0, EXACT)
        self._dissipate(theta, rows, DAMPING, True)
        for j in range(DAMPING, PRELOAD):
            theta[j] = theta[j] if theta[j] > 0.0 else 0.0
        self.theta = theta

    def estimate_delay(self, preload: float, preload_spread: float) -> tuple[float, float]:
        """Estimate d, the true minus the specified force delay; return its mean [s] and variance [s^2].

        Call this after a contact. `preload` and `preload_spread` [1/s] are prior mean and standard deviation
        of the force at the onset, divided by mass and approach speed.
        """
        mean = [self.mean[j] for j in DELAY_PARAMETERS]
        rows = [[self.covariance[i][j] for j in DELAY_PARAMETERS] for i in DELAY_PARAMETERS]
        last = len(DISSIPATIVE)  # index of the delay
        # Replace the priors of first slope and preload: the old prior reduces the slope of a stiff contact,
        # and the difference looks like damping.
        for index in range(last + 1, last + 3):
            j = DELAY_PARAMETERS[index]
            value = WIDE_STIFFNESS[0] if j == 0 else preload
            spread = WIDE_STIFFNESS[1] if j == 0 else preload_spread
            old, new = 1.0 / max(self._variances[j], MIN_VARIANCE), 1.0 / (spread * spread)
            observe(mean, rows, index, index, new * value - old * self._prior_mean[j], new - old)
        excess = SURPLUS * max(self._squares / max(self.count, 1.0), 1.0)
        lossy = list(mean)
        lossy_rows = [list(row) for row in rows]
        self._dissipate(lossy, lossy_rows, 0, False)
        evidence = 0.0
        for index in range(last):
            variance = max(rows[index][index], MIN_VARIANCE)
            ratio = max(self._variances[DAMPING + index], MIN_VARIANCE) / variance
            evidence += 0.5 * (log(ratio) - mean[index] * mean[index] / (variance * excess))
            observe(mean, rows, index, index, 0.0, EXACT)
        odds = exp(min(max(evidence, -50.0), 50.0))  # odds of an elastic contact, from the readings alone
        share = ELASTIC_ODDS * odds / (1.0 + ELASTIC_ODDS * odds)
        difference = mean[last] - lossy[last]
        delay = lossy[last] + share * difference
        share = odds / (1.0 + odds)  # without the prior odds, which must not affect the variance
        variance = lossy_rows[last][last] + share * (rows[last][last] - lossy_rows[last][last])
        variance += share * (1.0 - share) * (difference * difference)
        prior_variance = self._variances[DELAY]
        if not 0.0 < variance < prior_variance:
            return 0.0, prior_variance
        weakened = 1.0 / (1.0 / prior_variance + (1.0 / variance - 1.0 / prior_variance) / (excess * excess))
        return weakened * delay / variance / (excess * excess), weakened

    def _dissipate(self, mean: list[float], rows: list[list[float]], first: Count, certain: bool) -> None:
        """Constrain the dissipative parameters of a normal distribution to be >= 0, in place.

        Args:
            mean: mean of the distribution, which describes all parameters or some of them.
            rows: rows of its covariance; the first rows are those of the dissipative parameters.
            first: index of the first dissipative parameter in `mean` and in a row.
            certain: whether the constrained parameters count as exactly known.
        """
        for row in range(len(DISSIPATIVE)):
            index = first + row
            variance = max(rows[row][index], MIN_VARIANCE)
            expected, left = zero_or_positive(mean[index], variance, self._variances[DAMPING + row])
            old, new = 1.0 / variance, EXACT if certain else 1.0 / max(left, 1.0 / EXACT)
            observe(mean, rows, row, index, new * expected - old * mean[index], new - old)


def observe(
    mean: list[float], rows: list[list[float]], row: Count, index: Count, information: float, precision: float
) -> None:
    """Condition a normal distribution, in place, on an observation of one parameter.

    Args:
        mean: mean of the parameters.
        rows: rows of the covariance.
        row: row of the observed parameter.
        index: index of the observed parameter in `mean` and in a row.
        information: observed value, divided by its variance.
        precision: 1/variance of the observed value; negative to remove an earlier observation.
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
    """Return mean and variance of a parameter >= 0 that is 0 with prior probability `ZERO_PROBABILITY`.

    The arguments are posterior mean, posterior variance and prior variance without this constraint. Boyd's
    bound of Mills' ratio, pi/((pi - 1) t + sqrt(t^2 + 2 pi)), approximates the tail of the normal
    distribution.
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
    """Return the scalar product, added from the first term to the last."""
    total = 0.0
    for first, second in zip(left, right, strict=True):
        total += first * second
    return total
