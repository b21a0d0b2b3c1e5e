"""Checks of the six-axis inputs: sensor readings, channel by channel, and the numerical model's motion.

The last good reading of a channel replaces a bad reading. `SixAxisInputGuard.check` returns the faults of a
tick, and stores in `fatal` the faults that trip the controller. The compensator then gets the attributes
`wrench` and `measured`.
"""

from math import inf, isfinite, nan

from jaxhil.rig.bounds import POSITIONS
from jaxhil.rig.faults import (
    FORCE_NOT_FINITE,
    FORCE_OUT_OF_RANGE,
    FORCE_STUCK,
    MODEL_NOT_FINITE,
    POSITION_NOT_FINITE,
    POSITION_OUT_OF_RANGE,
    POSITION_STUCK,
)
from jaxhil.rig.inputs import TARE_ROUNDING
from jaxhil.rig.six_axes.limits import ROTATIONS
from jaxhil.rig.six_axes.vectors import AXES, COORDINATES, Vector, is_finite, is_within, length
from jaxhil.rig.types import Bits, Count, Index, Limits, Positive

WRENCH_BITS = (0x1, 0x2, 0x4, 0x8, 0x10, 0x20)  # bits of the wrench's channels in `channels`
POSE_BITS = (0x40, 0x80, 0x100, 0x200, 0x400, 0x800)  # bits of the pose's coordinates in `channels`


class WrenchTare:
    """Tare of the six-axis force sensor: the bias is the mean of `tare_ticks` readings out of contact.

    Attributes:
        bias: wrench to subtract from every reading [N, N m].
        fatal: whether the last tare failed.
    """

    __slots__ = (
        "_count", "_highest", "_limits", "_lowest", "_ranges", "_spreads", "_sum", "_ticks", "bias", "fatal",
    )  # fmt: skip
    _count: Count
    _lowest: Vector
    _highest: Vector
    _sum: Vector

    def __init__(self, limits: Limits) -> None:
        self._ticks = limits["tare_ticks"]
        self._spreads = [*[limits["tare_force_spread"]] * 3, *[limits["tare_torque_spread"]] * 3]
        self._limits = [*[limits["force_bias_limit"]] * 3, *[limits["torque_bias_limit"]] * 3]
        self._ranges = [*[limits["force_range"]] * 3, *[limits["torque_range"]] * 3]
        self.bias = [0.0] * AXES
        self.restart()

    def restart(self) -> None:
        """Begin a new tare at the next reading; keep the bias until the new tare succeeds."""
        self._count = 0
        self._sum = [0.0] * AXES
        self._lowest = [inf] * AXES
        self._highest = [-inf] * AXES
        self.fatal = False

    def take(self, reading: Vector) -> bool:
        """Add a reading [N, N m]; return whether the tare has ended. If it has failed, `fatal` is True."""
        if not self._count < self._ticks:
            return True
        if self._count == 0:
            self.restart()
        self._count += 1
        for i in range(AXES):
            value = reading[i]
            self._sum[i] += value
            if value < self._lowest[i]:
                self._lowest[i] = value
            if value > self._highest[i]:
                self._highest[i] = value
            if not (isfinite(value) and abs(value) < self._ranges[i]):
                self.fatal = True
        if self.fatal:
            return True
        if self._count < self._ticks:
            return False
        count: Positive = max(float(self._count), 1.0)
        mean = [total / count for total in self._sum]
        for i in range(AXES):
            spread = self._highest[i] - self._lowest[i]
            if not (spread <= self._spreads[i] and abs(mean[i]) <= self._limits[i]):
                self.fatal = True
        if not self.fatal:
            self.bias = mean
        return True


class SixAxisInputGuard:
    """Checks of sensor readings and model motion on each tick; `faults.SIX_AXIS_FAULTS` lists the faults.

    Attributes:
        wrench: last good wrench reading minus the bias [N, N m], for the compensator.
        measured: last good pose reading [m, rad], for the compensator.
        fatal: bits of the last tick's faults that trip the controller.
        channels: bits of the channels with a fault: 1 to 0x20 for the wrench, 0x40 to 0x800 for the pose.
        located: last measured pose of the drives [m, rad]; NaN before the first reading.
        is_located: whether `located` is an in-range reading of this run.
    """

    __slots__ = (
        "_bad_forces", "_bad_positions", "_desired", "_force_stuck", "_force_travel", "_has_reading",
        "_highest", "_lowest", "_max_held_readings", "_position_stuck", "_position_travel", "_ranges",
        "_reading", "_rig_highest", "_rig_lowest", "channels", "fatal", "is_located", "located", "measured",
        "wrench",
    )  # fmt: skip
    _bad_forces: Vector
    _bad_positions: Vector
    _desired: Vector
    _force_travel: Vector
    _position_travel: Vector
    _reading: Vector
    channels: Bits
    fatal: Bits
    measured: Vector
    wrench: Vector

    def __init__(self, limits: Limits) -> None:
        self._ranges = [*[limits["force_range"]] * 3, *[limits["torque_range"]] * 3]
        self._lowest = [limits[f"measured_lowest_{axis}"] for axis in COORDINATES]
        self._highest = [limits[f"measured_highest_{axis}"] for axis in COORDINATES]
        self._rig_lowest = [*[POSITIONS[0]] * 3, *[ROTATIONS[0]] * 3]
        self._rig_highest = [*[POSITIONS[1]] * 3, *[ROTATIONS[1]] * 3]
        self._max_held_readings = limits["held_readings"]
        self._force_stuck = limits["force_stuck_travel"]
        self._position_stuck = [
            *[limits["position_stuck_travel"]] * 3,
            *[limits["rotation_stuck_travel"]] * 3,
        ]
        self.located = [nan] * AXES
        self.is_located = False
        self.restart()

    def restart(self) -> None:
        """Forget past readings and counts of bad readings, but keep `located`, the last valid pose."""
        self._has_reading = False
        self._bad_forces = [0.0] * AXES
        self._bad_positions = [0.0] * AXES
        self._force_travel = [0.0] * AXES
        self._position_travel = [0.0] * AXES
        self._reading = [inf] * AXES
        self._desired = [0.0] * AXES
        self.wrench = [0.0] * AXES
        self.measured = [0.0] * AXES
        self.channels = 0
        self.fatal = 0

    def locate(self, pose: Vector) -> None:
        """Store the measured pose of the drives [m, rad], also after a trip; ignore a reading out of range.

        Until the run's first in-range reading, accept every reading in the wider ranges `POSITIONS` and
        `ROTATIONS`.
        """
        if is_within(pose, self._lowest, self._highest):
            self.is_located = True
            self.located = list(pose)
        elif not self.is_located and is_within(pose, self._rig_lowest, self._rig_highest):
            self.located = list(pose)

    def check(self, reading: Vector, desired: Vector, twist: Vector, pose: Vector, bias: Vector) -> int:
        """Check the inputs of one tick; return the bits of all faults.

        Args:
            reading: wrench reading [N, N m].
            desired: pose of the numerical model [m, rad].
            twist: twist of the numerical model [m/s, rad/s].
            pose: pose reading [m, rad].
            bias: bias of the force sensor [N, N m].
        """
        self.fatal = 0
        self.channels = 0
        if not (is_finite(desired) and is_finite(twist)):
            self.fatal = MODEL_NOT_FINITE
            return MODEL_NOT_FINITE
        first = not self._has_reading
        if first:
            # Before the first tick there is no reading: assume zero wrench and the desired pose.
            self._has_reading = True
            self._desired = list(desired)
            self.measured = list(desired)
        before = list(self.measured)
        faults = self._check_pose(pose, desired, first)
        self._desired = list(desired)
        travel = length(self.measured, before)
        for i in range(AXES):
            value = reading[i]
            if isfinite(value) and abs(value) < self._ranges[i]:
                self._bad_forces[i] = 0.0
                self.wrench[i] = value - bias[i]
                is_same = value == self._reading[i] and abs(self.wrench[i]) > TARE_ROUNDING * abs(value)
                self._force_travel[i] = self._force_travel[i] + travel if is_same else 0.0
                self._reading[i] = value
                if self._force_travel[i] > self._force_stuck:
                    faults |= FORCE_STUCK
                    self.fatal |= FORCE_STUCK
                    self.channels |= WRENCH_BITS[i]
            else:
                faults |= self._bad_force(value, i)
        return faults

    def _check_pose(self, pose: Vector, desired: Vector, first: bool) -> int:
        """Check the pose reading; return the bits of its faults."""
        faults = 0
        for i in range(AXES):
            value = pose[i]
            if self._lowest[i] <= value <= self._highest[i]:
                self._bad_positions[i] = 0.0
                is_same = value == self.measured[i]
                turned = abs(desired[i] - self._desired[i])
                self._position_travel[i] = self._position_travel[i] + turned if is_same else 0.0
                self.measured[i] = value
                if self._position_travel[i] > self._position_stuck[i]:
                    faults |= POSITION_STUCK
                    self.fatal |= POSITION_STUCK
                    self.channels |= POSE_BITS[i]
            else:
                # On the first tick there is no good reading yet, and the pose of the drives is unknown.
                fault = POSITION_OUT_OF_RANGE if isfinite(value) else POSITION_NOT_FINITE
                self._bad_positions[i] += 1.0
                self.channels |= POSE_BITS[i]
                self.fatal |= fault if first or self._bad_positions[i] > self._max_held_readings else 0
                faults |= fault
        return faults

    # Bad readings are rare: a separate function keeps their cost out of the usual tick.

    def _bad_force(self, value: float, channel: Index) -> int:
        """Count a bad reading of a wrench channel; return the bit of its fault."""
        fault = FORCE_OUT_OF_RANGE if isfinite(value) else FORCE_NOT_FINITE
        self._bad_forces[channel] += 1.0
        self.channels |= WRENCH_BITS[channel]
        self.fatal |= fault if self._bad_forces[channel] > self._max_held_readings else 0
        return fault
