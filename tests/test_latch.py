"""Latches: condition for capture, and spring that connects the captured bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from six_axes import lanes, place

from jaxhil.sixdof.latch import Latch, init_latch, latch_wrench
from jaxhil.sixdof.relative import Pose, Twist
from jaxhil.sixdof.rotations import exponential, left_jacobian
from jaxhil.sixdof.vectors import components, vector

BATCH = (1,)
STIFFNESS = np.diag([1e5, 1.3e5, 2e5, 5e3, 7e3, 4e3])
STIFFNESS[0, 4] = STIFFNESS[4, 0] = 6e3


def latch(from_start, damping=0.0):
    number = lanes([1.0], BATCH)
    return Latch(
        place([0, 0, 0], (1, 1)), 1e-3 * number, 0.05 * number, jnp.inf * number,
        lanes(STIFFNESS, (1, 1)), damping * lanes(STIFFNESS, (1, 1)), jnp.full((1, 1), from_start),
    )  # fmt: skip


def at(position, theta):
    return Pose(place(position, BATCH), exponential(place(theta, BATCH)))


def test_latch_captures_and_holds_bodies_that_are_deep_enough_and_aligned():
    """The force is zero until the capture; then it is the force of a spring."""
    one = latch(False)
    still = Twist(place([0, 0, 0], BATCH), place([0, 0, 0], BATCH))
    state = init_latch(one, at([0, 0, 0.01], [0, 0, 0]))
    step = jax.jit(latch_wrench)
    for position, theta in (([0, 0, -5e-4], [0, 0, 0]), ([0, 0, -2e-3], [0.06, 0, 0])):
        wrench, state = step(one, state, at(position, theta), still)
        assert not state.caught.any() and not np.any(components(wrench.force))
    caught = [3e-3, 0, -2e-3]
    wrench, state = step(one, state, at(caught, [0.01, 0, 0]), still)
    assert state.caught.all() and np.max(np.abs(components(wrench.force))) < 1e-12
    # Include distant bodies, and rotation about T's origin.
    wrench, state = step(one, state, at([3e-3, 0, 0.098], [0.01, 0, 0]), still)
    np.testing.assert_allclose(components(wrench.force)[:, 0], [0, 0, -2e4], atol=1e-9)
    np.testing.assert_allclose(components(wrench.moment)[:, 0], [0, 3e-3 * 2e4, 0], atol=1e-9)
    assert state.caught.all()


@pytest.mark.slow
def test_wrench_of_several_latches_is_sum_of_separate_wrenches():
    one, share = latch(False, 0.01), jnp.array([[1.0], [2.0], [3.0]])
    points = place([[0.2, 0.2, 0.2], [-0.1, 0.0, 0.3], [0.0, 0.0, 0.0]], BATCH)
    all_three = Latch(
        points, share * one.depth, share * one.angle, share * one.speed,
        share[None, None] * one.stiffness, share[None, None] ** 2 * one.damping, share < 0,
    )  # fmt: skip
    motion = Twist(place([0.01, 0.02, -0.01], BATCH), place([0.1, 0.0, 0.2], BATCH))

    @jax.jit
    def after(latches):
        held = init_latch(latches, at([0, 0, 0.01], [0, 0, 0]))
        poses = [([0, 0, -5e-3], [0.02, 0, 0]), ([0.01, 0, -8e-3], [0.01, 0.02, 0.03])]
        stacked = jax.tree.map(lambda *parts: jnp.stack(parts), *(at(*pose) for pose in poses))
        return jax.lax.scan(lambda held, pose: latch_wrench(latches, held, pose, motion)[::-1], held, stacked)

    held, together = after(all_three)
    assert held.caught.shape == (3, 1) and held.caught.all()
    # For a separate wrench, the other latches are never captured.
    alone = [after(all_three._replace(depth=jnp.where(one[:, None], 1e-3, jnp.inf))) for one in np.eye(3) > 0]
    assert all(held.caught.sum() == 1 for held, _ in alone)
    for result, *parts in zip(
        *map(jax.tree.leaves, (together, *(wrench for _, wrench in alone))), strict=True
    ):
        np.testing.assert_allclose(result, sum(parts), rtol=1e-9, atol=1e-9)
    assert np.max(np.abs(components(together.force))) > 1e3


@pytest.mark.slow
def test_latch_spring_is_conservative():
    """The spring does no work around a closed path of large rotations."""
    phase = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    way = 0.8 * np.stack([np.cos(phase) - 1, np.sin(phase), 0.5 * np.sin(2 * phase)])
    rates = 0.8 * np.stack([-np.sin(phase), np.cos(phase), np.cos(2 * phase)])
    one, still = latch(True), Twist(place([0, 0, 0], BATCH), place([0, 0, 0], BATCH))
    state = init_latch(one, at([0, 0, 0], [0, 0, 0]))

    @jax.jit
    def power(theta, rate):
        wrench, _ = latch_wrench(one, state, Pose(still.linear, exponential(vector(theta))), still)
        angular = left_jacobian(vector(theta), vector(rate))
        return jnp.sum(components(wrench.moment) * components(angular))

    work = [
        power(*(jnp.asarray(part[:, None]) for part in parts)) for parts in zip(way.T, rates.T, strict=True)
    ]
    assert np.max(np.abs(work)) > 100 and abs(np.mean(work)) < 1e-9 * np.max(np.abs(work))
