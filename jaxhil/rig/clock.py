"""Guard of the times of the ticks: early, late and missed ticks, and a clock that parts from the ticks."""

from math import inf, isfinite

from jaxhil.rig.faults import CLOCK, EARLY_TICK, LATE_TICK, MISSED_TICK
from jaxhil.rig.types import Limits, NonNegative, Positive

MOST_MISSED = 1_000_000  # periods counted for one gap, so that a wild clock stays a small number
LONGEST_GAP = 1.5  # periods since the last tick beyond which a tick is missing
DRIFT_KEPT = 0.99  # of the clock's drift from one tick to the next: it is forgotten over 100 ticks
MOST_DRIFT = 1.5  # periods: a clock that runs 1.5 % fast or slow comes to it, jitter does not


class Clock:
    """The times of the ticks: which came early or late, and how many were missed.

    Attributes: `missed` and `late`, ticks counted; `fatal`, whether the last tick's fault trips.
    """

    __slots__ = (
        "_awaited", "_drift", "_early_gap", "_in_a_row", "_late_gap", "_missing", "_period", "_time",
        "_tolerated", "fatal", "late", "missed",
    )  # fmt: skip
    _period: Positive

    def __init__(self, limits: Limits, period: Positive) -> None:
        self._period = period
        self._missing = LONGEST_GAP * period
        self._late_gap = (1.0 + limits["late_fraction"]) * period
        self._early_gap = (1.0 - limits["late_fraction"]) * period
        self._tolerated = limits["missed_in_a_row"]
        self.reset()

    def reset(self) -> None:
        """Forget the last tick and the counts."""
        self.missed = 0
        self.late = 0
        self.pause()

    def pause(self) -> None:
        """Let the time until the next tick be any."""
        self._time = -inf
        self._drift = 0.0  # periods by which the clock has gone ahead of the ticks, with those missed
        self._awaited = 0  # ticks counted as missed that may yet come
        self._in_a_row = 0  # ticks missed since the last one in time
        self.fatal = False

    def tick(self, time: float) -> int:
        """The fault of a tick at `time` [s], 0 if it comes as it should."""
        self.fatal = False
        if not isfinite(time):
            self.fatal = True
            return CLOCK
        if self._time == -inf:  # the first tick
            self._time = time
            return 0
        gap = time - self._time
        if not gap > 0.0:
            self.fatal = True
            return CLOCK
        self._time = time
        periods = gap / self._period
        if gap > self._missing:
            return self._miss(periods)
        self._in_a_row = 0
        drift = DRIFT_KEPT * self._drift + (periods - 1.0)
        fault = 0
        if gap < self._early_gap:
            fault = EARLY_TICK
            if self._awaited:
                # It was late by more than half a period, not missed.
                self._awaited -= 1
                drift += 1.0
        else:
            self._awaited = 0
            if gap > self._late_gap:
                self.late += 1
                fault = LATE_TICK
        return self._part(drift, fault)

    def _miss(self, periods: NonNegative) -> int:
        """Count the ticks missed in a gap of so many periods; the fault."""
        left_out = MOST_MISSED - 1
        drift = 0.0
        if periods <= MOST_MISSED:
            left_out = int(periods + 0.5) - 1
            drift = DRIFT_KEPT * self._drift + (periods - 1.0 - left_out)
        self.missed += left_out
        self._awaited = left_out
        self._in_a_row += left_out
        self.fatal = self._in_a_row > self._tolerated
        return self._part(drift, MISSED_TICK)

    def _part(self, drift: float, fault: int) -> int:
        """Take note of the drift [periods]; the tick's fault, or that clock and ticks have parted."""
        self._drift = drift
        if abs(drift) > MOST_DRIFT:
            self.fatal = True
            return CLOCK
        return fault
