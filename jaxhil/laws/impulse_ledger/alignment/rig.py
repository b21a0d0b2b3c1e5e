"""Alignment: delays the measured position and velocity by the delay of the force measurement."""

from jaxhil.rig.filters import DelayLine
from jaxhil.rig.types import Positive


class Alignment:
    """Filter that delays the measured position and its rate by the force delay `delay` [s]."""

    __slots__ = ("_last", "_line", "_middle", "_period", "_share")
    _period: Positive

    def __init__(self, delay: float, period: Positive) -> None:
        self._period = period
        # The delay of the line is shorter by one tick, so that the velocity can be a central difference.
        self._line = DelayLine(max(delay - period, 0.0), period)
        self._share = min(delay / period, 1.0)
        self._middle = 0.0
        self._last = 0.0

    def step(self, position: float, velocity: float, begins: bool) -> tuple[float, float]:
        """Return the delayed position [m] and velocity [m/s] for the `position` measured on this tick [m].

        If a run `begins` on this tick, assume uniform motion at `velocity` [m/s] before this tick.
        """
        period = self._period
        if begins:
            self._line.start(position, velocity)
        newest = self._line.step(position)
        if begins:
            self._middle = newest - period * velocity
            self._last = newest - 2.0 * (period * velocity)
        aligned = newest + self._share * (self._middle - newest)
        rate = (newest - self._last) / (2.0 * period)
        self._last = self._middle
        self._middle = newest
        return aligned, rate
