"""Checks of the inputs: sensor readings and the numerical model's motion.

The last good sensor reading replaces a bad reading. `InputGuard.check` returns the faults of a tick, and
stores in `fatal` the faults that trip the controller. The compensator then gets the attributes `force` and
`measured`.
"""

from math import inf, isfinite, nan

from jaxhil.rig.bounds import POSITIONS
from jaxhil.rig.faults import (
    FORCE_IN_FLIGHT,
    FORCE_NOT_FINITE,
    FORCE_OUT_OF_RANGE,
    FORCE_STUCK,
    MODEL_NOT_FINITE,
    POSITION_NOT_FINITE,
    POSITION_OUT_OF_RANGE,
    POSITION_STUCK,
)
from jaxhil.rig.types import Count, Limits, Positive

TARE_ROUNDING = 1e-9  # relative; limit on the rounding error of the mean of 1e6 equal readings


class Tare:
    """Tare of the force sensor: the bias is the mean of `tare_ticks` readings out of contact.

    Attributes:
        bias: force to subtract from every reading [N].
        fatal: whether the last tare failed.
    """

    __slots__ = (
        "_count", "_highest", "_limit", "_lowest", "_range", "_spread", "_sum", "_ticks", "bias", "fatal",
    )  # fmt: skip
    _count: Count

    def __init__(self, limits: Limits) -> None:
        self._ticks = limits["tare_ticks"]
        self._spread = limits["tare_spread"]
        self._limit = limits["bias_limit"]
        self._range = limits["force_range"]
        self.bias = 0.0
        self._begin()

    def _begin(self) -> None:
        self._count = 0
        self._sum = 0.0
        self._lowest = inf
        self._highest = -inf
        self.fatal = False

    def take(self, reading: float) -> bool:
        """Add a force reading [N]; return whether the tare has ended. If it has failed, `fatal` is True."""
        if not self._count < self._ticks:
            return True
        if self._count == 0:
            self._begin()
        self._count += 1
        self._sum += reading
        if reading < self._lowest:
            self._lowest = reading
        if reading > self._highest:
            self._highest = reading
        if not (isfinite(reading) and abs(reading) < self._range):
            self.fatal = True
        elif self._count < self._ticks:
            return False
        else:
            mean = self._sum / self._count
            spread = self._highest - self._lowest
            self.fatal = not (spread <= self._spread and abs(mean) <= self._limit and isfinite(mean))
            if not self.fatal:
                self.bias = mean
        return True

    def restart(self) -> None:
        """Begin a new tare at the next reading; keep the bias until the new tare succeeds."""
        self._begin()


class InputGuard:
    """Checks of sensor readings and model motion on each tick; `faults.FAULTS` lists the faults.

    Attributes:
        force: last good force reading minus the bias [N], for the compensator.
        measured: last good position reading [m], for the compensator.
        fatal: bits of the last tick's faults that trip the controller.
        located: last measured position of the drives [m]; NaN before the first reading.
        is_located: whether `located` is an in-range reading of this run.
    """

    __slots__ = (
        "_bad_forces", "_bad_positions", "_clearance", "_desired", "_force_limit", "_force_reading",
        "_force_stuck", "_force_travel", "_forces_in_flight", "_free_distance", "_free_force",
        "_free_ticks", "_has_reading", "_highest", "_lowest", "_max_bad", "_position_stuck",
        "_position_travel", "_range", "_settling", "fatal", "force", "is_located", "located", "measured",
    )  # fmt: skip

    def __init__(self, limits: Limits, period: Positive, clearance: float) -> None:
        self._clearance = clearance
        self._range = limits["force_range"]
        self._lowest = limits["measured_lowest"]
        self._highest = limits["measured_highest"]
        self._max_bad = limits["held_readings"]
        self._force_stuck = limits["force_stuck_travel"]
        self._position_stuck = limits["position_stuck_travel"]
        self._free_distance = limits["free_distance"]
        self._free_force = limits["free_force"]
        self._settling = limits["settling"] / period
        self.located = nan
        self.is_located = False
        self.restart()

    def restart(self) -> None:
        """Forget past readings and counts of bad readings, but keep `located`, the last valid position."""
        self._has_reading = False
        self._bad_forces = 0
        self._bad_positions = 0
        self._forces_in_flight = 0
        self._free_ticks = 0
        self._force_reading = 0.0
        self._force_travel = 0.0
        self._position_travel = 0.0
        self._desired = 0.0
        self.force = 0.0
        self.measured = 0.0
        self.fatal = 0

    def locate(self, position: float) -> None:
        """Store the measured position of the drives [m], also after a trip; ignore a reading out of range.

        Until the run's first in-range reading, accept every reading in the wider range `bounds.POSITIONS`.
        """
        if self._lowest <= position <= self._highest:
            self.is_located = True
            self.located = position
        elif not self.is_located and POSITIONS[0] <= position <= POSITIONS[1]:
            self.located = position

    def check(self, reading: float, desired: float, velocity: float, position: float, bias: float) -> int:
        """Check the inputs of one tick; return the bits of all faults.

        Args:
            reading: force reading [N].
            desired: position of the numerical model [m].
            velocity: velocity of the numerical model [m/s].
            position: position reading [m].
            bias: bias of the force sensor [N].
        """
        if not (isfinite(desired) and isfinite(velocity)):
            self.fatal = MODEL_NOT_FINITE
            return MODEL_NOT_FINITE
        faults = 0
        self.fatal = 0
        is_first = not self._has_reading
        if is_first:
            # Before the first tick there is no reading: assume no force and the desired position.
            self._has_reading = True
            self._desired = desired
            self.measured = desired
            self._force_reading = inf

        before = self.measured
        if isfinite(position) and self._lowest <= position <= self._highest:
            self._bad_positions = 0
            if position == before:
                faults = self._same_position(abs(desired - self._desired))
            else:
                self._position_travel = 0.0
            self.measured = position
        else:
            faults = self._bad_position(position, is_first)
        self._desired = desired
        measured = self.measured

        if isfinite(reading) and abs(reading) < self._range:
            self._bad_forces = 0
            self.force = reading - bias
            if reading == self._force_reading and (measured > 0.0 or measured < -self._clearance):
                faults |= self._same_force(measured - before if measured > 0.0 else before - measured)
            else:
                self._force_travel = 0.0
            self._force_reading = reading
        else:
            faults |= self._bad_force(reading)

        if measured < -self._free_distance and measured > self._free_distance - self._clearance:
            self._free_ticks += 1
        else:
            self._free_ticks = 0
        if self._free_ticks > self._settling and abs(self.force) > self._free_force:
            faults |= FORCE_IN_FLIGHT
            self._forces_in_flight += 1
            self.fatal |= FORCE_IN_FLIGHT if self._forces_in_flight > self._max_bad else 0
        else:
            self._forces_in_flight = 0
        return faults

    # Each rare case has its own function, so that a normal tick stays fast.

    def _bad_position(self, position: float, is_first: bool) -> int:
        # A bad reading on the first tick is fatal, because the position of the drives is unknown.
        fault = POSITION_OUT_OF_RANGE if isfinite(position) else POSITION_NOT_FINITE
        self._bad_positions += 1
        self.fatal |= fault if is_first or self._bad_positions > self._max_bad else 0
        return fault

    def _bad_force(self, reading: float) -> int:
        fault = FORCE_OUT_OF_RANGE if isfinite(reading) else FORCE_NOT_FINITE
        self._bad_forces += 1
        self.fatal |= fault if self._bad_forces > self._max_bad else 0
        return fault

    def _same_position(self, travel: float) -> int:
        """Count the `travel` [m] during a constant position reading; return `POSITION_STUCK` or 0."""
        self._position_travel += travel
        fault = POSITION_STUCK if self._position_travel > self._position_stuck else 0
        self.fatal |= fault
        return fault

    def _same_force(self, deeper: float) -> int:
        """Count the travel in contact [m] while the force reading is constant; return `FORCE_STUCK` or 0."""
        if abs(self.force) <= TARE_ROUNDING * abs(self._force_reading):
            # Without a force, a damped mechanism may move out of contact, but no mechanism moves deeper.
            travel = self._force_travel + deeper
            self._force_travel = travel if travel > 0.0 else 0.0
        else:
            self._force_travel += abs(deeper)
        fault = FORCE_STUCK if self._force_travel > self._force_stuck else 0
        self.fatal |= fault
        return fault
