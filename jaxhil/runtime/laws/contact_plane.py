"""Where a surface is expected: carried from contact to contact, as each finds it anew."""

from math import sqrt
from typing import NamedTuple

PER_TICK = 0.25  # how uncertain the surface is, of the ticks until it was found
DRIFT = 1e-6  # m, from contact to contact
ELSEWHERE = 25.0  # times the variance of where it is expected


class Meeting(NamedTuple):
    """A surface that was met."""

    plane: float  # by how much it counts as deeper than told, the force as old as the given delay says [m]
    place: float  # by how much it is by these readings alone [m]
    variance: float  # of that [m^2]
    speed: float  # at which it was met [m/s]
    pace: float  # seconds on the contact's scale of time in one [1]
    tick: float  # on that scale [s]
    stiffness: float  # the most that it may be, by three standard deviations [1/s^2]


class ContactPlane:
    """By how much a surface is deeper than told."""

    __slots__ = ("place", "spread")

    def __init__(self, spread: float) -> None:
        self.place = 0.0  # where it is expected [m]
        self.spread = spread  # of that [m]

    def learn(self, low: float, high: float, found: float) -> None:
        """It was met between two places [m], with the variance `found` [m^2]."""
        known = self.spread * self.spread
        middle = 0.5 * (low + high)
        away = middle - self.place
        elsewhere = away * away > ELSEWHERE * (known + found)
        self.place = middle if elsewhere else self.place + away * (known / (known + found))
        self.spread = sqrt((found if elsewhere else known * found / (known + found)) + DRIFT * DRIFT)


def found_variance(width: float, age: int) -> float:
    """Of a surface [m^2] that was met so many ticks before that was found, each of this width [m]."""
    late = PER_TICK * float(age)
    return width * width * (1.0 / 12.0 + late * late)
