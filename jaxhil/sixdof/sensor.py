"""Six-axis force sensor on the ground: its reading of a contact, and the controller's reconstruction.

The sensor is on one of two sides. On the fixed side, under the target's mechanism, it reads the reaction; the
weight on it is constant and tared. On the moving side, between the flange and the chaser's mechanism, it also
carries this mechanism, the tool, whose weight and inertia add to the reading and change with the pose. The
loop models delay and lag.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.simulation.sensors import sample_force
from jaxhil.sixdof.relative import Pose, Twist, Wrench
from jaxhil.sixdof.rotations import Quaternion, rotate, rotate_back
from jaxhil.sixdof.vectors import Matrix, Vector, components, cross


class Tool(NamedTuple):
    """Mass between a sensor on the moving side and the contact."""

    mass: Float[Array, "..."]  # m_t [kg]
    centre: Vector  # c, centre of mass from C's origin, in C axes [m]
    inertia: Matrix  # J_t about the centre of mass, in C axes [kg m^2]


class SampleErrors(NamedTuple):
    """Errors of a sample; per channel (fx, fy, fz, mx, my, mz), in N and N m."""

    # sensitivity of each channel (row) to each component [1]; None for the identity
    crosstalk: Float[Array, "6 6 *batch"] | None
    bias: Float[Array, "6 *batch"]
    quantum: Float[Array, "6 *batch"]  # 0 without quantisation
    dead_zone: Float[Array, "6 *batch"]
    range: Float[Array, "6 *batch"]  # infinite if unlimited


class Sensor(NamedTuple):
    """Force sensor, and the controller's assumptions about it."""

    delay: Float[Array, "*batch"]  # [s]
    time_constant: Float[Array, "*batch"]  # time constant of the lag of all channels [s]; 0 for none
    errors: SampleErrors
    noise_std: Float[Array, "6 *batch"]  # standard deviation of white noise [N, N m]
    mounting: Pose | None  # pose of a sensor on the fixed side relative to T; None if it is T
    tool: Tool  # tool of a sensor on the moving side
    gravity: Vector  # in T axes [m/s^2]
    assumed_tool: Tool  # tool as assumed by the controller
    assumed_gravity: Vector  # likewise [m/s^2]
    assumed_bias: Float[Array, "6 *batch"]  # likewise [N, N m]
    position_delay: Float[Array, "*batch"]  # delay of the measured pose [s]
    # standard deviation of white noise of the pose's coordinates, and step to which they are rounded [m, rad]
    position_noise_std: Float[Array, "6 *batch"]
    position_quantum: Float[Array, "6 *batch"]


def tool_load(tool: Tool, pose: Pose, twist: Twist, acceleration: Twist, gravity: Vector) -> Wrench:
    """Return weight and inertia of the tool [N, N m] on the flange, about C's origin, in T axes.

    `acceleration` contains the accelerations of C's origin and of the rotation, on the ground, where T is at
    rest.
    """
    centre = rotate(pose.attitude, tool.centre)
    angular, alpha = twist.angular, acceleration.angular
    centre_acceleration = acceleration.linear + cross(alpha, centre) + cross(angular, cross(angular, centre))
    force = tool.mass * (gravity - centre_acceleration)
    turned = _inertia(tool, pose, alpha) + cross(angular, _inertia(tool, pose, angular))
    return Wrench(force, cross(centre, force) - turned)


def weight(tool: Tool, attitude: Quaternion, gravity: Vector) -> Wrench:
    """Return the weight of the tool alone, as `tool_load` does."""
    force = tool.mass * gravity
    return Wrench(force, cross(rotate(attitude, tool.centre), force))


def tool_mass(tool: Tool) -> Float[Array, "6 6 *batch"]:
    """Return the tool's mass matrix about C's origin, for C aligned with T."""
    mass, centre = tool.mass, components(tool.centre)
    unit = jnp.eye(3, dtype=mass.dtype).reshape(3, 3, *[1] * mass.ndim)
    zero = jnp.zeros_like(mass)
    x, y, z = centre
    across = jnp.stack([jnp.stack(row) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])])
    inertia = jnp.stack([components(row) for row in (tool.inertia.x, tool.inertia.y, tool.inertia.z)])
    square = jnp.sum(centre**2, axis=0)[None, None] * unit - centre[:, None] * centre[None]
    mass = mass[None, None]
    top = jnp.concatenate([mass * unit, -mass * across], axis=1)
    return jnp.concatenate([top, jnp.concatenate([mass * across, inertia + mass * square], axis=1)])


def read_moving(wrench: Wrench, load: Wrench, pose: Pose) -> Wrench:
    """Return the reading of a sensor on the moving side, about C's origin, in C axes.

    It is the sum of contact and tool on the flange.
    """
    moment = wrench.moment - cross(pose.position, wrench.force) + load.moment
    return Wrench(*(rotate_back(pose.attitude, part) for part in (wrench.force + load.force, moment)))


def undo_moving(reading: Wrench, load: Wrench, pose: Pose) -> Wrench:
    """Return the contact's wrench from a reading on the moving side.

    `load` is the tool's weight as assumed by the controller, `pose` the measured pose.
    """
    force, moment = (rotate(pose.attitude, part) for part in reading)
    force = force - load.force
    return Wrench(force, moment - load.moment + cross(pose.position, force))


def read_fixed(wrench: Wrench, mounting: Pose | None) -> Wrench:
    """Return the reading of a sensor on the fixed side, about its own origin, in its own axes: the reaction.

    `mounting` is the pose of its frame relative to T, None if it is T.
    """
    if mounting is None:
        return Wrench(-wrench.force, -wrench.moment)
    at, attitude = mounting
    moment = wrench.moment - cross(at, wrench.force)
    return Wrench(*(-rotate_back(attitude, part) for part in (wrench.force, moment)))


def undo_fixed(reading: Wrench, mounting: Pose | None) -> Wrench:
    """Return the contact's wrench from a reading on the fixed side."""
    if mounting is None:
        return Wrench(-reading.force, -reading.moment)
    position, attitude = mounting
    force, moment = (-rotate(attitude, part) for part in reading)
    return Wrench(force, moment + cross(position, force))


def sample(
    reading: Wrench, errors: SampleErrors, noise: Float[Array, "6 *batch"] | None, has_effects: bool = True
) -> Wrench:
    """Return a sample of a reading: with cross-talk, bias and noise [N, N m].

    `has_effects` adds quantum, dead zone and range.
    """
    # Components are separate: the compiler would compute slices of stacked arrays repeatedly.
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
    """Return R J_t R^T angular."""
    return rotate(pose.attitude, tool.inertia @ rotate_back(pose.attitude, angular))
