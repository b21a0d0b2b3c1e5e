"""Alignment of the measured position with the force: position and velocity as old as the force reading."""

from typing import Annotated

from jaxhil.rig.filters import DelayLine
from jaxhil.rig.types import Positive


class Alignment:
    """Position and velocity of the hardware, delayed like the force by `delay` [s]."""

    __slots__ = ("_is_late", "_last", "_line", "_middle", "_period", "_share")
    _line: Annotated[DelayLine, "identification_delay"]
    _period: Positive

    def __init__(self, delay: float, period: Positive) -> None:
        # The line delays by one tick less, so that the velocity can be a central difference.
        self._is_late = delay > period
        self._period = period
        # For a delay below one period the line exists but is not used.
        self._line = DelayLine(delay - period if self._is_late else 0.5 * period, period)
        self._share = 1.0 if self._is_late else delay / period
        self._middle = 0.0
        self._last = 0.0

    def step(self, position: float, velocity: float, begins: bool) -> tuple[float, float]:
        """Return delayed position [m] and velocity [m/s].

        `position` [m] is measured on this tick. A run `begins` in uniform motion at `velocity` [m/s].
        """
        period = self._period
        line = self._line
        newest = position
        if self._is_late:
            if begins:
                line.start(position, velocity)
            newest = line.step(position)
        if begins:
            stride = period * velocity
            self._middle = newest - stride
            self._last = newest - 2.0 * stride
        aligned = newest + self._share * (self._middle - newest)
        rate = (newest - self._last) / (2.0 * period)
        self._last = self._middle
        self._middle = newest
        return aligned, rate
