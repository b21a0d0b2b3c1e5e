"""Whether readings are rather those of a force sensor that lags than what the map can be.

While the force lasts a lag takes away what a damper gives: of a contact with a damper the map then explains
all but how the force begins and ends, which is gradual. So the contact is identified a second time, from the
same prior, as a sensor with the time constant LAG would show it: what the force is linear in is smoothed
alike, and the surface was met where `lagged_onset` has it. Either is charged for every reading since before
the surface was met with (y - f)^2/s, f what it expects and s the variance of that and of the noise. Where the
lag is charged less by more than LIKELIER, twice the logarithm of odds, the map is not believed, if such a lag
makes the restitution err by more than MATTERS: in slow contact, whose onset is hardly known, it does not.
Scaled as in `force_depth_map`.
"""

from bisect import bisect_left
from math import ceil, inf, pi, sqrt

from .contact_plane import Meeting
from .force_depth_map import (
    JUMPS,
    KNOTS,
    PARAMETERS,
    REACH,
    SEGMENTS,
    SURFACE,
    ForceDepthMap,
    Prior,
    turning,
)
from .lagged_onset import BEFORE, FARTHEST, USUAL, WHOLE, lagged_onset
from .onset import SQUARINGS, exponential

LAG = 0.002  # s
LIKELIER = 6.0
MATTERS = 0.025  # of a restitution of 1

_SHARES = [min(knot / WHOLE, 1.0) for knot in KNOTS]


class LagCheck:
    """A contact as a lagging sensor would show it."""

    __slots__ = (
        "_before", "_below", "_deepest", "_held", "_kept", "_knots", "_lag", "_map", "_period", "_pushed",
        "_tick", "_widths", "earlier", "surprise",
    )  # fmt: skip

    def __init__(self, prior: Prior, period: float) -> None:
        self._period = period
        self._kept = exponential(period / LAG, SQUARINGS)  # of what it shows, after a tick
        self._map = ForceDepthMap(prior)
        self.earlier = ceil(LAG / period) + int(BEFORE)  # ticks before it was met, whose readings count
        self.surprise = 0.0  # what it is charged

    def matters(self, peak: float) -> bool:
        """Whether such a lag makes the restitution of contact of this peak force [1/s] err, by pi/2 p l."""
        return 0.5 * pi * (peak * self._lag) > MATTERS

    def begin(self, meeting: Meeting, depths: list[float], forces: list[float], variance: float) -> None:
        """A contact begins; the newest readings, at depths [s] beyond where the surface was met, forces [1/s]
        with a variance [1/s^2]."""
        length = meeting.speed / meeting.pace
        self._lag = LAG * meeting.pace
        self._tick = meeting.tick
        later, square = lagged_onset(self._lag, depths, forces, variance, meeting.tick)
        around = square + meeting.variance / (length * length)
        off = sqrt(around) if around > 0.0 else 0.0
        self._map.restart(USUAL * (meeting.stiffness * off))
        self._below = (meeting.place - meeting.plane) / length + later
        farther = min(max(-later, -FARTHEST), FARTHEST)
        self._knots = [knot + farther * share for knot, share in zip(KNOTS, _SHARES, strict=True)]
        self._widths = [end - knot for knot, end in zip(self._knots, [*self._knots[1:], inf], strict=True)]
        self._deepest = 0.0
        self._pushed = False  # whether the contact pushed
        self._held = [0.0] * PARAMETERS  # what is smoothed
        self._before = self._held  # as it was before that
        self.surprise = 0.0

    def take(self, depth: float, rate: float, force: float, variance: float, shown: bool) -> None:
        """One reading: depth [s] and speed as old as the force, force [1/s], its variance [1/s^2], whether
        the sensor shows it."""
        depth -= self._below
        if depth > self._deepest:
            self._deepest = depth
        self._smooth(depth, rate)
        if not shown:
            return
        pressed = self._held[: bisect_left(self._knots, self._deepest)]
        others = self._held[SEGMENTS:]
        if self._pushed:
            self.surprise += self._map.learn(pressed, others, rate > 0.0, force, variance)
        else:
            expected = self._map.expected(pressed, others)
            missed = force - (expected if expected > 0.0 else 0.0)
            self.surprise += missed * missed / variance

    def _smooth(self, depth: float, rate: float) -> None:
        """As a sensor that lags shows it: of what the force is linear in the mean over the tick, from the
        entry on where that is within it, as long as the contact pushes."""
        now = [
            (width if depth - knot > width else depth - knot) if depth > knot else 0.0
            for knot, width in zip(self._knots, self._widths, strict=True)
        ]
        others = [rate, depth * rate / REACH, depth - self._deepest, turning(rate), 1.0]
        pushes = depth > SURFACE and (rate > 0.0 or self._map.expected(now, others) > 0.0)
        now += others
        lost = self._kept
        before = self._before
        if pushes and not self._pushed:
            since = depth / rate if rate > 0.0 else 0.0
            lost = exponential((since if since < self._tick else self._tick) / self._lag, SQUARINGS)
            before = [now[place] if place in JUMPS else 0.0 for place in range(PARAMETERS)]
        kept = self._kept
        if pushes or self._pushed:
            half = 0.5 * (1.0 - lost)
            self._held = [
                kept * held + half * (then + this)
                for held, then, this in zip(self._held, before, now, strict=True)
            ]
        else:
            self._held = [kept * held for held in self._held]
        self._before = now
        self._pushed = pushes
