"""Six-axis contact episodes (all contacts of a run): comparison with one axis and with closed forms.

The cases are the lanes of one program: central contact of claw-350kg; oblique contact far off the centre
line; the same in a run that begins earlier; the same with a biased sensor; a miss; a contact whose rotation
makes a second point touch; and a contact that hardly changes a fast motion along the surface.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from six_axes import ideal_sensor, lanes, meeting, place, plain_body, second_order, spheres, springs

import jaxhil as package
from jaxhil.sixdof.approach import find_touching_height
from jaxhil.sixdof.bodies import kinetic_energy
from jaxhil.sixdof.friction import Regularised
from jaxhil.sixdof.ideal_contact_integration import EVENT_ACCURACY, IdealContactModel, sample_ideal_contact
from jaxhil.sixdof.kinematics import TaskSpace
from jaxhil.sixdof.loop import build_loop, run
from jaxhil.sixdof.metrics import evaluate
from jaxhil.sixdof.relative import Pair
from jaxhil.sixdof.rollout import STATUS_NAMES
from jaxhil.sixdof.rotations import identity
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.shapes import Plane

pytestmark = pytest.mark.slow
CENTRAL, ASIDE, EARLIER, BIASED, AWAY, AGAIN, GRAZING = range(7)
LANES = 7
TICKS = 1500
SIDEWAYS = 0.5  # along the surface [m/s]
QUIET = 0.06  # time without touch after which an episode ends [s]
BATCH = (LANES,)
PERIOD = 1e-3
EYE = np.eye(3)
STATIC = {"integrator": "semi_implicit_euler", "hold": "linear", "latency": 0}


def scenario():
    bodies = Pair(
        plain_body(1050.0, np.diag([900.0, 700.0, 500.0]), [0, 0, 1.0], BATCH),
        plain_body(525.0, np.diag([150.0, 180.0, 110.0]), [0, 0, -1.0], BATCH),
    )
    aside = np.isin(np.arange(LANES), (ASIDE, EARLIER, BIASED, AGAIN))
    centres = np.array([[0.4, 0.0], [-0.3, 0.0], [0.0, 10.0]])[:, :, None] * aside
    centres[2, 1] = 10.0
    centres[:, 1, AGAIN] = [-0.4, 0.3, 0.00065]
    one = jnp.ones((2, LANES))
    flat = Plane(place([0, 0, 0], one.shape), place([0, 0, 1], one.shape))
    friction = Regularised(0.2 * aside[None] * one, 2e-3 * one)
    spring = springs(124355.0 * one, 395.8 * one, one)
    contact = spheres(jnp.asarray(centres), 0 * one, flat, "kelvin_voigt", spring, friction)
    zero = jnp.zeros(LANES)
    height = find_touching_height((contact,), zero, zero, identity(zero))
    twist = lanes([0, 0, -0.005, 0, 0, 0], BATCH).at[2, AWAY].set(0.005).at[0].add(0.002 * aside)
    twist = twist.at[0, GRAZING].set(SIDEWAYS)
    pose = jnp.zeros((6, LANES)).at[2].set(height)
    before = (zero + 0.02 + PERIOD / 3).at[AWAY].set(-0.1).at[EARLIER].add(7 * PERIOD)
    delays = lanes([4e-3] * 6, BATCH)
    sensor = ideal_sensor(4e-3 + zero)
    bias = sensor.errors.bias.at[:, BIASED].set(jnp.array([2.0, 1.0, -1.0, 0.1, 0.2, 0.3]))
    sensor = sensor._replace(errors=sensor.errors._replace(bias=bias))
    return Scenario(
        bodies, meeting(bodies, pose, twist, before), (contact,), (),
        second_order(12.0 + 0 * delays, 0.8 + 0 * delays, delays), TaskSpace(), sensor,
        PERIOD + zero, (0.6 + zero).at[AGAIN].set(1.5), jnp.zeros((2, LANES), jnp.uint32),
    )  # fmt: skip


@pytest.fixture(scope="module")
def evaluated():
    scenarios = scenario()
    loop = build_loop(scenarios, **STATIC)
    return jax.tree.map(np.asarray, jax.jit(evaluate, static_argnums=0)(loop, {}, scenarios))


def test_central_contact_in_six_axis_run_equals_one_axis_contact(evaluated):
    expected = package.simulate("claw-350kg", "none").contacts[0]
    result = evaluated.metrics

    def of(name):
        return getattr(result, name)[..., 0, CENTRAL]

    e, reference = expected.restitution, expected.reference_restitution
    np.testing.assert_allclose(of("restitution"), e, rtol=1e-9)
    np.testing.assert_allclose(of("reference_restitution"), reference, rtol=1e-7)
    np.testing.assert_allclose(of("energy_error"), e**2 - reference**2, rtol=1e-6)
    np.testing.assert_allclose(of("twist_error"), (e - reference) / (1 + reference), rtol=1e-6)
    np.testing.assert_allclose(of("normal_part"), (e - reference) / (1 + reference), rtol=1e-6)
    assert max(of("lateral_part"), of("rotational_part")) < 1e-9
    np.testing.assert_allclose([of("effective_mass"), of("approach_velocity")], [350, 0.005], rtol=1e-9)
    np.testing.assert_allclose(of("peak_force"), expected.peak_force, rtol=1e-4)
    np.testing.assert_allclose(of("reference_peak_force"), expected.reference_peak_force, rtol=1e-5)
    assert STATUS_NAMES[of("status")] == "rebounded" and of("touches") == of("reference_touches") == 1
    np.testing.assert_allclose(of("normal"), [0, 0, 1], atol=1e-12)


def test_oblique_contact_has_normal_tangential_and_rotational_errors(evaluated):
    result = evaluated.metrics

    def of(name):
        return getattr(result, name)[..., 0, ASIDE]

    parts = [of(f"{name}_part") for name in ("normal", "lateral", "rotational")]
    np.testing.assert_allclose(np.linalg.norm(parts), of("twist_error"), rtol=1e-9)
    assert min(np.abs(parts)) > 1e-3
    assert of("energy_error") > 1 and of("reference_energy_change") < 0
    assert 100 < of("effective_mass") < 300


def test_six_axis_metrics_do_not_depend_on_start_time_of_run(evaluated):
    for name, figure in evaluated.metrics._asdict().items():
        one, other = (figure[..., 0, lane] for lane in (ASIDE, EARLIER))
        # The ideal contact determines begin and end of a touch to 1 us.
        tolerance = EVENT_ACCURACY if name == "reference_duration" else 1e-10
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=tolerance, err_msg=name)


@partial(jax.jit, static_argnums=0)
def record_touches(loop, given):
    """Return touches and energies at every tick, of the rig and of the ideal contact.

    For the rig these are touches of the hardware, and the energy of the numerical model before the tick.
    """
    _, seen = run(loop, {}, given, TICKS)
    contact_model = IdealContactModel(given.bodies, given.groups, ())
    _, ideal = sample_ideal_contact(
        contact_model, given.start, given.control_period, TICKS, given.control_period
    )

    def energy(states):
        return sum(kinetic_energy(*one) for one in zip(given.bodies, states, strict=True))

    def touches(forces):
        return jnp.any(forces[0].touch.depth > 0, axis=1)

    rig = touches(seen.forces), jax.vmap(energy)(seen.states)
    return *rig, touches(ideal.forces), jax.vmap(energy)(ideal.states)


@pytest.fixture(scope="module")
def ticks():
    scenarios = scenario()
    return [np.asarray(part) for part in record_touches(build_loop(scenarios, **STATIC), scenarios)]


def last_touches(touches):
    """Return, for each tick, the last tick in touch so far, or -inf before the first touch."""
    return np.maximum.accumulate(np.where(touches, np.arange(len(touches)), -np.inf))


@pytest.mark.parametrize("lane", [CENTRAL, ASIDE, AGAIN])
def test_six_axis_run_ends_60_ms_after_last_real_and_ideal_contact(evaluated, ticks, lane):
    rig, energy, ideal, expected = (part[:, lane] for part in ticks)
    since = [np.arange(TICKS) - last_touches(touches) for touches in (rig, ideal)]
    over = np.flatnonzero((np.minimum(*since) > QUIET / PERIOD) & np.isfinite(since[0] + since[1]))[0]
    assert STATUS_NAMES[evaluated.metrics.status[0, lane]] == "rebounded"

    def of(name):
        return getattr(evaluated.metrics, name)[0, lane]

    np.testing.assert_allclose(of("energy_change"), energy[over + 1] - energy[0], rtol=1e-9)
    np.testing.assert_allclose(of("reference_energy_change"), expected[over] - expected[0], rtol=1e-6)
    onsets = [np.sum(np.diff(touches[: over + 1].astype(int)) > 0) for touches in (rig, ideal)]
    assert onsets == [of("touches"), of("reference_touches")]
    if lane == AGAIN:
        # The ideal contact is separated for a while before the rig is, and touches again.
        assert np.max(np.diff(np.flatnonzero(ideal[:over]))) > QUIET / PERIOD
        assert onsets == [1, 2]


def test_six_axis_run_with_sensor_bias_ends_after_longest_wait(evaluated, ticks):
    """A biased wrench never decays, so the model also moves before and after contact."""
    rig, energy, *_ = (part[:, BIASED] for part in ticks)
    over = np.flatnonzero(rig)[-1] + round((QUIET + 0.1) / PERIOD) + 2
    change = energy[over] - energy[0]
    np.testing.assert_allclose(evaluated.metrics.energy_change[0, BIASED], change, rtol=1e-10)


def test_six_axis_run_does_not_end_after_contact_of_little_energy(evaluated):
    result = evaluated.metrics
    assert STATUS_NAMES[result.status[0, GRAZING]] == "timeout"
    assert result.touches[0, GRAZING] == result.reference_touches[0, GRAZING] == 1
    np.testing.assert_allclose(result.duration[0, GRAZING], result.duration[0, CENTRAL], rtol=0.1)
    names = "energy_change", "reference_energy_change", "energy_error"
    change, expected, error = (getattr(result, name)[0, GRAZING] for name in names)
    # Inverse of the mass matrix for x and the rotation about y, with the centres of mass 1 m from the touch.
    turning = 1 / np.array([700.0, 180.0])
    inverse = np.array(
        [[1 / 350 + sum(turning), turning[0] - turning[1]], [turning[0] - turning[1], sum(turning)]]
    )
    approach = (np.linalg.inv(inverse)[0, 0] * SIDEWAYS**2 + 350 * 0.005**2) / 2
    np.testing.assert_allclose(error, (change - expected) / (0.05 * approach), rtol=1e-3)
    first_touch = 350 * 0.005**2 / 2
    np.testing.assert_allclose((change - expected) / first_touch, result.energy_error[0, CENTRAL], rtol=0.1)


def test_six_axis_run_without_contact_has_status_miss(evaluated):
    result = evaluated.metrics
    assert STATUS_NAMES[result.status[0, AWAY]] == "miss"
    assert np.isnan(result.energy_error[0, AWAY]) and result.touches[0, AWAY] == 0
    np.testing.assert_allclose(evaluated.final_time[AWAY], 0.6)
