"""Limits of the outputs: the force on the numerical model and the position command to the drives.

Both guards continue from their last output, so that neither a trip nor a reset makes it jump. At the
beginning of a run the position command continues from the measured position. After a trip the force ramps to
0. The position command brakes; in contact, or nearer to a surface than `free_distance`, it moves away at
`retreat_velocity`; then it comes to rest.
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
    """Limiter of the force on the numerical model (`force_limit`) and of its change (`force_slew`).

    Attributes:
        output: last force [N].
        fatal: bits of the faults that trip.
    """

    __slots__ = ("_cut", "_cut_tolerated", "_limit", "_most", "fatal", "output")

    def __init__(self, limits: Limits, period: Positive) -> None:
        self._limit = limits["force_limit"]
        self._most = limits["force_slew"] * period
        self._cut_tolerated = limits["limited_in_a_row"]
        self.output = 0.0
        self.restart()

    def restart(self) -> None:
        """Forget the faults; the next command continues from the last output."""
        self._cut = 0
        self.fatal = 0

    def limit(self, command: float) -> int:
        """Move the output to the command [N] as far as the limits allow; return the faults."""
        self.fatal = 0
        if not isfinite(command):
            self.fatal = COMMAND_NOT_FINITE
            return COMMAND_NOT_FINITE
        if abs(command) > self._limit:
            self.fatal = FORCE_LIMIT
            return FORCE_LIMIT
        if abs(command - self.output) <= self._most:
            self._cut = 0
            self.output = command
            return 0
        self._cut += 1
        if self._cut > self._cut_tolerated:
            self.fatal = FORCE_SLEW
        else:
            self.output = _towards(self.output, command, self._most)
        return FORCE_SLEW

    def fade(self) -> None:
        """Move the output towards 0 as far as `force_slew` allows."""
        self.output = _towards(self.output, 0.0, self._most)


class PositionGuard:
    """Limiter of the position command (stroke) and of its change (`velocity_limit`).

    Two commands in a row differ by at most what the velocity limit allows in a period. A run's first command
    differs as little from the measured position; out of contact, where moving drives lag behind, it may
    differ by `start_distance`. A command is outside the stroke only on the way back into it.

    Attributes:
        output: last command [m].
        known: whether there has been a command.
        at_rest: whether the last command after a trip did not move.
        fatal: bits of the faults that trip.
    """

    __slots__ = (
        "_braking", "_clearance", "_cut", "_cut_tolerated", "_distance", "_engaged", "_highest", "_lowest",
        "_most", "_rate", "_retreat", "_start", "at_rest", "fatal", "known", "output",
    )  # fmt: skip

    def __init__(self, limits: Limits, period: Positive, clearance: float) -> None:
        self._clearance = clearance
        self._lowest = limits["command_lowest"]
        self._highest = limits["command_highest"]
        self._most = limits["velocity_limit"] * period
        self._braking = limits["deceleration"] * period * period
        self._retreat = limits["retreat_velocity"] * period
        # In a narrow gap the safest position is the middle.
        distance, middle = limits["free_distance"], 0.5 * clearance
        self._distance = distance if distance < middle else middle
        self._cut_tolerated = limits["limited_in_a_row"]
        self._start = limits["start_distance"]
        self.output = 0.0
        self.known = False
        self.restart()

    def restart(self) -> None:
        """Forget the faults; changes may be cut without limit until the output reaches the next command."""
        self._cut = 0
        self._engaged = False
        self._rate = 0.0
        self.at_rest = False
        self.fatal = 0

    def release(self) -> None:
        """Forget the last output, because the drives have been moved by other means."""
        self.known = False
        self.restart()

    def limit(self, command: float, position: float, measured: float, is_fresh: bool) -> int:
        """Move the output to the command as far as the limits allow; return the faults.

        Args:
            command: position to command [m].
            position: position of the numerical model [m].
            measured: last measured position of the drives [m]; NaN if there is none.
            is_fresh: whether that measurement is of this run.
        """
        self.fatal = 0
        if not isfinite(command):
            self.fatal = MODEL_NOT_FINITE
            return MODEL_NOT_FINITE
        if command < self._lowest or command > self._highest:
            self.fatal = STROKE
            return STROKE
        if not self.known:
            # Moving drives lag behind. Without a reading the drives are assumed at the model's position.
            near = abs(command - (measured if is_fresh else position)) <= self._start
            if near and deflection(position, self._clearance) == 0.0:
                self.known = True
                self.output = command
            else:
                self._stand(measured, position)
        before = self.output
        if abs(command - before) <= self._most:
            self._engaged = True
            self._cut = 0
            self._rate = command - before
            self.output = command
            return 0
        if self._engaged:
            self._cut += 1
            if self._cut > self._cut_tolerated:
                self.fatal = VELOCITY_LIMIT
                return VELOCITY_LIMIT
        self.output = _towards(before, command, self._most)
        self._rate = self.output - before
        return VELOCITY_LIMIT

    def retreat(self, measured: float, position: float) -> None:
        """Move the output by one period on the way to rest out of contact; arguments as in `limit`."""
        if not self.known:
            self._stand(measured, position)
        output = self.output
        wanted = 0.0
        if output > -self._distance:
            wanted = -self._retreat
        elif output < self._distance - self._clearance:
            wanted = self._retreat
        rate = self._rate
        change = wanted - rate
        if change > self._braking:
            rate += self._braking
        elif change < -self._braking:
            rate -= self._braking
        else:
            rate = wanted
        moved = output + rate
        # An output outside the stroke may come back, but does not move further out.
        if moved < self._lowest and rate < 0.0:
            moved = output if output < self._lowest else self._lowest
            rate = 0.0
        elif moved > self._highest and rate > 0.0:
            moved = output if output > self._highest else self._highest
            rate = 0.0
        self._rate = rate
        self.output = moved
        self.at_rest = rate == 0.0 and wanted == 0.0

    def _stand(self, measured: float, position: float) -> None:
        """Begin at the measured position; without one, at the model's, moved into stroke and free space."""
        self.known = True
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


def _towards(start: float, target: float, most: float) -> float:
    """Return the value nearest to the target that differs by at most `most` from the start."""
    if target > start:
        moved = start + most
        return moved if moved < target else target
    moved = start - most
    return moved if moved > target else target
