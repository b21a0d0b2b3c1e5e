"""Warnings about implausible values in a six-axis mechanism file, which often have a wrong unit."""

from collections.abc import Iterator

import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.six_axes_rules import inertia_matrix

# Maximum plausible values.
MAX_VELOCITY = 1.0  # approach velocity [m/s]
MAX_ANGLE = 0.3  # angle between the frames of chaser and target at the first touch [rad]
MAX_RATE = 0.1  # angular velocity of the chaser relative to the target [rad/s]
MAX_GRAVITY = 10.0  # gravity on the ground [m/s^2]
MAX_TOOL_DISTANCE = 2.0  # distance from the origin of chaser frame C to the tool's centre of mass [m]
MAX_INTERFACE_RATIO = 20.0  # distance from centre of mass to interface, divided by radius of gyration [1]
MAX_GYRATION_RATIO = 10.0  # radius of gyration, divided by interface distance or, if larger, 1 m [1]


def unit_warnings(mechanism: SixAxisMechanism) -> tuple[str, ...]:
    """Return a warning for each implausible value, with key, found value, expected value and unit."""
    return tuple(_warnings(mechanism))


def _warnings(mechanism: SixAxisMechanism) -> Iterator[str]:
    for name, body in (("target", mechanism.target), ("chaser", mechanism.chaser)):
        moment = float(np.linalg.eigvalsh(inertia_matrix(body.inertia))[-1])
        radius, distance = (moment / body.mass) ** 0.5, float(np.linalg.norm(body.interface))
        if distance > MAX_INTERFACE_RATIO * radius:
            found = f"{name}.interface: found {distance:.3g} m for a radius of gyration of {radius:.3g} m"
            expected = f"at most {MAX_INTERFACE_RATIO:g} times this radius"
            yield f"{found}, expected {expected}: lengths in m, inertia in kg m^2"
        if radius > MAX_GYRATION_RATIO * max(distance, 1.0):
            found = f"{name}.inertia: found a radius of gyration of {radius:.3g} m"
            yield f"{found}, expected about the size of the body: mass in kg, inertia in kg m^2"
    approach = mechanism.approach
    if approach is not None:
        for key, limit, unit in (
            ("attitude", MAX_ANGLE, "rad"),
            ("velocity", MAX_VELOCITY, "m/s"),
            ("angular_velocity", MAX_RATE, "rad/s"),
        ):
            size = float(np.linalg.norm(getattr(approach, key)))
            if size > limit:
                yield f"approach.{key}: found {size:.3g} {unit}, expected at most {limit:g} {unit}"
    sensor = mechanism.rig.force_sensor
    gravity, path = float(np.linalg.norm(sensor.gravity)), "rig.force_sensor"
    if gravity > MAX_GRAVITY:
        yield f"{path}.gravity: found {gravity:.4g} m/s^2, expected at most {MAX_GRAVITY:g} m/s^2"
    if sensor.tool is not None:
        limit = min(mechanism.target.mass, mechanism.chaser.mass)
        if sensor.tool.mass > limit:
            expected = f"expected at most {limit:.4g} kg, the mass of the lighter body"
            yield f"{path}.tool.mass: found {sensor.tool.mass:.4g} kg, {expected}"
        length = float(np.linalg.norm(sensor.tool.com))
        if length > MAX_TOOL_DISTANCE:
            yield f"{path}.tool.com: found {length:.3g} m, expected at most {MAX_TOOL_DISTANCE:g} m"
