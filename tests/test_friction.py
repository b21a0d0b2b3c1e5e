"""Friction laws: Coulomb's cone, a spring at rest, no NaN without slip or without normal force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxhil.sixdof.friction import Bristle, Regularised, Touching
from jaxhil.sixdof.vectors import components, dot, norm, vector

COEFFICIENT, STIFFNESS, DAMPING, SLIP = 0.3, 2e6, 300.0, 1e-3
PERIOD = 1e-3


def of_one(value):
    return jnp.asarray(np.full((1, 1), value))


BRISTLE = Bristle(of_one(COEFFICIENT), of_one(STIFFNESS), of_one(DAMPING))
REGULARISED = Regularised(of_one(COEFFICIENT), of_one(SLIP))


def along_x(force, speed):
    zero = 0 * force
    normal = vector(jnp.stack([zero, zero, zero + 1]))
    return Touching(force, normal, vector(jnp.stack([speed, zero, zero])), of_one(PERIOD))


@jax.jit
def tangential_forces(forces, speeds):
    """Return the tangential force along x at every tick."""

    def tick(state, inputs):
        force, state = BRISTLE.step(along_x(*inputs), state)
        return state, force.x

    return lax.scan(tick, BRISTLE.init(of_one(0.0)), (forces[:, None, None], speeds[:, None, None]))[1][
        :, 0, 0
    ]


def test_bristle_friction_sticks_then_slides_then_resets():
    speeds = np.r_[np.full(10, 1e-6), np.zeros(10), np.full(80, 1e-3), np.zeros(1), np.zeros(1)]
    forces = np.r_[np.full(100, 50.0), 0.0, 50.0]
    result = np.asarray(tangential_forces(jnp.asarray(forces), jnp.asarray(speeds)))
    # While sticking, the bristle is a spring, up to its share of the friction limit.
    stuck_force = STIFFNESS * 1e-6 * PERIOD * 10
    np.testing.assert_allclose(result[10:20], -stuck_force, rtol=stuck_force / (COEFFICIENT * 50))
    np.testing.assert_allclose(result[99], -COEFFICIENT * 50, rtol=1e-6)
    assert result[100] == 0 and result[101] == 0


@pytest.mark.slow
def test_friction_force_stays_within_coulomb_cone():
    generator = np.random.default_rng(8)
    forces = generator.uniform(0, 80, 3000) * (generator.random(3000) > 0.1)
    result = np.asarray(
        tangential_forces(jnp.asarray(forces), jnp.asarray(generator.normal(size=3000) * 0.02))
    )
    assert np.all(np.abs(result) <= COEFFICIENT * forces * (1 + 1e-12))
    slip = vector(jnp.asarray(generator.normal(size=(3, 1, 1)) * 10))
    force, _ = REGULARISED.step(along_x(of_one(50.0), of_one(0.0))._replace(slip=slip), ())
    assert 0.999 < norm(force)[0, 0] / (COEFFICIENT * 50) < 1
    opposite = -norm(force)[0, 0] / norm(slip)[0, 0]
    np.testing.assert_allclose(components(force), opposite * np.asarray(components(slip)), rtol=1e-12)


def random_contacts(count, seed):
    """Return random forces, slips in random tangent planes, and deflections; every eleventh value is 0."""
    generator = np.random.default_rng(seed)
    normal = generator.normal(size=(3, count, 1))
    normal /= np.linalg.norm(normal, axis=0)
    slip, deflection = (np.cross(normal, generator.normal(size=(3, count, 1)), axis=0) for _ in range(2))
    slip *= 10 ** generator.uniform(-9, 1, (count, 1))
    deflection *= 10 ** generator.uniform(-9, -3, (count, 1))
    force = 10 ** generator.uniform(-3, 3, (count, 1))
    for number, part in enumerate((force, slip, deflection)):
        part[..., number::11, :] = 0
    normal, slip, deflection = (vector(jnp.asarray(part)) for part in (normal, slip, deflection))
    return Touching(jnp.asarray(force), normal, slip, of_one(PERIOD)), deflection


def test_regularised_friction_dissipates_expected_power():
    """The dissipated power is -f_t.t = mu F |t|^2/sqrt(|t|^2 + v_s^2), which is never negative."""
    touching, _ = random_contacts(3000, 1)
    force, _ = REGULARISED.step(touching, ())
    taken = np.asarray(-dot(force, touching.slip))
    slip = np.linalg.norm(components(touching.slip), axis=0)
    expected = COEFFICIENT * touching.force * slip**2 / np.sqrt(slip**2 + SLIP**2)
    np.testing.assert_allclose(taken, expected, rtol=1e-12)
    assert np.all(taken >= 0) and np.count_nonzero(taken) > 2000


def test_bristle_friction_never_generates_energy():
    """The dissipated power -f_t.t - d(k_t z^2/2)/dt is never negative, for any deflection z."""
    touching, before = random_contacts(3000, 2)
    force, (after,) = BRISTLE.step(touching, (before,))
    work = np.asarray(-PERIOD * dot(force, touching.slip))
    stored = [np.asarray(STIFFNESS / 2 * dot(bent, bent)) for bent in (before, after)]
    taken = work - (stored[1] - stored[0])
    assert np.all(taken >= -1e-12 * (np.abs(work) + stored[0] + stored[1]))
    # The bristle also returns and stores energy.
    assert np.any(work < 0) and np.any(stored[1] > stored[0]) and np.count_nonzero(taken > 0) > 2000


@pytest.mark.slow
def test_regularised_friction_creeps_as_predicted():
    """The creep is v_s s/sqrt(1 - s^2) with s = |f_t|/(mu F)."""
    share = 0.6
    creep = SLIP * share / np.sqrt(1 - share**2)
    force, _ = REGULARISED.step(along_x(of_one(50.0), of_one(creep)), ())
    np.testing.assert_allclose(force.x, -share * COEFFICIENT * 50, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("law", [BRISTLE, REGULARISED])
@pytest.mark.parametrize("force", [0.0, 50.0])
def test_friction_derivatives_are_finite_without_slip(law, force):
    def tangential(force, speed):
        result, _ = law.step(along_x(force, speed), law.init(force))
        return result.x

    slopes = jax.jacfwd(tangential, argnums=(0, 1))(of_one(force), of_one(0.0))
    assert all(np.isfinite(slope).all() for slope in slopes)
