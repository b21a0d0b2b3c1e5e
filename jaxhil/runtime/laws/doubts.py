"""Reasons to doubt that a contact is identified, which the retrospective laws report as their status.

The first that holds is reported, with p the peak force that the map predicts, scaled as in `retrospective`:

    unsure       fewer than FEW readings in contact
    too short    the hardware entered when LATE of the contact was over, pi/p its duration
    displaced    the surface was found farther than FAR times the gain `plane_spread` from where it was told
    noisy        the force that the map expects where it was read last has a standard deviation above WIDE p;
                 the sensor's dead zone is above HIDING p; the measured position's noise is above SHAKING: the
                 mean square of its second differences is 6 times its variance: the motion has hardly any
    unexplained  the readings are not those of contact that the map can be (`balance`)
    identified   else
"""

from math import pi

from ..law_status import DISPLACED, IDENTIFIED, NOISY, TOO_SHORT, UNEXPLAINED, UNSURE

FEW = 5
LATE = 0.5
FAR = 3.0
WIDE = 0.01
HIDING = 0.1
SHAKING = 0.0005  # s, over the approach speed


class Doubts:
    """What is counted of one contact."""

    __slots__ = ("_position", "_step", "_swings", "_swung", "displaced", "late", "readings", "unexplained")

    def __init__(self) -> None:
        self.start(0.0, 0.0)
        self.restart()

    def start(self, position: float, stride: float) -> None:
        """The run begins in uniform motion: the position [m] before its first, by a tick's stride [m]."""
        self._position = position
        self._step = stride

    def restart(self) -> None:
        """Another contact."""
        self.readings = 0  # in contact
        self.late = 0.0  # by how much [s] the hardware enters after the numerical model
        self.displaced = False  # whether its surface is far from where it was told
        self.unexplained = False  # whether the readings are
        self._swings = 0.0
        self._swung = 0.0

    def move(self, position: float) -> None:
        """The position [m] measured at this tick."""
        step = position - self._position
        swing = step - self._step
        self._swings += swing * swing
        self._swung += 1.0
        self._position = position
        self._step = step

    def status(self, peak: float, variance: float, zone: float, speed: float) -> int:
        """By the map's peak force [1/s], the expected force's variance [1/s^2], the dead zone [1/s] and the
        approach speed [m/s]."""
        if self.readings < FEW:
            return UNSURE
        if self.late * peak > LATE * pi:
            return TOO_SHORT
        if self.displaced:
            return DISPLACED
        wide = WIDE * peak
        shaking = SHAKING * speed
        hides = zone > HIDING * peak
        if hides or variance > wide * wide or self._swings > 6.0 * self._swung * (shaking * shaking):
            return NOISY
        return UNEXPLAINED if self.unexplained else IDENTIFIED
