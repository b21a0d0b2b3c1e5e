"""Reasons to doubt that a contact is identified, which the retrospective laws report as their status.

The first that holds is reported, with p the peak force that the map predicts, scaled as in `retrospective`:

    unsure       fewer than FEW readings in contact
    too short    the hardware entered when LATE of the contact was over, pi/p its duration
    displaced    more than EARLY readings stood out of the noise before the hardware should be in contact; or,
                 once it is 24 ms deep, those of the first 10 ms are, but for chance, less than SOFTEST of
                 what a spring from there to the surface would push: its surface is nearer, or deeper, than
                 given
    noisy        the force that the map expects where it was read last has a standard deviation above WIDE p;
                 the sensor's dead zone is above HIDING p; the measured position's noise is above SHAKING: the
                 mean square of its second differences is 6 times its variance: the motion has hardly any
    identified   else

Contact that is as soft as a gap at first cannot be distinguished from a surface that is deeper than given.
"""

from math import pi, sqrt

from ..law_status import DISPLACED, IDENTIFIED, NOISY, TOO_SHORT, UNSURE
from .force_depth_map import KNOTS, Curve

FEW = 5
LATE = 0.5
EARLY = 2
SHALLOW, DEEP = 3, 5  # the knots at 10 and 24 ms of depth
SOFTEST = 0.25
WIDE = 0.01
HIDING = 0.1
SHAKING = 0.0005  # s, over the approach speed


class Doubts:
    """What is counted of one contact."""

    __slots__ = (
        "_depth", "_force", "_position", "_shallow", "_step", "_swings", "_swung", "_variance", "early",
        "late", "readings",
    )  # fmt: skip

    def __init__(self) -> None:
        self.start(0.0, 0.0)
        self.restart()

    def start(self, position: float, stride: float) -> None:
        """The run begins in uniform motion: the position [m] before its first, by a tick's stride [m]."""
        self._position = position
        self._step = stride

    def restart(self) -> None:
        """Another contact."""
        self.early = 0  # readings that stood out of the noise before the hardware should be in contact
        self.readings = 0  # in contact
        self.late = 0.0  # by how much [s] the hardware enters after the numerical model
        self._swings = 0.0
        self._swung = 0.0
        self._shallow = 0
        self._force = 0.0
        self._depth = 0.0
        self._variance = 0.0

    def move(self, position: float) -> None:
        """The position [m] measured at this tick."""
        step = position - self._position
        swing = step - self._step
        self._swings += swing * swing
        self._swung += 1.0
        self._position = position
        self._step = step

    def read(self, depth: float, deepest: float, force: float, variance: float) -> None:
        """A reading in contact: its depth and the deepest point so far [s], the force [1/s], its variance."""
        self.readings += 1
        if deepest <= KNOTS[SHALLOW]:
            self._shallow += 1
            self._force += force
            self._depth += depth
            self._variance += variance

    def status(
        self, curve: Curve, peak: float, deepest: float, variance: float, zone: float, speed: float
    ) -> int:
        """By the map's `curve` and peak force [1/s], the hardware's deepest point [s], the expected force's
        variance [1/s^2], the dead zone [1/s] and the approach speed [m/s]."""
        if self.readings < FEW:
            return UNSURE
        if self.late * peak > LATE * pi:
            return TOO_SHORT
        if self.early > EARLY or (deepest >= KNOTS[DEEP] and self._is_deeper(curve)):
            return DISPLACED
        wide = WIDE * peak
        shaking = SHAKING * speed
        hides = zone > HIDING * peak
        if hides or variance > wide * wide or self._swings > 6.0 * self._swung * (shaking * shaking):
            return NOISY
        return IDENTIFIED

    def _is_deeper(self, curve: Curve) -> bool:
        if self._shallow < FEW:
            return False
        slope = curve.at_knots[DEEP] / KNOTS[DEEP]
        return self._force + 2.0 * sqrt(self._variance) < SOFTEST * (slope * self._depth)
