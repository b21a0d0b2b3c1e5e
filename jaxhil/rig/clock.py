"""Monitor of the tick times: detects early, late and missed ticks, and a clock that is too fast or slow."""

from math import inf, isfinite

from jaxhil.rig.faults import CLOCK, EARLY_TICK, LATE_TICK, MISSED_TICK
from jaxhil.rig.types import Limits, NonNegative, Positive, SmallInt

MAX_MISSED = 1_000_000  # limit on the missed ticks of one gap [periods], because a clock may jump by any time
MAX_GAP = 1.5  # longest gap between two ticks without a missing tick [periods]
DRIFT_DECAY_FACTOR = 0.99  # per tick, so that past drift decays with a time constant of 100 ticks
MAX_DRIFT = 1.5  # drift [periods] that a clock 1.5 % fast or slow reaches, but jitter does not


class Clock:
    """Monitor of the tick times, with counts of missed and late ticks.

    Attributes:
        missed: number of missed ticks.
        late: number of late ticks.
        fatal: whether the last tick's fault trips the controller.
    """

    __slots__ = (
        "_awaited", "_drift", "_early_gap", "_in_a_row", "_late_gap", "_max_in_a_row", "_missing", "_period",
        "_time", "fatal", "late", "missed",
    )  # fmt: skip
    _period: Positive

    def __init__(self, limits: Limits, period: Positive) -> None:
        self._period = period
        self._missing = MAX_GAP * period
        self._late_gap = (1.0 + limits["late_fraction"]) * period
        self._early_gap = (1.0 - limits["late_fraction"]) * period
        self._max_in_a_row = limits["missed_in_a_row"]
        self.reset()

    def reset(self) -> None:
        """Set the counts of missed and late ticks to 0 and forget the last tick's time."""
        self.missed = 0
        self.late = 0
        self.pause()

    def pause(self) -> None:
        """Forget the last tick's time and the clock's drift, so that the next tick may come at any time."""
        self._time = -inf
        self._drift = 0.0  # periods by which the clock is ahead of the ticks, including missed ticks
        self._awaited = 0  # number of ticks counted as missed that may still arrive
        self._in_a_row = 0  # number of successive missed ticks
        self.fatal = False

    def tick(self, time: float) -> int:
        """Check a tick at `time` [s]; return its fault bit, 0 if the tick is on time."""
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
        drift = DRIFT_DECAY_FACTOR * self._drift + (periods - 1.0)
        fault = 0
        if gap < self._early_gap:
            fault = EARLY_TICK
            if self._awaited:
                # An earlier tick was counted as missed, but was only late by more than half a period.
                self._awaited -= 1
                drift += 1.0
        else:
            self._awaited = 0
            if gap > self._late_gap:
                self.late += 1
                fault = LATE_TICK
        return self._check_drift(drift, fault)

    def _miss(self, periods: NonNegative) -> int:
        """Count the missed ticks in a gap of `periods` control periods; return `MISSED_TICK` or `CLOCK`."""
        missed: SmallInt = MAX_MISSED - 1
        drift = 0.0
        if periods <= MAX_MISSED:
            missed = int(periods + 0.5) - 1
            drift = DRIFT_DECAY_FACTOR * self._drift + (periods - 1.0 - missed)
        self.missed += missed
        self._awaited = missed
        self._in_a_row += missed
        self.fatal = self._in_a_row > self._max_in_a_row
        return self._check_drift(drift, MISSED_TICK)

    def _check_drift(self, drift: float, fault: int) -> int:
        """Store the clock's drift [periods]; return `CLOCK` if the drift is too large, otherwise `fault`."""
        self._drift = drift
        if abs(drift) > MAX_DRIFT:
            self.fatal = True
            return CLOCK
        return fault
