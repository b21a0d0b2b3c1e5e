"""Construction of scenarios and loops from a six-axis mechanism, nominal or drawn.

Arrays are NumPy's until a run is compiled, except draws given as JAX arrays. The batch is the trailing axis.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.six_axes_rig import Tool
from jaxhil.simulation.scenario import MotionSimulatorBatch
from jaxhil.sixdof import sensor
from jaxhil.sixdof.approach import begin, touching_height
from jaxhil.sixdof.bodies import Body, build_body, build_state
from jaxhil.sixdof.building_contacts import build_groups, build_latches
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.kinematics import Kinematics, TaskSpace, TwoRobots
from jaxhil.sixdof.loop import Loop, build_loop
from jaxhil.sixdof.relative import Pair, Pose, States, Twist
from jaxhil.sixdof.rotations import Quaternion, exponential
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.stewart import Stewart
from jaxhil.sixdof.values import Values
from jaxhil.sixdof.vectors import Vector, vector

APPROACH = 0.02  # s; free flight before the first touch, in addition to the phase
LONGEST = 10.0  # s; duration of a run whose start does not specify one


def build_scenarios(
    mechanism: SixAxisMechanism, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
) -> Scenario:
    """Return a batch of scenarios of a mechanism.

    `draws` maps dotted paths to values, (number,), or (number, *entries) for lists; other numbers are
    nominal. Without draws the batch is the nominal run alone. Noise keys depend only on `seed` and `first` +
    lane.
    """
    numbers = Values(mechanism, dict(draws or {}))
    bodies = Pair(*(_body(numbers, name) for name in ("target", "chaser")))
    groups = build_groups(mechanism, numbers)
    indices = np.arange(first, first + numbers.number, dtype=np.uint32)
    key: Any = np.stack([np.full(numbers.number, seed & 0xFFFFFFFF, np.uint32), indices])
    period = numbers("rig.control_period")
    if mechanism.start is not None:
        start = _specified(numbers, bodies)
        duration = numbers("start.duration") if mechanism.start.duration else numbers.constant(LONGEST)
    else:
        before = APPROACH + numbers("approach.phase") * period
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
    ))  # fmt: skip


def loop_of(mechanism: SixAxisMechanism, compensator: str, scenario: Scenario) -> Loop:
    """Return the static loop of a mechanism's scenarios."""
    rig, sensor = mechanism.rig, scenario.sensor
    return build_loop(
        scenario,
        integrator=rig.integrator,
        hold=rig.command_hold,
        latency=rig.command_latency,
        side=rig.force_sensor.side,
        has_noise=bool(np.any(np.asarray(sensor.noise_std) > 0)),
        has_pose_errors=any(
            bool(np.any(np.asarray(values) > 0))
            for values in (sensor.position_noise_std, sensor.position_quantum)
        ),
        compensator=compensator,
        episodes=mechanism.approach.episodes if mechanism.approach else 1,
        whole=mechanism.start is not None and mechanism.start.duration is not None,
    )


def _body(numbers: Values, name: str) -> Body:
    """Return a body by its name."""
    turned = f"{name}.interface_rotation"
    return build_body(
        jnp.asarray(numbers(f"{name}.mass")),
        numbers.matrix(numbers.inertia(f"{name}.inertia")),
        numbers.vector(numbers(f"{name}.interface")),
        None if numbers.nothing(turned) else numbers.rotation(numbers(turned)),
    )


def _specified(numbers: Values, bodies: Pair) -> States:
    """Return the states of [start]."""

    def state(name: str, body: Body):
        parts = numbers(f"start.{name}.attitude")
        norm = numbers.np.sqrt((parts**2).sum(axis=0))
        attitude = Quaternion(jnp.asarray(parts[0] / norm), numbers.vector(parts[1:] / norm))
        motion = (numbers.vector(numbers(f"start.{name}.{key}")) for key in ("position", "velocity"))
        position, velocity = motion
        return build_state(
            body, position, velocity, attitude, numbers.vector(numbers(f"start.{name}.angular_velocity"))
        )

    return States(state("target", bodies.target), state("chaser", bodies.chaser))


def _before_touch(numbers: Values, bodies: Pair, groups: tuple[ContactGroup, ...], before: Any) -> States:
    """Return the states before the first touch of [approach]."""
    keys = ("offset", "attitude", "velocity", "angular_velocity")
    return _lowered(bodies, groups, *(numbers(f"approach.{key}") for key in keys), before)


@jax.jit
def _lowered(bodies, groups, offset, attitude, velocity, angular_velocity, before) -> States:
    """Return the states `before` [s] the chaser, with an offset and attitude, touches the target."""
    turned = exponential(vector(attitude))
    height = touching_height(groups, offset[0], offset[1], turned)
    pose = Pose(Vector(offset[0], offset[1], height), turned)
    return begin(bodies, pose, Twist(vector(velocity), vector(angular_velocity)), before)


def _kinematics(mechanism: SixAxisMechanism, numbers: Values) -> Kinematics:
    """Return the relation of axes and coordinates."""
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


def _simulator(mechanism: SixAxisMechanism, numbers: Values) -> MotionSimulatorBatch:
    """Return every axis's motion simulator as a transfer function; `ideal` has order 0."""
    path, model = "rig.simulator.", mechanism.rig.simulator.model

    def of(key: str) -> Any:
        """Return a key's values for all axes.

        With two robots, the target's axes follow the chaser's, and have the same values unless specified.
        """
        chaser = numbers(path + key)
        if mechanism.rig.simulator.target_robot is None:
            return chaser
        target = path + "target_robot." + key
        return numbers.np.concatenate([chaser, numbers(target) if numbers.has(target) else chaser])

    delay = of("delay")
    ones, stack = 0 * delay + 1, numbers.np.stack
    numerator: Any
    denominator: Any
    if model == "ideal":
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
    return MotionSimulatorBatch(numerator, denominator, delay, limit, limit)


def _sensor(mechanism: SixAxisMechanism, numbers: Values) -> sensor.Sensor:
    """Return the force sensor and the controller's assumptions about it."""
    path = "rig.force_sensor."
    nothing: Any = np.zeros((6, numbers.number))
    tool = _tool(mechanism, numbers)
    errors = sensor.SampleErrors(
        None if numbers.nothing(path + "crosstalk") else np.eye(6)[:, :, None] + numbers(path + "crosstalk"),
        *(numbers(path + key) for key in ("bias", "quantum", "dead_zone", "range")),
    )
    gravity = numbers.vector(numbers(path + "gravity"))
    return sensor.Sensor(
        delay=numbers(path + "delay"),
        time_constant=numbers(path + "time_constant"),
        errors=errors,
        noise_std=numbers(path + "noise_std"),
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


def _tool(mechanism: SixAxisMechanism, numbers: Values, assumed: str = "") -> sensor.Tool:
    """Return the tool or, with a suffix, the controller's assumed tool, by default the nominal one."""
    tool = mechanism.rig.force_sensor.tool or Tool(mass=0.0, com=[0.0, 0.0, 0.0])
    path = "rig.force_sensor.tool."
    return sensor.Tool(
        numbers(f"{path}mass{assumed}", tool.mass),
        numbers.vector(numbers(f"{path}com{assumed}", tool.com)),
        numbers.matrix(numbers.inertia(f"{path}inertia{assumed}", tool.inertia)),
    )
