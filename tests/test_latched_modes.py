"""Vibration modes of a latched contact under delay, and response error with its true stiffness.

A latch with a full stiffness matrix K connects bodies that are not aligned; M is their relative mass matrix.
The motion is so small that nonlinear terms are below rounding.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import lambertw
from six_axes import FULL, ideal_sensor, lanes, meeting, place, plain_body, second_order

from jaxhil.simulation.scenario import MotionSimulatorBatch
from jaxhil.sixdof.axes import actuate, build_axes, read_samples, start_uniform_motion
from jaxhil.sixdof.bodies import SHARES
from jaxhil.sixdof.kinematics import TaskSpace, to_rigid_motion
from jaxhil.sixdof.latch import Latch, init_latch, latch_wrench
from jaxhil.sixdof.loop import build_loop, model_motion, run
from jaxhil.sixdof.relative import Pair, Pose, Wrench, advance, mass_matrix
from jaxhil.sixdof.rotations import identity
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.vectors import components, vector

pytestmark = pytest.mark.slow
BATCH, PERIOD, TICKS, DELAY = (1,), 5e-4, 4000, 6e-3
UNEQUAL = [DELAY, 5e-3, 7e-3, 8e-3, 4e-3, 6.5e-3]
MODES, APART = 12, 20  # complex modes; ticks between the fitted samples
SMALL = 1e-7  # rad/s [m/s]
STIFFNESS = np.diag([1e5, 1.3e5, 2e5, 5e3, 7e3, 4e3])
STIFFNESS[0, 4] = STIFFNESS[4, 0] = 6e3


def latch():
    number = lanes([1.0], BATCH)
    stiffness = lanes(STIFFNESS, (1, 1))
    return Latch(place([0, 0, 0], (1, 1)), number, number, number, stiffness, 0 * stiffness, number > 0)


def docked_bodies():
    """Return docked bodies that move in all six coordinates."""
    bodies = Pair(
        plain_body(1800.0, FULL[0], (0.05, -0.02, 1.2), BATCH),
        plain_body(420.0, FULL[1], (0.01, 0.04, -1.0), BATCH),
    )
    twist = SMALL * lanes([1.0, 2.0, -1.0, 3.0, 1.0, -2.0], BATCH)
    return bodies, meeting(bodies, jnp.zeros((6, 1)), twist, jnp.zeros(1))


def scenario(delays):
    """Return a scenario with a motion simulator that only has delays."""
    late = lanes(delays, BATCH)
    free = late + jnp.inf
    simulator = MotionSimulatorBatch(jnp.zeros((0, 6, 1)), jnp.ones((1, 6, 1)), late, free, free)
    bodies, start = docked_bodies()
    return Scenario(
        bodies, start, (), (latch(),), simulator, TaskSpace(), ideal_sensor(jnp.zeros(1)),
        lanes(PERIOD, BATCH), lanes(TICKS * PERIOD, BATCH), jnp.zeros((2, 1), jnp.uint32),
    )  # fmt: skip


@pytest.mark.parametrize("delays", [[DELAY] * 6, UNEQUAL], ids=["equal", "unequal"])
def test_vibration_modes_of_latched_bodies_grow_as_characteristic_roots(delays):
    """Compare with the fastest growing root of det(s^2 M + K diag(exp(-s tau))) = 0.

    For equal delays this is the root of the stiffest mode, by Lambert's function. The integrator adds half a
    period of delay.
    """
    scenarios = scenario(delays)
    loop = build_loop(scenarios, integrator="zoh", hold="linear", latency=0)
    _, seen = jax.jit(run, static_argnums=(0, 3))(loop, {}, scenarios, TICKS)
    mass = np.asarray(mass_matrix(scenarios.bodies, scenarios.start))[..., 0]
    signal = np.concatenate([np.asarray(components(part))[..., 0] for part in seen.command])
    frequencies = np.sqrt(np.linalg.eigvals(np.linalg.solve(mass, STIFFNESS)).real)
    late = np.asarray(delays) + PERIOD / 2
    root = _fastest(mass, late, frequencies)
    if len(set(delays)) == 1:
        by_lambert = 2 / late[0] * lambertw(1j * np.max(frequencies) * late[0] / 2)
        np.testing.assert_allclose(root, by_lambert, rtol=1e-9)
    result = _growth(signal[:, 200::APART], root)
    assert abs(result - root) < 1e-4 * abs(root), (result, root)


def test_response_error_with_true_stiffness_cancels_rig_dynamics_of_latched_bodies():
    """Expect -K xi_a - K (xi_d - xi_a) = -K xi_d for six axes; the uncompensated run diverges."""
    bodies, start = docked_bodies()
    pose = Pose(vector(jnp.zeros((3, 1))), identity(jnp.zeros(1)))
    one, period = latch(), lanes(PERIOD, BATCH)
    simulator = second_order(lanes([14.0, 13.0, 12.0, 11.0, 10.0, 9.0], BATCH), 0.8, lanes(UNEQUAL, BATCH))
    axes = build_axes(simulator, 0 * period, 0 * period, period, "linear")
    at, rates, _ = model_motion(bodies, start)
    hardware = start_uniform_motion(axes, at, rates * PERIOD, period, "linear", 0, 64)
    still = init_latch(one, pose)

    def pulled(share):
        """Return the chaser's coordinates at every tick with the given share of the response error."""

        def tick(carry, now):
            states, hardware = carry
            motion = read_samples(axes, hardware, now).motion
            here = to_rigid_motion(motion)
            real, _ = latch_wrench(one, still, here.pose, here.twist)
            wanted, *_ = model_motion(bodies, states)
            missing = jnp.einsum("ij,jb->ib", jnp.asarray(STIFFNESS), wanted - motion.position)
            wrench = Wrench(
                real.force - share * vector(missing[:3]), real.moment - share * vector(missing[3:])
            )
            states = advance(bodies, states, wrench, period, SHARES["zoh"])
            sent, *_ = model_motion(bodies, states)
            return (states, actuate(axes, hardware, now, sent, "linear", 0)), wanted

        return jax.lax.scan(tick, (start, hardware), jnp.arange(TICKS // 2, dtype=jnp.int32))[1]

    def alone(states, _):
        """Simulate the numerical model with its own spring, without the rig."""
        wanted, *_ = model_motion(bodies, states)
        pull = -jnp.einsum("ij,jb->ib", jnp.asarray(STIFFNESS), wanted)
        wrench = Wrench(vector(pull[:3]), vector(pull[3:]))
        return advance(bodies, states, wrench, period, SHARES["zoh"]), wanted

    with_it, without = np.asarray(jax.jit(jax.vmap(pulled))(jnp.array([1.0, 0.0])))
    expected = np.asarray(jax.lax.scan(alone, start, None, length=TICKS // 2)[1])
    np.testing.assert_allclose(with_it, expected, atol=1e-5 * np.max(np.abs(expected)))
    assert np.max(np.abs(without[-200:])) > 100 * np.max(np.abs(expected))


def _fastest(mass, late, frequencies):
    """Return the root with the largest growth, by Newton's method from each mode under the mean delay."""

    def determinant(s):
        return np.linalg.det(s**2 * np.eye(6) + np.linalg.solve(mass, STIFFNESS @ np.diag(np.exp(-s * late))))

    roots = []
    for s in 2 / np.mean(late) * lambertw(1j * frequencies * np.mean(late) / 2) * (1 + 1e-3j):
        for _ in range(50):
            step = 1e-6 * abs(s)
            s = s - determinant(s) * 2 * step / (determinant(s + step) - determinant(s - step))
        roots.append(s)
    return max(roots, key=lambda s: s.real)


def _growth(signal, guess):
    """Return the complex frequency of the samples that is nearest to a guess (Prony's method)."""
    windows = [
        np.lib.stride_tricks.sliding_window_view(one / np.max(np.abs(one)), MODES + 1) for one in signal
    ]
    rows = np.concatenate(windows)
    coefficients, *_ = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)
    rates = np.log(np.roots([1, *-coefficients[::-1]]).astype(complex)) / (APART * PERIOD)
    return rates[np.argmin(np.abs(rates - guess))]
