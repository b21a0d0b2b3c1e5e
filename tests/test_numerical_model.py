"""Six-axis numerical model: closed forms of free tops, momentum, relative mass.

One program simulates two bodies under given wrenches; its lanes are the cases.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scipy.spatial.transform import Rotation
from scipy.special import ellipj

from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.sixdof.bodies import (
    SHARES,
    Load,
    angular_momentum,
    angular_velocity,
    build_body,
    build_state,
    kick_drift,
    kinetic_energy,
    linear_momentum,
)
from jaxhil.sixdof.relative import (
    Pair,
    States,
    Wrench,
    advance,
    effective_mass,
    interface_frame,
    mass_matrix,
    relative_motion,
    wrench_at_chaser,
)
from jaxhil.sixdof.rotations import Quaternion, identity, logarithm, rotate
from jaxhil.sixdof.vectors import Vector, components, matrix, vector

STEPS, PERIOD = 1001, 8e-3
SEEDED = np.random.default_rng(11)
TOPS, PUSHED = slice(0, 3), slice(3, 6)  # lanes
PERIODS = np.r_[PERIOD, PERIOD / 2, PERIOD / 4, [1e-3] * 3]
SHARE = np.array([1.0] * 3 + [SHARES[name] for name in INTEGRATORS])
LANES = len(SHARE)

# The target's principal moments, and its principal axes, which differ from the body axes; the chaser is
# axisymmetric.
MOMENTS, AXES = np.array([1400.0, 1100.0, 800.0]), Rotation.from_rotvec([0.3, -0.5, 0.2])
SYMMETRIC = np.array([150.0, 150.0, 110.0])
MASSES = np.array([1800.0, 420.0])


def quaternion(rotations):
    x, y, z, w = rotations.as_quat().T
    return Quaternion(jnp.asarray(w), vector(jnp.asarray(np.stack([x, y, z]))))


def lanes(values, number=LANES):
    """Repeat the values in every lane."""
    values = np.asarray(values, float)
    return jnp.asarray(np.broadcast_to(values[..., None], (*values.shape, number)))


def bodies():
    tilted = AXES.as_matrix() @ np.diag(MOMENTS) @ AXES.as_matrix().T
    turned = [quaternion(Rotation.from_rotvec([axes] * LANES)) for axes in ([0, 0.1, 0], [np.pi, 0.0, 0.2])]
    return Pair(
        build_body(lanes(MASSES[0]), matrix(lanes(tilted)), vector(lanes([0.05, -0.02, 1.2])), turned[0]),
        build_body(
            lanes(MASSES[1]), matrix(lanes(np.diag(SYMMETRIC))), vector(lanes([0.01, 0.04, -1.0])), turned[1]
        ),
    )


FREE = np.array([0.4, 0.0, 0.25])  # angular velocity of the target about its principal axes [rad/s]
SPUN = np.array([0.2, -0.1, 0.35])  # angular velocity of the chaser about its principal axes [rad/s]


def start(pair):
    still, velocity = np.zeros((3, LANES)), np.zeros((3, LANES))
    velocity[:, PUSHED] = [[0.3], [-0.2], [-0.5]]
    attitude = np.linspace(-1, 1, 3 * LANES).reshape(LANES, 3)
    target, chaser = (quaternion(Rotation.from_rotvec(turn)) for turn in (attitude, attitude[:, ::-1]))
    at_rest, moving = vector(jnp.asarray(still)), vector(jnp.asarray(velocity))
    return States(
        build_state(pair.target, at_rest, at_rest, target, vector(lanes(AXES.apply(FREE)))),
        build_state(pair.chaser, vector(lanes([0.1, 0.2, 2.5])), moving, chaser, vector(lanes(SPUN))),
    )


def wrenches():
    """Return wrenches (steps, 6, lanes)."""
    wrenches_drawn = np.zeros((STEPS, 6, LANES))
    wrenches_drawn[:, :, PUSHED] = SEEDED.normal(size=(STEPS, 6, 1)) * 50
    return wrenches_drawn


@jax.jit
def begin():
    pair = bodies()
    return pair, start(pair)


@jax.jit
def simulate(pair, states, given, period, share):
    def seen(states, wrench):
        frame = interface_frame(pair.target, states.target)
        return {
            "angular": [components(angular_velocity(*one)) for one in zip(pair, states, strict=True)],
            "energy": sum(kinetic_energy(*one) for one in zip(pair, states, strict=True)),
            "linear": sum(components(linear_momentum(*one)) for one in zip(pair, states, strict=True)),
            "momentum": sum(components(angular_momentum(*one)) for one in zip(pair, states, strict=True)),
            "velocity": components(states.chaser.velocity - states.target.velocity),
            "attitude": jnp.stack([*components(states.chaser.attitude.v), states.chaser.attitude.w]),
            "spin": components(states.target.spin),
            "force": components(rotate(frame.attitude, wrench.force)),
        }

    def body(states, given):
        wrench = Wrench(vector(given[:3]), vector(given[3:]))
        return advance(pair, states, wrench, period, share), seen(states, wrench)

    return lax.scan(body, states, given)[1]


GIVEN = wrenches()


@pytest.fixture(scope="module")
def run():
    result = simulate(*begin(), jnp.asarray(GIVEN), jnp.asarray(PERIODS), jnp.asarray(SHARE))
    return jax.tree.map(np.asarray, result)


def at_the_same_time(series):
    """Return the tops' states (components, lanes) at one time: after 250 of the longest steps."""
    return np.stack([series[250 * 2**lane, :, lane] for lane in range(3)], axis=-1)


def test_torque_free_rotation_converges_to_jacobi_solution_at_second_order(run):
    result = AXES.inv().apply(at_the_same_time(run["angular"][0]).T).T
    (one, two, three), (first, _, third) = MOMENTS, FREE
    second = third * np.sqrt(three * (one - three) / (two * (one - two)))
    rate = first * np.sqrt((one - three) * (one - two) / (two * three))
    modulus = (two - three) * second * third / (one * first * rate)
    sn, cn, dn, _ = ellipj(rate * 250 * PERIOD, modulus)
    errors = np.linalg.norm(result - np.array([[first * dn], [-second * sn], [third * cn]]), axis=0)
    np.testing.assert_allclose(errors[:-1] / errors[1:], 4, rtol=0.02)
    assert errors[-1] < 1e-6
    # Every step leaves the angular momentum unchanged, to the bit.
    np.testing.assert_array_equal(run["spin"][:, :, TOPS], run["spin"][:1, :, TOPS] + np.zeros((STEPS, 1, 1)))
    energy = run["energy"][:, 2]
    assert np.max(np.abs(energy / energy[0] - 1)) < 1e-6


def test_attitude_of_axisymmetric_top_matches_closed_form(run):
    """Expect a precession at |pi|/J_1 about the angular momentum, and a spin at (1 - J_3/J_1) w_3."""
    first = Rotation.from_quat(run["attitude"][0].T)
    time = 250 * PERIOD
    spin = first.apply(SYMMETRIC * SPUN)
    precessed = Rotation.from_rotvec(spin * time / SYMMETRIC[0])
    turned = Rotation.from_rotvec([0, 0, (1 - SYMMETRIC[2] / SYMMETRIC[0]) * SPUN[2] * time])
    expected = (precessed * first * turned)[:3]
    result = Rotation.from_quat(at_the_same_time(run["attitude"]).T)
    errors = (expected.inv() * result).magnitude()
    np.testing.assert_allclose(errors[:-1] / errors[1:], 4, rtol=0.02)
    assert errors[-1] < 1e-6


def test_numerical_model_conserves_momentum_under_any_contact_wrench(run):
    exchanged = np.sum(np.abs(GIVEN[:, :3]), axis=(0, 1)) * PERIODS
    linear = run["linear"] - run["linear"][:1]
    assert np.all(np.abs(linear) <= 1e-12 * np.maximum(exchanged, 1))
    # A period changes the angular momentum by (1 - share) T^2 (v_chaser - v_target) x f.
    lost = np.cross(run["velocity"], run["force"], axis=1) * PERIODS**2 * (1 - SHARE)
    expected = run["momentum"][:1] + np.cumsum(lost, axis=0) - lost
    exchanged = np.sum(np.abs(GIVEN), axis=(0, 1)) * PERIODS * 3
    assert np.all(np.abs(run["momentum"] - expected) <= 1e-12 * np.maximum(exchanged, 1000))
    assert np.all(np.abs(lost[:, :, 4:6]).sum(axis=(0, 1)) > 1e-6)


@pytest.mark.slow
def test_six_axis_integrators_agree_with_one_axis_for_single_axis_motion():
    pushes = SEEDED.normal(size=40) * 20

    @jax.jit
    def pushed(mass, inertia, pushes):
        still, turn = vector(jnp.zeros((3, 3))), identity(mass)
        body = build_body(mass, matrix(inertia), still, turn)

        def step(state, push):
            along = Vector(still.x, still.y, push + still.z)
            return kick_drift(body, state, Load(along, along), 0.1 + still.x, jnp.asarray(SHARE[3:])), None

        state = lax.scan(step, build_state(body, still, still, turn, still), pushes)[0]
        return state.position.z, state.velocity.z, logarithm(state.attitude).z, state.spin.z

    result = np.asarray(pushed(lanes(2.0, 3), lanes(np.diag(SYMMETRIC), 3), jnp.asarray(pushes)))
    for lane, (name, integrator) in enumerate(INTEGRATORS.items()):
        line, turn = (0.0, 0.0), (0.0, 0.0)
        for push in pushes:
            line = integrator(*line, push / 2.0, 0.1)
            turn = integrator(*turn, push / SYMMETRIC[2], 0.1)
        expected = [*line, turn[0], turn[1] * SYMMETRIC[2]]
        np.testing.assert_allclose(result[:, lane], expected, rtol=1e-12, err_msg=name)
    assert len(set(result[0])) == 3


@jax.jit
def push_from_rest(pair, states, wrench, point, normal):
    wrench = Wrench(vector(wrench[:3]), vector(wrench[3:]))
    frames = [interface_frame(*one) for one in zip(pair, states, strict=True)]
    pose, _ = relative_motion(*frames)
    after = advance(pair, states, wrench, 1e-9 + 0 * normal[0], 1.0)
    _, twist = relative_motion(*(interface_frame(*one) for one in zip(pair, after, strict=True)))
    return (
        twist,
        wrench_at_chaser(wrench, pose),
        pose.position,
        mass_matrix(pair, states),
        effective_mass(pair, states, vector(point), vector(normal)),
    )


@pytest.mark.slow
def test_acceleration_under_contact_wrench_matches_relative_mass():
    pair, states = begin()
    states = States(*(state._replace(velocity=0 * state.velocity, spin=0 * state.spin) for state in states))
    wrench, point, normal = (SEEDED.normal(size=(size, LANES)) for size in (6, 3, 3))
    normal /= np.linalg.norm(normal, axis=0)
    wrench[:, :3] = np.concatenate([normal, np.cross(point, normal, axis=0)])[:, :3]
    arguments = (jnp.asarray(part) for part in (wrench, point, normal))
    result = [
        np.squeeze(np.stack(jax.tree.leaves(part))) for part in push_from_rest(pair, states, *arguments)
    ]
    result[0] = result[0] / 1e-9
    for lane, (gained, moved, origin, mass, effective) in enumerate(
        zip(*(np.moveaxis(part, -1, 0) for part in result), strict=True)
    ):
        np.testing.assert_allclose(mass, mass.T, rtol=1e-10, atol=1e-10 * np.max(mass))
        assert np.all(np.linalg.eigvalsh(mass) > 0)
        np.testing.assert_allclose(mass @ gained, moved, rtol=1e-7, atol=1e-7)
        x, y, z = point[:, lane] - origin
        at_point = np.hstack([np.eye(3), -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])])
        along = normal[:, lane] @ at_point
        if lane < 3:
            np.testing.assert_allclose(along @ gained, 1 / effective, rtol=1e-7)
        mobility = np.linalg.inv(mass)
        np.testing.assert_allclose(along @ mobility @ along, 1 / effective, rtol=1e-9)
        # If tangential motion is prevented, the effective mass is larger.
        constrained_mass = np.linalg.inv(at_point @ mobility @ at_point.T)
        assert normal[:, lane] @ constrained_mass @ normal[:, lane] > 1.001 * effective
