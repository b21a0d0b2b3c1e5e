"""The readings of a tick as the retrospective laws use them: as old as one another, and how noisy."""

from ..filters import DelayLine

SEEN = 8.0  # differences between readings that show how noisy the force is
OUTSTANDING = 32.0  # times the noise's variance: what hardly is noise


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


class ForceNoise:
    """How noisy the force is: as told, or as differences between readings out of contact show if that is
    more."""

    __slots__ = ("_before", "_count", "_known", "_shown_before", "_squares")

    def __init__(self, deviation: float) -> None:
        self._known = deviation * deviation
        self.restart()

    def restart(self) -> None:
        """Before the first tick of a run."""
        self._squares = 0.0
        self._count = 0.0
        self._before = 0.0
        self._shown_before = False

    @property
    def variance(self) -> float:
        """The force's variance [N^2]."""
        seen = self._squares / (self._count if self._count > 0.0 else 1.0)
        return seen if seen > self._known else self._known

    def take(self, force: float, shown: bool, free: bool) -> None:
        """A reading [N]: whether the sensor showed it, whether the hardware is `free`."""
        step = force - self._before
        if (
            free
            and shown
            and self._shown_before
            and not (self._count >= SEEN and step * step > OUTSTANDING * self.variance)
        ):
            self._squares += 0.5 * (step * step)
            self._count += 1.0
        self._before = force
        self._shown_before = shown
