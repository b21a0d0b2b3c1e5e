"""From a mechanism of six axes, nominal or drawn, to the arrays of its runs.

All is NumPy until a run is compiled, but for what is drawn as jax arrays. The batch is the trailing axis.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.six_axes_rig import Tool
from jaxhil.simulation.scenario import MotionSimulator
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

APPROACH = 0.02  # s: how long before the first touch a run begins, and a part of a control period
LONGEST = 10.0  # s, of a run whose start says nothing of its duration


def build_scenarios(
    mechanism: SixAxisMechanism, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
) -> Scenario:
    """Batch of scenarios of a mechanism.

    `draws` maps dotted paths to values, (number,) or for lists (number, *entries); what it lacks is nominal.
    Without it, a batch of one: the nominal run. Noise keys depend on `seed` and `first` + lane alone.
    """
    numbers = Values(mechanism, dict(draws or {}))
    bodies = Pair(*(_body(numbers, name) for name in ("target", "chaser")))
    groups = build_groups(mechanism, numbers)
    indices = np.arange(first, first + numbers.number, dtype=np.uint32)
    key: Any = np.stack([np.full(numbers.number, seed & 0xFFFFFFFF, np.uint32), indices])
    period = numbers("rig.control_period")
    if mechanism.start is not None:
        start = _stated(numbers, bodies)
        duration = numbers("start.duration") if mechanism.start.duration else numbers.constant(LONGEST)
    else:
        before = APPROACH + numbers("approach.phase") * period
        start = _approaching(numbers, bodies, groups, before)
        duration = before + numbers("approach.duration")
    # Compiled functions are typed by jax's arrays alone.
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
    """What shapes the compiled loop of a mechanism's scenarios."""
    rig = mechanism.rig
    return build_loop(
        scenario,
        integrator=rig.integrator,
        hold=rig.command_hold,
        latency=rig.command_latency,
        side=rig.force_sensor.side,
        has_noise=any(rig.force_sensor.noise_std),
        compensator=compensator,
        episodes=mechanism.approach.episodes if mechanism.approach else 1,
        whole=mechanism.start is not None and mechanism.start.duration is not None,
    )


def _body(numbers: Values, name: str) -> Body:
    turned = f"{name}.interface_rotation"
    return build_body(
        jnp.asarray(numbers(f"{name}.mass")),
        numbers.matrix(numbers.inertia(f"{name}.inertia")),
        numbers.vector(numbers(f"{name}.interface")),
        None if numbers.nothing(turned) else numbers.rotation(numbers(turned)),
    )


def _stated(numbers: Values, bodies: Pair) -> States:
    """The states of [start]."""

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


def _approaching(numbers: Values, bodies: Pair, groups: tuple[ContactGroup, ...], before: Any) -> States:
    """The states before the first touch of [approach]."""
    keys = ("offset", "attitude", "velocity", "angular_velocity")
    return _lowered(bodies, groups, *(numbers(f"approach.{key}") for key in keys), before)


@jax.jit
def _lowered(bodies, groups, offset, attitude, velocity, angular_velocity, before) -> States:
    turned = exponential(vector(attitude))
    height = touching_height(groups, offset[0], offset[1], turned)
    pose = Pose(Vector(offset[0], offset[1], height), turned)
    return begin(bodies, pose, Twist(vector(velocity), vector(angular_velocity)), before)


def _kinematics(mechanism: SixAxisMechanism, numbers: Values) -> Kinematics:
    """What the axes move."""
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


def _simulator(mechanism: SixAxisMechanism, numbers: Values) -> MotionSimulator:
    """Every model as a transfer function of each axis; `ideal` has order 0."""
    path, model = "rig.simulator.", mechanism.rig.simulator.model

    def of(key: str) -> Any:
        """Of each axis: the target's robot has after the chaser's what it is said to have, else the same."""
        own = numbers(path + key)
        if mechanism.rig.simulator.target_robot is None:
            return own
        other = path + "target_robot." + key
        return numbers.np.concatenate([own, numbers(other) if numbers.has(other) else own])

    delay = of("delay")
    one, stack = 0 * delay + 1, numbers.np.stack
    numerator: Any
    denominator: Any
    if model == "ideal":
        numerator, denominator = np.zeros((0, *one.shape)), one[None]
    elif model == "first_order":
        numerator, denominator = one[None], stack([of("time_constant"), one])
    elif model == "second_order":
        frequency = 2 * np.pi * of("natural_frequency")
        numerator = stack([0 * one, frequency**2])
        denominator = stack([one, 2 * of("damping_ratio") * frequency, frequency**2])
    elif model == "third_order":
        a_1, a_2, a_3 = numbers(path + "coefficients")
        numerator, denominator = stack([0 * one, 0 * one, one]), stack([a_3 * one, a_2 * one, a_1 * one, one])
    else:
        denominator = numbers(path + "denominator")[:, None] * one
        numerator = numbers(path + "numerator")[:, None] * one
        missing = len(denominator) - 1 - len(numerator)
        numerator = numbers.np.concatenate([np.zeros((missing, *one.shape)), numerator])
    limit: Any = np.full(one.shape, np.inf)
    return MotionSimulator(numerator, denominator, delay, limit, limit)


def _sensor(mechanism: SixAxisMechanism, numbers: Values) -> sensor.Sensor:
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
    )


def _tool(mechanism: SixAxisMechanism, numbers: Values, assumed: str = "") -> sensor.Tool:
    """The tool, or what the controller takes it to be: the nominal one where it is not told otherwise."""
    given = mechanism.rig.force_sensor.tool or Tool(mass=0.0, com=[0.0, 0.0, 0.0])
    path = "rig.force_sensor.tool."
    return sensor.Tool(
        numbers(f"{path}mass{assumed}", given.mass),
        numbers.vector(numbers(f"{path}com{assumed}", given.com)),
        numbers.matrix(numbers.inertia(f"{path}inertia{assumed}", given.inertia)),
    )
