"""What the hardware shows of a contact, moved to the times of the reference motion.

The numerical model and the hardware enter the contact at two moments, both between two ticks. The reference
motion counts its ticks from the model's entry, so the hardware's samples are moved, straight between two of
them, to the same times after the hardware's own entry.
"""

from math import floor

from .reintegration import ReferenceMotion


class HardwareSamples:
    """The samples of one contact, moved into the history of `reference`."""

    __slots__ = (
        "_deepest", "_depth", "_force", "_fraction", "_impulse", "_moved", "_moved_shown", "_offset",
        "_period", "_read", "_reference", "_shown", "_speed", "_ticks", "first",
    )  # fmt: skip

    def __init__(self, reference: ReferenceMotion, period: float) -> None:
        self._reference = reference
        self._period = period
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.begin(0.0, 0.0, True, 0.0, 0.0)
        self._fraction = 0.0
        self._offset = 0
        self._ticks = 0
        self._impulse = 0.0
        self._read = 0.0
        self._moved = 0.0
        self._moved_shown = True

    def begin(self, first: float, force: float, shown: bool, depth: float, speed: float) -> None:
        """The numerical model has entered `first` [s] ago; the sample before this tick's."""
        self.first = first  # time of the first tick after the numerical model's entry [s]
        self._force = force
        self._shown = shown
        self._depth = depth
        self._speed = speed
        self._deepest = 0.0

    def enter(self, depth: float, speed: float) -> None:
        """The hardware has entered: at this tick it is at this depth [s], with this speed."""
        period = self._period
        since = 0.5 * period
        if speed > 0.0:
            since = depth / speed
            if not since <= period:
                since = period
        shift = (self.first - since) / period
        whole = floor(shift)
        self._fraction = shift - whole
        self._offset = -1 - whole
        self._ticks = 0

    def take(
        self, entered: bool, force: float, shown: bool, depth: float, speed: float, deepest: float
    ) -> None:
        """This tick's sample: force [1/s], whether the sensor shows it, depth [s], speed, deepest point [s].

        It goes into the history once the hardware has `entered`.
        """
        if entered:
            fraction = self._fraction
            before = self._force
            moved = before + fraction * (force - before)
            moved_shown = shown and self._shown
            index = self._ticks + self._offset
            self._ticks += 1
            if index == 0:
                ticks = self.first / self._period if moved_shown else 0.0
                self._impulse = 0.5 * moved * ticks
                self._read = ticks
            elif index > 0 and moved_shown and self._moved_shown:
                self._impulse += 0.5 * (self._moved + moved)
                self._read += 1.0
            self._moved = moved
            self._moved_shown = moved_shown
            if index >= 0:
                before_depth = self._depth
                before_speed = self._speed
                before_deepest = self._deepest
                self._reference.remember(
                    index,
                    self._impulse,
                    self._read,
                    before_depth + fraction * (depth - before_depth),
                    before_speed + fraction * (speed - before_speed),
                    before_deepest + fraction * (deepest - before_deepest),
                )
        self._force = force
        self._shown = shown
        self._depth = depth
        self._speed = speed
        self._deepest = deepest
