"""Alignment of the measured position with the force: position and velocity as old as the force reading."""

from ..filters import DelayLine


class Alignment:
    """The hardware's position and velocity as old as the force, which is read this `delay` [s] late."""

    __slots__ = ("_last", "_line", "_middle", "_period", "_share")

    def __init__(self, delay: float, period: float) -> None:
        # The line delays by a tick less, so that the speed can be a difference about the middle.
        whole = delay > period
        self._period = period
        self._line = DelayLine(delay - period, period) if whole else None
        self._share = 1.0 if whole else delay / period
        self._middle = 0.0
        self._last = 0.0

    def step(self, position: float, velocity: float, begins: bool) -> tuple[float, float]:
        """Position [m] and velocity [m/s], of a position measured at this tick [m]; a run `begins` in uniform
        motion at this velocity [m/s]."""
        period = self._period
        line = self._line
        newest = position
        if line is not None:
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
