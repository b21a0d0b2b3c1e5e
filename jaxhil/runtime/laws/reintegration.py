"""The reference motion: what a contact should have made of the numerical model, had nothing been late.

From depth 0 at speed 1 (speeds over the approach speed, forces over mass times approach speed):

    x' = v,   v' = -f,   f = F(x, v, x_m) + rho [y - F(X, V, X_m)]

F is the force-depth map; y is the measured force, X and V are the hardware's depth and speed at that force,
x_m and X_m the deepest points so far. The bracket counts only as far as the hardware has been measured. The
motion ends where it separates: x <= 0, or v < 0 and f <= 0. The map improves while the contact lasts: so the
motion is integrated over again from the entry, in passes of up to `STRIDE` steps per tick. One that has
caught up with the present becomes the live motion, which goes on tick by tick under the newest map, and the
next pass starts. How it is stepped: `jaxhil/compensators/reintegration.py`.
"""

from math import floor

from .force_depth_map import REACH, Curve

STRIDE = 24  # steps per tick of the pass from the entry
COARSE = 0.002  # s, the longest step of that pass, at least a tick
HISTORY = 1024  # samples kept; a longer contact is not integrated over again


class Path:
    """A motion, at one sample."""

    __slots__ = ("curve", "deepest", "depth", "expected", "force", "free", "impulse", "read", "speed")

    def __init__(self) -> None:
        self.curve = Curve()  # the map that it moves under
        self.enter()

    def enter(self) -> None:
        """Begin at depth 0 with speed 1."""
        self.depth = 0.0  # [s]
        self.speed = 1.0  # as a fraction of the approach speed
        self.deepest = 0.0  # point so far [s]
        self.force = 0.0  # without damping [1/s]
        self.impulse = 0.0  # integral of the measured force since the entry, at its sample there [ticks/s]
        self.read = 0.0  # over how many ticks that is
        self.expected = 0.0  # the map's force at the measured sample [1/s]
        self.free = False  # whether it has separated

    def take(self, other: "Path") -> None:
        """Go on from where the other is."""
        self.depth = other.depth
        self.speed = other.speed
        self.deepest = other.deepest
        self.force = other.force
        self.impulse = other.impulse
        self.read = other.read
        self.expected = other.expected
        self.free = other.free


class ReferenceMotion:
    """The live motion and the pass behind it."""

    __slots__ = (
        "_behind", "_coarse", "_deepest", "_depths", "_first", "_impulses", "_number", "_period", "_present",
        "_reached", "_reads", "_speeds", "live", "replay", "shift",
    )  # fmt: skip

    def __init__(self, period: float) -> None:
        self.replay = 0.0  # rho
        # By how much [s] the force is older than it was taken for when samples were remembered: it belongs to
        # X - shift V.
        self.shift = 0.0
        self._period = period
        steps = COARSE / period
        self._coarse = floor(steps + 1e-9) if 1.0 < steps < HISTORY else (1 if steps <= 1.0 else HISTORY)
        self._impulses = [0.0] * HISTORY
        self._reads = [0.0] * HISTORY
        self._depths = [0.0] * HISTORY
        self._speeds = [0.0] * HISTORY
        self._deepest = [0.0] * HISTORY
        self.live = Path()  # where the numerical model should be by now, and how fast
        self._behind = Path()
        self.restart(0.0)

    def restart(self, first: float) -> None:
        """A contact whose sample 0, the next tick's, comes `first` [s] after its entry."""
        self._first = first
        self._number = 0
        self._present = -1
        self._reached = -1
        self._behind.enter()

    def remember(
        self, index: int, impulse: float, read: float, depth: float, speed: float, deepest: float
    ) -> None:
        """A measured sample: the integral since the entry [ticks/s] of the force that could be read, over how
        many ticks that is, depth [s], speed, deepest point so far [s]."""
        slot = index & (HISTORY - 1)
        self._impulses[slot] = impulse
        self._reads[slot] = read
        self._depths[slot] = depth
        self._speeds[slot] = speed
        self._deepest[slot] = deepest
        self._number = index + 1

    def tick(self, curve: Curve) -> None:
        """One tick of the live motion and of the pass."""
        present = self._present + 1
        self._present = present
        live = self.live
        behind = self._behind
        reached = self._reached
        if reached >= 0 or self._number <= HISTORY:
            if reached < 0:
                behind.curve.take(curve)
            reached = self._pass(behind, reached, present)
        if reached == present:
            live.take(behind)
            behind.enter()
            reached = -1
        else:
            live.curve.take(curve)
            self._advance(live, present, 1.0)
        self._reached = reached

    def _pass(self, behind: Path, reached: int, present: int) -> int:
        """Up to `STRIDE` steps from the sample `reached`; the one reached then."""
        coarse = self._coarse
        for _ in range(STRIDE):
            if reached >= present:
                break
            if reached < 0:
                reached = 0
                self._advance(behind, 0, self._first / self._period)
            else:
                jump = coarse if present - reached >= coarse else 1
                reached += jump
                self._advance(behind, reached, float(jump))
        return reached

    def _advance(self, path: Path, index: int, ticks: float) -> None:
        """The path to the sample `index`, over so many ticks."""
        curve = path.curve
        missing = 0.0
        if index < self._number and ticks > 0.0:
            slot = index & (HISTORY - 1)
            impulse = self._impulses[slot]
            read = self._reads[slot]
            speed = self._speeds[slot]
            expected = curve.force(self._depths[slot] - self.shift * speed, speed, self._deepest[slot])
            modelled = 0.5 * (path.expected + expected)
            gap = (impulse - path.impulse) - (read - path.read) * modelled
            missing = self.replay * (gap / ticks)
            path.impulse = impulse
            path.read = read
            path.expected = expected
        duration = ticks * self._period
        depth = path.depth
        if path.free:
            path.depth = depth + duration * path.speed
            return
        half = 0.5 * duration
        drag = curve.damping + curve.depth_damping * depth / REACH
        middle = (path.speed - half * (path.force + missing)) / (1.0 + drag * half)
        depth += duration * middle
        drag = curve.damping
        force = 0.0
        if depth > path.deepest:
            path.deepest = depth
        if depth > 0.0:
            drag += curve.depth_damping * depth / REACH
            force = curve.elastic(depth) - curve.unloading * (path.deepest - depth)
        speed = middle - half * (force + missing + drag * middle)
        path.depth = depth
        path.speed = speed
        path.force = force
        path.free = depth <= 0.0 or (speed < 0.0 and force + missing + drag * speed <= 0.0)
