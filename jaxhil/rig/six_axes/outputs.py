"""Limits of the six-axis outputs: the wrench on the numerical model and the pose command to the drives.

`WrenchGuard` limits the wrench, and `PoseGuard` the pose command. After a trip or a reset, each guard
continues from its last output, so that no output jumps. At the beginning of a run the pose command continues
from the measured pose. After a trip the wrench ramps to 0, and the pose command brakes, retraces its path
backwards and comes to rest.
"""

from math import sqrt

from jaxhil.rig.faults import (
    COMMAND_NOT_FINITE,
    FORCE_LIMIT,
    FORCE_SLEW,
    MODEL_NOT_FINITE,
    STROKE,
    VELOCITY_LIMIT,
)
from jaxhil.rig.six_axes.path import POINTS, CommandPath
from jaxhil.rig.six_axes.vectors import AXES, COORDINATES, Vector, angle, is_finite, is_within, length
from jaxhil.rig.types import Bits, Limits, NonNegative, Positive

HEIGHT = 2  # index of z; the chaser leaves the target in this direction


class WrenchGuard:
    """Guard of the wrench on the numerical model: magnitude and rate of each channel.

    Attributes:
        output: last wrench [N, N m].
        fatal: bits of the last command's faults that trip the controller.
    """

    __slots__ = ("_limited_ticks", "_limits", "_max_change", "_max_limited_ticks", "fatal", "output")
    _limits: Vector
    _max_change: Vector
    fatal: Bits
    output: Vector

    def __init__(self, limits: Limits, period: Positive) -> None:
        self._limits = [*[limits["force_limit"]] * 3, *[limits["torque_limit"]] * 3]
        self._max_change = [*[limits["force_slew"] * period] * 3, *[limits["torque_slew"] * period] * 3]
        self._max_limited_ticks = limits["limited_in_a_row"]
        self.output = [0.0] * AXES
        self.restart()

    def restart(self) -> None:
        """Forget the faults; the next command continues from the last output."""
        self._limited_ticks = 0.0
        self.fatal = 0

    def limit(self, command: Vector) -> int:
        """Move the output to the command [N, N m] as far as the limits allow; return the fault bits."""
        self.fatal = 0
        if not is_finite(command):
            self.fatal = COMMAND_NOT_FINITE
            return COMMAND_NOT_FINITE
        is_slow = True
        for limit, max_change, value, last in zip(
            self._limits, self._max_change, command, self.output, strict=True
        ):
            if abs(value) > limit:
                self.fatal = FORCE_LIMIT
            is_slow = is_slow and abs(value - last) <= max_change
        if self.fatal:
            return FORCE_LIMIT
        if is_slow:
            self._limited_ticks = 0.0
            self.output = list(command)
            return 0
        self._limited_ticks += 1.0
        if self._limited_ticks > self._max_limited_ticks:
            self.fatal = FORCE_SLEW
        else:
            self._move(command)
        return FORCE_SLEW

    def fade(self) -> None:
        """Move the output towards 0 by the largest step that the rate limits allow in one period."""
        self._move([0.0] * AXES)

    def _move(self, target: Vector) -> None:
        """Move each channel towards the target by at most the step that the rate limits allow."""
        for i in range(AXES):
            change = target[i] - self.output[i]
            if abs(change) <= self._max_change[i]:
                self.output[i] = target[i]
            elif change > 0.0:
                self.output[i] += self._max_change[i]
            else:
                self.output[i] -= self._max_change[i]


class PoseGuard:
    """Guard of the pose command: range (stroke), and rate of translation and rotation.

    A command may be outside the stroke only on the way back into the stroke.

    Attributes:
        output: last command [m, rad].
        has_output: whether there is a last command.
        at_rest: whether the pose command has come to rest after a trip.
        fatal: bits of the last command's faults that trip the controller.
    """

    __slots__ = (
        "_back", "_braking", "_braking_turn", "_engaged", "_highest", "_limited_ticks", "_lowest",
        "_max_change", "_max_limited_ticks", "_max_turn", "_path", "_rate", "_remaining", "_retreat",
        "_retreat_distance", "_retreat_turn", "_share", "_start", "_start_angle", "at_rest", "fatal",
        "has_output", "output",
    )  # fmt: skip
    _braking: NonNegative
    _rate: Vector
    _lowest: Vector
    _highest: Vector
    fatal: Bits
    output: Vector

    def __init__(self, limits: Limits, period: Positive) -> None:
        self._lowest = [limits[f"command_lowest_{axis}"] for axis in COORDINATES]
        self._highest = [limits[f"command_highest_{axis}"] for axis in COORDINATES]
        self._max_change = limits["velocity_limit"] * period
        self._max_turn = limits["angular_velocity_limit"] * period
        self._braking = limits["deceleration"] * period * period
        self._braking_turn = limits["angular_deceleration"] * period * period
        self._retreat = limits["retreat_velocity"] * period
        self._retreat_turn = limits["retreat_angular_velocity"] * period
        self._retreat_distance = limits["retreat_distance"]
        self._max_limited_ticks = limits["limited_in_a_row"]
        self._start = limits["start_distance"]
        self._start_angle = limits["start_angle"]
        spacing = max(self._retreat, 2.0 * self._retreat_distance / POINTS)
        # At the retreat's speeds, a rotation by an angle takes as long as a translation by lever times angle.
        lever = self._retreat / self._retreat_turn if self._retreat_turn > 0.0 else 0.0
        self._path = CommandPath(spacing, self._retreat_turn, lever)
        self.output = [0.0] * AXES
        self.has_output = False
        self.restart()

    def restart(self) -> None:
        """Forget the faults; the rate limit does not trip before the output first reaches a command."""
        self._limited_ticks = 0.0
        self._engaged = False
        self._rate = [0.0] * AXES
        self._back = False  # whether braking has ended and the command moves back
        self._share = 0.0  # speed on the way back, divided by the retreat speed
        self._remaining = self._retreat_distance  # remaining length of the way back [m]
        self.at_rest = False
        self.fatal = 0

    def release(self) -> None:
        """Forget the last output and the path, after something else has moved the drives."""
        self.has_output = False
        self._path.clear()
        self.restart()

    def limit(self, command: Vector, pose: Vector, measured: Vector, is_fresh: bool, is_free: bool) -> int:
        """Move the output to the command as far as the limits allow; return the fault bits.

        Args:
            command: pose to command [m, rad].
            pose: pose of the numerical model [m, rad].
            measured: last measured pose of the drives [m, rad]; NaN if there is none.
            is_fresh: whether `measured` was measured in this run.
            is_free: whether the rig is out of contact.
        """
        self.fatal = 0
        if not is_finite(command):
            self.fatal = MODEL_NOT_FINITE
            return MODEL_NOT_FINITE
        if not is_within(command, self._lowest, self._highest):
            self.fatal = STROKE
            return STROKE
        if not self.has_output:
            # Moving drives lag behind. Without a reading, assume that they are at the model's pose.
            near = self._is_near(command, measured) if is_fresh else self._is_near(command, pose)
            if is_free and near:
                self.has_output = True
                self.output = list(command)
            else:
                self._stand(measured, pose)
        fault = 0
        share = self._share_of(command, self._max_change, self._max_turn)
        if share < 1.0:
            fault = VELOCITY_LIMIT
            if self._engaged:
                self._limited_ticks += 1.0
                if self._limited_ticks > self._max_limited_ticks:
                    self.fatal = VELOCITY_LIMIT
                    return VELOCITY_LIMIT
        else:
            self._engaged = True
            self._limited_ticks = 0.0
        self._move(command, share)
        self._path.record(self.output)
        return fault

    def retreat(self, measured: Vector, pose: Vector) -> None:
        """Brake or retrace the path for one period after a trip; see `limit` for the arguments."""
        if not self.has_output:
            self._stand(measured, pose)
        if not self._back:
            self._brake()
            return
        path = self._path
        step = 0.0
        if path.count > 0:
            distance = path.distance(path.newest, self.output)
            remaining = min(self._remaining, distance + path.length_back())
            step = self._next_share(remaining)
        if not step > 0.0:
            self.at_rest = True
            self._share = 0.0
            return
        target = list(path.newest)
        share = self._share_of(target, step * self._retreat, step * self._retreat_turn)
        before = list(self.output)
        self._move(target, share)
        self._remaining -= path.distance(self.output, before)
        self._share = step
        if not share < 1.0:
            path.drop()

    def _next_share(self, remaining: float) -> float:
        """Return the next speed as a share of the retreat speed; `remaining` is the rest of the path [m]."""
        if remaining > 0.0 and self._retreat > 0.0 and self._retreat_turn > 0.0:
            gain = min(self._braking / self._retreat, self._braking_turn / self._retreat_turn)
            slowing = sqrt(2.0 * self._braking * remaining) / self._retreat
            # The speed does not fall below the value from which one period's braking stops the motion.
            return min(self._share + gain, max(slowing, gain), 1.0)
        return 0.0

    def _brake(self) -> None:
        """Slow the command down for one period; at a standstill or the stroke's end, begin the way back."""
        rate = self._rate
        zero = [0.0] * AXES
        speed, turning = length(rate, zero), angle(rate, zero)
        slower = 1.0
        if speed > 0.0 and speed > self._braking:
            slower = self._braking / speed
        if turning > 0.0 and turning > self._braking_turn:
            slower = min(slower, self._braking_turn / turning)
        moved = [at + (1.0 - slower) * step for at, step in zip(self.output, rate, strict=True)]
        if slower < 1.0 and self._stays(moved):
            self._rate = [(1.0 - slower) * step for step in rate]
            self.output = moved
            self._path.record(self.output)
        else:
            self._rate = [0.0] * AXES
            self._back = True

    def _stays(self, moved: Vector) -> bool:
        """Return False if a move to `moved` takes a coordinate out of the stroke, or further away from it."""
        stays = True
        for low, high, new, old in zip(self._lowest, self._highest, moved, self.output, strict=True):
            stays = stays and not (new < low and new < old) and not (new > high and new > old)
        return stays

    def _is_near(self, command: Vector, reference: Vector) -> bool:
        """Return whether a run's first command is within `start_distance` and `start_angle` of a pose."""
        near = length(command, reference) <= self._start
        return near and angle(command, reference) <= self._start_angle

    def _share_of(self, target: Vector, max_change: float, max_turn: float) -> float:
        """Return the fraction (at most 1) of the way to a pose that `max_change` and `max_turn` allow."""
        distance, turn = length(target, self.output), angle(target, self.output)
        share = 1.0
        if distance > 0.0 and distance > max_change:
            share = max_change / distance
        if turn > 0.0 and turn > max_turn:
            share = min(share, max_turn / turn)
        return share

    def _move(self, target: Vector, share: float) -> None:
        """Move the output by the fraction `share` of the way to a pose."""
        before = list(self.output)
        if share < 1.0:
            self.output = [at + share * (to - at) for at, to in zip(before, target, strict=True)]
        else:
            self.output = list(target)
        self._rate = [new - old for new, old in zip(self.output, before, strict=True)]

    def _stand(self, measured: Vector, pose: Vector) -> None:
        """Set the output to `measured`; if `measured` is not finite, use `pose` limited to the stroke."""
        self.has_output = True
        if is_finite(measured):
            self.output = list(measured)
            return
        for i in range(AXES):
            start = pose[i]
            # Without any pose, assume that the chaser is far from the target.
            if not start - start == 0.0:
                start = self._highest[i] if i == HEIGHT else 0.0
            self.output[i] = min(max(start, self._lowest[i]), self._highest[i])
