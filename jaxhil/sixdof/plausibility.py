"""Checks of a nominal six-axis run: no contact at the start, poses within reach, and a limited duration."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxhil.errors import InputError
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, supported_options
from jaxhil.simulation.plausibility import check_jitter_poles, check_poles
from jaxhil.sixdof.approach import SEARCH_HEIGHT
from jaxhil.sixdof.building_contacts import candidate_names
from jaxhil.sixdof.candidates import motion_at
from jaxhil.sixdof.forces import deepest
from jaxhil.sixdof.latch import init_latch, latch_wrench
from jaxhil.sixdof.numerical_model import model_motion
from jaxhil.sixdof.relative import relative
from jaxhil.sixdof.rollout import SEGMENT_TICKS
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.stewart import Stewart, condition
from jaxhil.sixdof.vectors import dot

MAX_TICKS = 1e7  # maximum number of ticks of a run
MAX_ATTITUDE = 1.0  # maximum angle between the frames of chaser and target at the start [rad]
MAX_CONDITION_NUMBER = 100.0  # maximum condition number of a hexapod's Jacobian, with lengths in m
# Number of control periods between checks of a run. In this time, shapes must not pass through each other.
CHECK_PERIODS = SEGMENT_TICKS


class StartValues(NamedTuple):
    """Values at the start of a run, by which `check_scenario` decides whether the run can be simulated."""

    coordinates: Float[Array, "6 *batch"]  # coordinates of chaser frame C relative to target frame T
    depth: Float[Array, "*batch"]  # largest penetration [m]
    # per group: speed of the shapes [m/s], and penetration at which one has passed through the other [m]
    passing: tuple[tuple[Float[Array, "candidates *batch"], Float[Array, "candidates *batch"]], ...]
    caught: tuple[Bool[Array, "latches *batch"], ...]  # whether latches catch at the start
    # at the start and in the docked pose: lengths of a hexapod's legs [m], condition number of their Jacobian
    legs: tuple[Float[Array, "6 *batch"], ...]
    conditions: tuple[Float[Array, "*batch"], ...]


def check_scenario(mechanism: SixAxisMechanism, scenario: Scenario) -> None:
    """Raise `InputError` unless the nominal run of a mechanism can start.

    The bodies must start without contact, at a pose that the six coordinates and the rig can represent. The
    run must have at most 1e7 ticks.
    """
    ticks = float(scenario.duration[0] / scenario.control_period[0])
    where = "start" if mechanism.start is not None else "approach"
    if not ticks <= MAX_TICKS:
        found = f"{where}.duration: found {scenario.duration[0]:g} s, {ticks:.2g} control periods"
        raise InputError(f"{mechanism.name}: {found}, expected at most {MAX_TICKS:.0e} periods")
    denominator = np.asarray(scenario.simulator.denominator)[..., 0]
    period = np.full(denominator.shape[1], scenario.control_period[0])
    check_poles(mechanism.name, denominator, period)
    check_jitter_poles(mechanism.name, scenario.timing, denominator, period)
    start: StartValues = jax.tree.map(np.asarray, _compiled()(scenario))
    at = start.coordinates[:, 0]
    if not np.all(np.isfinite(at)):
        found = f"a chaser that passes the target without a touch (searched below {SEARCH_HEIGHT:g} m)"
        raise InputError(
            f"{mechanism.name}: approach.offset: found {found}, expected an offset in m that leads to a touch"
        )
    angle = float(np.linalg.norm(at[3:]))
    if angle > MAX_ATTITUDE:
        allowed = f"at most {MAX_ATTITUDE:g} rad between the interface frames (see interface_rotation)"
        key = "start.chaser.attitude" if mechanism.start else "approach.angular_velocity"
        found = f"{key}: found a rotation by {angle:.3g} rad at the start"
        raise InputError(f"{mechanism.name}: {found}, expected {allowed}")
    depth = float(start.depth[0])
    if depth > 0:
        key = "start.chaser.position" if mechanism.start else "approach.angular_velocity"
        change = "move the chaser along z" if mechanism.start else "reduce angular or sideways velocity"
        found = f"{key}: found a contact at the start, {depth:.3g} m deep"
        raise InputError(f"{mechanism.name}: {found}, expected a start without contact: {change}")
    _check_speed(mechanism, start, float(scenario.control_period[0]))
    for (name, latch), caught in zip(mechanism.latch.items(), start.caught, strict=True):
        if caught.any() and not latch.latched:
            found = f"latch.{name}.depth: found {latch.depth:g} m, with which the latch catches at the start"
            allowed = "a depth or an angle with which the latch catches later, or latched = true"
            raise InputError(f"{mechanism.name}: {found}, expected {allowed}")
    _check_legs(mechanism, start)


def _check_speed(mechanism: SixAxisMechanism, start: StartValues, period: float) -> None:
    """Raise `InputError` if shapes are so fast that they could pass through each other undetected."""
    speeds, sizes = (np.concatenate([pair[i][:, 0] for pair in start.passing] or [[]]) for i in (0, 1))
    for name, speed, size in zip(candidate_names(mechanism), speeds, sizes, strict=True):
        max_speed = size / (CHECK_PERIODS * period)
        if speed > max_speed:
            key = "start.chaser.velocity" if mechanism.start else "approach.velocity"
            found = f"{key}: found a speed of {speed:.3g} m/s between the shapes of contact.{name}"
            ratio = f"their size {size:.3g} m divided by {CHECK_PERIODS} control periods"
            allowed = f"at most {max_speed:.3g} m/s ({ratio})"
            raise InputError(f"{mechanism.name}: {found}, expected {allowed}")


def _check_legs(mechanism: SixAxisMechanism, start: StartValues) -> None:
    """Raise `InputError` if a hexapod cannot reach a required pose, or is nearly singular there.

    The required poses are the start and the docked pose, in which chaser frame C equals target frame T.
    """
    stroke = mechanism.rig.simulator.stroke
    poses = zip(("the start", "the docked pose"), start.legs, start.conditions, strict=False)
    for pose, legs, conditions in poses:
        lengths, number = legs[:, 0], float(conditions[0])
        if not number <= MAX_CONDITION_NUMBER:
            found = f"rig.simulator.base: found legs that are nearly singular at {pose}"
            allowed = f"joints whose Jacobian has a condition number of at most {MAX_CONDITION_NUMBER:g}"
            raise InputError(f"{mechanism.name}: {found} (condition number {number:.3g}), expected {allowed}")
        if stroke is not None and not (stroke[0] <= lengths.min() and lengths.max() <= stroke[1]):
            found = f"rig.simulator.stroke: found legs from {lengths.min():.4g} to {lengths.max():.4g} m"
            allowed = f"{stroke[0]:g} to {stroke[1]:g} m: change stroke or height"
            raise InputError(f"{mechanism.name}: {found} at {pose}, expected {allowed}")


@cache
def _compiled() -> Callable[[Scenario], StartValues]:
    return jax.jit(_start_values, compiler_options=supported_options(SINGLE_RUN_OPTIONS))


def _start_values(scenario: Scenario) -> StartValues:
    pose, twist = relative(scenario.bodies, scenario.start)
    at, *_ = model_motion(scenario.bodies, scenario.start)
    caught = tuple(
        latch_wrench(latch, init_latch(latch, pose), pose, twist)[1].caught for latch in scenario.latches
    )
    legs: tuple[Any, ...] = ()
    conditions: tuple[Any, ...] = ()
    hexapod = scenario.kinematics
    if isinstance(hexapod, Stewart):
        poses = at, jnp.zeros_like(at)
        legs = tuple(hexapod.command(pose_at) for pose_at in poses)
        conditions = tuple(condition(hexapod, pose_at) for pose_at in poses)
    lifted, moving = jax.tree.map(lambda leaf: leaf[None], (pose, twist))
    passing = []
    for group in scenario.groups:
        touch = group.candidates.touch(lifted)
        rate, slip = motion_at(touch, lifted, moving)
        passing.append(
            (jnp.sqrt(rate**2 + dot(slip, slip)), jnp.broadcast_to(group.candidates.size, rate.shape))
        )
    return StartValues(at, deepest(scenario.groups, pose), tuple(passing), caught, legs, conditions)
