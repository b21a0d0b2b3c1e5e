"""Six-axis force sensor of the rig, and the controller's reconstruction of the contact wrench.

A sensor on the fixed side, under the target's mechanism, reads the reaction force. A tare removes the
constant weight on this sensor. A sensor on the moving side is between the robot's flange and the chaser's
mechanism (the tool). It also reads the tool's weight and inertial force, which depend on the tool's
orientation and motion. Delay and lag of the sensor are part of `jaxhil.sixdof.loop`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.simulation.sensors import sample_force
from jaxhil.sixdof.relative import Pose, Twist, Wrench
from jaxhil.sixdof.rotations import Quaternion, rotate, rotate_back
from jaxhil.sixdof.vectors import Matrix, Vector, components, cross


class Tool(NamedTuple):
    """Mass properties of the tool: the chaser's mechanism, carried by a force sensor on the moving side."""

    mass: Float[Array, "..."]  # mass m_t [kg]
    centre: Vector  # vector c from the origin of chaser frame C to the centre of mass, in C [m]
    inertia: Matrix  # inertia J_t about the centre of mass, in chaser frame C [kg m^2]


class SampleErrors(NamedTuple):
    """Errors of the force sensor's samples, per channel (fx, fy, fz, mx, my, mz) [N, N m]."""

    # sensitivity of each channel (row) to each component of the wrench (column); None for the identity
    crosstalk: Float[Array, "6 6 *batch"] | None
    bias: Float[Array, "6 *batch"]
    quantum: Float[Array, "6 *batch"]  # resolution; 0 without quantisation
    dead_zone: Float[Array, "6 *batch"]
    range: Float[Array, "6 *batch"]  # largest |reading|; infinite if unlimited


class Sensor(NamedTuple):
    """Sensors of force and pose, and the controller's assumptions about the force sensor."""

    delay: Float[Array, "*batch"]  # delay of the force sensor [s]
    time_constant: Float[Array, "*batch"]  # time constant of the lag of all channels [s]; 0 without a lag
    errors: SampleErrors
    noise_std: Float[Array, "6 *batch"]  # standard deviation of the white noise [N, N m]
    mounting: Pose | None  # pose of a fixed sensor's frame in target frame T; None if equal to T
    tool: Tool  # tool that a sensor on the moving side carries
    gravity: Vector  # gravity in target frame T [m/s^2]
    assumed_tool: Tool  # tool that the controller assumes
    assumed_gravity: Vector  # gravity that the controller assumes, in target frame T [m/s^2]
    assumed_bias: Float[Array, "6 *batch"]  # bias that the controller assumes [N, N m]
    position_delay: Float[Array, "*batch"]  # delay of the pose sensor [s]
    position_noise_std: Float[Array, "6 *batch"]  # standard deviation of the pose's noise [m, rad]
    position_quantum: Float[Array, "6 *batch"]  # resolution of the pose's coordinates [m, rad]
    # cutoff frequency of the low-pass filter of all channels [rad/s], (*batch); None without a filter. With a
    # filter, `time_constant` is that of the filter's slowest mode.
    cutoff: Any = None
    # random walk of the bias, (6, *batch) [N/sqrt(s), N m/sqrt(s)]; None if no scenario has one
    bias_walk: Any = None


def tool_load(tool: Tool, pose: Pose, twist: Twist, acceleration: Twist, gravity: Vector) -> Wrench:
    """Return the wrench of the tool's weight and inertial force about the origin of chaser frame C [N, N m].

    The wrench is in the axes of target frame T, which is at rest. `acceleration` contains the acceleration of
    C's origin and the tool's angular acceleration.
    """
    centre = rotate(pose.attitude, tool.centre)
    angular, alpha = twist.angular, acceleration.angular
    centre_acceleration = acceleration.linear + cross(alpha, centre) + cross(angular, cross(angular, centre))
    force = tool.mass * (gravity - centre_acceleration)
    inertia_moment = _inertia(tool, pose, alpha) + cross(angular, _inertia(tool, pose, angular))
    return Wrench(force, cross(centre, force) - inertia_moment)


def weight(tool: Tool, attitude: Quaternion, gravity: Vector) -> Wrench:
    """Return the wrench of the tool's weight about the origin of chaser frame C, in target frame T."""
    force = tool.mass * gravity
    return Wrench(force, cross(rotate(attitude, tool.centre), force))


def tool_mass(tool: Tool) -> Float[Array, "6 6 *batch"]:
    """Return the tool's mass matrix about the origin of chaser frame C, in C [kg, kg m, kg m^2]."""
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
    """Return the reading of a sensor on the moving side, in chaser frame C and about its origin.

    The reading is the sum of the contact's `wrench` and the tool's `load`.
    """
    moment = wrench.moment - cross(pose.position, wrench.force) + load.moment
    return Wrench(*(rotate_back(pose.attitude, part) for part in (wrench.force + load.force, moment)))


def undo_moving(reading: Wrench, load: Wrench, pose: Pose) -> Wrench:
    """Reconstruct the contact's wrench from the reading of a sensor on the moving side.

    `load` is the tool's weight that the controller assumes, `pose` the measured pose.
    """
    force, moment = (rotate(pose.attitude, part) for part in reading)
    force = force - load.force
    return Wrench(force, moment - load.moment + cross(pose.position, force))


def read_fixed(wrench: Wrench, mounting: Pose | None) -> Wrench:
    """Return the reading of a sensor on the fixed side: the reaction to `wrench`, in the sensor's frame.

    `mounting` is the pose of the sensor's frame relative to target frame T; None if both frames are equal.
    """
    if mounting is None:
        return Wrench(-wrench.force, -wrench.moment)
    at, attitude = mounting
    moment = wrench.moment - cross(at, wrench.force)
    return Wrench(*(-rotate_back(attitude, part) for part in (wrench.force, moment)))


def undo_fixed(reading: Wrench, mounting: Pose | None) -> Wrench:
    """Reconstruct the contact's wrench from the reading of a sensor on the fixed side (see `read_fixed`)."""
    if mounting is None:
        return Wrench(-reading.force, -reading.moment)
    position, attitude = mounting
    force, moment = (-rotate(attitude, part) for part in reading)
    return Wrench(force, moment + cross(position, force))


def sample(
    reading: Wrench,
    errors: SampleErrors,
    noise: Float[Array, "6 *batch"] | None,
    has_effects: bool = True,
    cuts_dead_zone: bool = False,
) -> Wrench:
    """Add cross-talk, bias and `noise` [N, N m], which includes changes of the bias, to a reading.

    If `has_effects` is true, apply resolution (quantum), dead zone and range too. The dead zone sets small
    values to 0 and reduces larger values by its half-width; with `cuts_dead_zone`, larger values remain
    unchanged.
    """
    # Each component is a separate array: from a stack, the compiler would compute the components repeatedly.
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
        step = jnp.zeros_like(mixed) if cuts_dead_zone else None
        return sample_force(mixed, errors.quantum[row], errors.dead_zone[row], errors.range[row], step)

    return structure.unflatten([channel(row) for row in range(6)])


def _inertia(tool: Tool, pose: Pose, angular: Vector) -> Vector:
    """Return R J_t R^T `angular`, where R is the matrix of the pose's attitude and J_t the tool's inertia."""
    return rotate(pose.attitude, tool.inertia @ rotate_back(pose.attitude, angular))
