"""Contact model: a piecewise-linear force-penetration model with dissipation, fitted while contact lasts.

    f(x, v, x_m) = preload + sum_j hinge_j max(0, x - kappa_j)
                   + (damping + depth_damping x/REACH) v - unloading (x_m - x)
                   + friction v/sqrt(v^2 + SLOW^2)                              at x > 0, else 0

x is the depth, v the speed and x_m the largest depth so far. All values are scaled by the approach speed v0
and the equivalent mass M: depth x/v0 [s], speed v/v0 [1], force F/(M v0) [1/s]. The slope at a depth is the
sum of the hinges above it, so that slopes which change by independent amounts from knot to knot have a
diagonal prior covariance. The parameters theta are estimated by recursive least squares.

Sources: recursive least squares, Ljung, "System Identification" (1999), section 11.2; a parameter that is
zero with a given probability, Mitchell and Beauchamp, "Bayesian variable selection in linear regression"
(1988).
"""

from collections.abc import Sequence
from itertools import pairwise
from math import exp, pi, sqrt

# Depths [s] at which the slope may change.
KNOTS = (0.0, 0.003, 0.008, 0.015, 0.024, 0.034, 0.046, 0.06, 0.076, 0.1, 0.14, 0.2)
HINGES = len(KNOTS)
PARAMETERS = HINGES + 5
DAMPING, DEPTH_DAMPING, UNLOADING, FRICTION, PRELOAD = range(HINGES, PARAMETERS)
DISSIPATIVE = (DAMPING, DEPTH_DAMPING, UNLOADING)  # each zero or positive
WANDER = 0.03  # s; over this depth the slope changes by its prior spread
BROAD = 0.12  # s; beyond this depth the slope does not change
REACH = 0.03  # s; depth at which depth_damping counts like damping
SLOW = 0.03  # speed at which friction changes its sign
ZERO_PROBABILITY = 0.75  # prior probability that a dissipative parameter is zero
ODDS = ZERO_PROBABILITY / (2.0 * (1.0 - ZERO_PROBABILITY)) * sqrt(2.0 * pi)
LEAST_VARIANCE = 1e-12  # of a dissipative parameter; below it the parameter is known


def prior_variances(spreads: Sequence[float]) -> list[float]:
    """Return the prior variances of theta.

    `spreads` are the standard deviations of the slope at depth 0 [1/s^2], of its change over `WANDER`
    [1/s^2], of damping [1/s], depth damping [1/s], unloading [1/s^2], friction [1/s] and preload [1/s].
    """
    common, wander, *others = spreads
    variances = [common * common]
    for before, knot in pairwise(min(knot, BROAD) for knot in KNOTS):
        variances.append(wander * wander * ((knot - before) / WANDER))
    return variances + [spread * spread for spread in others]


def features(depth: float, speed: float, deepest: float) -> list[float]:
    """Return phi, with which the force is phi.theta; zeros out of contact."""
    if not depth > 0.0:
        return [0.0] * PARAMETERS
    phi = [depth - knot if depth > knot else 0.0 for knot in KNOTS]
    back = depth - deepest
    turning = speed / sqrt(speed * speed + SLOW * SLOW)
    return [*phi, speed, depth * speed / REACH, back if back < 0.0 else 0.0, turning, 1.0]


def force(theta: Sequence[float], depth: float, speed: float, deepest: float) -> float:
    """Return the force [1/s] of the parameters `theta`."""
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
    """Return the slope [1/s^2] at a depth, at least 0."""
    total = 0.0
    for hinge, knot in zip(theta, KNOTS, strict=False):
        if not depth > knot:
            break
        total += hinge
    return total if total > 0.0 else 0.0


class ContactModel:
    """Estimate of theta: mean and covariance, and the parameters that count.

    Attributes:
        mean: posterior mean of theta without the sign of what dissipates.
        covariance: posterior covariance of theta.
        theta: posterior mean of theta with what dissipates zero or positive.
    """

    __slots__ = ("_prior_mean", "_prior_variances", "covariance", "mean", "theta")

    def __init__(self, stiffness: float, spreads: Sequence[float]) -> None:
        self._prior_mean = [stiffness] + [0.0] * (PARAMETERS - 1)
        self._prior_variances = prior_variances(spreads)
        self.restart()

    def restart(self) -> None:
        """Return to the prior."""
        self.mean = list(self._prior_mean)
        self.theta = list(self._prior_mean)
        self.covariance = [[0.0] * PARAMETERS for _ in range(PARAMETERS)]
        for j, variance in enumerate(self._prior_variances):
            self.covariance[j][j] = variance

    def learn(self, phi: Sequence[float], force: float, variance: float) -> None:
        """Update the estimate with one reading of the force [1/s] whose noise has this variance [1/s^2]."""
        covariance = self.covariance
        column = [dot(row, phi) for row in covariance]
        total = variance + dot(phi, column)
        if not total > 0.0:
            return  # rounding has spoilt the covariance
        share = 1.0 / total
        innovation = share * (force - dot(phi, self.mean))
        self.mean = [mean + entry * innovation for mean, entry in zip(self.mean, column, strict=True)]
        for row, entry in zip(covariance, column, strict=True):
            scaled = share * entry
            row[:] = [old - scaled * other for old, other in zip(row, column, strict=True)]

    def conclude(self) -> None:
        """Compute `theta`: condition mean and covariance on the expected dissipative parameters."""
        theta = self.mean
        columns = [list(self.covariance[j]) for j in DISSIPATIVE]
        for index, j in enumerate(DISSIPATIVE):
            column = columns[index]
            variance = column[j]
            if not variance > LEAST_VARIANCE:
                continue
            change = (zero_or_positive(theta[j], variance, self._prior_variances[j]) - theta[j]) / variance
            theta = [mean + entry * change for mean, entry in zip(theta, column, strict=True)]
            for other in columns[index + 1 :]:
                share = other[j] / variance
                other[:] = [entry - share * own for entry, own in zip(other, column, strict=True)]
        self.theta = [
            value if not DAMPING <= j <= FRICTION or value > 0.0 else 0.0 for j, value in enumerate(theta)
        ]


def zero_or_positive(mean: float, variance: float, prior_variance: float) -> float:
    """Return the posterior mean of a parameter that is zero with `ZERO_PROBABILITY` or else positive.

    `mean` and `variance` are those of the posterior without this knowledge. The tail of the normal
    distribution is Boyd's bound of Mills' ratio, pi/((pi - 1) t + sqrt(t^2 + 2 pi)).
    """
    spread = sqrt(variance)
    ratio = mean / spread
    size = abs(ratio)
    mills = pi / ((pi - 1.0) * size + sqrt(size * size + 2.0 * pi))
    density = exp(-0.5 * (size * size)) / sqrt(2.0 * pi)
    odds = (
        ZERO_PROBABILITY / (2.0 * (1.0 - ZERO_PROBABILITY)) * sqrt(2.0 * pi) * sqrt(prior_variance / variance)
    )
    if ratio > 0.0:
        hazard = density / (1.0 - density * mills)
        return spread * (ratio + hazard) / (1.0 + odds * hazard)
    hazard = 1.0 / mills
    return spread * (hazard - size) / (1.0 + odds * hazard)


def dot(left: Sequence[float], right: Sequence[float]) -> float:
    """Return the sum of products, added from the first to the last."""
    total = 0.0
    for one, other in zip(left, right, strict=True):
        total += one * other
    return total
