"""Conversion of force sensor readings to the contact's wrench (notebooks/guide/six_axes.md, section 5)."""

from jaxhil.rig.six_axes.registry import ModelConstants
from jaxhil.rig.six_axes.vectors import Vector, cross, rotate, wrench_at_target


class SensorReader:
    """Reader of a force sensor: subtracts a tool's weight and moves the moment to target frame T's origin."""

    __slots__ = ("_sign", "_tool")
    _tool: Vector

    def __init__(self, constants: ModelConstants) -> None:
        self._sign = constants.sensor_sign
        self._tool = constants.tool_load

    def convert(self, reading: Vector, pose: Vector) -> Vector:
        """Return the wrench on the chaser about T's origin, in T axes [N, N m].

        Args:
            reading: reading of the sensor, in the axes and about the origin of its frame [N, N m].
            pose: measured pose of C relative to T [m, rad].
        """
        if self._sign < 0.0:
            # A sensor on the target's side reads the reaction, in frame T.
            return [-entry for entry in reading]
        weight, force = self._tool[:3], rotate(pose, reading[:3])
        moment, pull = rotate(pose, reading[3:]), cross(rotate(pose, self._tool[3:]), weight)
        fx, fy, fz = [a - b for a, b in zip(force, weight, strict=True)]
        mx, my, mz = [a - b for a, b in zip(moment, pull, strict=True)]
        return wrench_at_target([fx, fy, fz, mx, my, mz], pose)
