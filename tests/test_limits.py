"""Velocity and acceleration limits of the command: no violation, no overshoot, no effect if not reached."""

import dataclasses

import cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case
from hypothesis import given, settings
from hypothesis import strategies as st
from lanes import mechanism, run_record

from jaxhil.simulation.metrics import OK
from jaxhil.simulation.rate_limits import limit_command

PERIOD, VELOCITY_LIMIT, ACCELERATION_LIMIT = 1e-3, 0.02, 0.5


@jax.jit
def limit_commands(targets, velocity_limit, acceleration_limit):
    """Return the limited commands c(n), n >= 1, of a model at `targets` that starts in uniform motion."""

    def tick(carry, pair):
        command, step = carry
        before, target = pair
        period = jnp.asarray(PERIOD, targets.dtype)
        command, step = limit_command(
            target, before, command, step, period, velocity_limit, acceleration_limit
        )
        return (command, step), command

    pairs = jnp.stack([targets[:-1], targets[1:]], axis=1)
    return jax.lax.scan(tick, (targets[0], targets[1] - targets[0]), pairs)[1]


def limited_motion(targets, velocity_limit=np.inf, acceleration_limit=np.inf):
    """Return the result of `limit_commands`, preceded by the initial position."""
    limits = np.array([velocity_limit, acceleration_limit], np.asarray(targets).dtype)
    return np.concatenate([targets[:1], np.asarray(limit_commands(jnp.asarray(targets), *limits))])


def moves(speeds):
    return np.concatenate([[0.0], np.cumsum(PERIOD * np.asarray(speeds))])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.floats(-0.08, 0.08), min_size=8, max_size=8))
def test_command_velocity_and_acceleration_limits_hold_for_any_motion(speeds):
    # The drives can reach the initial speed.
    speeds[0] = np.clip(speeds[0], -VELOCITY_LIMIT, VELOCITY_LIMIT)
    commands = limited_motion(moves(np.repeat(speeds, 12)), VELOCITY_LIMIT, ACCELERATION_LIMIT)
    steps = np.diff(commands)
    assert np.abs(steps).max() <= VELOCITY_LIMIT * PERIOD * (1 + 1e-9)
    assert np.abs(np.diff(steps)).max() <= ACCELERATION_LIMIT * PERIOD**2 * (1 + 1e-9)


def gap(distance, speed=0.0):
    """Return the distance of the command behind a target that moves at `speed` and jumps by `distance`."""
    targets = moves(np.full(800, speed))
    targets[2:] += distance
    return (targets - limited_motion(targets, VELOCITY_LIMIT, ACCELERATION_LIMIT)) * np.sign(distance)


@pytest.mark.parametrize("speed", [0.0, 0.003, -0.004])
@pytest.mark.parametrize("distance", [1e-7, 3.3e-6, 1e-4, 2.7e-3, -1e-3])
def test_limited_command_reaches_displaced_target(distance, speed):
    behind = gap(distance, speed)
    assert np.all(behind[:2] == 0) and abs(behind[-1]) < 1e-12
    # The gap closes completely and is never overshot.
    assert np.diff(behind[2:]).max() < 1e-15
    assert behind.min() > -1e-15


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.floats(1e-9, 1e-3), st.floats(-VELOCITY_LIMIT / 4, VELOCITY_LIMIT / 4))
def test_limited_command_does_not_overshoot_displaced_target(distance, speed):
    behind = gap(distance, speed)
    assert behind.min() > -1e-15 and abs(behind[-1]) < 1e-15


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.integers(1, 30), st.floats(0, 1))
def test_limited_command_reaches_displaced_target_in_fewest_periods(count, spare):
    change = ACCELERATION_LIMIT * PERIOD**2
    distance = (count**2 - spare * (2 * count - 2 if count > 1 else 1)) * change
    targets = np.r_[0.0, 0.0, np.full(200, distance)]
    commands = limited_motion(targets, acceleration_limit=ACCELERATION_LIMIT)
    steps = np.count_nonzero(np.abs(commands - distance)[2:] > 1e-12 * change + 1e-15)
    assert steps <= 2 * count - 2


@pytest.mark.parametrize("limit", [1.0, 0.1])
def test_limited_command_stops_in_the_minimum_time(limit):
    """A displacement x takes at least 2 sqrt(x/a).

    The time until 0.99 x is shorter by sqrt(2 x/a)/10; times are whole periods.
    """
    distance = 1e-4
    commands = limited_motion(np.r_[0.0, 0.0, np.full(600, distance)], acceleration_limit=limit)
    ticks = np.argmax(commands > 0.99 * distance) - 1
    fastest = (2 - 0.1 * np.sqrt(2)) * np.sqrt(distance / limit) / PERIOD
    assert fastest - 1 <= ticks <= 1.05 * fastest + 2


@pytest.mark.parametrize(("dtype", "margin"), [("float64", 1.01), ("float32", 1.05)])
@pytest.mark.parametrize("offset", [0, 1e-3, -0.1])
def test_command_limits_that_are_not_reached_leave_commands_bit_identical(offset, dtype, margin):
    time = PERIOD * np.arange(400)
    smooth = offset + 0.01 * np.sin(2 * np.pi * 3 * time)
    steps = np.diff(smooth)
    loose = margin * np.abs(steps).max() / PERIOD, margin * np.abs(np.diff(steps)).max() / PERIOD**2
    targets = smooth.astype(dtype)
    for limits in (loose, (loose[0], np.inf), (np.inf, loose[1])):
        np.testing.assert_array_equal(limited_motion(targets, *limits), targets)
    # Limits that are lower than the motion requires change the commands.
    assert np.abs(limited_motion(targets, loose[0] / margin**2, np.inf) - targets).max() > 1e-6
    assert np.abs(limited_motion(targets, np.inf, loose[1] / margin**2) - targets).max() > 1e-7


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("origin", [0.0, 0.05])
def test_command_limit_that_is_just_reached_does_not_change_the_command(origin, dtype):
    speed, period = np.array(VELOCITY_LIMIT, dtype), np.array(PERIOD, dtype)
    targets = np.full(400, origin - 0.004, dtype)
    for n in range(1, len(targets)):
        targets[n] = targets[n - 1] + period * speed
    np.testing.assert_array_equal(limited_motion(targets, speed, ACCELERATION_LIMIT), targets)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.floats(1e-9, 1e-3), st.floats(-VELOCITY_LIMIT / 4, VELOCITY_LIMIT / 4), st.floats(-0.05, 0.05))
def test_limited_command_equals_target_bit_for_bit_after_reaching_the_target(distance, speed, origin):
    targets = origin + moves(np.full(800, speed))
    targets[2:] += distance
    commands = limited_motion(targets, VELOCITY_LIMIT, ACCELERATION_LIMIT)
    np.testing.assert_array_equal(commands[-50:], targets[-50:])


@pytest.mark.parametrize("limits", [(0.0053, np.inf), (np.inf, 0.06), (0.0053, 0.06)])
def test_command_limits_hold_over_a_whole_contact(limits):
    names = ("velocity_limit", "acceleration_limit")
    simulator = {"model": "ideal"} | {n: x for n, x in zip(names, limits, strict=True) if np.isfinite(x)}
    batch = cases.build_batch({"": Case(mechanism({"law": "linear"}, simulator, 0.012, period=PERIOD))})
    loop = dataclasses.replace(batch.loop, has_limits=True)
    metrics, ticks = run_record(loop, batch.gains, batch.scenario, 320)
    commands = np.asarray(ticks.signals.position_measured)[:, 0]
    wanted = np.asarray(ticks.signals.position_desired)[:, 0]
    going = np.asarray(ticks.active)[:, 0]
    behind = np.abs(wanted - commands)
    steps = np.diff(commands[going])
    assert np.abs(steps).max() <= limits[0] * PERIOD * (1 + 1e-9)
    assert np.abs(np.diff(steps)).max() <= limits[1] * PERIOD**2 * (1 + 1e-9)
    # The limits are reached in this contact: the model is faster than the drives.
    assert metrics.status[0, 0] == OK
    # Ticks from the first touch to the tick at which the contact ends.
    begin, end = np.argmax(np.asarray(ticks.plant_signals.force)[:, 0] != 0), np.argmin(going)
    largest = behind[begin : end + 1].max()
    assert largest > 1e-6 and metrics.position_shortfall[0, 0] == pytest.approx(largest, rel=1e-9)
