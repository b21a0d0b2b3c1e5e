"""The rig of a mechanism file of six axes, as plain frozen structs: motion simulator, sensors, period."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, field

from jaxhil.mechanism.structs import (
    Coefficient,
    CommandHold,
    Integrator,
    Polynomial,
    SimulatorModel,
    says,
)

__all__ = [
    "AXES",
    "ForceSensor",
    "Inertia",
    "Length",
    "Metre",
    "PositionSensor",
    "Radian",
    "Rig",
    "Simulator",
    "TargetRobot",
    "Tool",
    "six",
    "three",
    "zeros",
]

MOTION = ("translation", "rotation")
LOADS = ("force", "torque")
# Keys of a motion simulator that are said of each axis by itself.
AXES = ("natural_frequency", "damping_ratio", "time_constant", "delay")

# Entries of lists.
Metre = Annotated[float, says("component", "m")]
Radian = Annotated[float, says("component of a rotation vector", "rad")]
Acceleration = Annotated[float, says("component", "m/s^2")]
Length = Annotated[float, says("length", "m", gt=0.0)]
Joint = Annotated[list[Metre], Meta(min_length=3, max_length=3)]
Moment = Annotated[float, says("entry of the inertia", "kg m^2")]
MomentRow = Annotated[list[Moment], Meta(min_length=3, max_length=3)]
Inertia = list[Moment | MomentRow]
CrosstalkRow = Annotated[
    list[Annotated[float, says("of one component in another's channel", "1", ge=-1.0, le=1.0)]],
    Meta(min_length=6, max_length=6),
]
# Of six axes or channels. Where translation and rotation have different units, both are said.
Hertz = Annotated[float, says("of one axis", "Hz", gt=0.0)]
Ratio = Annotated[float, says("of one axis", "1", gt=0.0)]
Second = Annotated[float, says("of one axis", "s", ge=0.0, le=1.0)]
Share = Annotated[float, says("of one coordinate", "1", ge=0.0, le=1.0)]
Load = Annotated[float, says("of one channel", "N, N m")]
Spread = Annotated[float, says("of one channel", "N, N m", ge=0.0)]
Limit = Annotated[float, says("of one channel", "N, N m", gt=0.0, infinite=True)]


def three(meaning: str) -> Meta:
    """Of a vector, what it means."""
    return Meta(min_length=3, max_length=3, description=meaning)


def six(meaning: str, names: tuple[str, str] = MOTION) -> Meta:
    """Of six numbers, what they mean. A file may say one number for all, or one each for the `names`."""
    stated: Any = {"six": list(names)}
    return Meta(
        min_length=6, max_length=6, description=meaning, extra={"six": names}, extra_json_schema=stated
    )


def zeros(count: int) -> Callable[[], list[Any]]:
    """What makes a list of so many zeros."""
    return lambda: [0.0] * count


class TargetRobot(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The robot that carries the target's mechanism; what is not said is as the chaser's robot has it."""

    share: Annotated[list[Share], six("of each coordinate's motion that it makes")]
    natural_frequency: Annotated[list[Hertz], six("of second_order")] | None = None
    damping_ratio: Annotated[list[Ratio], six("of second_order")] | None = None
    time_constant: Annotated[list[Second], six("of first_order")] | None = None
    delay: Annotated[list[Second], six("transport delay of the motion")] | None = None


class Simulator(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The motion simulator, axis by axis, from commanded to actual motion: G(s) exp(-s delay).

    Its axes are the six coordinates (`task`), six legs (`stewart`), or the coordinates of two robots.
    """

    space: Annotated[Literal["task", "stewart", "two_robots"], says("what its axes are")] = "task"
    model: Annotated[SimulatorModel, says("what G(s) is")]
    natural_frequency: Annotated[list[Hertz], six("of second_order")] | None = None
    damping_ratio: Annotated[list[Ratio], six("of second_order")] | None = None
    time_constant: Annotated[list[Second], six("of first_order")] | None = None
    coefficients: (
        Annotated[
            list[Coefficient],
            Meta(min_length=3, max_length=3, description="[a1, a2, a3] of 1/(1 + a1 s + a2 s^2 + a3 s^3)"),
        ]
        | None
    ) = None
    numerator: Annotated[Polynomial, Meta(description="of G(s), in descending powers of s")] | None = None
    denominator: Annotated[Polynomial, Meta(description="of G(s), in descending powers of s")] | None = None
    delay: Annotated[list[Second], six("transport delay of the motion")] = field(default_factory=zeros(6))
    base: (
        Annotated[list[Joint], Meta(min_length=6, max_length=6, description="a hexapod's joints, in T axes")]
        | None
    ) = None
    platform: (
        Annotated[list[Joint], Meta(min_length=6, max_length=6, description="a hexapod's joints, in C axes")]
        | None
    ) = None
    height: Annotated[list[Metre], three("of the platform over the base where C is T")] | None = None
    stroke: (
        Annotated[list[Length], Meta(min_length=2, max_length=2, description="shortest and longest leg")]
        | None
    ) = None
    target_robot: Annotated[TargetRobot, says("of two_robots: the one under the target")] | None = None


class Tool(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a moving sensor carries, and what the controller takes it to be."""

    mass: Annotated[float, says("of the tool", "kg", ge=0.0)]
    com: Annotated[list[Metre], three("its centre of mass, in C axes")]
    inertia: Annotated[Inertia, three("about its centre of mass, in C axes")] = field(
        default_factory=zeros(3)
    )
    mass_assumed: Annotated[float, says("what the controller takes it to be", "kg", ge=0.0)] | None = None
    com_assumed: Annotated[list[Metre], three("what the controller takes it to be")] | None = None
    inertia_assumed: Annotated[Inertia, three("what the controller takes it to be")] | None = None


class ForceSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The six-axis force sensor: where it is, its delay and lag, then what becomes of a sample."""

    side: Annotated[Literal["fixed", "moving"], says("under the target's mechanism, or on the flange")] = (
        "fixed"
    )
    delay: Annotated[float, says("transport delay of the reading", "s", ge=0.0, le=1.0)] = 0.0
    time_constant: Annotated[float, says("of the reading's first-order lag", "s", ge=0.0)] = 0.0
    noise_std: Annotated[list[Spread], six("standard deviation of white noise", LOADS)] = field(
        default_factory=zeros(6)
    )
    crosstalk: Annotated[
        list[CrosstalkRow],
        Meta(min_length=6, max_length=6, description="of each component (column) in each channel (row)",
             extra={"square": 6}, extra_json_schema={"square": 6}),
    ] = field(default_factory=lambda: [[0.0] * 6 for _ in range(6)])  # fmt: skip
    bias: Annotated[list[Load], six("added to every reading", LOADS)] = field(default_factory=zeros(6))
    quantum: Annotated[list[Spread], six("to multiples of which a reading is rounded", LOADS)] = field(
        default_factory=zeros(6)
    )
    dead_zone: Annotated[list[Spread], six("below which nothing is read", LOADS)] = field(
        default_factory=zeros(6)
    )
    range: Annotated[list[Limit], six("beyond which a reading saturates", LOADS)] = field(
        default_factory=lambda: [math.inf] * 6
    )
    tool: Annotated[Tool, says("what a moving sensor carries")] | None = None
    gravity: Annotated[list[Acceleration], three("for a moving sensor, in T axes")] = field(
        default_factory=zeros(3)
    )


class PositionSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The sensor of the hardware's pose, by which the reading of a moving force sensor is turned back."""

    delay: Annotated[float, says("transport delay of the reading", "s", ge=0.0, le=1.0)] = 0.0


class Rig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The controller, the motion simulator, the sensor."""

    control_period: Annotated[float, says("time from tick to tick", "s", gt=0.0, le=0.1)]
    integrator: Annotated[Integrator, says("of the numerical model")] = "semi_implicit_euler"
    command_latency: Annotated[int, says("periods until a command reaches the drives", "1", ge=0, le=1)] = 0
    command_hold: Annotated[CommandHold, says("of the command within a period")] = "linear"
    simulator: Annotated[Simulator, says("the motion simulator")]
    force_sensor: Annotated[ForceSensor, says("the force sensor")] = field(default_factory=ForceSensor)
    position_sensor: Annotated[PositionSensor, says("the position sensor")] = PositionSensor()
