"""Checks of the inputs: sensor readings and the numerical model's motion.

The last good sensor reading replaces a bad one. `InputGuard.check` returns the faults of a tick and stores
which of them trip; `force` and `measured` are then the inputs of the compensator.
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

TARE_ROUNDING = 1e-9  # relative; by this the mean of 1e6 equal readings may differ from them


class Tare:
    """Tare of the force sensor: its bias is the mean of `tare_ticks` readings out of contact.

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
        """Add a reading [N]; return whether the tare is over, successful or `fatal`."""
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
        """Let the next reading begin a new tare; the bias remains until that tare is over."""
        self._begin()


class InputGuard:
    """Guard of the inputs; see `faults.FAULTS` for its checks.

    Attributes:
        force: force of the last tick without bias [N], for the compensator.
        measured: measured position of the last tick [m], for the compensator.
        fatal: bits of the last tick's faults that trip.
        located: position where the drives were measured last [m]; NaN before.
        is_located: whether `located` is a reading of this run in range.
    """

    __slots__ = (
        "_bad_forces", "_bad_positions", "_clearance", "_desired", "_flight", "_force_limit",
        "_force_reading", "_force_stuck", "_force_travel", "_forces_in_flight", "_free_distance",
        "_free_force", "_held", "_highest", "_known", "_lowest", "_position_stuck", "_position_travel",
        "_range", "_settling", "fatal", "force", "is_located", "located", "measured",
    )  # fmt: skip

    def __init__(self, limits: Limits, period: Positive, clearance: float) -> None:
        self._clearance = clearance
        self._range = limits["force_range"]
        self._lowest = limits["measured_lowest"]
        self._highest = limits["measured_highest"]
        self._held = limits["held_readings"]
        self._force_stuck = limits["force_stuck_travel"]
        self._position_stuck = limits["position_stuck_travel"]
        self._free_distance = limits["free_distance"]
        self._free_force = limits["free_force"]
        self._settling = limits["settling"] / period
        self.located = nan
        self.is_located = False
        self.restart()

    def restart(self) -> None:
        """Forget the readings so far, but not where the drives were measured last."""
        self._known = False
        self._bad_forces = 0
        self._bad_positions = 0
        self._forces_in_flight = 0
        self._flight = 0
        self._force_reading = 0.0
        self._force_travel = 0.0
        self._position_travel = 0.0
        self._desired = 0.0
        self.force = 0.0
        self.measured = 0.0
        self.fatal = 0

    def locate(self, position: float) -> None:
        """Store where the drives are measured [m], also after a trip.

        Before a run's first reading in range, any reading that a rig can have is stored.
        """
        if self._lowest <= position <= self._highest:
            self.is_located = True
            self.located = position
        elif not self.is_located and POSITIONS[0] <= position <= POSITIONS[1]:
            self.located = position

    def check(self, reading: float, desired: float, velocity: float, position: float, bias: float) -> int:
        """Return the faults of a tick.

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
        first = not self._known
        if first:
            # Without a reading before the first tick, assume no force and the desired position.
            self._known = True
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
            faults = self._bad_position(position, first)
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
            self._flight += 1
        else:
            self._flight = 0
        if self._flight > self._settling and abs(self.force) > self._free_force:
            faults |= FORCE_IN_FLIGHT
            self._forces_in_flight += 1
            self.fatal |= FORCE_IN_FLIGHT if self._forces_in_flight > self._held else 0
        else:
            self._forces_in_flight = 0
        return faults

    # The unusual cases are functions of their own, so that a usual tick does not pay for them.

    def _bad_position(self, position: float, first: bool) -> int:
        # On the first tick there is no good reading yet, and the position of the drives is unknown.
        fault = POSITION_OUT_OF_RANGE if isfinite(position) else POSITION_NOT_FINITE
        self._bad_positions += 1
        self.fatal |= fault if first or self._bad_positions > self._held else 0
        return fault

    def _bad_force(self, reading: float) -> int:
        fault = FORCE_OUT_OF_RANGE if isfinite(reading) else FORCE_NOT_FINITE
        self._bad_forces += 1
        self.fatal |= fault if self._bad_forces > self._held else 0
        return fault

    def _same_position(self, travel: float) -> int:
        """Add the model's travel [m] under an unchanged position reading; return the fault."""
        self._position_travel += travel
        fault = POSITION_STUCK if self._position_travel > self._position_stuck else 0
        self.fatal |= fault
        return fault

    def _same_force(self, deeper: float) -> int:
        """Add the travel into contact [m] under an unchanged force reading; return the fault."""
        if abs(self.force) <= TARE_ROUNDING * abs(self._force_reading):
            # A damped mechanism may move out of contact without a force, but none moves deeper.
            travel = self._force_travel + deeper
            self._force_travel = travel if travel > 0.0 else 0.0
        else:
            self._force_travel += abs(deeper)
        fault = FORCE_STUCK if self._force_travel > self._force_stuck else 0
        self.fatal |= fault
        return fault
