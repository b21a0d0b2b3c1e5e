"""Six-axis loop of the rig: comparison with one axis, momentum, and a rotated and boosted world.

The cases are the lanes of one program. All lanes have the rig of claw-350kg, two of them with other delays.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from six_axes import ideal_sensor, second_order, springs

import jaxhil as package
from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.sixdof.bodies import (
    angular_momentum,
    build_body,
    build_state,
    kinetic_energy,
    linear_momentum,
)
from jaxhil.sixdof.candidates import ChaserSpheres
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.friction import Regularised
from jaxhil.sixdof.kinematics import TaskSpace
from jaxhil.sixdof.loop import run
from jaxhil.sixdof.loop_state import Loop
from jaxhil.sixdof.relative import Pair, States
from jaxhil.sixdof.rotations import Quaternion
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.shapes import Plane
from jaxhil.sixdof.vectors import components, matrix, vector

LANES, TICKS, PERIOD, FORCE_DELAY = 6, 450, 1e-3, 4e-3
CENTRAL, OFF, SLOW, LIGHT, OBLIQUE, ELSEWHERE = range(LANES)
EYE = np.eye(3)
MASSES = np.array([1050.0, 525.0])  # an equivalent mass of 350 kg
MOMENTS = np.array([[900.0, 700.0, 500.0], [150.0, 180.0, 110.0]])
OFFSETS = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
ARM = np.array([0.4, -0.3, 0.0])  # offset of the contact from the line through both centres of mass [m]
STIFFNESS, DAMPING = 124355.0, 395.8


def effective_mass():
    """Return the effective mass of a contact that is off the centre line by ARM."""
    turned = np.cross(ARM, [0, 0, 1])
    return 1 / (np.sum(1 / MASSES) + np.sum(turned**2 / MOMENTS))


def cases():
    """Return masses, moments, contact points, speeds, delays and friction of every lane, lanes last."""
    masses = np.tile(MASSES[:, None], LANES)
    # Central contact whose equivalent mass equals the effective mass of the off-centre contact.
    masses[:, LIGHT] *= effective_mass() / 350
    points, speeds = np.zeros((3, LANES)), np.tile([[0.0], [0.0], [-0.005]], LANES)
    points[:, OFF:LIGHT] = ARM[:, None]
    points[:, OBLIQUE:] = [[0.3], [0.2], [0.0]]
    speeds[2, OFF], speeds[2, SLOW] = -5e-4, -5e-5
    speeds[:, OBLIQUE:] = [[2e-3], [-1e-3], [-5e-3]]
    delays = np.full((6, LANES), 4e-3)
    delays[:, OBLIQUE:] = np.array([5.0, 4.5, 3.0, 5.3, 2.2, 4.4])[:, None] * 1e-3
    friction = np.where(np.arange(LANES) >= OBLIQUE, 0.2, 0.0)
    return masses, points, speeds, delays, friction


TURNED, BOOST = Rotation.from_rotvec([0.5, -1.0, 2.0]), np.array([0.03, -0.07, 0.11])


def start(masses, speeds, begin):
    """Return (bodies, states) as NumPy arrays; the world of the last lane is rotated and boosted."""
    zero = np.zeros((3, LANES))
    gap = speeds * -begin
    places = [zero.copy(), OFFSETS[0][:, None] + gap - OFFSETS[1][:, None]]
    moving = [zero.copy(), speeds.copy()]
    for position, speed in zip(places, moving, strict=True):
        position[:, ELSEWHERE] = TURNED.apply(position[:, ELSEWHERE])
        speed[:, ELSEWHERE] = TURNED.apply(speed[:, ELSEWHERE]) + BOOST
    turns = np.tile([[1.0], [0.0], [0.0], [0.0]], LANES)
    turns[:, ELSEWHERE] = np.roll(TURNED.as_quat(), 1)
    inertias = [np.tile(np.diag(row)[:, :, None], LANES) for row in MOMENTS]
    offsets = [np.tile(row[:, None], LANES) for row in OFFSETS]
    return list(masses), inertias, offsets, places, moving, turns


@partial(jax.jit, static_argnums=0)
def simulate(loop, given, points, delays, friction):
    masses, inertias, offsets, places, speeds, turns = given
    zero = jnp.zeros(LANES)
    still = vector(jnp.zeros((3, LANES)))
    plain = Quaternion(zero + 1, still)
    attitude = Quaternion(turns[0], vector(turns[1:]))
    pair = Pair(*(
        build_body(mass, matrix(inertia), vector(offset), plain)
        for mass, inertia, offset in zip(masses, inertias, offsets, strict=True)
    ))  # fmt: skip
    states = States(*(
        build_state(body, vector(position), vector(speed), attitude, still)
        for body, position, speed in zip(pair, places, speeds, strict=True)
    ))  # fmt: skip
    one = jnp.ones((1, LANES))
    none = 0 * one
    flat = vector(jnp.zeros((3, 1, LANES)))
    up = vector(jnp.stack([none, none, one]))
    spheres = ChaserSpheres(vector(points[:, None]), none, Plane(flat, up))
    group = ContactGroup(
        spheres,
        CONTACT_LAWS["kelvin_voigt"],
        springs(STIFFNESS * one, DAMPING * one, one),
        Regularised(friction[None], 2e-3 * one),
    )
    simulator = second_order(12.0 + 0 * delays, 0.8 + 0 * delays, delays)
    scenario = Scenario(
        pair, states, (group,), (), simulator, TaskSpace(), ideal_sensor(FORCE_DELAY + zero), PERIOD + zero,
        PERIOD * TICKS + zero, jnp.zeros((2, LANES), jnp.uint32),
    )  # fmt: skip
    _, seen = run(loop, {}, scenario, TICKS)

    def of_both(function):
        lifted = jax.tree.map(lambda leaf: leaf[None], pair)
        return sum(function(*one) for one in zip(lifted, seen.states, strict=True))

    return {
        "speed": components(seen.states.chaser.velocity) - components(seen.states.target.velocity),
        "force": components(seen.command.force),
        "moment": components(seen.command.moment),
        "energy": of_both(kinetic_energy)[None],
        "linear": of_both(lambda *one: components(linear_momentum(*one))),
        "angular": of_both(lambda *one: components(angular_momentum(*one))),
    }


def simulated(*loop):
    """Return the program's results, each part (lanes, ticks, components)."""
    masses, points, speeds, delays, friction = cases()
    states = start(masses, speeds, 0.02 + PERIOD / 3)
    result = simulate(Loop(*loop), *jax.tree.map(jnp.asarray, (states, points, delays, friction)))
    return {key: np.moveaxis(np.asarray(part), 0, -1).swapaxes(0, 1) for key, part in result.items()}


@pytest.fixture(scope="module")
def seen():
    return simulated("semi_implicit_euler", "linear", 0, 16)


def energy_error(seen, lane, mass, speed):
    """Return the gained kinetic energy relative to the kinetic energy of the approach."""
    energy = seen["energy"][lane, :, 0]
    assert np.all(seen["force"][lane, -20:] == 0)
    return (energy[-1] - energy[0]) / (mass * speed**2 / 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "hold", "latency"),
    [("semi_implicit_euler", "linear", 0), ("zoh", "zoh", 1), ("explicit_euler", "linear", 1)],
)
def test_six_axis_rig_central_contact_equals_one_axis_contact(integrator, hold, latency):
    changes = {"rig.integrator": integrator, "rig.command_hold": hold, "rig.command_latency": latency}
    expected = package.simulate(package.load("claw-350kg", changes), "none").contacts[0].restitution
    result = simulated(integrator, hold, latency, 16)
    np.testing.assert_allclose(result["speed"][CENTRAL, -1, 2] / 0.005, expected, rtol=1e-9)
    np.testing.assert_allclose(energy_error(result, CENTRAL, 350, 0.005), expected**2 - 1, rtol=1e-9)


def test_six_axis_rig_off_centre_contact_follows_effective_mass(seen):
    mass = effective_mass()
    assert mass < 300
    expected = energy_error(seen, LIGHT, mass, 5e-3)
    faults = [energy_error(seen, lane, mass, speed) - expected for lane, speed in ((OFF, 5e-4), (SLOW, 5e-5))]
    assert expected > 1 and abs(faults[0]) < 0.02
    np.testing.assert_allclose(faults[0] / faults[1], 10, rtol=0.1)


def test_six_axis_rig_conserves_momentum(seen):
    for lane in range(LANES):
        exchanged = np.sum(np.abs(seen["force"][lane])) * PERIOD
        for key in ("linear", "angular"):
            drift = np.max(np.abs(seen[key][lane] - seen[key][lane, 0]))
            assert drift < 1e-12 * max(exchanged, np.max(np.abs(seen[key][lane])))
    assert np.max(np.abs(seen["force"][OBLIQUE, :, 0])) > 1


def test_six_axis_rig_is_invariant_to_rotation_and_boost_of_the_world(seen):
    for key in ("force", "moment"):
        one, other = seen[key][OBLIQUE], seen[key][ELSEWHERE]
        np.testing.assert_allclose(one, other, atol=1e-9 * np.max(np.abs(one)))
