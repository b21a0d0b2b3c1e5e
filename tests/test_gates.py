"""Contact gates of JAX and runtime: time beyond a threshold, weighted with a triangle of two periods."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxhil.contact.laws import deflection
from jaxhil.laws.shared.gates import rig as on_the_rig
from jaxhil.laws.shared.gates.simulation import gate, share_beyond

CLEARANCE = 3.0
TICKS = np.arange(-4, 40)
PHASES = np.linspace(0, 1, 21)


def on_jax(positions, clearance=np.inf):
    """Return the gate at every tick of a reading (ticks, lanes), except the first."""
    return np.asarray(_gates(jnp.asarray(positions), clearance))


@jax.jit
def _gates(positions, clearance):
    shares = _shares(positions, clearance)
    before = jnp.concatenate([jnp.zeros_like(shares[:1]), shares[:-1]])
    return gate(shares, before)


def _shares(positions, clearance):
    excess = deflection(positions, jnp.full(positions.shape, clearance))
    return share_beyond(excess[1:], excess[:-1], jnp.diff(positions, axis=0))


@jax.jit
@jax.grad
def slope(positions, clearance):
    """Return the derivative of the last gate with respect to every reading, (ticks,)."""
    shares = _shares(positions, clearance)
    return gate(shares[1], shares[0])


def rig(positions, clearance=np.inf):
    def beyond(x):
        return float(x) if x > 0 else float(min(x + clearance, 0.0))

    def lane(x):
        shares = [
            on_the_rig.share_beyond(beyond(now), beyond(last), float(now - last)) for last, now in pairwise(x)
        ]
        return [on_the_rig.gate(s, last) for s, last in zip(shares, [0.0, *shares], strict=False)]

    return np.array([lane(x) for x in np.asarray(positions).T]).T


SIDES = pytest.mark.parametrize("gates", [on_jax, rig])


def crossing(enters, leaves):
    """Return a reading (ticks, lanes) that exceeds 0 between the two times, in periods."""
    rising, falling = TICKS[:, None] - enters, leaves - TICKS[:, None]
    return np.where(rising < falling, rising, falling)


@SIDES
def test_sum_of_contact_gate_equals_contact_time_and_gate_lags_one_period(gates):
    enters, duration = (leaf.ravel() for leaf in np.meshgrid(PHASES, 7.3 + PHASES))
    leaves = enters + duration
    result = gates(crossing(enters, leaves))
    np.testing.assert_allclose(result.sum(axis=0), duration, rtol=0, atol=1e-13)
    moment = np.einsum("t,tn->n", TICKS[1:], result)
    np.testing.assert_allclose(moment, (leaves**2 - enters**2) / 2 + duration, rtol=0, atol=1e-11)


@SIDES
def test_contact_gate_is_1_in_contact_0_outside_and_triangular_between(gates):
    result = gates(crossing(PHASES, PHASES + 20))
    age = TICKS[1:, None] - PHASES
    # The integral of the triangle from the onset to this tick, at most two periods.
    entered = np.where(age < 1, age**2 / 2, 1 - (2 - age) ** 2 / 2)
    entered = np.where(age < 0, 0, np.where(age > 2, 1, entered))
    early = TICKS[1:] < 15
    np.testing.assert_allclose(result[early], entered[early], rtol=0, atol=1e-14)
    # The release mirrors the onset.
    release_gates = gates(crossing(PHASES - 20, PHASES))
    np.testing.assert_allclose(release_gates[early][1:], 1 - entered[early][1:], rtol=0, atol=1e-14)
    assert np.all((result >= 0) & (result <= 1)) and np.any(result == 1) and np.any(result == 0)


def test_contact_gate_is_continuously_differentiable_in_crossing_time():
    def gates_of(enters):
        x = jnp.asarray(TICKS, float) - enters
        excess = jnp.where(x > 0, x, 0)
        shares = share_beyond(excess[1:], excess[:-1], jnp.diff(x))
        return gate(shares[1:], shares[:-1])

    slope_of = jax.jit(jax.jacfwd(gates_of))
    for at in (-1.0, 0.0, 2.0):  # times at which an onset moves to another tick
        slopes = [slope_of(jnp.asarray(at + side)) for side in (-1e-9, 0.0, 1e-9)]
        np.testing.assert_allclose(slopes[0], slopes[2], rtol=0, atol=1e-8)
        np.testing.assert_allclose(slopes[1], slopes[2], rtol=0, atol=1e-8)
        assert np.abs(slopes[0]).max() > 0.9


@SIDES
def test_contact_gate_is_reduced_while_reading_crosses_gap_between_surfaces(gates):
    speed = np.array([0.5, 1.1, 2.9, 6.0, 30.0])
    down = 10.5 * speed - speed * TICKS[:, None]
    result = gates(down, CLEARANCE)[8:]
    free = (1 - result).sum(axis=0)
    np.testing.assert_allclose(free[:2], CLEARANCE / speed[:2], rtol=0, atol=1e-12)
    assert np.all((free[2:] > 0) & (free[2:] < CLEARANCE / speed[2:]))
    assert np.all(gates(np.full((5, 1), -1.0), CLEARANCE) == 0)
    assert np.all(gates(np.full((5, 1), -4.0), CLEARANCE)[1:] == 1)
    assert np.all(gates(np.array([[1.0], [-1.0], [2.0]]), 0.0)[1:] == 1)


# Neither values nor their differences are subnormal: XLA programs flush such numbers to 0.
NORMAL = st.floats(-1e3, 1e3).filter(lambda x: x == 0 or abs(x) > 1e-290)
READINGS = NORMAL | st.sampled_from([0.0, 1e-300, -1e-300, -CLEARANCE])


@given(st.lists(READINGS, min_size=3, max_size=3), st.sampled_from([np.inf, 0.0, CLEARANCE]))
def test_contact_gates_of_jax_and_runtime_agree_and_have_finite_derivatives(readings, clearance):
    x = np.array(readings)[:, None]
    np.testing.assert_allclose(on_jax(x, clearance), rig(x, clearance), rtol=0, atol=1e-12)
    # The derivative for a change of a few denormals overflows.
    if np.abs(np.diff(x, axis=0))[np.diff(x, axis=0) != 0].min(initial=1.0) > 1e-150:
        assert np.all(np.isfinite(slope(jnp.asarray(x[:, 0]), clearance)))
