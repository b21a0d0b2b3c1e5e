"""Six-axis sensor: wrench of a tool of many particles, compensated readings, and wrong tool parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxhil.sixdof.relative import Coordinates, Pose, Twist, Wrench, motion_of
from jaxhil.sixdof.rotations import exponential, rotate
from jaxhil.sixdof.sensor import (
    SampleErrors,
    Tool,
    read_fixed,
    read_moving,
    sample,
    tool_load,
    undo_fixed,
    undo_moving,
)
from jaxhil.sixdof.vectors import Vector, components, matrix, vector

SEEDED = np.random.default_rng(21)
PARTICLES = 6
MASSES, PLACES = SEEDED.uniform(1, 3, PARTICLES), SEEDED.normal(size=(3, PARTICLES)) * 0.2
GRAVITY = np.array([0.5, -1.0, -9.7])
# Coordinates of a motion: value, rate and acceleration.
MOTION = SEEDED.normal(size=(3, 6))


def triple(values):
    return Vector(*(jnp.asarray(value) for value in np.asarray(values, float)))


def tool():
    centre = PLACES @ MASSES / MASSES.sum()
    arms = PLACES - centre[:, None]
    inertia = np.sum(MASSES * np.sum(arms**2, axis=0)) * np.eye(3) - (MASSES * arms) @ arms.T
    return Tool(jnp.asarray(MASSES.sum()), triple(centre), matrix(jnp.asarray(inertia)))


def along(time):
    """Return the coordinates of the motion at a time."""
    at = MOTION[0] + time * MOTION[1] + time**2 / 2 * MOTION[2]
    return Coordinates(vector(at[:3]), vector(at[3:]))


def moving():
    """Return pose, twist and acceleration at time 0."""

    def motion(time):
        return motion_of(*jax.jvp(along, (time,), (jnp.ones_like(time),)))

    (pose, twist), (_, acceleration) = jax.jvp(motion, (jnp.asarray(0.0),), (jnp.asarray(1.0),))
    return pose, twist, Twist(*acceleration)


def wrench():
    return Wrench(triple([40.0, -15.0, 120.0]), triple([3.0, 8.0, -2.0]))


def close(result, expected, **tolerances):
    leaves = zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True)
    for one, other in leaves:
        np.testing.assert_allclose(one, other, **tolerances)


@pytest.mark.slow
def test_tool_wrench_equals_sum_over_its_particles():
    """Each particle exerts its weight minus its inertial force."""

    def places(time):
        at = along(time)
        turn = exponential(at.rotation)
        return jnp.stack([components(at.position + rotate(turn, triple(place))) for place in PLACES.T])

    def slope(function):
        return lambda time: jax.jvp(function, (time,), (jnp.ones_like(time),))[1]

    now = jnp.asarray(0.0)
    forces = MASSES[:, None] * (GRAVITY - np.asarray(jax.jit(slope(slope(places)))(now)))
    pose, twist, acceleration = moving()
    arms = np.asarray(places(now)) - np.asarray(components(pose.position))
    load = tool_load(tool(), pose, twist, acceleration, triple(GRAVITY))
    np.testing.assert_allclose(components(load.force), forces.sum(axis=0), rtol=1e-11)
    np.testing.assert_allclose(components(load.moment), np.cross(arms, forces).sum(axis=0), rtol=1e-11)


@pytest.mark.slow
def test_correct_tool_parameters_recover_contact_wrench_from_sensor():
    pose, twist, acceleration = moving()
    load = tool_load(tool(), pose, twist, acceleration, triple(GRAVITY))
    reading = read_moving(wrench(), load, pose)
    close(undo_moving(reading, load, pose), wrench(), rtol=1e-12)
    # Also convert a reading without a tool, about C's origin and in C axes.
    turn = Rotation.from_rotvec(MOTION[0, 3:])
    force, moment = (np.array(jax.tree.leaves(part)) for part in wrench())
    nothing = jax.tree.map(jnp.zeros_like, load)
    at_chaser = turn.inv().apply([force, moment - np.cross(MOTION[0, :3], force)])
    close(read_moving(wrench(), nothing, pose), list(at_chaser.ravel()), rtol=1e-12)
    close(undo_fixed(read_fixed(wrench(), pose), pose), wrench(), rtol=1e-12)
    close(read_fixed(wrench(), pose), list(-at_chaser.ravel()), rtol=1e-12)


def test_wrong_tool_parameters_leave_residual_gravity_wrench():
    """A mass error leaves its share of the weight; an attitude error leaves weight times angle."""
    still = Twist(triple([0.0] * 3), triple([0.0] * 3))
    level = Pose(triple([0.1, 0.0, 0.2]), exponential(triple([0.0, 0.0, 0.0])))
    down = triple([0.0, 0.0, -9.80665])
    tool_carried = tool()._replace(mass=jnp.asarray(12.0))
    load = tool_load(tool_carried, level, still, still, down)
    reading = read_moving(wrench(), load, level)
    lighter = tool_load(tool_carried._replace(mass=0.98 * tool_carried.mass), level, still, still, down)
    residual_force = undo_moving(reading, lighter, level).force - wrench().force
    np.testing.assert_allclose(components(residual_force), [0, 0, -0.02 * 12 * 9.80665], atol=1e-12)
    # The contact force itself also rotates with the measured attitude.
    tilted = level._replace(attitude=exponential(triple([0.03, 0.0, 0.0])))
    residual_force = undo_moving(
        read_moving(jax.tree.map(jnp.zeros_like, load), load, level), load, tilted
    ).force
    np.testing.assert_allclose(residual_force.y, 0.03 * 12 * 9.80665, rtol=2e-4)


@pytest.mark.slow
def test_six_axis_sensor_applies_crosstalk_then_bias_then_quantisation():
    mixing = np.eye(6)
    mixing[0, 2], mixing[4, 1] = 0.01, -0.02
    zero = np.zeros(6)
    quantum, dead_zone, limit = zero.copy(), zero.copy(), np.full(6, np.inf)
    quantum[1], dead_zone[5], limit[2] = 4.0, 0.5, 100.0
    errors = SampleErrors(*(jnp.asarray(part) for part in (mixing, zero + 0.25, quantum, dead_zone, limit)))
    expected = [40 + 1.2 + 0.375, -16.0, 100.0, 3.375, 8 + 0.3 + 0.375, -2 + 0.375 + 0.5]
    close(sample(wrench(), errors, jnp.asarray(zero + 0.125)), expected, rtol=1e-12)
    # A cut dead zone leaves larger readings unchanged.
    cut = sample(wrench(), errors, jnp.asarray(zero + 0.125), cuts_dead_zone=True)
    close(cut, [*expected[:5], -2 + 0.375], rtol=1e-12)
