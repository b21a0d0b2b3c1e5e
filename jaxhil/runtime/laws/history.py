"""What was measured in a run, by tick.

Of the newest 255 ticks every sample is kept, of the 4 times as many before every 4th, then every 16th, 64th
and 256th: the last of each block of so many ticks.
"""

from typing import NamedTuple

SLOTS = 256
LEVELS = 5


class Sample(NamedTuple):
    """What was measured at a tick."""

    impulse: float  # integral since the run began of the force that the sensor showed [N ticks]
    shown: float  # over how many ticks that is
    position: float  # of the hardware, as old as the force [m]
    velocity: float  # likewise [m/s]


NO_SAMPLE = Sample(0.0, 0.0, 0.0, 0.0)


class History:
    """The samples of a run."""

    __slots__ = ("_forces", "_levels", "_shows", "newest")

    def __init__(self) -> None:
        self._levels = [[NO_SAMPLE] * SLOTS for _ in range(LEVELS)]
        self._forces = [0.0] * SLOTS
        self._shows = [False] * SLOTS
        self.restart()

    def restart(self) -> None:
        """Before the first tick of a run."""
        self.newest = -1  # tick

    def take(self, force: float, shows: bool, position: float, velocity: float) -> None:
        """One more tick: force [N], whether the sensor `shows` it, position [m] and velocity [m/s]."""
        impulse = 0.0
        shown = 0.0
        if self.newest >= 0:
            slot = self.newest % SLOTS
            before = self._levels[0][slot]
            impulse = before.impulse
            shown = before.shown
            if shows and self._shows[slot]:
                impulse += 0.5 * (self._forces[slot] + force)
                shown += 1.0
        self.newest += 1
        tick = self.newest
        sample = Sample(impulse, shown, position, velocity)
        for level, samples in enumerate(self._levels):
            samples[(tick >> (2 * level)) % SLOTS] = sample
        self._forces[tick % SLOTS] = force
        self._shows[tick % SLOTS] = shows

    def stride(self, tick: int) -> int:
        """How many ticks lie between the samples that are kept as old as that of `tick`."""
        age = self.newest - tick
        stride = 1
        while age >= (SLOTS - 1) * stride:
            stride *= 4
        return stride

    def recall(self, tick: int) -> Sample:
        """The sample of a tick that is kept."""
        stride = self.stride(tick)
        level = (stride.bit_length() - 1) // 2
        return self._levels[level][(tick // stride) % SLOTS]

    def reading(self, tick: int) -> tuple[float, bool]:
        """The force [N] at one of the newest 256 ticks, and whether the sensor showed it."""
        slot = tick % SLOTS
        return self._forces[slot], self._shows[slot]
