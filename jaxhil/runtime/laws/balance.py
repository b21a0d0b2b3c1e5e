"""Whether the readings are those of contact that the map can be: what they tell of energy, onset and turning.

W, the energy that the contact took, is the integral of the force that was read over the way, less what the
map stores between the ends of that; L is what the map dissipates. With p the map's peak force, no contact
that is known explains that

- W and L differ by more than OFF and chance: the restitution errs by their difference;
- W is beyond that, no more than a force delay wrong by DELAY makes of it, and the force at the onset is less
  than DAMPER of a damper's that takes W: it is taken without a jump at the onset;
- as the hardware turns, until its speed is TURNING, readings are less than expected by MISSING p in the mean
  and chance: friction.

Chance is three standard deviations of the noise. Scaled as in `force_depth_map`, energies over mass and the
square of the approach speed.
"""

from math import pi, sqrt

from .force_depth_map import OUTLYING, REACH, Curve, turning

OFF = 0.014
DAMPER = 0.7
DELAY = 0.004  # s
TURNING = -0.15
MISSING = 0.045
SHALLOW = 0.25  # of the deepest point: the contact is nearly over


class Balance:
    """Sums over the readings of one contact while it pushes."""

    __slots__ = (
        "_begun", "_depth", "_first", "_force", "_gained", "_last", "_lost", "_missing", "_rate", "_released",
        "_spread", "_terms", "_turned", "_variance", "_work",
    )  # fmt: skip

    def __init__(self) -> None:
        self._first = 0.0  # depth where they begin [s]
        self._last = 0.0  # and where they end [s]
        self._depth = 0.0  # of the last reading, as it was taken for [s]
        self._rate = 0.0
        self._force = 0.0
        self._terms = (0.0, 0.0, 0.0, 0.0)  # of what dissipates
        self.restart()

    def restart(self) -> None:
        """Another contact."""
        self._work = 0.0  # the integral of the force over depth
        self._gained = 0.0  # and over speed
        self._variance = 0.0  # of the work
        self._lost = (0.0, 0.0, 0.0, 0.0)  # the integrals over depth of what dissipates
        self._missing = 0.0  # by how much less than expected the readings at the turning were [1/s]
        self._spread = 0.0  # the variance of that [1/s^2]
        self._turned = 0.0  # how many they are
        self._begun = False
        self._released = False  # whether the contact pushes no more

    def take(
        self,
        curve: Curve,
        given: float,
        less: float,
        rate: float,
        deepest: float,
        force: float,
        variance: float,
        known: float,
    ) -> None:
        """A reading that the curve has not learnt from: depth [s], by how much less [s] that counts, speed,
        deepest point [s], force [1/s], its variance and that of what was expected last [1/s^2]."""
        depth = given - less
        expected = curve.force(depth, rate, deepest)
        pushes = rate > 0.0 or expected > 0.0 or force * force > OUTLYING * variance
        if not (depth > 0.0 and pushes):
            self._released = self._begun and rate < 0.0
            return
        terms = (rate, depth * rate / REACH, depth - deepest, turning(rate))
        if self._begun:
            way = given - self._depth
            mean = 0.5 * (self._force + force)
            self._work += mean * way
            self._gained += mean * (rate - self._rate)
            self._variance += variance * way * way
            ends = zip(self._lost, self._terms, terms, strict=True)
            self._lost = tuple(lost + 0.5 * (before + now) * way for lost, before, now in ends)
        else:
            self._first = depth
        self._begun = True
        self._released = False
        self._last = depth
        self._depth = given
        self._rate = rate
        self._force = force
        self._terms = terms
        if 0.0 > rate > TURNING:
            self._missing += expected - force
            # Of readings that no sensor makes, rounding leaves less than nothing.
            self._spread += variance + known if known > 0.0 else variance
            self._turned += 1.0

    def unexplained(self, curve: Curve, peak: float, deepest: float, shift: float, pace: float) -> bool:
        """Whether the map that makes this curve, of this peak force [1/s], does not explain what was read;
        the force is older by `shift` [s] than it was taken for, time slower by `pace` than usual."""
        over = self._begun and self._rate < 0.0 and (self._released or self._last < SHALLOW * deepest)
        missing = MISSING * (peak * self._turned) + 3.0 * sqrt(self._spread)
        return self._missing > missing or (over and self._unequal(curve, peak, shift, pace))

    def _unequal(self, curve: Curve, peak: float, shift: float, pace: float) -> bool:
        """Whether the energy of a contact that is nearly over is not explained."""
        between = curve.stored(self._last) - curve.stored(self._first)
        taken = self._work - shift * self._gained - between
        lost = self._lost
        dissipated = (
            curve.damping * lost[0]
            + curve.depth_damping * lost[1]
            + curve.unloading * lost[2]
            + curve.friction * lost[3]
        )
        off = OFF + 3.0 * sqrt(self._variance)
        onset = curve.at_knots[0] + curve.damping + curve.friction
        damper = 2.0 / pi * (taken * peak)
        most = 0.5 * pi * (peak * (DELAY * pace))
        if taken - dissipated > off or taken - dissipated < -off:
            return True
        return off < taken < most and onset < DAMPER * damper
