"""Hexapod: inverse and forward kinematics; equal legs compared with a task-space simulator; two robots."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from six_axes import lanes, place, second_order

from jaxhil.sixdof.axes import AxisMotion, actuate, build_axes, read_samples, start_uniform_motion
from jaxhil.sixdof.kinematics import TaskSpace, TwoRobots
from jaxhil.sixdof.stewart import Stewart, condition
from jaxhil.sixdof.vectors import vector

pytestmark = pytest.mark.slow
BATCH = (2,)
ANGLES = np.radians([[-8, 8, 112, 128, 232, 248], [-52, 52, 68, 172, 188, 292]])
PERIOD, TICKS, RING = 1e-3, 400, 32


def joints(radius, angles):
    circle = radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles])
    return vector(lanes(circle, BATCH))


def hexapod():
    return Stewart(joints(1.2, ANGLES[0]), joints(0.7, ANGLES[1]), place([0, 0, 1.1], BATCH))


def poses():
    seeded = np.random.default_rng(3)
    scales = np.array([0.1, 0.1, 0.1, 0.2, 0.2, 0.2])[:, None]
    return [jnp.asarray(scales * seeded.uniform(-1, 1, (6, 2))) for _ in range(3)]


def test_hexapod_pose_survives_inverse_and_forward_kinematics():
    rig, (at, rate, bend) = hexapod(), poses()

    def along(time):
        return rig.command(at + time * rate + time**2 / 2 * bend)

    def slope(function):
        return lambda time: jax.jvp(function, (time,), (jnp.ones_like(time),))[1]

    now = jnp.asarray(0.0)
    legs = AxisMotion(along(now), slope(along)(now), slope(slope(along))(now))
    result = jax.jit(lambda *given: rig.coordinates(*given))(legs, at + 2e-3)
    for part, expected in zip(result, (at, rate, bend), strict=True):
        np.testing.assert_allclose(part, expected, atol=1e-10)
    assert np.all(np.asarray(condition(rig, at)) < 100)


def test_hexapod_pose_derivatives_agree_with_differences():
    rig, (at, *_) = hexapod(), poses()
    legs = rig.command(at)

    @jax.jit
    def pose(scale):
        changed = Stewart(scale * rig.base, rig.platform, rig.height)
        return changed.coordinates(AxisMotion(legs, 0 * legs, None), at).position

    one = jnp.asarray(1.0)
    _, result = jax.jvp(pose, (one,), (one,))
    expected = (pose(one + 1e-6) - pose(one - 1e-6)) / 2e-6
    np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-8)
    assert np.max(np.abs(result)) > 0.1


def oscillate(kinematics, axes, amplitude):
    """Return the coordinates at the sensor for an oscillating command."""
    shape = jnp.asarray([1.0, -0.5, 0.7, 0.8, 0.6, -0.9])[:, None] * jnp.ones((6, 2))
    number = kinematics.command(shape).shape[0]
    late = lanes([4.4e-3] * number, BATCH)
    zero, period = jnp.zeros(BATCH), PERIOD + jnp.zeros(BATCH)
    plant = build_axes(second_order(axes + 0 * late, 0.8 + 0 * late, late), zero, zero, period, "linear")
    start = kinematics.command(0 * shape)
    hardware = start_uniform_motion(plant, start, 0 * start, period, "linear", 0, RING)

    def body(hardware, tick):
        seen = kinematics.coordinates(read_samples(plant, hardware, tick).motion, 0 * shape)
        way = jnp.sin(2 * np.pi * 3.0 * PERIOD * (tick + 1).astype(float)) ** 2
        hardware = actuate(plant, hardware, tick, kinematics.command(amplitude * way * shape), "linear", 0)
        return hardware, jnp.concatenate([seen.position, seen.rate])

    return lax.scan(body, hardware, jnp.arange(TICKS, dtype=jnp.int32))[1]


def test_hexapod_with_equal_legs_equals_task_space_simulator_for_small_strokes():
    """The difference is of second order in the stroke."""
    both = [
        [np.asarray(jax.jit(oscillate, static_argnums=(1, 2))(one, 12.0, size)) for size in (1e-2, 1e-3)]
        for one in (hexapod(), TaskSpace())
    ]
    large, small = (np.max(np.abs(a - b)) for a, b in zip(*both, strict=True))
    assert np.max(np.abs(both[0][0])) > 0.01 and large > 1e-6
    np.testing.assert_allclose(large / small, 100, rtol=0.2)


def test_two_equal_robots_move_like_a_single_robot():
    share = lanes([0.2, 0.3, 0.0, 0.7, 1.0, 0.5], BATCH)
    one, two = (jax.jit(oscillate, static_argnums=(1, 2)) for _ in range(2))
    expected = np.asarray(one(TaskSpace(), 12.0, 0.01))
    np.testing.assert_allclose(two(TwoRobots(share), 12.0, 0.01), expected, atol=1e-14)
    # A slow second robot changes the motion by its share.
    slow = jnp.concatenate([lanes([12.0] * 6, BATCH), lanes([3.0] * 6, BATCH)])
    result = np.asarray(jax.jit(lambda share: oscillate(TwoRobots(share), slow, 0.01))(share))
    apart = np.max(np.abs(result - expected), axis=(0, 2))
    assert apart[2] < 1e-14 and np.all(apart[[0, 1, 3, 4, 5]] > 1e-5)


@pytest.mark.parametrize("hold", ["linear", "zoh"])
@pytest.mark.parametrize("has_window", [False, True])
def test_readings_before_the_first_tick_include_the_ripple_of_held_commands(hold, has_window):
    """The delays are 4.4 ms and 7.3 ms; uniform commands must write the same delay line."""
    late = lanes([4.4e-3, 7.3e-3, 1e-3, 0.0, 2.5e-3, 3.7e-3], BATCH)
    zero, period = jnp.zeros(BATCH), PERIOD + jnp.zeros(BATCH)
    simulator = second_order(12.0 + 0 * late, 0.8 + 0 * late, late)
    if has_window:
        unity = jnp.ones((1, *late.shape))
        simulator = simulator._replace(numerator=unity, denominator=unity, window=0.0124 + 0 * late)
    plant = build_axes(simulator, 2.3e-3 + zero, zero, period, hold, True, True)
    at, stride = lanes([1e-3] * 6, BATCH), lanes([1e-5, -2e-5, 5e-5, 1e-4, -3e-5, 4e-5], BATCH)

    def body(hardware, tick):
        seen = read_samples(plant, hardware, tick)
        return actuate(plant, hardware, tick, at + (tick + 1).astype(float) * stride, hold, 1), seen

    first = start_uniform_motion(plant, at, stride, period, hold, 1, RING)
    ticks = jnp.arange(2 * RING, dtype=jnp.int32)
    seen = jax.jit(lambda: lax.scan(body, first, ticks)[1])()
    for part in (seen.motion.rate, seen.motion.acceleration):
        scale = 1e-9 * max(float(np.max(np.abs(part))), 1e-3)
        np.testing.assert_allclose(part, np.broadcast_to(part[-1], part.shape), atol=scale)
    steps = np.diff(seen.motion.position, axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(stride, steps.shape), atol=1e-15)
    ripple = np.max(np.abs(np.asarray(seen.motion.rate) - np.asarray(stride) / PERIOD))
    assert (ripple > 1e-5) == (hold == "zoh")
