"""Six-axis contact: closed forms of impacts, and independence of the choice of axes.

Each friction law is one program with two pairs of shapes per lane; the lanes are the cases.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from six_axes import springs

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
from jaxhil.sixdof.friction import Bristle, Frictionless, Regularised
from jaxhil.sixdof.ideal_contact_integration import IdealContactModel, sample_ideal_contact
from jaxhil.sixdof.relative import Pair, States, effective_mass, power, wrench_at_chaser
from jaxhil.sixdof.rotations import Quaternion
from jaxhil.sixdof.shapes import Cavity, Plane
from jaxhil.sixdof.vectors import components, matrix, vector

pytestmark = pytest.mark.slow
LANES = ("central", "off_centre", "couple", "sliding", "rolling", "oblique", "elsewhere")
STEPS = 1500
EYE, Z = np.eye(3), np.array([0.0, 0.0, 1.0])


def case(**changes):
    """Return a lane in m and m/s; by default its contact lasts half a period of sqrt(mass/k)."""
    values = {
        "masses": (1800.0, 420.0),
        "inertias": (np.diag([1400.0, 1100.0, 800.0]), np.diag([150.0, 180.0, 110.0])),
        "interfaces": ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),
        "pose": (0.0, 0.0, 1e-9),  # pose of C relative to T
        "velocity": (0.0, 0.0, -0.02),
        "angular": (0.0, 0.0, 0.0),
        "spheres": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        "radius": 0.0,
        "normals": (Z, Z),
        "stiffness": (1e6, 0.0),
        "exponent": 1.0,
        "damping": 0.0,
        "friction": 0.0,
        "slip": 1e-3,
        "bristle": (1e6, 0.0),
        "duration": 0.1,
    }
    return values | changes


BALL = {
    "masses": (1e12, 1.0), "inertias": (1e12 * EYE, 0.4 * 0.1**2 * EYE), "interfaces": ((0.0, 0.0, 0.0),) * 2,
    "pose": (0.0, 0.0, 0.1 + 1e-9), "radius": 0.1, "stiffness": (1e4, 0.0), "duration": 0.05,
}  # fmt: skip
OBLIQUE = {
    "inertias": (
        np.array([[1400.0, 30, -20], [30, 1100, 15], [-20, 15, 800]]),
        np.array([[150.0, 10, 5], [10, 180, -8], [5, -8, 110]]),
    ),
    "interfaces": ((0.05, -0.02, 1.2), (0.01, 0.04, -1.0)), "velocity": (0.01, -0.006, -0.02),
    "angular": (0.003, -0.02, 0.001), "spheres": ((0.3, 0.1, 0.0), (-0.2, 0.2, 0.001)),
    "pose": (0.0, 0.0, 1e-9), "stiffness": (1e6, 2e6), "exponent": 1.5, "damping": 2.0, "friction": 0.2,
    "slip": 2e-3, "duration": 0.3,
}  # fmt: skip
CASES = {
    "central": case(exponent=1.5, stiffness=(3e6, 0.0), damping=3.0, duration=0.2),
    "off_centre": case(spheres=((0.5, -0.3, 0.0),) * 2, velocity=(0.0, 0.0, -0.002)),
    "couple": case(
        interfaces=((0.0, 0.0, 0.0),) * 2, velocity=(0.0,) * 3, angular=(0.0, 1e-3, 0.0),
        pose=(0.0, 0.0, 0.0), spheres=((0.6, 0.0, 0.0), (-0.6, 0.0, 0.0)), normals=(Z, -Z),
        stiffness=(1e6, 1e6), duration=0.06,
    ),
    "sliding": case(**BALL, velocity=(0.5, 0.0, -0.1), friction=0.2),
    "rolling": case(**BALL, velocity=(0.3, 0.0, -0.1), friction=1.0, bristle=(1e6, 500.0)),
    "oblique": case(**OBLIQUE),
    "elsewhere": case(**OBLIQUE),
}  # fmt: skip
TURNED, BOOST, MOVED = (
    Rotation.from_rotvec([0.5, -1.0, 2.0]),
    np.array([0.3, -0.7, 1.1]),
    np.array([5, 2, -3]),
)
HERE = LANES.index("elsewhere")


def collect(key, index=None):
    """Return one value of every lane, lanes last."""
    every = [CASES[name][key] if index is None else CASES[name][key][index] for name in LANES]
    return np.moveaxis(np.array(every, float), 0, -1)


def both_candidates(key):
    """Return a value of both shape pairs, (components, candidates, lanes)."""
    return vector(jnp.asarray(np.moveaxis(collect(key), 0, 1)))


def initial_states():
    """Return the initial states: target at rest at the origin; last lane rotated and boosted."""
    zero = np.zeros((3, len(LANES)))
    target_offset, chaser_offset = collect("interfaces", 0), collect("interfaces", 1)
    position = target_offset + collect("pose") - chaser_offset
    velocity = collect("velocity") - np.cross(collect("angular"), chaser_offset, axis=0)
    places, speeds = [zero.copy(), position], [zero.copy(), velocity]
    turns = np.tile([[1.0], [0.0], [0.0], [0.0]], len(LANES))
    x, y, z, w = TURNED.as_quat()
    turns[:, HERE] = w, x, y, z
    for start, speed in zip(places, speeds, strict=True):
        start[:, HERE] = TURNED.apply(start[:, HERE]) + MOVED
        speed[:, HERE] = TURNED.apply(speed[:, HERE]) + BOOST
    attitude = Quaternion(jnp.asarray(turns[0]), vector(jnp.asarray(turns[1:])))
    return places, speeds, attitude, (zero, collect("angular"))


def group(law="regularised"):
    # One array per parameter, (candidates, lanes).
    same = {
        key: np.tile(collect(key), (2, 1)) for key in ("exponent", "damping", "friction", "slip", "radius")
    }
    numbers = collect("stiffness"), same["damping"], same["exponent"]
    parameters = springs(*map(jnp.asarray, numbers))
    points = vector(jnp.zeros((3, 2, len(LANES))))
    coefficient, slip = (jnp.asarray(same[key]) for key in ("friction", "slip"))
    tangential = [jnp.asarray(np.tile(collect("bristle", index), (2, 1))) for index in range(2)]
    frictions = {
        "regularised": Regularised(coefficient, slip),
        "bristle": Bristle(coefficient, *tangential),
    }
    return ContactGroup(
        ChaserSpheres(
            both_candidates("spheres"), jnp.asarray(same["radius"]), Plane(points, both_candidates("normals"))
        ),
        CONTACT_LAWS["hunt_crossley"],
        parameters,
        frictions[law],
    )


@jax.jit
def begin(masses, inertias, offsets, places, speeds, attitude, angular):
    none = Quaternion(jnp.ones_like(masses[0]), vector(jnp.zeros_like(places[0])))
    pair = Pair(*(
        build_body(mass, matrix(inertia), vector(offset), none)
        for mass, inertia, offset in zip(masses, inertias, offsets, strict=True)
    ))  # fmt: skip
    states = States(*(
        build_state(body, vector(place), vector(speed), attitude, vector(rate))
        for body, place, speed, rate in zip(pair, places, speeds, angular, strict=True)
    ))  # fmt: skip
    return pair, states


@jax.jit
def simulate(pair, states, contact, step):
    flight, seen = sample_ideal_contact(IdealContactModel(pair, (contact,), ()), states, step, STEPS, step)
    final = flight.states
    lifted = jax.tree.map(lambda leaf: leaf[None], pair)

    def of_both(function):
        return sum(function(*one) for one in zip(lifted, seen.states, strict=True))

    return final, {
        "twist": components(seen.twist.linear),
        "angular": components(seen.twist.angular),
        "position": components(seen.pose.position),
        "force": components(seen.wrench.force),
        "moment": components(seen.wrench.moment),
        "energy": of_both(kinetic_energy),
        "linear": of_both(lambda *one: components(linear_momentum(*one))),
        "momentum": of_both(lambda *one: components(angular_momentum(*one))),
        "power": power(wrench_at_chaser(seen.wrench, seen.pose), seen.twist),
    }


def prepared(law="regularised"):
    """Return bodies, states, contact and step of every lane."""
    keys = ("masses", "inertias", "interfaces")
    arguments = [[collect(key, index) for index in range(2)] for key in keys]
    places, speeds, attitude, angular = initial_states()
    pair, states = begin(*jax.tree.map(jnp.asarray, (*arguments, places, speeds)), attitude, angular)
    return pair, states, group(law), jnp.asarray(collect("duration") / STEPS)


@pytest.fixture(scope="module", params=["regularised", "bristle"])
def run(request):
    pair, states, contact, step = prepared(request.param)
    _, seen = simulate(pair, states, contact, step)
    at = [vector(jnp.asarray(part)) for part in (collect("spheres", 0), collect("normals", 0))]
    mass = np.asarray(effective_mass(pair, states, *at))
    seen = {
        name: {key: np.asarray(part[..., lane]).T for key, part in seen.items()}
        for lane, name in enumerate(LANES)
    }
    return seen, dict(zip(LANES, mass, strict=True)), dict(zip(LANES, np.asarray(step), strict=True))


def test_six_axis_central_impact_equals_one_axis_impact(run):
    seen, mass, _ = run
    result, parameters = seen["central"], CASES["central"]
    np.testing.assert_allclose(mass["central"], 1800 * 420 / 2220, rtol=1e-12)
    restitution = result["twist"][-1, 2] / 0.02
    # Hunt and Crossley: a (1 + e) = log((1 + a)/(1 - a e)), a = (3/2) chi v.
    a = 1.5 * parameters["damping"] * 0.02
    np.testing.assert_allclose(a * (1 + restitution), np.log((1 + a) / (1 - a * restitution)), rtol=1e-9)
    assert result["force"][-1, 2] == 0 and 0.5 < restitution < 0.95


def test_six_axis_off_centre_impulse_follows_effective_mass(run):
    """To first order in the rotation, the impulse is 2 m_n v_n."""
    seen, mass, step = run
    result = seen["off_centre"]
    impulse = np.sum(result["force"][:, 2]) * step["off_centre"]
    assert mass["off_centre"] < 0.8 * mass["central"] and result["force"][-1, 2] == 0
    np.testing.assert_allclose(impulse, 2 * mass["off_centre"] * 0.002, rtol=1e-4)
    np.testing.assert_allclose(result["energy"][-1], result["energy"][0], rtol=2e-6)
    arm = np.array([0.5, -0.3, 0.0])
    after = result["twist"][-1, 2] + np.cross(result["angular"][-1], arm)[2]
    np.testing.assert_allclose(after, 0.002, rtol=1e-3)


def test_pure_moment_of_six_axis_contact_acts_on_reduced_inertia(run):
    seen, _, step = run
    inertia = 1100.0 * 180 / (1100 + 180)
    frequency = np.sqrt(2 * 1e6 * 0.6**2 / inertia)
    time = np.arange(STEPS) * step["couple"]
    swing = np.where(frequency * time < np.pi, np.cos(frequency * time), -1)
    np.testing.assert_allclose(seen["couple"]["angular"][:, 1], 1e-3 * swing, atol=1e-7)
    np.testing.assert_allclose(np.min(seen["couple"]["moment"][:, 1]), -inertia * frequency * 1e-3, rtol=1e-4)
    assert frequency * time[-1] > 3.2 and np.max(np.abs(seen["couple"]["force"])) < 1e-3


def test_six_axis_ball_slides_or_rolls_as_in_closed_form(run, request):
    """Expect the tangential speed v_t - mu (1 + e) v_n while sliding, and 5/7 v_t if rolling (Walton)."""
    seen, *_ = run
    bristle = request.node.callspec.params["run"] == "bristle"
    sliding, rolling = seen["sliding"]["twist"][-1], seen["rolling"]["twist"][-1]
    np.testing.assert_allclose(sliding[2], 0.1, rtol=1e-6)
    np.testing.assert_allclose(sliding[0], 0.5 - 0.2 * 2 * 0.1, rtol=1e-4)
    # The penetration, at most v_n sqrt(m/k), shortens the lever arm by its share of the radius, and the speed
    # by 10/49 v_t times this share.
    shorter = 10 / 49 * 0.3 * 1e-3 / 0.1
    # The ball spins about y as in rolling; a remaining slip changes the speed by 2/7 of the slip.
    slip = rolling[0] - 0.1 * seen["rolling"]["angular"][-1, 1]
    assert 0.5 * shorter < 5 / 7 * 0.3 + 2 / 7 * slip - rolling[0] < shorter
    if not bristle:
        assert 0 < abs(slip) < 1e-3
        return
    # A bristle that bends while F grows reduces the force by F'/(k_t t), the speed by (mu F)^2/(2 m k_t t),
    # for slips t of 0.5 to 0.43 m/s until the deepest point.
    lacks = (0.2 * 10) ** 2 / (2 * 1e6 * np.array([0.5, 0.43]))
    assert lacks[0] < sliding[0] - 0.46 < lacks[1]
    # A damped bristle holds until mu F can no longer make the slip follow the lever, at w v_n;
    # m_t = 2/7 m keeps the remaining slip.
    changing = 5 / 7 * 0.3 / 0.1 * 0.1
    assert abs(slip) < 2 / 7 * changing**2 / (1e4 * 0.1)


def test_six_axis_contact_conserves_momentum_and_balances_energy(run):
    seen, _, step = run
    for name in ("off_centre", "oblique", "elsewhere"):
        result = seen[name]
        exchanged = np.sum(np.abs(result["force"])) * step[name]
        assert np.max(np.abs(result["linear"] - result["linear"][0])) < 1e-11 * max(exchanged, 1000)
        # The Runge-Kutta method does not conserve angular momentum to rounding.
        assert np.max(np.abs(result["momentum"] - result["momentum"][0])) < 1e-8 * max(exchanged, 1000)
        assert exchanged > 0.5
        power = result["power"]
        work = np.sum(power[1:] + power[:-1]) / 2 * step[name]
        gained = result["energy"][-1] - result["energy"][0]
        np.testing.assert_allclose(work, gained, atol=2e-4 * np.max(np.abs(np.cumsum(power))) * step[name])
    # Friction and damping dissipate energy.
    assert seen["oblique"]["energy"][-1] < 0.95 * seen["oblique"]["energy"][0]


def test_six_axis_contact_is_invariant_to_rotation_and_boost(run):
    seen, *_ = run
    for key in ("twist", "angular", "position", "force", "moment"):
        plain, turned = seen["oblique"][key], seen["elsewhere"][key]
        np.testing.assert_allclose(plain, turned, atol=1e-9 * np.max(np.abs(plain)))
    touched = np.max(np.abs(seen["oblique"]["force"][:, :2]))
    assert touched > 10


def test_six_axis_contact_combines_elastoplastic_contact_and_tether():
    """Expect e = 1/sqrt(r) for a central contact with a bristle at rest and a slack tether."""
    pair, states, contact, step = prepared()
    parameters = contact.parameters._replace(unloading_ratio=jnp.full((2, len(LANES)), 4.0))
    same = [jnp.full((2, len(LANES)), value) for value in (0.2, 1e6, 10.0)]
    yields = ContactGroup(contact.candidates, CONTACT_LAWS["elastoplastic"], parameters, Bristle(*same))
    slack = Cavity(contact.candidates.centre, jnp.full((2, len(LANES)), 5.0))
    tether = ChaserSpheres(contact.candidates.centre, jnp.zeros((2, len(LANES))), slack)
    tethered = ContactGroup(tether, CONTACT_LAWS["hunt_crossley"], contact.parameters, Frictionless())
    contact_model = IdealContactModel(pair, (yields, tethered), ())
    flight, _ = jax.jit(sample_ideal_contact, static_argnums=3)(contact_model, states, step, STEPS, step)
    final = flight.states
    lane = LANES.index("central")
    speed = np.asarray(final.chaser.velocity.z - final.target.velocity.z)[lane]
    np.testing.assert_allclose(speed / 0.02, 0.5, rtol=2e-3)
    assert abs(final.chaser.velocity.x[lane]) < 1e-15


def test_six_axis_contact_derivatives_match_finite_differences():
    pair, states, contact, step = prepared()

    @jax.jit
    def speeds(scales):
        stiffness, damping, friction = scales
        changed = contact.parameters._replace(
            stiffness=stiffness * contact.parameters.stiffness, damping=damping * contact.parameters.damping
        )
        law = Regularised(friction * contact.friction.coefficient, contact.friction.slip)
        changed_group = ContactGroup(contact.candidates, contact.law, changed, law)
        flight, _ = sample_ideal_contact(
            IdealContactModel(pair, (changed_group,), ()), states, step, STEPS, step
        )
        final = flight.states
        return jnp.stack([*jax.tree.leaves(final.chaser.velocity), *jax.tree.leaves(final.chaser.spin)])

    ones = jnp.ones(3)
    slopes = np.asarray(jax.jit(jax.jacfwd(speeds))(ones))
    assert np.isfinite(slopes).all()
    smooth = [LANES.index(name) for name in ("central", "oblique", "elsewhere")]
    for index in range(3):
        change = jnp.zeros(3).at[index].set(1e-4)
        expected = np.asarray(speeds(ones + change) - speeds(ones - change)) / 2e-4
        np.testing.assert_allclose(slopes[..., smooth, index], expected[..., smooth], rtol=1e-4, atol=1e-6)
