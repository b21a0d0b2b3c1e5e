"""A force-depth map of unknown contact, identified while it lasts: slopes between knots, and dissipation.

f(x, v, x_m) = preload + sum_j slope_j clip(x - kappa_j, 0, kappa_{j+1} - kappa_j) + (damping + depth_damping
x/REACH) v - unloading (x_m - x) + friction v/sqrt(v^2 + SLOW^2) at x > 0, else 0; x_m is the deepest point so
far. Depth in s (over the approach speed), speed as a fraction of that speed, force in 1/s (over mass and
approach speed). All parameters start from a Gaussian prior and are identified by recursive least squares;
what dissipates counts with its mean given that it is not negative. Only segments that are pressed in enter
the sums.
"""

from bisect import bisect_left
from collections.abc import Sequence
from math import pi, sqrt
from typing import NamedTuple

KNOTS = (0.0, 0.003, 0.008, 0.015, 0.024, 0.034, 0.046, 0.06, 0.076, 0.1, 0.14, 0.2)
SEGMENTS = len(KNOTS)
DAMPING, DEPTH_DAMPING, UNLOADING, FRICTION, PRELOAD = range(SEGMENTS, SEGMENTS + 5)
OTHERS = 5
PARAMETERS = SEGMENTS + OTHERS
JUMPS = (DAMPING, FRICTION, PRELOAD)  # what begins with a jump
WANDERING = 0.03  # s of depth over which a slope wanders by its spread
BROAD = 0.092  # s of depth, beyond which slopes wander less and less
SLOW = 0.03  # speed at which friction turns
REACH = 0.03  # s of depth at which the depth damping is as strong as its name says
SURFACE = 1e-12  # s of depth: nearer than that is on the surface, which rounding does not decide
OUTLYING = 4.0  # times the noise's variance: a force that hardly is noise


class Prior(NamedTuple):
    """What is known before any reading.

    Slopes are N(stiffness, common^2 + wandering^2 wandered(min(kappa_i, kappa_j)) / 30 ms), what dissipates
    and the preload are N(0, spread^2)."""

    stiffness: float  # mean of the slopes [1/s^2]
    common: float  # how uncertain all slopes are together [1/s^2]
    wandering: float  # how far they differ from depth to depth [1/s^2]
    damping: float  # spread of the damping [1/s]
    depth_damping: float  # spread of the damping that grows with depth [1/s]
    unloading: float  # spread of what unloading takes away [1/s^2]
    friction: float  # spread of the friction [1/s]
    preload: float  # spread of the preload [1/s]

    def moments(self) -> tuple[list[float], list[list[float]]]:
        """Mean and covariance of all parameters."""
        common = self.common * self.common
        wandering = self.wandering * self.wandering
        rows = []
        for i in range(SEGMENTS):
            row = []
            for j in range(SEGMENTS):
                shared = wandered(KNOTS[i] if i < j else KNOTS[j])
                row.append(common + wandering * (shared / WANDERING))
            rows.append(row + [0.0] * OTHERS)
        others = (self.damping, self.depth_damping, self.unloading, self.friction, self.preload)
        for place, spread in enumerate(others):
            row = [0.0] * PARAMETERS
            row[SEGMENTS + place] = spread * spread
            rows.append(row)
        return [self.stiffness] * SEGMENTS + [0.0] * OTHERS, rows


class Curve:
    """What counts of a map."""

    __slots__ = ("at_knots", "damping", "depth_damping", "friction", "slopes", "unloading")

    def __init__(self) -> None:
        self.slopes = [0.0] * SEGMENTS  # [1/s^2]
        self.at_knots = [0.0] * SEGMENTS  # force there, at the first the preload [1/s]
        self.damping = 0.0  # [1/s]
        self.depth_damping = 0.0  # [1/s]
        self.unloading = 0.0  # [1/s^2]
        self.friction = 0.0  # [1/s]

    def take(self, other: "Curve") -> None:
        """Become equal to the other, whose lists are never changed."""
        self.slopes = other.slopes
        self.at_knots = other.at_knots
        self.damping = other.damping
        self.depth_damping = other.depth_damping
        self.unloading = other.unloading
        self.friction = other.friction

    def elastic(self, depth: float) -> float:
        """Force [1/s] that does not depend on how the contact came there, 0 out of contact."""
        segment = bisect_left(KNOTS, depth) - 1
        if segment < 0:
            return 0.0
        return self.at_knots[segment] + self.slopes[segment] * (depth - KNOTS[segment])

    def stored(self, depth: float) -> float:
        """What is stored at a depth [s]: the integral of `elastic`."""
        stored = 0.0
        for j in range(SEGMENTS):
            if not depth > KNOTS[j]:
                break
            through = j + 1 < SEGMENTS and depth > KNOTS[j + 1]
            width = (KNOTS[j + 1] if through else depth) - KNOTS[j]
            stored += (self.at_knots[j] + 0.5 * (self.slopes[j] * width)) * width
        return stored

    def force(self, depth: float, speed: float, deepest: float) -> float:
        """Force [1/s], 0 out of contact; the deepest point may be short of the depth."""
        if not depth > 0.0:
            return 0.0
        drag = (self.damping + self.depth_damping * depth / REACH) * speed
        back = deepest - depth if deepest > depth else 0.0
        return self.elastic(depth) + (drag + self.friction * turning(speed) - self.unloading * back)

    def peak_force(self) -> float:
        """Force [1/s] where a contact entered at speed 1 comes to rest without dissipation: that up to which
        int f dx = 1/2, at least 1. At knots where the map pulls the force counts as 0."""
        reached = self.at_knots[0] if self.at_knots[0] > 0.0 else 0.0
        energy = 0.0
        rise = self.slopes[SEGMENTS - 1]
        for j in range(SEGMENTS - 1):
            width = KNOTS[j + 1] - KNOTS[j]
            force = self.at_knots[j + 1]
            if not force > 0.0:
                force = 0.0
            more = energy + 0.5 * (reached + force) * width
            if not more < 0.5:
                rise = (force - reached) / width
                break
            reached = force
            energy = more
        square = reached * reached
        if rise > 0.0:
            square += 2.0 * rise * (0.5 - energy)
        return sqrt(square) if square > 1.0 else 1.0


class ForceDepthMap:
    """Mean and covariance of the slopes [1/s^2], damping and depth damping [1/s] and unloading [1/s^2]; the
    `curve` that counts; the `variance` [1/s^2] of the force that it expects where it was read last."""

    __slots__ = ("_covariance", "_estimate", "_prior_covariance", "_prior_estimate", "curve", "variance")

    def __init__(self, prior: Prior) -> None:
        self._prior_estimate, self._prior_covariance = prior.moments()
        self.curve = Curve()
        self.restart()

    def restart(self, preload: float = 0.0) -> None:
        """Return to the prior, to the spread of whose preload so much [1/s] is added."""
        self._estimate = list(self._prior_estimate)
        self._covariance = [list(row) for row in self._prior_covariance]
        self._covariance[PRELOAD][PRELOAD] += preload * preload
        self.variance = 0.0
        self._conclude()

    def update(self, depth: float, speed: float, deepest: float, force: float, variance: float) -> float:
        """One reading in contact, its noise of a `variance` [1/s^2]; `learn` of it."""
        others = (speed, depth * speed / REACH, depth - deepest, turning(speed), 1.0)
        surprise = self.learn(_pressed(depth), others, speed > 0.0, force, variance)
        self._conclude()
        return surprise

    def expected(self, pressed: Sequence[float], others: Sequence[float]) -> float:
        """phi.theta: the force [1/s] where segments are pressed in so far, as many as there are, and what
        else it is linear in."""
        total = 0.0
        for ramp, value in zip(pressed, self._estimate, strict=False):
            total += ramp * value
        for other, value in zip(others, self._estimate[SEGMENTS:], strict=True):
            total += other * value
        return total

    def learn(
        self, pressed: Sequence[float], others: Sequence[float], closes: bool, force: float, variance: float
    ) -> float:
        """One reading, if the contact `closes`, or the map or the reading tells of contact: g = P phi,
        s = variance + phi.g, theta += g (f - phi.theta)/s, P -= g g'/s. By how much it was missed, squared
        and over s; while nothing is expected, over the noise's variance."""
        estimate = self._estimate
        covariance = self._covariance
        expected = self.expected(pressed, others)
        nothing = not (closes or expected > 0.0)
        if nothing and not force * force > OUTLYING * variance:
            return force * force / variance
        g = []
        for row in covariance:
            product = 0.0
            for entry, ramp in zip(row, pressed, strict=False):
                product += entry * ramp
            for entry, other in zip(row[SEGMENTS:], others, strict=True):
                product += entry * other
            g.append(product)
        s = variance
        for ramp, value in zip(pressed, g, strict=False):
            s += ramp * value
        for other, value in zip(others, g[SEGMENTS:], strict=True):
            s += other * value
        if not s > 0.0:
            return 0.0
        share = 1.0 / s
        self.variance = variance * ((s - variance) * share)
        innovation = force - expected
        for i, row in enumerate(covariance):
            scaled = share * g[i]
            estimate[i] += scaled * innovation
            covariance[i] = [entry - scaled * other for entry, other in zip(row, g, strict=True)]
        return force * force / variance if nothing else innovation * innovation * share

    def _conclude(self) -> None:
        estimate = self._estimate
        covariance = self._covariance
        slopes = estimate[:SEGMENTS]
        reached = estimate[PRELOAD]
        at_knots = [reached] * SEGMENTS
        for j in range(1, SEGMENTS):
            reached += slopes[j - 1] * (KNOTS[j] - KNOTS[j - 1])
            at_knots[j] = reached
        curve = self.curve
        curve.slopes = slopes
        curve.at_knots = at_knots
        curve.damping = positive_mean(estimate[DAMPING], covariance[DAMPING][DAMPING])
        curve.depth_damping = positive_mean(estimate[DEPTH_DAMPING], covariance[DEPTH_DAMPING][DEPTH_DAMPING])
        curve.unloading = positive_mean(estimate[UNLOADING], covariance[UNLOADING][UNLOADING])
        curve.friction = positive_mean(estimate[FRICTION], covariance[FRICTION][FRICTION])


def wandered(depth: float) -> float:
    """Over how much depth [s] slopes have wandered at a depth [s]: beyond BROAD ever less, as
    (BROAD/depth)^4."""
    if not depth > BROAD:
        return depth
    ratio = BROAD / depth
    return BROAD * (4.0 - ratio * ratio * ratio) / 3.0


def turning(speed: float) -> float:
    """Which way a speed goes, from -1 to 1."""
    ratio = speed / SLOW
    return ratio / sqrt(1.0 + ratio * ratio)


def positive_mean(mean: float, variance: float) -> float:
    """The mean of N(mean, variance) given that it is not negative.

    That is s (t + phi(t)/Phi(t)), t = mean/s, phi and Phi the normal density and distribution, with Boyd's
    bound of Mills' ratio, (1 - Phi(u))/phi(u) = pi/((pi - 1) u + sqrt(u^2 + 2 pi)), exact at 0 and far out,
    and (1 + u^2/512)^-256 for the density's exponential.
    """
    if not variance > 0.0:
        return mean if mean > 0.0 else 0.0
    spread = sqrt(variance)
    ratio = mean / spread
    root = sqrt(ratio * ratio + 2.0 * pi)
    if not ratio > 0.0:
        # (ratio + root)/pi, without the cancellation far below 0.
        return spread * (2.0 / (root - ratio))
    mills = pi / ((pi - 1.0) * ratio + root)
    tail = 1.0 / (1.0 + ratio * ratio / 512.0)
    for _ in range(8):
        tail *= tail
    density = tail / sqrt(2.0 * pi)
    return spread * (ratio + density / (1.0 - density * mills))


def _pressed(depth: float) -> list[float]:
    """How far [s] each segment is pressed in, of those that are."""
    last = bisect_left(KNOTS, depth) - 1
    pressed = [KNOTS[j + 1] - KNOTS[j] for j in range(last)]
    pressed.append(depth - KNOTS[last])
    return pressed
