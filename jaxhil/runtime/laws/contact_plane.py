"""Where a surface is expected: carried from contact to contact, as each finds it anew."""

from math import sqrt

LATE = 0.25  # how uncertain the surface is, of the ticks until it was found
DRIFT = 1e-6  # m, from contact to contact
ELSEWHERE = 25.0  # times the variance of where it is expected


class ContactPlane:
    """By how much a surface is deeper than told."""

    __slots__ = ("place", "spread")

    def __init__(self, spread: float) -> None:
        self.place = 0.0  # where it is expected [m]
        self.spread = spread  # of that [m]

    def learn(self, low: float, high: float, age: int) -> None:
        """It was met between two places [m], so many ticks before that was found."""
        width = high - low
        late = LATE * float(age)
        found = width * width * (1.0 / 12.0 + late * late)
        known = self.spread * self.spread
        middle = 0.5 * (low + high)
        away = middle - self.place
        elsewhere = away * away > ELSEWHERE * (known + found)
        self.place = middle if elsewhere else self.place + away * (known / (known + found))
        self.spread = sqrt((found if elsewhere else known * found / (known + found)) + DRIFT * DRIFT)
