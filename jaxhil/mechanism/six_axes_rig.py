"""Rig of a six-axis mechanism file as plain frozen structs: motion simulator, sensors, control period."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, field

from jaxhil.mechanism.structs import (
    BIAS_RANDOM_WALK,
    DEAD_ZONE_KINDS,
    MAX_LATENCY,
    CommandHold,
    CubicCoefficients,
    DeadZoneKind,
    Denominator,
    Integrator,
    Jitter,
    LossProbability,
    MissedTickProbability,
    Numerator,
    SensorFilter,
    SimulatorModel,
    key_metadata,
)

__all__ = [
    "PER_AXIS_KEYS",
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
    "six_axis_metadata",
    "vector_metadata",
    "zeros",
]

MOTION_NAMES = ("translation", "rotation")
LOAD_NAMES = ("force", "torque")
# Keys of a motion simulator that have one value for each axis.
PER_AXIS_KEYS = ("natural_frequency", "damping_ratio", "time_constant", "window", "delay")

# Types of the entries of lists.
Metre = Annotated[float, key_metadata("component", "m")]
Radian = Annotated[float, key_metadata("component of a rotation vector", "rad")]
Acceleration = Annotated[float, key_metadata("component", "m/s^2")]
Length = Annotated[float, key_metadata("length", "m", gt=0.0)]
Joint = Annotated[list[Metre], Meta(min_length=3, max_length=3)]
Moment = Annotated[float, key_metadata("entry of the inertia", "kg m^2")]
MomentRow = Annotated[list[Moment], Meta(min_length=3, max_length=3)]
Inertia = list[Moment | MomentRow]
CrosstalkRow = Annotated[
    list[
        Annotated[float, key_metadata("gain from one component to another's channel", "1", ge=-1.0, le=1.0)]
    ],
    Meta(min_length=6, max_length=6),
]
# Types of the entries of lists for six axes or channels, with the units of translation and rotation.
Hertz = Annotated[float, key_metadata("frequency of one axis", "Hz", gt=0.0)]
Ratio = Annotated[float, key_metadata("ratio of one axis", "1", gt=0.0)]
Second = Annotated[float, key_metadata("time of one axis", "s", ge=0.0, le=1.0)]
Window = Annotated[float, key_metadata("window of one axis", "s", gt=0.0, le=1.0)]
Share = Annotated[float, key_metadata("share of one coordinate", "1", ge=0.0, le=1.0)]
Load = Annotated[float, key_metadata("load of one channel", "N, N m")]
LoadMagnitude = Annotated[float, key_metadata("load of one channel", "N, N m", ge=0.0)]
LoadDrift = Annotated[float, key_metadata("drift of one channel", "N/sqrt(s), N m/sqrt(s)", ge=0.0)]
Error = Annotated[float, key_metadata("error of one coordinate", "m, rad", ge=0.0)]
LoadLimit = Annotated[float, key_metadata("limit of one channel", "N, N m", gt=0.0, infinite=True)]


def vector_metadata(meaning: str) -> Meta:
    """Return the msgspec metadata of a key whose value is a vector with three entries."""
    return Meta(min_length=3, max_length=3, description=meaning)


def six_axis_metadata(meaning: str, names: tuple[str, str] = MOTION_NAMES) -> Meta:
    """Return the msgspec metadata of a key with six numbers.

    A file may also state one number for all six, or a table with one number for each of `names`.
    """
    schema: Any = {"six": list(names)}
    return Meta(
        min_length=6, max_length=6, description=meaning, extra={"six": names}, extra_json_schema=schema
    )


def zeros(count: int) -> Callable[[], list[Any]]:
    """Return a default factory for a list of `count` zeros."""
    return lambda: [0.0] * count


class TargetRobot(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Robot that moves the target's mechanism; omitted keys have the values of the chaser's robot."""

    share: Annotated[
        list[Share], six_axis_metadata("share of each coordinate's motion that this robot makes")
    ]
    natural_frequency: (
        Annotated[list[Hertz], six_axis_metadata("natural frequency of second_order")] | None
    ) = None
    damping_ratio: Annotated[list[Ratio], six_axis_metadata("damping ratio of second_order")] | None = None
    time_constant: Annotated[list[Second], six_axis_metadata("time constant of first_order")] | None = None
    window: Annotated[list[Window], six_axis_metadata("window of moving_average")] | None = None
    delay: Annotated[list[Second], six_axis_metadata("transport delay of the motion")] | None = None


class Simulator(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Motion simulator: G(s) exp(-s delay) from the commanded to the actual motion of each axis.

    The axes are the six coordinates of the pose (`task`), the six legs of a hexapod (`stewart`), or the
    coordinates of two robots (`two_robots`).
    """

    space: Annotated[Literal["task", "stewart", "two_robots"], key_metadata("kind of axes")] = "task"
    model: Annotated[SimulatorModel, key_metadata("form of G(s)")]
    natural_frequency: (
        Annotated[list[Hertz], six_axis_metadata("natural frequency of second_order")] | None
    ) = None
    damping_ratio: Annotated[list[Ratio], six_axis_metadata("damping ratio of second_order")] | None = None
    time_constant: Annotated[list[Second], six_axis_metadata("time constant of first_order")] | None = None
    coefficients: CubicCoefficients | None = None
    numerator: Numerator | None = None
    denominator: Denominator | None = None
    window: Annotated[list[Window], six_axis_metadata("window of moving_average")] | None = None
    delay: Annotated[list[Second], six_axis_metadata("transport delay of the motion")] = field(
        default_factory=zeros(6)
    )
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
    height: (
        Annotated[list[Metre], vector_metadata("platform above the base when C coincides with T")] | None
    ) = None
    stroke: (
        Annotated[
            list[Length], Meta(min_length=2, max_length=2, description="shortest and longest leg length")
        ]
        | None
    ) = None
    target_robot: (
        Annotated[TargetRobot, key_metadata("for two_robots: the robot under the target")] | None
    ) = None


class Tool(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Tool that a moving force sensor carries, and the values that the controller assumes for the tool."""

    mass: Annotated[float, key_metadata("mass of the tool", "kg", ge=0.0)]
    com: Annotated[list[Metre], vector_metadata("centre of mass of the tool, in C axes")]
    inertia: Annotated[Inertia, vector_metadata("inertia about the centre of mass, in C axes")] = field(
        default_factory=zeros(3)
    )
    mass_assumed: Annotated[float, key_metadata("mass that the controller assumes", "kg", ge=0.0)] | None = (
        None
    )
    com_assumed: (
        Annotated[list[Metre], vector_metadata("centre of mass that the controller assumes")] | None
    ) = None
    inertia_assumed: Annotated[Inertia, vector_metadata("inertia that the controller assumes")] | None = None


class ForceSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Six-axis force sensor: its location, its delay and lag, then the errors of each reading."""

    side: Annotated[
        Literal["fixed", "moving"], key_metadata("location: under the target's mechanism, or on the flange")
    ] = "fixed"
    delay: Annotated[float, key_metadata("transport delay of the reading", "s", ge=0.0, le=1.0)] = 0.0
    jitter: Jitter = 0.0
    loss_probability: LossProbability = 0.0
    time_constant: Annotated[
        float, key_metadata("time constant of the reading's first-order lag", "s", ge=0.0)
    ] = 0.0
    noise_std: Annotated[
        list[LoadMagnitude], six_axis_metadata("standard deviation of white noise", LOAD_NAMES)
    ] = field(default_factory=zeros(6))
    crosstalk: Annotated[
        list[CrosstalkRow],
        Meta(min_length=6, max_length=6, description="share of each component (column) in each channel (row)",
             extra={"square": 6}, extra_json_schema={"square": 6}),
    ] = field(default_factory=lambda: [[0.0] * 6 for _ in range(6)])  # fmt: skip
    bias: Annotated[list[Load], six_axis_metadata("bias added to every reading", LOAD_NAMES)] = field(
        default_factory=zeros(6)
    )
    bias_random_walk: Annotated[list[LoadDrift], six_axis_metadata(BIAS_RANDOM_WALK, LOAD_NAMES)] = field(
        default_factory=zeros(6)
    )
    quantum: Annotated[
        list[LoadMagnitude], six_axis_metadata("resolution: readings are multiples of this", LOAD_NAMES)
    ] = field(default_factory=zeros(6))
    dead_zone: Annotated[
        list[LoadMagnitude], six_axis_metadata("magnitude below which the reading is 0", LOAD_NAMES)
    ] = field(default_factory=zeros(6))
    dead_zone_kind: Annotated[DeadZoneKind, key_metadata(DEAD_ZONE_KINDS)] = "continuous"
    range: Annotated[
        list[LoadLimit], six_axis_metadata("magnitude at which a reading saturates", LOAD_NAMES)
    ] = field(default_factory=lambda: [math.inf] * 6)
    filter: Annotated[SensorFilter, key_metadata("low-pass filter of all channels")] | None = None
    tool: Annotated[Tool, key_metadata("tool that a moving sensor carries")] | None = None
    gravity: Annotated[list[Acceleration], vector_metadata("gravity for a moving sensor, in T axes")] = field(
        default_factory=zeros(3)
    )


class PositionSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Position sensor, which measures the pose of the hardware for the controller."""

    delay: Annotated[float, key_metadata("transport delay of the reading", "s", ge=0.0, le=1.0)] = 0.0
    noise_std: Annotated[list[Error], six_axis_metadata("standard deviation of white noise")] = field(
        default_factory=zeros(6)
    )
    quantum: Annotated[list[Error], six_axis_metadata("resolution: readings are multiples of this")] = field(
        default_factory=zeros(6)
    )


class Rig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Rig: controller, motion simulator and sensors."""

    control_period: Annotated[float, key_metadata("time from tick to tick", "s", gt=0.0, le=0.1)]
    integrator: Annotated[Integrator, key_metadata("integrator of the numerical model")] = (
        "semi_implicit_euler"
    )
    command_latency: Annotated[
        int, key_metadata("periods until a command reaches the drives", "1", ge=0, le=MAX_LATENCY)
    ] = 0
    command_hold: Annotated[CommandHold, key_metadata("hold of the command within a period")] = "linear"
    missed_tick_probability: MissedTickProbability = 0.0
    simulator: Annotated[Simulator, key_metadata("the motion simulator")]
    force_sensor: Annotated[ForceSensor, key_metadata("the force sensor")] = field(
        default_factory=ForceSensor
    )
    position_sensor: Annotated[PositionSensor, key_metadata("the position sensor")] = PositionSensor()
