"""A force-depth map of unknown contact, identified while it is met: slopes between knots, and damping.

f(x, v) = sum_j slope_j clip(x - kappa_j, 0, kappa_{j+1} - kappa_j) + damping v at x > 0, else 0. Depth in s
(over the approach speed), speed as a fraction of that speed, force in 1/s (over mass and approach speed).
Slopes and damping start from a Gaussian prior and are identified by recursive least squares. Only segments
that are pressed in enter the sums.
"""

from bisect import bisect_left
from math import pi, sqrt

KNOTS = (0.0, 0.002, 0.005, 0.01, 0.016, 0.024, 0.032, 0.04, 0.05, 0.062, 0.076, 0.092)
SEGMENTS = 12
WANDERING = 0.03  # s of depth over which a slope wanders by its spread
SHALLOWEST = 0.01  # s of depth by which it is judged how much has been learnt
OUTLYING = 4.0  # times the noise's variance: a force that hardly is noise


def segment_of(depth: float) -> int:
    """The segment that a depth [s] lies in; -1 out of contact."""
    return bisect_left(KNOTS, depth) - 1


class ForceDepthMap:
    """Mean and covariance of the slopes [1/s^2] and, last, the damping [1/s].

    Attributes of use outside: `slopes`, the force `at_knots` [1/s], and the `damping` [1/s] that counts, the
    mean given that it is not negative.
    """

    __slots__ = (
        "_common",
        "_covariance",
        "_damping_variance",
        "_estimate",
        "_prior_covariance",
        "_prior_estimate",
        "_wandering",
        "at_knots",
        "damping",
        "slopes",
    )

    def __init__(
        self,
        stiffness: float,
        common_spread: float,
        wandering_spread: float,
        damping: float,
        damping_spread: float,
    ) -> None:
        common = common_spread * stiffness
        wandering = wandering_spread * stiffness
        self._common = common * common
        self._wandering = wandering * wandering
        self._damping_variance = damping_spread * damping_spread
        self._prior_estimate = [stiffness] * SEGMENTS + [damping]
        rows = []
        for i in range(SEGMENTS):
            row = []
            for j in range(SEGMENTS):
                shared = KNOTS[i] if i < j else KNOTS[j]
                row.append(self._common + self._wandering * (shared / WANDERING))
            rows.append([*row, 0.0])
        self._prior_covariance = [*rows, [0.0] * SEGMENTS + [self._damping_variance]]
        self.at_knots = [0.0] * SEGMENTS
        self.restart()

    def restart(self) -> None:
        """Return to the prior."""
        self._estimate = list(self._prior_estimate)
        self._covariance = [list(row) for row in self._prior_covariance]
        self._conclude()

    def update(self, depth: float, speed: float, force: float, variance: float) -> None:
        """One reading in contact, its noise of a `variance` [1/s^2], if the map or the reading tells of
        contact: g = P phi, s = variance + phi.g, theta += g (f - phi.theta)/s, P -= g g'/s."""
        estimate = self._estimate
        covariance = self._covariance
        pressed = self._pressed(depth)
        expected = 0.0
        for j, ramp in enumerate(pressed):
            expected += ramp * estimate[j]
        expected += speed * estimate[SEGMENTS]
        if not (expected > 0.0 or force * force > OUTLYING * variance):
            return
        g = []
        for row in covariance:
            product = 0.0
            for entry, ramp in zip(row, pressed, strict=False):
                product += entry * ramp
            g.append(product + row[SEGMENTS] * speed)
        s = variance
        for j, ramp in enumerate(pressed):
            s += ramp * g[j]
        s += speed * g[SEGMENTS]
        if not s > 0.0:
            return
        share = 1.0 / s
        innovation = force - expected
        for i, row in enumerate(covariance):
            scaled = share * g[i]
            estimate[i] += scaled * innovation
            covariance[i] = [entry - scaled * other for entry, other in zip(row, g, strict=True)]
        self._conclude()

    def elastic(self, depth: float) -> float:
        """Force [1/s] without damping, 0 out of contact."""
        segment = bisect_left(KNOTS, depth) - 1
        if segment < 0:
            return 0.0
        return self.at_knots[segment] + self.slopes[segment] * (depth - KNOTS[segment])

    def force(self, depth: float, speed: float) -> float:
        """Force [1/s], 0 out of contact."""
        return self.elastic(depth) + self.damping * speed if depth > 0.0 else 0.0

    def learnt(self, depth: float, speed: float) -> float:
        """By which share the variance of the force at a depth, 10 ms or deeper, is less than the prior's."""
        if not depth > SHALLOWEST:
            depth = SHALLOWEST
        covariance = self._covariance
        pressed = self._pressed(depth)
        last = covariance[SEGMENTS]
        left = 0.0
        crossed = 0.0
        for i, ramp in enumerate(pressed):
            row = covariance[i]
            product = 0.0
            for entry, other in zip(row, pressed, strict=False):
                product += entry * other
            left += ramp * product
            crossed += ramp * (row[SEGMENTS] + last[i])
        left += speed * crossed + speed * last[SEGMENTS] * speed
        wandered = 0.0
        for j in range(1, len(pressed)):
            beyond = depth - KNOTS[j]
            wandered += (KNOTS[j] - KNOTS[j - 1]) / WANDERING * (beyond * beyond)
        before = (
            self._common * (depth * depth)
            + self._wandering * wandered
            + self._damping_variance * (speed * speed)
        )
        return 1.0 - left / before if before > 0.0 else 0.0

    def _pressed(self, depth: float) -> list[float]:
        """How far [s] each segment is pressed in, of those that are."""
        last = bisect_left(KNOTS, depth) - 1
        pressed = [KNOTS[j + 1] - KNOTS[j] for j in range(last)]
        pressed.append(depth - KNOTS[last])
        return pressed

    def _conclude(self) -> None:
        estimate = self._estimate
        slopes = estimate[:SEGMENTS]
        at_knots = [0.0] * SEGMENTS
        reached = 0.0
        for j in range(1, SEGMENTS):
            reached += slopes[j - 1] * (KNOTS[j] - KNOTS[j - 1])
            at_knots[j] = reached
        self.slopes = slopes
        self.at_knots = at_knots
        self.damping = positive_mean(estimate[SEGMENTS], self._covariance[SEGMENTS][SEGMENTS])


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
        return spread * ((ratio + root) / pi)
    mills = pi / ((pi - 1.0) * ratio + root)
    tail = 1.0 / (1.0 + ratio * ratio / 512.0)
    for _ in range(8):
        tail *= tail
    density = tail / sqrt(2.0 * pi)
    return spread * (ratio + density / (1.0 - density * mills))
