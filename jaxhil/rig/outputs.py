"""Limits of the outputs: the force on the numerical model and the position command to the drives.

Both guards continue from their last output, so that no output jumps at a trip or a reset. At the beginning
of a run the position command continues from the measured position. After a trip the force ramps to 0 and the
position command brakes. In contact, or nearer to a surface than `free_distance`, the position command moves
away at `retreat_velocity`; then it comes to rest.
"""

from math import isfinite

from jaxhil.rig.faults import (
    COMMAND_NOT_FINITE,
    FORCE_LIMIT,
    FORCE_SLEW,
    MODEL_NOT_FINITE,
    STROKE,
    VELOCITY_LIMIT,
)
from jaxhil.rig.surfaces import deflection
from jaxhil.rig.types import Limits, Positive


class ForceGuard:
    """Guard of the force on the numerical model: magnitude (`force_limit`) and rate (`force_slew`).

    Attributes:
        output: last force [N].
        fatal: bits of the last command's faults that trip the controller.
    """

    __slots__ = ("_limit", "_limited_ticks", "_max_change", "_max_limited_ticks", "fatal", "output")

    def __init__(self, limits: Limits, period: Positive) -> None:
        self._limit = limits["force_limit"]
        self._max_change = limits["force_slew"] * period
        self._max_limited_ticks = limits["limited_in_a_row"]
        self.output = 0.0
        self.restart()

    def restart(self) -> None:
        """Forget the faults; the next command continues from the last output."""
        self._limited_ticks = 0
        self.fatal = 0

    def limit(self, command: float) -> int:
        """Move the output to the command [N] as far as the limits allow; return the fault bits."""
        self.fatal = 0
        if not isfinite(command):
            self.fatal = COMMAND_NOT_FINITE
            return COMMAND_NOT_FINITE
        if abs(command) > self._limit:
            self.fatal = FORCE_LIMIT
            return FORCE_LIMIT
        if abs(command - self.output) <= self._max_change:
            self._limited_ticks = 0
            self.output = command
            return 0
        self._limited_ticks += 1
        if self._limited_ticks > self._max_limited_ticks:
            self.fatal = FORCE_SLEW
        else:
            self.output = _move_towards(self.output, command, self._max_change)
        return FORCE_SLEW

    def fade(self) -> None:
        """Move the output towards 0 by the largest step that `force_slew` allows in one period."""
        self.output = _move_towards(self.output, 0.0, self._max_change)


class PositionGuard:
    """Guard of the position command: range (stroke) and rate (`velocity_limit`).

    Two successive commands differ by at most one period's travel at `velocity_limit`. A run's first command
    may differ from the measured position by at most this travel. If the model is out of contact, the limit is
    `start_distance` instead, because moving drives lag behind. A command may be outside the stroke only on
    the way back into the stroke.

    Attributes:
        output: last command [m].
        has_output: whether there is a last command.
        at_rest: whether the position command has come to rest after a trip.
        fatal: bits of the last command's faults that trip the controller.
    """

    __slots__ = (
        "_braking", "_clearance", "_distance", "_engaged", "_highest", "_limited_ticks", "_lowest",
        "_max_change", "_max_limited_ticks", "_rate", "_retreat", "_start", "at_rest", "fatal", "has_output",
        "output",
    )  # fmt: skip

    def __init__(self, limits: Limits, period: Positive, clearance: float) -> None:
        self._clearance = clearance
        self._lowest = limits["command_lowest"]
        self._highest = limits["command_highest"]
        self._max_change = limits["velocity_limit"] * period
        self._braking = limits["deceleration"] * period * period
        self._retreat = limits["retreat_velocity"] * period
        # In a narrow gap, the position command comes to rest in the middle.
        distance, middle = limits["free_distance"], 0.5 * clearance
        self._distance = distance if distance < middle else middle
        self._max_limited_ticks = limits["limited_in_a_row"]
        self._start = limits["start_distance"]
        self.output = 0.0
        self.has_output = False
        self.restart()

    def restart(self) -> None:
        """Forget the faults; the rate limit does not trip before the output first reaches a command."""
        self._limited_ticks = 0
        self._engaged = False
        self._rate = 0.0
        self.at_rest = False
        self.fatal = 0

    def release(self) -> None:
        """Forget the last output, after something else has moved the drives."""
        self.has_output = False
        self.restart()

    def limit(self, command: float, position: float, measured: float, is_fresh: bool) -> int:
        """Move the output to the command as far as the limits allow; return the fault bits.

        Args:
            command: position command [m].
            position: position of the numerical model [m].
            measured: last measured position of the drives [m]; NaN if there is none.
            is_fresh: whether `measured` was measured in this run.
        """
        self.fatal = 0
        if not isfinite(command):
            self.fatal = MODEL_NOT_FINITE
            return MODEL_NOT_FINITE
        if command < self._lowest or command > self._highest:
            self.fatal = STROKE
            return STROKE
        if not self.has_output:
            # Moving drives lag behind. Without a reading, assume that they are at the model's position.
            is_near = abs(command - (measured if is_fresh else position)) <= self._start
            if is_near and deflection(position, self._clearance) == 0.0:
                self.has_output = True
                self.output = command
            else:
                self._stand(measured, position)
        before = self.output
        if abs(command - before) <= self._max_change:
            self._engaged = True
            self._limited_ticks = 0
            self._rate = command - before
            self.output = command
            return 0
        if self._engaged:
            self._limited_ticks += 1
            if self._limited_ticks > self._max_limited_ticks:
                self.fatal = VELOCITY_LIMIT
                return VELOCITY_LIMIT
        self.output = _move_towards(before, command, self._max_change)
        self._rate = self.output - before
        return VELOCITY_LIMIT

    def retreat(self, measured: float, position: float) -> None:
        """Retreat from a near surface, or brake to a standstill, for one period after a trip.

        Args:
            measured: last measured position of the drives [m]; NaN if there is none.
            position: position of the numerical model [m].
        """
        if not self.has_output:
            self._stand(measured, position)
        output = self.output
        target_rate = 0.0
        if output > -self._distance:
            target_rate = -self._retreat
        elif output < self._distance - self._clearance:
            target_rate = self._retreat
        rate = self._rate
        change = target_rate - rate
        if change > self._braking:
            rate += self._braking
        elif change < -self._braking:
            rate -= self._braking
        else:
            rate = target_rate
        moved = output + rate
        # An output outside the stroke may move back into the stroke, but not further out.
        if moved < self._lowest and rate < 0.0:
            moved = output if output < self._lowest else self._lowest
            rate = 0.0
        elif moved > self._highest and rate > 0.0:
            moved = output if output > self._highest else self._highest
            rate = 0.0
        self._rate = rate
        self.output = moved
        self.at_rest = rate == 0.0 and target_rate == 0.0

    def _stand(self, measured: float, position: float) -> None:
        """Set the output to `measured` or, if `measured` is NaN, to a substitute.

        The substitute is `position`, moved out of contact if necessary, and then limited to the stroke.
        """
        self.has_output = True
        self.output = measured
        if isfinite(measured):
            return
        start = position
        if not isfinite(position) or position > 0.0:
            start = -self._distance
        elif position < -self._clearance:
            start = self._distance - self._clearance
        if start < self._lowest:
            start = self._lowest
        elif start > self._highest:
            start = self._highest
        self.output = start


def _move_towards(start: float, target: float, max_change: float) -> float:
    """Move from `start` towards `target` by at most `max_change`."""
    if target > start:
        moved = start + max_change
        return moved if moved < target else target
    moved = start - max_change
    return moved if moved > target else target
