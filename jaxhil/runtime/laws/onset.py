"""Where the hardware's surface is: the tick from which on the force tells of contact.

While the numerical model flies freely, the hardware may have met the surface in any tick. Since then the
force would be y = b + B + K s, s the time since the middle of that tick, K ~ N(K0, s_K^2), B ~ N(0, s_B^2);
before, y = b, the sensor's bias. Its evidence against free flight throughout has a closed form in sums over
the readings; the surface is found when the evidence of the best tick, with how likely a surface is there,
exceeds e^CERTAIN. The surface is expected at a place with a spread s: of a distance d s from there its
density is 1/(pi s (1 + d^2)). The farther back, the fewer ticks are tried; beside the best of them all are,
by ever smaller steps. Scaled by approach speed and mass: forces in 1/s, K in 1/s^2.
"""

from collections.abc import Callable
from math import pi, sqrt
from typing import Any, NamedTuple

from .history import SLOTS

# Ticks since the surface was met that are tried first, what bounds them, and the steps from the best of them.
AGES = (1, 2, 3, 4, 5, 6, 8, 11, 16, 24, 36, 56, 88, 140, 224)
BOUNDS = (0, *AGES, 225)
STEPS = (32, 16, 8, 4, 2, 1)
STIFFNESS = 300.0  # K0 [1/s^2]
STIFFNESS_VARIANCE = 160000.0  # s_K^2 [1/s^4]
JUMP_VARIANCE = 36.0  # s_B^2 [1/s^2]
CERTAIN = 9.0
WAIT = 0.004  # s, and a tick, since the surface was met: then its stiffness shows
LONGEST_FLIGHT = 65536  # ticks of a flight up to which the sums are exact enough; then they begin anew
BESIDE = 8  # steps to both sides of what was found, together its age
SQUARINGS = 10


class Found(NamedTuple):
    """A surface."""

    age: int  # ticks since it was met
    evidence: float  # ln of that for it against none
    bias: float  # of the force [1/s]
    stiffness: float  # the most that it may be, by three standard deviations [1/s^2]
    earlier: float = 0.0  # ticks by which it was met before the middle of that tick, in the mean
    variance: float = 0.0  # of that, where the surface is not expected anywhere


class Onset:
    """The readings of a flight."""

    __slots__ = ("_period", "_sums", "_watched")

    def __init__(self, period: float) -> None:
        self._period = period
        self._sums = [(0.0, 0.0, 0.0, 0.0, 0.0)] * SLOTS
        self.restart()

    def restart(self) -> None:
        """A flight begins."""
        self._watched = 0
        self._sums[0] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def take(self, force: float, shown: bool) -> None:
        """One reading [1/s], and whether the sensor shows it."""
        if self._watched == LONGEST_FLIGHT:
            self.restart()
        sums = self._sums[self._watched % SLOTS]
        self._watched += 1
        if shown:
            number, ticks, squares, forces, moments = sums
            m = float(self._watched)
            sums = (number + 1.0, ticks + m, squares + m * m, forces + force, moments + m * force)
        self._sums[self._watched % SLOTS] = sums

    def find(self, noise: float, unknown: float, rarity: Callable[[int], float]) -> Found | None:
        """The surface, if the readings tell of one; `rarity` is of each age, for the rest see `suppose`."""
        best = None
        below = above = 0
        for place, age in enumerate(AGES):
            if age >= self._watched:
                break
            one = self.suppose(age, noise, unknown, rarity(age))
            if one.evidence > (best.evidence if best else CERTAIN):
                best = one
                below, above = BOUNDS[place], BOUNDS[place + 2]
        if best is None:
            return None
        for step in STEPS:
            middle = best.age
            for age in (middle - step, middle + step):
                if below < age < above and age < self._watched:
                    one = self.suppose(age, noise, unknown, rarity(age))
                    best = one if one.evidence > best.evidence else best
        waited = best.age > 1 and float(best.age) * self._period >= WAIT * (1.0 - 1e-9)
        return self._spread(best, noise, unknown) if waited else None

    def suppose(self, age: int, noise: float, unknown: float, rarity: float) -> Found:
        """What the readings say of a surface met `age` ticks ago.

        `noise` is the variance of a reading and `unknown` that of the bias [1/s^2]; a surface there is
        1/`rarity` as likely as none."""
        period = self._period
        number, all_ticks, all_squares, forces, moments = self._sums[self._watched % SLOTS]
        before, ticks_before, squares_before, forces_before, moments_before = self._sums[
            (self._watched - age) % SLOTS
        ]
        middle = float(self._watched - age) + 0.5
        known = before * unknown + noise
        bias = forces_before * unknown / known
        left = unknown * noise / known
        n = number - before
        ticks = (all_ticks - ticks_before) - middle * n
        squares = (all_squares - squares_before) - middle * (2.0 * (all_ticks - ticks_before) - middle * n)
        force = forces - forces_before
        moment = (moments - moments_before) - middle * force
        s = period * ticks
        y = force - bias * n
        p = noise / STIFFNESS_VARIANCE + period * period * squares
        jump = JUMP_VARIANCE + left
        r = noise / jump + n
        f = noise * (STIFFNESS / STIFFNESS_VARIANCE) + (period * moment - bias * s)
        determinant = p * r - s * s
        if not (y > 0.0 and determinant > 0.0):
            return Found(age, -CERTAIN, bias, 0.0)
        explained = (r * f * f - 2.0 * (s * f * y) + p * y * y) / determinant
        silence = noise + n * left
        occam = determinant * (STIFFNESS_VARIANCE * jump) / (noise * silence)
        prior = STIFFNESS * STIFFNESS / STIFFNESS_VARIANCE
        silent = y * y * left / (noise * silence)
        evidence = 0.5 * (explained / noise - prior - silent - logarithm(occam * rarity * rarity))
        stiffness = ((r * f - s * y) + 3.0 * sqrt(r * noise * determinant)) / determinant
        return Found(age, evidence, bias, stiffness)

    def _spread(self, found: Found, noise: float, unknown: float) -> Found:
        """With how much earlier the surface was met, by the ticks beside it."""
        most = self.suppose(found.age, noise, unknown, 1.0).evidence
        step = 1 + found.age // (2 * BESIDE)
        total = 1.0  # that of what was found
        mean = square = 0.0
        for i in range(-BESIDE, BESIDE + 1):
            age = found.age + i * step
            if i == 0 or age < 1 or age >= self._watched or age > AGES[-1]:
                continue
            evidence = self.suppose(age, noise, unknown, 1.0).evidence
            weight = exponential(most - evidence, SQUARINGS) if evidence > -CERTAIN else 0.0
            earlier = float(i * step)
            total += weight
            mean += weight * earlier
            square += weight * (earlier * earlier)
        mean /= total
        return found._replace(earlier=mean, variance=square / total - mean * mean)


def rarity(away: float, spread: float, width: float) -> float:
    """One over the probability of a surface in a stretch of this width, so far `away` from where it is
    expected."""
    distance = away / spread
    return pi * spread * (1.0 + distance * distance) / width


def logarithm(z: float) -> float:
    """ln z, of a positive number that is not extreme; by square roots alone, the same on every machine."""
    for _ in range(10):
        z = sqrt(z)
    return 2048.0 * (z - 1.0) / (z + 1.0)


def exponential(u: Any, squarings: int) -> Any:
    """(1 + u/n)^-n, n = 2^squarings: exp(-u), and less steep far out; of a number or of an array of them."""
    value = 1.0 / (1.0 + u / float(1 << squarings))
    for _ in range(squarings):
        value = value * value
    return value
