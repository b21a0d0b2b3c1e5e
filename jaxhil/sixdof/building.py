"""Construction of scenarios and loops from a six-axis mechanism, with nominal or drawn values.

Values are computed in NumPy, or in JAX if the draws are JAX arrays. The last axis of all arrays is the batch.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.sensor_filter import find_modes
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.six_axes_rig import Tool
from jaxhil.simulation.scenario import MotionSimulatorBatch, build_timing
from jaxhil.sixdof import sensor
from jaxhil.sixdof.approach import begin, find_touching_height
from jaxhil.sixdof.bodies import Body, build_body, build_state
from jaxhil.sixdof.building_contacts import build_groups, build_latches
from jaxhil.sixdof.drawn_values import DrawnValues
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.kinematics import Kinematics, TaskSpace, TwoRobots
from jaxhil.sixdof.loop import build_loop
from jaxhil.sixdof.loop_state import Loop
from jaxhil.sixdof.relative import Pair, Pose, States, Twist
from jaxhil.sixdof.rotations import Quaternion, exponential
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.stewart import Stewart
from jaxhil.sixdof.vectors import Vector, vector

APPROACH_DURATION = 0.02  # duration of the flight before the first touch, without the phase [s]
DEFAULT_DURATION = 10.0  # duration of a run if [start] does not specify a duration [s]


def build_scenarios(
    mechanism: SixAxisMechanism, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
) -> Scenario:
    """Build a batch of scenarios of a mechanism.

    Args:
        mechanism: Mechanism with the nominal values.
        draws: Drawn values by dotted path, (scenarios,), or (scenarios, *entries) for lists. All other values
            are nominal. None builds the nominal scenario alone.
        seed: Seed of the sensors' noise.
        first: Index of the first scenario. The noise of a scenario depends only on seed and index.
    """
    numbers = DrawnValues(mechanism, dict(draws or {}))
    bodies = Pair(*(_body(numbers, name) for name in ("target", "chaser")))
    groups = build_groups(mechanism, numbers)
    indices = np.arange(first, first + numbers.number, dtype=np.uint32)
    key: Any = np.stack([np.full(numbers.number, seed & 0xFFFFFFFF, np.uint32), indices])
    period = numbers("rig.control_period")
    if mechanism.start is not None:
        start = _specified(numbers, bodies)
        duration = (
            numbers("start.duration") if mechanism.start.duration else numbers.constant(DEFAULT_DURATION)
        )
    else:
        before = APPROACH_DURATION + numbers("approach.phase") * period
        start = _before_touch(numbers, bodies, groups, before)
        duration = before + numbers("approach.duration")
    # Compiled functions accept only JAX arrays.
    return jax.tree.map(jnp.asarray, Scenario(
        bodies=bodies,
        start=start,
        groups=groups,
        latches=build_latches(mechanism, numbers),
        simulator=_simulator(mechanism, numbers),
        kinematics=_kinematics(mechanism, numbers),
        sensor=_sensor(mechanism, numbers),
        control_period=period,
        duration=duration,
        key=key,
        timing=build_timing(numbers.optional),
    ))  # fmt: skip


def make_loop(mechanism: SixAxisMechanism, compensator: str, scenario: Scenario) -> Loop:
    """Return the loop that runs a mechanism's scenarios with a compensator."""
    rig, sensor, low_pass = mechanism.rig, scenario.sensor, mechanism.rig.force_sensor.filter
    return build_loop(
        scenario,
        integrator=rig.integrator,
        hold=rig.command_hold,
        latency=rig.command_latency,
        side=rig.force_sensor.side,
        sensor_filter=None if low_pass is None else find_modes(low_pass.kind, low_pass.order),
        cuts_dead_zone=rig.force_sensor.dead_zone_kind == "cut"
        and bool(np.any(np.asarray(sensor.errors.dead_zone) > 0)),
        has_noise=bool(np.any(np.asarray(sensor.noise_std) > 0)),
        has_pose_errors=any(
            bool(np.any(np.asarray(values) > 0))
            for values in (sensor.position_noise_std, sensor.position_quantum)
        ),
        compensator=compensator,
        episodes=mechanism.approach.episodes if mechanism.approach else 1,
        whole=mechanism.start is not None and mechanism.start.duration is not None,
    )


def _body(numbers: DrawnValues, name: str) -> Body:
    rotation_path = f"{name}.interface_rotation"
    return build_body(
        jnp.asarray(numbers(f"{name}.mass")),
        numbers.matrix(numbers.inertia(f"{name}.inertia")),
        numbers.vector(numbers(f"{name}.interface")),
        None if numbers.is_zero(rotation_path) else numbers.rotation(numbers(rotation_path)),
    )


def _specified(numbers: DrawnValues, bodies: Pair) -> States:
    """Return the bodies' states from the table [start] of the mechanism file."""

    def state(name: str, body: Body):
        parts = numbers(f"start.{name}.attitude")
        norm = numbers.np.sqrt((parts**2).sum(axis=0))
        attitude = Quaternion(jnp.asarray(parts[0] / norm), numbers.vector(parts[1:] / norm))
        position, velocity = (
            numbers.vector(numbers(f"start.{name}.{key}")) for key in ("position", "velocity")
        )
        return build_state(
            body, position, velocity, attitude, numbers.vector(numbers(f"start.{name}.angular_velocity"))
        )

    return States(state("target", bodies.target), state("chaser", bodies.chaser))


def _before_touch(
    numbers: DrawnValues, bodies: Pair, groups: tuple[ContactGroup, ...], before: Any
) -> States:
    """Return the bodies' states `before` [s] before the first touch, which the table [approach] describes."""
    keys = ("offset", "attitude", "velocity", "angular_velocity")
    return _compute_start(bodies, groups, *(numbers(f"approach.{key}") for key in keys), before)


@jax.jit
def _compute_start(bodies, groups, offset, attitude, velocity, angular_velocity, before) -> States:
    """Return the bodies' states `before` [s] before a first touch with the given relative motion."""
    rotation = exponential(vector(attitude))
    height = find_touching_height(groups, offset[0], offset[1], rotation)
    pose = Pose(Vector(offset[0], offset[1], height), rotation)
    return begin(bodies, pose, Twist(vector(velocity), vector(angular_velocity)), before)


def _kinematics(mechanism: SixAxisMechanism, numbers: DrawnValues) -> Kinematics:
    path, simulator = "rig.simulator.", mechanism.rig.simulator
    if simulator.space == "task":
        return TaskSpace()
    if simulator.space == "two_robots":
        return TwoRobots(jnp.asarray(numbers(path + "target_robot.share")))
    base, platform = (
        numbers.vector(numbers.np.moveaxis(numbers(path + key), 1, 0)) for key in ("base", "platform")
    )
    height, stroke = numbers.vector(numbers(path + "height")), numbers(path + "stroke", [0.0, np.inf])
    return Stewart(base, platform, height, jnp.asarray(stroke))


def _simulator(mechanism: SixAxisMechanism, numbers: DrawnValues) -> MotionSimulatorBatch:
    """Return the motion simulator of all axes; num(s)/den(s) has order 0 for "ideal" and "moving_average"."""
    path, model = "rig.simulator.", mechanism.rig.simulator.model

    def of(key: str) -> Any:
        """Return the values of a key for all axes; with two robots, the axes of the chaser's robot are first.

        If the file has no value for the target's robot, both robots have the same value.
        """
        chaser = numbers(path + key)
        if mechanism.rig.simulator.target_robot is None:
            return chaser
        target = path + "target_robot." + key
        return numbers.np.concatenate([chaser, numbers(target) if numbers.has_value(target) else chaser])

    delay = of("delay")
    ones, stack = 0 * delay + 1, numbers.np.stack
    numerator: Any
    denominator: Any
    if model in ("ideal", "moving_average"):
        numerator, denominator = np.zeros((0, *ones.shape)), ones[None]
    elif model == "first_order":
        numerator, denominator = ones[None], stack([of("time_constant"), ones])
    elif model == "second_order":
        frequency = 2 * np.pi * of("natural_frequency")
        numerator = stack([0 * ones, frequency**2])
        denominator = stack([ones, 2 * of("damping_ratio") * frequency, frequency**2])
    elif model == "third_order":
        a_1, a_2, a_3 = numbers(path + "coefficients")
        numerator, denominator = (
            stack([0 * ones, 0 * ones, ones]),
            stack([a_3 * ones, a_2 * ones, a_1 * ones, ones]),
        )
    else:
        denominator = numbers(path + "denominator")[:, None] * ones
        numerator = numbers(path + "numerator")[:, None] * ones
        missing = len(denominator) - 1 - len(numerator)
        numerator = numbers.np.concatenate([np.zeros((missing, *ones.shape)), numerator])
    limit: Any = np.full(ones.shape, np.inf)
    window = of("window") if model == "moving_average" else None
    return MotionSimulatorBatch(numerator, denominator, delay, limit, limit, window)


def _sensor(mechanism: SixAxisMechanism, numbers: DrawnValues) -> sensor.Sensor:
    """Build the force sensor and the controller's assumptions about the sensor."""
    path = "rig.force_sensor."
    nothing: Any = np.zeros((6, numbers.number))
    tool, low_pass, cutoff, slowest = _tool(mechanism, numbers), mechanism.rig.force_sensor.filter, None, 1.0
    if low_pass is not None:
        cutoff = 2 * np.pi * numbers(path + "filter.cutoff")
        slowest = find_modes(low_pass.kind, low_pass.order).slowest
    errors = sensor.SampleErrors(
        None if numbers.is_zero(path + "crosstalk") else np.eye(6)[:, :, None] + numbers(path + "crosstalk"),
        *(numbers(path + key) for key in ("bias", "quantum", "dead_zone", "range")),
    )
    gravity = numbers.vector(numbers(path + "gravity"))
    walk = path + "bias_random_walk"
    is_walking = walk in mechanism.uncertainty or not numbers.is_zero(walk)
    return sensor.Sensor(
        delay=numbers(path + "delay"),
        time_constant=numbers(path + "time_constant") if cutoff is None else 1 / (slowest * cutoff),
        cutoff=cutoff,
        errors=errors,
        noise_std=numbers(path + "noise_std"),
        bias_walk=numbers(walk) if is_walking else None,
        mounting=None,
        tool=tool,
        gravity=gravity,
        assumed_tool=_tool(mechanism, numbers, "_assumed"),
        assumed_gravity=gravity,
        assumed_bias=nothing,
        position_delay=numbers("rig.position_sensor.delay"),
        position_noise_std=numbers("rig.position_sensor.noise_std"),
        position_quantum=numbers("rig.position_sensor.quantum"),
    )


def _tool(mechanism: SixAxisMechanism, numbers: DrawnValues, assumed: str = "") -> sensor.Tool:
    """Build the real tool or, with the suffix "_assumed", the tool that the controller assumes.

    Without assumed values in the file, the controller assumes the nominal tool.
    """
    tool = mechanism.rig.force_sensor.tool or Tool(mass=0.0, com=[0.0, 0.0, 0.0])
    path = "rig.force_sensor.tool."
    return sensor.Tool(
        numbers(f"{path}mass{assumed}", tool.mass),
        numbers.vector(numbers(f"{path}com{assumed}", tool.com)),
        numbers.matrix(numbers.inertia(f"{path}inertia{assumed}", tool.inertia)),
    )
