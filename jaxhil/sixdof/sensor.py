"""The six-axis force sensor on the ground: what it reads of a contact, and how a controller takes that back.

The sensor is on one of two sides. On the fixed side, under the target's mechanism, it reads the reaction;
what weighs on it is constant and tared. On the moving side, between the flange and the chaser's mechanism, it
also carries that mechanism, the tool: its weight and its inertia come on top, and change with the pose. Delay
and lag are the loop's.
"""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from jaxhil.simulation.sensors import sample_force
from jaxhil.sixdof.relative import Pose, Twist, Wrench
from jaxhil.sixdof.rotations import Quaternion, rotate, rotate_back
from jaxhil.sixdof.vectors import Matrix, Vector, cross


class Tool(NamedTuple):
    """What is between a sensor on the moving side and the contact."""

    mass: Float[Array, "..."]  # m_t [kg]
    centre: Vector  # c, its centre of mass from C's origin, in C axes [m]
    inertia: Matrix  # J_t about its centre of mass, in C axes [kg m^2]


class SampleErrors(NamedTuple):
    """What becomes of a sample; per channel (fx, fy, fz, mx, my, mz), in N and N m."""

    # what each channel (row) reads of each component [1]; None where each reads its own
    crosstalk: Float[Array, "6 6 *batch"] | None
    bias: Float[Array, "6 *batch"]
    quantum: Float[Array, "6 *batch"]  # 0 for none
    dead_zone: Float[Array, "6 *batch"]
    range: Float[Array, "6 *batch"]  # infinite for none


class Sensor(NamedTuple):
    """The sensor, and what the controller takes it to be."""

    delay: Float[Array, "*batch"]  # [s]
    time_constant: Float[Array, "*batch"]  # of the lag of all channels [s]; 0 for none
    errors: SampleErrors
    noise_std: Float[Array, "6 *batch"]  # [N, N m]
    mounting: Pose | None  # of a sensor on the fixed side: its frame against T; None where it is T
    tool: Tool  # on the moving side
    gravity: Vector  # in T axes [m/s^2]
    assumed_tool: Tool  # the controller's
    assumed_gravity: Vector  # likewise [m/s^2]
    assumed_bias: Float[Array, "6 *batch"]  # likewise [N, N m]
    position_delay: Float[Array, "*batch"]  # of the measured pose [s]


def tool_load(tool: Tool, pose: Pose, twist: Twist, acceleration: Twist, gravity: Vector) -> Wrench:
    """Weight and inertia of the tool [N, N m], about C's origin, in T axes: what the flange has to hold.

    `acceleration` is that of C's origin and of the angular velocity, on the ground, where T is at rest.
    """
    centre = rotate(pose.attitude, tool.centre)
    angular, alpha = twist.angular, acceleration.angular
    carried = acceleration.linear + cross(alpha, centre) + cross(angular, cross(angular, centre))
    force = tool.mass * (gravity - carried)
    turned = _inertia(tool, pose, alpha) + cross(angular, _inertia(tool, pose, angular))
    return Wrench(force, cross(centre, force) - turned)


def weight(tool: Tool, attitude: Quaternion, gravity: Vector) -> Wrench:
    """Weight of the tool alone, as `tool_load`."""
    force = tool.mass * gravity
    return Wrench(force, cross(rotate(attitude, tool.centre), force))


def read_moving(wrench: Wrench, load: Wrench, pose: Pose) -> Wrench:
    """Reading of a sensor on the moving side, about C's origin, in C axes: contact and tool on the flange."""
    moment = wrench.moment - cross(pose.position, wrench.force) + load.moment
    return Wrench(*(rotate_back(pose.attitude, part) for part in (wrench.force + load.force, moment)))


def undo_moving(reading: Wrench, load: Wrench, pose: Pose) -> Wrench:
    """The contact's wrench, from a reading on the moving side: with the controller's own numbers of the tool
    (`load`) and the pose that it measures."""
    force, moment = (rotate(pose.attitude, part) for part in reading)
    force = force - load.force
    return Wrench(force, moment - load.moment + cross(pose.position, force))


def read_fixed(wrench: Wrench, mounting: Pose | None) -> Wrench:
    """Reading of a sensor on the fixed side, about its own origin, in its own axes: the reaction.

    `mounting` is the pose of its frame against T, None where it is T.
    """
    if mounting is None:
        return Wrench(-wrench.force, -wrench.moment)
    at, attitude = mounting
    moment = wrench.moment - cross(at, wrench.force)
    return Wrench(*(-rotate_back(attitude, part) for part in (wrench.force, moment)))


def undo_fixed(reading: Wrench, mounting: Pose | None) -> Wrench:
    """The contact's wrench, from a reading on the fixed side."""
    if mounting is None:
        return Wrench(-reading.force, -reading.moment)
    at, attitude = mounting
    force, moment = (-rotate(attitude, part) for part in reading)
    return Wrench(force, moment + cross(at, force))


def sample(
    reading: Wrench, errors: SampleErrors, noise: Float[Array, "6 *batch"] | None, has_effects: bool = True
) -> Wrench:
    """A sample of a reading: cross-talk, bias, noise [N, N m]; then, where there are any, quantum, dead zone
    and range."""
    # Component by component: slices of what was stacked are worked out over and over.
    components, structure = jax.tree.flatten(reading)

    def channel(row: int) -> Array:
        mixed = errors.bias[row] if noise is None else errors.bias[row] + noise[row]
        if errors.crosstalk is None:
            mixed = mixed + components[row]
        else:
            for column, component in enumerate(components):
                mixed = mixed + errors.crosstalk[row, column] * component
        if not has_effects:
            return mixed
        return sample_force(mixed, errors.quantum[row], errors.dead_zone[row], errors.range[row])

    return structure.unflatten([channel(row) for row in range(6)])


def _inertia(tool: Tool, pose: Pose, angular: Vector) -> Vector:
    """R J_t R^T angular."""
    return rotate(pose.attitude, tool.inertia @ rotate_back(pose.attitude, angular))
