"""Guard of the tick times: detects early, late and missed ticks, and a clock that drifts from the ticks."""

from math import inf, isfinite

from jaxhil.rig.faults import CLOCK, EARLY_TICK, LATE_TICK, MISSED_TICK
from jaxhil.rig.types import Limits, NonNegative, Positive, SmallInt

MAX_MISSED = 1_000_000  # periods; one gap counts no more, however wrong the clock is
MAX_GAP = 1.5  # periods; after a longer gap a tick is missing
DRIFT_DECAY_FACTOR = 0.99  # share of the clock's drift that remains after a tick: it decays over 100 ticks
MAX_DRIFT = 1.5  # periods; a clock that is 1.5 % fast or slow reaches it, jitter does not


class Clock:
    """Guard of the tick times.

    Attributes:
        missed: number of missed ticks.
        late: number of late ticks.
        fatal: whether the last tick's fault trips the controller.
    """

    __slots__ = (
        "_awaited", "_drift", "_early_gap", "_in_a_row", "_late_gap", "_missing", "_period", "_time",
        "_tolerated", "fatal", "late", "missed",
    )  # fmt: skip
    _period: Positive

    def __init__(self, limits: Limits, period: Positive) -> None:
        self._period = period
        self._missing = MAX_GAP * period
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
        """Accept any time until the next tick."""
        self._time = -inf
        self._drift = 0.0  # periods by which the clock is ahead of the ticks, missed ones included
        self._awaited = 0  # ticks counted as missed that may still arrive
        self._in_a_row = 0  # ticks missed one after another
        self.fatal = False

    def tick(self, time: float) -> int:
        """Return the fault of a tick at `time` [s], 0 if it is on time."""
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
                # A tick that was counted as missed was only late, by more than half a period.
                self._awaited -= 1
                drift += 1.0
        else:
            self._awaited = 0
            if gap > self._late_gap:
                self.late += 1
                fault = LATE_TICK
        return self._part(drift, fault)

    def _miss(self, periods: NonNegative) -> int:
        """Count the ticks missed in a gap of `periods` control periods; return the fault."""
        left_out: SmallInt = MAX_MISSED - 1
        drift = 0.0
        if periods <= MAX_MISSED:
            left_out = int(periods + 0.5) - 1
            drift = DRIFT_DECAY_FACTOR * self._drift + (periods - 1.0 - left_out)
        self.missed += left_out
        self._awaited = left_out
        self._in_a_row += left_out
        self.fatal = self._in_a_row > self._tolerated
        return self._part(drift, MISSED_TICK)

    def _part(self, drift: float, fault: int) -> int:
        """Store the drift [periods]; return the tick's fault, or `CLOCK` if the drift is too large."""
        self._drift = drift
        if abs(drift) > MAX_DRIFT:
            self.fatal = True
            return CLOCK
        return fault
