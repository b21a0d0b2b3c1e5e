"""Rig of a six-axis mechanism file as plain frozen structs: motion simulator, sensors, control period."""

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
# Keys of a motion simulator with one value for each axis.
AXES = ("natural_frequency", "damping_ratio", "time_constant", "delay")

# Types of the entries of lists.
Metre = Annotated[float, says("component", "m")]
Radian = Annotated[float, says("component of a rotation vector", "rad")]
Acceleration = Annotated[float, says("component", "m/s^2")]
Length = Annotated[float, says("length", "m", gt=0.0)]
Joint = Annotated[list[Metre], Meta(min_length=3, max_length=3)]
Moment = Annotated[float, says("entry of the inertia", "kg m^2")]
MomentRow = Annotated[list[Moment], Meta(min_length=3, max_length=3)]
Inertia = list[Moment | MomentRow]
CrosstalkRow = Annotated[
    list[Annotated[float, says("gain from one component to another's channel", "1", ge=-1.0, le=1.0)]],
    Meta(min_length=6, max_length=6),
]
# Types of the entries for six axes or channels; the units are those of translation and rotation.
Hertz = Annotated[float, says("frequency of one axis", "Hz", gt=0.0)]
Ratio = Annotated[float, says("ratio of one axis", "1", gt=0.0)]
Second = Annotated[float, says("time of one axis", "s", ge=0.0, le=1.0)]
Share = Annotated[float, says("share of one coordinate", "1", ge=0.0, le=1.0)]
Load = Annotated[float, says("load of one channel", "N, N m")]
Spread = Annotated[float, says("load of one channel", "N, N m", ge=0.0)]
Limit = Annotated[float, says("limit of one channel", "N, N m", gt=0.0, infinite=True)]


def three(meaning: str) -> Meta:
    """Return the metadata of a vector with three entries."""
    return Meta(min_length=3, max_length=3, description=meaning)


def six(meaning: str, names: tuple[str, str] = MOTION) -> Meta:
    """Return the metadata of six numbers; a file may give one for all, or one for each of the `names`."""
    schema: Any = {"six": list(names)}
    return Meta(
        min_length=6, max_length=6, description=meaning, extra={"six": names}, extra_json_schema=schema
    )


def zeros(count: int) -> Callable[[], list[Any]]:
    """Return a function that returns a list of `count` zeros."""
    return lambda: [0.0] * count


class TargetRobot(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Robot that carries the target's mechanism; omitted keys have the values of the chaser's robot."""

    share: Annotated[list[Share], six("share of each coordinate's motion that this robot makes")]
    natural_frequency: Annotated[list[Hertz], six("natural frequency of second_order")] | None = None
    damping_ratio: Annotated[list[Ratio], six("damping ratio of second_order")] | None = None
    time_constant: Annotated[list[Second], six("time constant of first_order")] | None = None
    delay: Annotated[list[Second], six("transport delay of the motion")] | None = None


class Simulator(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Motion simulator with G(s) exp(-s delay) from commanded to actual motion of each axis.

    The axes are the six coordinates (`task`), six legs (`stewart`), or the coordinates of two robots.
    """

    space: Annotated[Literal["task", "stewart", "two_robots"], says("kind of axes")] = "task"
    model: Annotated[SimulatorModel, says("form of G(s)")]
    natural_frequency: Annotated[list[Hertz], six("natural frequency of second_order")] | None = None
    damping_ratio: Annotated[list[Ratio], six("damping ratio of second_order")] | None = None
    time_constant: Annotated[list[Second], six("time constant of first_order")] | None = None
    coefficients: (
        Annotated[
            list[Coefficient],
            Meta(min_length=3, max_length=3, description="[a1, a2, a3] of 1/(1 + a1 s + a2 s^2 + a3 s^3)"),
        ]
        | None
    ) = None
    numerator: (
        Annotated[Polynomial, Meta(description="numerator of G(s), in descending powers of s")] | None
    ) = None
    denominator: (
        Annotated[Polynomial, Meta(description="denominator of G(s), in descending powers of s")] | None
    ) = None
    delay: Annotated[list[Second], six("transport delay of the motion")] = field(default_factory=zeros(6))
    base: (
        Annotated[
            list[Joint],
            Meta(min_length=6, max_length=6, description="joints on the base of a hexapod, in T axes"),
        ]
        | None
    ) = None
    platform: (
        Annotated[
            list[Joint],
            Meta(min_length=6, max_length=6, description="joints on the platform of a hexapod, in C axes"),
        ]
        | None
    ) = None
    height: Annotated[list[Metre], three("platform above the base when C coincides with T")] | None = None
    stroke: (
        Annotated[
            list[Length], Meta(min_length=2, max_length=2, description="shortest and longest leg length")
        ]
        | None
    ) = None
    target_robot: Annotated[TargetRobot, says("for two_robots: the robot under the target")] | None = None


class Tool(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Tool that a moving sensor carries, and the controller's assumptions about it."""

    mass: Annotated[float, says("mass of the tool", "kg", ge=0.0)]
    com: Annotated[list[Metre], three("centre of mass of the tool, in C axes")]
    inertia: Annotated[Inertia, three("inertia about the centre of mass, in C axes")] = field(
        default_factory=zeros(3)
    )
    mass_assumed: Annotated[float, says("mass that the controller assumes", "kg", ge=0.0)] | None = None
    com_assumed: Annotated[list[Metre], three("centre of mass that the controller assumes")] | None = None
    inertia_assumed: Annotated[Inertia, three("inertia that the controller assumes")] | None = None


class ForceSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Six-axis force sensor: location, delay and lag, then the errors of a sample."""

    side: Annotated[
        Literal["fixed", "moving"], says("location: under the target's mechanism, or on the flange")
    ] = "fixed"
    delay: Annotated[float, says("transport delay of the reading", "s", ge=0.0, le=1.0)] = 0.0
    time_constant: Annotated[float, says("time constant of the reading's first-order lag", "s", ge=0.0)] = 0.0
    noise_std: Annotated[list[Spread], six("standard deviation of white noise", LOADS)] = field(
        default_factory=zeros(6)
    )
    crosstalk: Annotated[
        list[CrosstalkRow],
        Meta(min_length=6, max_length=6, description="share of each component (column) in each channel (row)",
             extra={"square": 6}, extra_json_schema={"square": 6}),
    ] = field(default_factory=lambda: [[0.0] * 6 for _ in range(6)])  # fmt: skip
    bias: Annotated[list[Load], six("bias added to every reading", LOADS)] = field(default_factory=zeros(6))
    quantum: Annotated[list[Spread], six("step to whose multiples a reading is rounded", LOADS)] = field(
        default_factory=zeros(6)
    )
    dead_zone: Annotated[list[Spread], six("magnitude below which the reading is 0", LOADS)] = field(
        default_factory=zeros(6)
    )
    range: Annotated[list[Limit], six("magnitude at which a reading saturates", LOADS)] = field(
        default_factory=lambda: [math.inf] * 6
    )
    tool: Annotated[Tool, says("tool that a moving sensor carries")] | None = None
    gravity: Annotated[list[Acceleration], three("gravity for a moving sensor, in T axes")] = field(
        default_factory=zeros(3)
    )


class PositionSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sensor of the hardware's pose, with which the reading of a moving force sensor is rotated back."""

    delay: Annotated[float, says("transport delay of the reading", "s", ge=0.0, le=1.0)] = 0.0


class Rig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Rig: controller, motion simulator and sensors."""

    control_period: Annotated[float, says("time from tick to tick", "s", gt=0.0, le=0.1)]
    integrator: Annotated[Integrator, says("integrator of the numerical model")] = "semi_implicit_euler"
    command_latency: Annotated[int, says("periods until a command reaches the drives", "1", ge=0, le=1)] = 0
    command_hold: Annotated[CommandHold, says("hold of the command within a period")] = "linear"
    simulator: Annotated[Simulator, says("the motion simulator")]
    force_sensor: Annotated[ForceSensor, says("the force sensor")] = field(default_factory=ForceSensor)
    position_sensor: Annotated[PositionSensor, says("the position sensor")] = PositionSensor()
