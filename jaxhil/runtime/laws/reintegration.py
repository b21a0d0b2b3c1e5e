"""The motion that a contact should have had, integrated over again from its entry while the map improves.

Scaled as in `force_depth_map`: from depth 0 at speed 1, x' = v, v' = -f, f = F(x, v, x_m) + rho [y - F(X, V,
X_m)], until it separates: x <= 0, or v < 0 and f <= 0. The bracket is what was measured and the map does not
explain, as far as the hardware has been measured and y could be read; x_m and X_m are the deepest points so
far. By the velocity Verlet scheme, the damping implicit in the first half of a step and explicit in the
second (order 2), the bracket constant within a step. A pass from the entry makes a bounded number of steps
per tick; when it has caught up with the present it becomes the live motion, which until the next goes on tick
by tick under the newest map. Samples count by the hardware's ticks, the present lies between two of them.
"""

from math import floor

from .force_depth_map import REACH, Curve, turning
from .history import LEVELS, NO_SAMPLE, SLOTS, History, Sample

STRIDE = 24  # steps per tick of the pass from the entry
COARSE = 0.002  # s, the longest step of a pass where every sample is kept, at least a tick
LONGEST = (SLOTS - 2) * 4 ** (LEVELS - 1)  # ticks of a contact, up to which it is integrated over again


class Scales:
    """What the signals of a contact are scaled by."""

    __slots__ = ("_clearance", "bias", "length", "plane", "side", "speed", "weight")

    def __init__(self, clearance: float) -> None:
        self._clearance = clearance
        self.side = 0.0  # of the surface, 1 or -1
        self.plane = 0.0  # by how much it is deeper than told [m]
        self.speed = 1.0  # approach speed [m/s]
        self.length = 1.0  # that times the unit of time [m]
        self.weight = 1.0  # mass times the approach speed, over the unit of time [N]
        self.bias = 0.0  # of the force sensor [N]

    def beyond(self, position: float) -> float:
        """By how much [m] a position [m] is beyond the surface as told."""
        return -self._clearance - position if self.side < 0.0 else position

    def depth(self, position: float) -> float:
        """Depth [s] at a position [m]."""
        return (self.beyond(position) - self.plane) / self.length

    def rate(self, velocity: float) -> float:
        """Speed [1] at a velocity [m/s]."""
        return self.side * velocity / self.speed

    def force(self, force: float) -> float:
        """Force [1/s] of one that is read [N]."""
        return self.side * (force - self.bias) / self.weight


class Motion:
    """A motion under a `curve` of its own."""

    __slots__ = (
        "_expected",
        "_farthest",
        "_impulse",
        "_shown",
        "curve",
        "deepest",
        "depth",
        "force",
        "free",
        "speed",
    )

    def __init__(self) -> None:
        self.curve = Curve()
        self.enter(NO_SAMPLE)

    def enter(self, sample: Sample) -> None:
        """Depth 0, speed 1, at the hardware's last sample before its own entry."""
        self.depth = 0.0  # [s]
        self.speed = 1.0  # [1]
        self.deepest = 0.0  # point so far [s]
        self.force = 0.0  # without damping and friction [1/s]
        self.free = False  # whether it has separated
        self._impulse = sample.impulse
        self._shown = sample.shown
        self._farthest = 0.0  # deepest point of the hardware so far [s]
        self._expected = 0.0  # force of the map at the hardware's sample [1/s]

    def begin(self, curve: Curve) -> None:
        """Enter under this curve."""
        self.curve.take(curve)
        self.force = curve.at_knots[0]
        self._expected = curve.at_knots[0] + (curve.damping + curve.friction)

    def take(self, other: "Motion") -> None:
        """Become equal to the other."""
        self.depth = other.depth
        self.speed = other.speed
        self.deepest = other.deepest
        self.force = other.force
        self.free = other.free
        self._impulse = other._impulse
        self._shown = other._shown
        self._farthest = other._farthest
        self._expected = other._expected
        self.curve.take(other.curve)

    def missing(self, sample: Sample, scales: Scales, shift: float, deeper: float, ticks: float) -> float:
        """What was measured and the map does not explain, on the way to this sample: its mean [1/s] over so
        many ticks."""
        rate = scales.rate(sample.velocity)
        depth = scales.depth(sample.position) - (shift * rate + deeper)
        if depth > self._farthest:
            self._farthest = depth
        expected = self.curve.force(depth, rate, self._farthest)
        shown = sample.shown - self._shown
        part = shown if shown < ticks else ticks
        impulse = (sample.impulse - self._impulse) - scales.bias * shown
        gap = scales.side * impulse / scales.weight - part * (0.5 * (self._expected + expected))
        self._impulse = sample.impulse
        self._shown = sample.shown
        self._expected = expected
        return gap / ticks

    def advance(self, duration: float, missing: float) -> None:
        """Go on for so long [s] with so much force [1/s] beside the map's."""
        curve = self.curve
        speed = self.speed
        if self.free:
            self.depth += duration * speed
            return
        half = 0.5 * duration
        before = curve.damping + curve.depth_damping * self.depth / REACH
        rubbed = curve.friction * turning(speed)
        middle = (speed - half * (self.force + rubbed + missing)) / (1.0 + before * half)
        depth = self.depth + duration * middle
        drag = curve.damping
        force = 0.0
        rubbing = 0.0
        if depth > self.deepest:
            self.deepest = depth
        if depth > 0.0:
            drag += curve.depth_damping * depth / REACH
            rubbing = curve.friction * turning(middle)
            force = curve.elastic(depth) - curve.unloading * (self.deepest - depth)
        speed = middle - half * (force + rubbing + missing + drag * middle)
        self.depth = depth
        self.speed = speed
        self.force = force
        self.free = depth <= 0.0 or (speed < 0.0 and force + rubbing + missing + drag * speed <= 0.0)


class ReferenceMotion:
    """The `live` motion, and the pass behind it that is to take its place."""

    __slots__ = (
        "_behind", "_beyond", "_coarse", "_history", "_present", "_reached", "_since", "_start",
        "deeper", "entry", "live", "period", "replay", "scales", "shift",
    )  # fmt: skip

    def __init__(self, history: History, scales: Scales, period: float) -> None:
        self._history = history
        self.period = period  # of control [s], on the contact's scale of time
        self._coarse = 1  # ticks of a step where every sample is kept
        while 2.0 * float(self._coarse) * period <= COARSE * (1.0 + 1e-9):
            self._coarse *= 2
        self._behind = Motion()
        self.scales = scales
        self.live = Motion()
        self.replay = 0.0  # rho
        # The force is older by `shift` [s] than it was taken for, the surface `deeper` [s] than it was met:
        # the force belongs to the depth X - shift V - deeper.
        self.shift = 0.0
        self.deeper = 0.0
        self.begin(-1, NO_SAMPLE, 0.5, 0.0)

    def begin(self, entry: int, start: Sample, since: float, depth: float) -> None:
        """Before a tick at which the hardware has met the surface `since` [ticks] before the sample after
        that of the tick `entry`, the numerical model `depth` [s] ago: until the first pass is done, it should
        go on as it does."""
        ticks = depth / self.period - since
        ticks = ticks if ticks < LONGEST else float(LONGEST)
        whole = float(floor(ticks)) if ticks > 0.0 else 0.0
        self.entry = entry  # tick of the last sample before the hardware's own entry
        self._start = start
        self._reached = entry
        self._since = since
        self._present = entry + int(whole)
        self._beyond = ticks - whole if ticks > 0.0 else 0.0
        self._behind.enter(start)
        self.live.enter(start)
        self.live.depth = depth - self.period
        self.live.free = True

    def tick(self, curve: Curve) -> None:
        """One tick more, with the newest curve."""
        entry = self.entry
        self._present += 1
        whole = self._history.newest - entry < LONGEST
        if self._reached > entry or whole:
            if self._reached == entry:
                self._behind.begin(curve)
            self._pass()
        if self._reached == self._present:
            self._advance(self._behind, self._present, self._beyond)
            self.live.take(self._behind)
            self._behind.enter(self._start)
            self._reached = entry
        else:
            self.live.curve.take(curve)
            self._advance(self.live, self._present, 1.0)

    def _pass(self) -> None:
        for _ in range(STRIDE):
            reached = self._reached
            if not reached < self._present:
                break
            following = self._next(reached)
            ticks = float(following - reached)
            if reached == self.entry:
                ticks += self._since - 1.0
            self._reached = following
            self._advance(self._behind, following, ticks)

    def _next(self, index: int) -> int:
        """The sample to go on to: as far as is measured, one that is kept."""
        newest = self._history.newest
        stride = self._coarse
        if not index < newest:
            return min(index + stride, self._present)
        stride = max(stride, self._history.stride(index))
        return min(((index + 1) // stride + 1) * stride - 1, newest, self._present)

    def _advance(self, motion: Motion, index: int, ticks: float) -> None:
        """The motion to the sample `index`, over so many ticks."""
        missing = 0.0
        if index <= self._history.newest and ticks > 0.0:
            sample = self._history.recall(index)
            missing = self.replay * motion.missing(sample, self.scales, self.shift, self.deeper, ticks)
        motion.advance(ticks * self.period, missing)
