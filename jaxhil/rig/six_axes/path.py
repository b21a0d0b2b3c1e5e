"""Path of the pose commands, along which the rig retreats after a trip."""

from typing import Annotated

from jaxhil.rig.six_axes.vectors import AXES, Vector, angle, length
from jaxhil.rig.types import Index

POINTS = 256  # stored points of the path, a power of two
NEWEST_POINTS = POINTS - 1
MIN_TURN = 0.002  # lower bound of the rotation between two stored points [rad]


class CommandPath:
    """Stored points of the path of the pose commands; a new point overwrites the oldest.

    Args:
        spacing: distance from the newest point beyond which a command becomes a point [m].
        turn: rotation from the newest point beyond which a command becomes a point at any distance [rad].
        lever: distance that counts as much as a rotation of 1 rad [m].

    Attributes:
        count: number of points.
        newest: the newest point [m, rad].
    """

    __slots__ = ("_head", "_lengths", "_lever", "_points", "_spacing", "_turn", "count", "newest")
    _head: Index
    _lengths: Annotated[list[float], POINTS]  # length of the path up to each point [m]
    _points: Annotated[list[list[float]], POINTS, AXES]
    count: int
    newest: Vector

    def __init__(self, spacing: float, turn: float, lever: float) -> None:
        self._lever = lever
        self._spacing = spacing
        self._turn = max(turn, MIN_TURN)
        self._points = [[0.0] * AXES for _ in range(POINTS)]
        self._lengths = [0.0] * POINTS
        self.clear()

    def clear(self) -> None:
        """Remove all points of the path."""
        self.count = 0
        self._head = 0
        self.newest = [0.0] * AXES

    def record(self, pose: Vector) -> None:
        """Add a command [m, rad] if its distance or rotation from the newest point is large enough."""
        travelled = 0.0
        if self.count > 0:
            if length(pose, self.newest) <= self._spacing and angle(pose, self.newest) <= self._turn:
                return
            before: Index = self._head
            travelled = self._lengths[before] + self.distance(pose, self.newest)
            self._head = (self._head + 1) & NEWEST_POINTS
        head: Index = self._head
        self._points[head] = list(pose)
        self._lengths[head] = travelled
        self.newest = list(pose)
        if self.count < POINTS:
            self.count += 1

    def drop(self) -> None:
        """Remove the newest point."""
        if self.count == 0:
            return
        self.count -= 1
        self._head = (self._head - 1) & NEWEST_POINTS
        head: Index = self._head
        self.newest = list(self._points[head])

    def distance(self, pose: Vector, other: Vector) -> float:
        """Return the distance of two poses or, if larger, the lever times their relative rotation [m]."""
        return max(length(pose, other), self._lever * angle(pose, other))

    def length_back(self) -> float:
        """Return the length of the path from the newest to the oldest point [m]."""
        if self.count == 0:
            return 0.0
        head: Index = self._head
        oldest: Index = (self._head - (self.count - 1)) & NEWEST_POINTS
        return self._lengths[head] - self._lengths[oldest]
