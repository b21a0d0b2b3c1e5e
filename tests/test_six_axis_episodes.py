"""Six-axis episodes: compared with one axis by its own metrics, and with closed forms.

One program; its lanes are the cases: a central contact of claw-350kg, an oblique one far off the line through
the centres of mass, the same in a run that begins earlier, and with a biased sensor, and a miss.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from six_axes import ideal_sensor, lanes, meeting, place, plain_body, second_order, spheres, springs

import jaxhil as package
from jaxhil.sixdof.approach import touching_height
from jaxhil.sixdof.bodies import kinetic_energy
from jaxhil.sixdof.forces import deepest
from jaxhil.sixdof.friction import Regularised
from jaxhil.sixdof.kinematics import TaskSpace
from jaxhil.sixdof.loop import build_loop, run
from jaxhil.sixdof.metrics import evaluate
from jaxhil.sixdof.relative import Pair, relative
from jaxhil.sixdof.rollout import STATUS_NAMES
from jaxhil.sixdof.rotations import identity
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.shapes import Plane

pytestmark = pytest.mark.slow
CENTRAL, ASIDE, EARLIER, BIASED, AWAY = range(5)
LANES = 5
BATCH = (LANES,)
PERIOD = 1e-3
EYE = np.eye(3)
STATIC = {"integrator": "semi_implicit_euler", "hold": "linear", "latency": 0}


def scenario():
    bodies = Pair(
        plain_body(1050.0, np.diag([900.0, 700.0, 500.0]), [0, 0, 1.0], BATCH),
        plain_body(525.0, np.diag([150.0, 180.0, 110.0]), [0, 0, -1.0], BATCH),
    )
    aside = np.isin(np.arange(LANES), (ASIDE, EARLIER, BIASED))
    centres = np.array([0.4, -0.3, 0.0])[:, None, None] * aside
    one = jnp.ones((1, LANES))
    flat = Plane(place([0, 0, 0], one.shape), place([0, 0, 1], one.shape))
    friction = Regularised(jnp.asarray(0.2 * aside)[None], 2e-3 * one)
    spring = springs(124355.0 * one, 395.8 * one, one)
    contact = spheres(jnp.asarray(centres), 0 * one, flat, "kelvin_voigt", spring, friction)
    zero = jnp.zeros(LANES)
    height = touching_height((contact,), zero, zero, identity(zero))
    twist = lanes([0, 0, -0.005, 0, 0, 0], BATCH).at[2, AWAY].set(0.005).at[0].add(0.002 * aside)
    pose = jnp.zeros((6, LANES)).at[2].set(height)
    before = (zero + 0.02 + PERIOD / 3).at[AWAY].set(-0.1).at[EARLIER].add(7 * PERIOD)
    delays = lanes([4e-3] * 6, BATCH)
    sensor = ideal_sensor(4e-3 + zero)
    bias = sensor.errors.bias.at[:, BIASED].set(jnp.array([2.0, 1.0, -1.0, 0.1, 0.2, 0.3]))
    sensor = sensor._replace(errors=sensor.errors._replace(bias=bias))
    return Scenario(
        bodies, meeting(bodies, pose, twist, before), (contact,), (),
        second_order(12.0 + 0 * delays, 0.8 + 0 * delays, delays), TaskSpace(), sensor,
        PERIOD + zero, 0.6 + zero, jnp.zeros((2, LANES), jnp.uint32),
    )  # fmt: skip


@pytest.fixture(scope="module")
def evaluated():
    given = scenario()
    loop = build_loop(given, **STATIC)
    return jax.tree.map(np.asarray, jax.jit(evaluate, static_argnums=0)(loop, {}, given))


def test_central_episode_is_that_of_one_axis(evaluated):
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


def test_oblique_episode_has_all_three_error_parts(evaluated):
    result = evaluated.metrics

    def of(name):
        return getattr(result, name)[..., 0, ASIDE]

    parts = [of(f"{name}_part") for name in ("normal", "lateral", "rotational")]
    np.testing.assert_allclose(np.linalg.norm(parts), of("twist_error"), rtol=1e-9)
    assert min(np.abs(parts)) > 1e-3
    assert of("energy_error") > 1 and of("reference_energy_change") < 0
    assert 100 < of("effective_mass") < 300


def test_episode_does_not_depend_on_the_start_of_its_run(evaluated):
    """Expect the same metrics, whichever ticks the check for the end falls on."""
    for name, figure in evaluated.metrics._asdict().items():
        one, other = (figure[..., 0, lane] for lane in (ASIDE, EARLIER))
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-10, err_msg=name)


@partial(jax.jit, static_argnums=(0, 2))
def followed(loop, given, ticks):
    """Return depths on the hardware and in the model, and the model's kinetic energy, at every tick."""
    _, seen = run(loop, {}, given, ticks)

    def of(states):
        energies = [kinetic_energy(*one) for one in zip(given.bodies, states, strict=True)]
        return deepest(given.groups, relative(given.bodies, states)[0]), energies[0] + energies[1]

    return seen.forces[0].touch.depth[:, 0], *jax.vmap(of)(seen.states)


def test_episode_lasts_from_the_last_free_tick_to_the_first_tick_after(evaluated):
    """Include a bias, by which the wrench never dies out and the numerical model moves before and after."""
    given = scenario()
    depths, own, energy = (
        np.asarray(one)[:, BIASED] for one in followed(build_loop(given, **STATIC), given, 400)
    )
    touches, (model, *_) = np.flatnonzero(depths > 0), np.flatnonzero(own >= 0)
    # Zero for the delay and two periods, and for the longest waiting time.
    over = touches[-1] + 7 + 100 + 1
    change = energy[over] - energy[model - 1]
    np.testing.assert_allclose(evaluated.metrics.energy_change[0, BIASED], change, rtol=1e-10)


def test_episode_without_contact_is_a_miss(evaluated):
    result = evaluated.metrics
    assert STATUS_NAMES[result.status[0, AWAY]] == "miss"
    assert np.isnan(result.energy_error[0, AWAY]) and result.touches[0, AWAY] == 0
    np.testing.assert_allclose(evaluated.final_time[AWAY], 0.6)
