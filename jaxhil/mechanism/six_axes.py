"""What a mechanism file of six axes says, as plain frozen structs (schema `jaxhil/mechanism/2`).

Two rigid bodies, how they meet, where and by which laws they touch, and a rig of six axes. Conventions:
notebooks/guide/six_axes.md. T and C are the interface frames of target and chaser; both have z along the
docking axis, from the target to the chaser. As in `jaxhil.mechanism.structs`, a field's type carries its
meaning, unit and range.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct, field

from jaxhil.mechanism.structs import (
    Coefficient,
    CommandHold,
    Correlation,
    Depth,
    Integrator,
    Law,
    Polynomial,
    Range,
    SimulatorModel,
    Slopes,
    Stiffness,
    Uncertainty,
    ranges_of,
    says,
)

__all__ = [
    "SCHEMA_SIX",
    "Approach",
    "BodyState",
    "Contact",
    "ForceSensor",
    "Friction",
    "Pattern",
    "PositionSensor",
    "Rig",
    "RigidBody",
    "Shape",
    "Simulator",
    "SixAxisMechanism",
    "Start",
    "TargetPattern",
    "Tool",
    "is_six_axes",
    "numeric_keys_beside",
    "numeric_keys_of",
    "six_axis_type",
]

SCHEMA_SIX = "jaxhil/mechanism/2"
MOTION = ("translation", "rotation")
LOADS = ("force", "torque")

ShapeName = Literal["sphere", "plane", "drogue", "capsule", "box"]

# Entries of lists.
Metre = Annotated[float, says("component", "m")]
Radian = Annotated[float, says("component of a rotation vector", "rad")]
Speed = Annotated[float, says("component", "m/s")]
Rate = Annotated[float, says("component", "rad/s")]
Acceleration = Annotated[float, says("component", "m/s^2")]
Part = Annotated[float, says("component", "1")]
Length = Annotated[float, says("length", "m", gt=0.0)]
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
Load = Annotated[float, says("of one channel", "N, N m")]
Spread = Annotated[float, says("of one channel", "N, N m", ge=0.0)]
Limit = Annotated[float, says("of one channel", "N, N m", gt=0.0, infinite=True)]


def three(meaning: str) -> Meta:
    """Of a vector, what it means."""
    return Meta(min_length=3, max_length=3, description=meaning)


def six(meaning: str, names: tuple[str, str] = MOTION) -> Meta:
    """Of six numbers, what they mean. A file may say one number for all, or one each for the `names`."""
    return Meta(min_length=6, max_length=6, description=meaning, extra={"six": names})


def _zeros(count: int) -> Callable[[], list[Any]]:
    return lambda: [0.0] * count


class RigidBody(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A free rigid body with its interface frame."""

    mass: Annotated[float, says("of the body", "kg", gt=0.0)]
    inertia: Annotated[Inertia, three("about the centre of mass, in body axes: three moments, or three rows")]
    interface: Annotated[list[Metre], three("from the centre of mass to the interface frame, in body axes")]
    interface_rotation: Annotated[
        list[Radian], three("rotation vector of the interface frame against the body axes")
    ] = field(default_factory=_zeros(3))


class Approach(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the bodies meet: C against T at the first touch, in T axes, in free flight."""

    offset: Annotated[list[Metre], Meta(min_length=2, max_length=2, description="of C's origin, x and y")] = (
        field(default_factory=_zeros(2))
    )
    attitude: Annotated[list[Radian], three("rotation vector of C against T")] = field(
        default_factory=_zeros(3)
    )
    velocity: Annotated[list[Speed], three("of C's origin, as seen from T; z is negative")]
    angular_velocity: Annotated[list[Rate], three("of the chaser against the target")] = field(
        default_factory=_zeros(3)
    )
    episodes: Annotated[int, says("how many chains of touches a run has, at most", "1", ge=1, le=100)] = 1
    duration: Annotated[float, says("of the run, at most", "s", gt=0.0, le=1000.0)] = 3.0
    phase: Annotated[float, says("of the first touch within a control period", "1", ge=0.0, le=1.0)] = (
        1.0 / 3.0
    )


class BodyState(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Motion of a body at the start."""

    position: Annotated[list[Metre], three("of the centre of mass, in world axes")]
    attitude: Annotated[
        list[Part],
        Meta(min_length=4, max_length=4, description="quaternion (w, x, y, z) from body to world axes"),
    ]
    velocity: Annotated[list[Speed], three("of the centre of mass, in world axes")]
    angular_velocity: Annotated[list[Rate], three("in body axes")]


class Start(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Explicit states of both bodies at the start, instead of an approach."""

    duration: Annotated[float, says("of the run, to the nearest tick", "s", gt=0.0, le=1000.0)] | None = None
    target: Annotated[BodyState, says("the target's")]
    chaser: Annotated[BodyState, says("the chaser's")]


class Shape(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True,
            rename={"start": "from", "end": "to"}):  # fmt: skip
    """A shape on a body, in the axes of its interface frame."""

    shape: Annotated[ShapeName, says("what it is")]
    centre: Annotated[list[Metre], three("of sphere and box")] | None = None
    radius: Annotated[float, says("of sphere and capsule", "m", ge=0.0)] | None = None
    inside: Annotated[bool, says("whether a sphere is touched from inside, like a tether's end")] = False
    point: Annotated[list[Metre], three("on the plane")] | None = None
    normal: Annotated[list[Part], three("of the plane, outwards, of any length")] | None = None
    half_angle: Annotated[float, says("of the drogue's cone", "rad", gt=0.0, lt=math.pi / 2)] | None = None
    bottom_radius: Annotated[float, says("of the drogue's rounded bottom", "m", gt=0.0)] | None = None
    bottom: Annotated[float, says("z of the centre of the drogue's bottom", "m")] | None = None
    mouth_radius: Annotated[float, says("where the drogue's wall ends", "m", gt=0.0)] | None = None
    start: Annotated[list[Metre], three("one end of the capsule")] | None = None
    end: Annotated[list[Metre], three("its other end")] | None = None
    half_lengths: Annotated[list[Length], three("of the box's edges, rounding included")] | None = None
    rounding: Annotated[float, says("radius of the box's edges", "m", gt=0.0)] | None = None
    rotation: Annotated[list[Radian], three("rotation vector of the box")] | None = None


class Pattern(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Copies of a pair of shapes, turned about z at equal angles."""

    count: Annotated[int, says("how many there are", "1", ge=1, le=256)]
    phase: Annotated[float, says("angle of the first", "rad")] = 0.0


class TargetPattern(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """By how much the target's copies are turned further."""

    phase: Annotated[float, says("angle about z", "rad")]


class Friction(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The tangential force of a contact."""

    law: Annotated[Literal["regularised", "bristle"], says("which law")]
    coefficient: Annotated[float, says("Coulomb's", "1", ge=0.0, le=10.0)]
    slip: Annotated[float, says("below which regularised creeps", "m/s", gt=0.0)] | None = None
    stiffness: Annotated[float, says("of the bristle", "N/m", gt=0.0)] | None = None
    damping: Annotated[float, says("of the bristle", "N s/m", ge=0.0)] | None = None


class Contact(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A pair of shapes that may touch, or a pattern of such pairs, and its laws."""

    chaser: Annotated[Shape, says("the chaser's shape, in C axes")]
    target: Annotated[Shape, says("the target's shape, in T axes")]
    pattern: Annotated[Pattern, says("copies of both")] | None = None
    target_pattern: Annotated[TargetPattern, says("how the target's copies are turned")] | None = None
    law: Law
    stiffness: Annotated[
        Stiffness | Slopes, says("in N/m^exponent for hunt_crossley and depth_damped", "N/m")
    ]
    damping: Annotated[
        float,
        says("in s/m for hunt_crossley, none for elastoplastic and preloaded", "N s/m", ge=0.0),
    ] = 0.0
    tension: Annotated[bool, says("whether kelvin_voigt may pull")] = False
    exponent: Annotated[float, says("of the depth, for hunt_crossley and depth_damped", "1", ge=1.0)] = 1.5
    depths: Annotated[
        list[Depth], Meta(max_length=20, description="where the slope changes, for piecewise_linear")
    ] = field(default_factory=list)
    reference_depth: (
        Annotated[float, says("at which hardening has four times its first slope, and depth_damped its "
                              "damping", "m", gt=0.0)] | None
    ) = None  # fmt: skip
    unloading_ratio: (
        Annotated[float, says("slope of unloading over that of loading, for elastoplastic", "1", ge=1.0)]
        | None
    ) = None
    preload: Annotated[float, says("of the spring at the touch, for preloaded", "N", ge=0.0)] = 0.0
    dry_friction: Annotated[float, says("against the depth's motion, for preloaded", "N", ge=0.0)] = 0.0
    friction: Annotated[Friction, says("along the surface")] | None = None


class Simulator(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The motion simulator, axis by axis, from commanded to actual coordinates: G(s) exp(-s delay)."""

    space: Annotated[Literal["task"], says("what its axes are")] = "task"
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
    delay: Annotated[list[Second], six("transport delay of the motion")] = field(default_factory=_zeros(6))


class Tool(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a moving sensor carries, and what the controller takes it to be."""

    mass: Annotated[float, says("of the tool", "kg", ge=0.0)]
    com: Annotated[list[Metre], three("its centre of mass, in C axes")]
    inertia: Annotated[Inertia, three("about its centre of mass, in C axes")] = field(
        default_factory=_zeros(3)
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
        default_factory=_zeros(6)
    )
    crosstalk: Annotated[
        list[CrosstalkRow],
        Meta(min_length=6, max_length=6, description="of each component (column) in each channel (row)",
             extra={"square": 6}),
    ] = field(default_factory=lambda: [[0.0] * 6 for _ in range(6)])  # fmt: skip
    bias: Annotated[list[Load], six("added to every reading", LOADS)] = field(default_factory=_zeros(6))
    quantum: Annotated[list[Spread], six("to multiples of which a reading is rounded", LOADS)] = field(
        default_factory=_zeros(6)
    )
    dead_zone: Annotated[list[Spread], six("below which nothing is read", LOADS)] = field(
        default_factory=_zeros(6)
    )
    range: Annotated[list[Limit], six("beyond which a reading saturates", LOADS)] = field(
        default_factory=lambda: [math.inf] * 6
    )
    tool: Annotated[Tool, says("what a moving sensor carries")] | None = None
    gravity: Annotated[list[Acceleration], three("for a moving sensor, in T axes")] = field(
        default_factory=_zeros(3)
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


class SixAxisMechanism(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One docking mechanism on one rig, in six axes."""

    schema: Annotated[Literal["jaxhil/mechanism/2"], says("what kind of file it is")]
    name: Annotated[str, says("what to call it", min_length=1, max_length=100)]
    source: Annotated[str, says("where its numbers come from", max_length=10_000)] = "assumed"
    target: Annotated[RigidBody, says("the body with the frame T")]
    chaser: Annotated[RigidBody, says("the body with the frame C")]
    approach: Annotated[Approach, says("how they meet")] | None = None
    start: Annotated[Start, says("their states at the start, instead of approach")] | None = None
    contact: Annotated[dict[str, Contact], says("where they may touch")] = field(default_factory=dict)
    rig: Annotated[Rig, says("the rig")]
    uncertainty: Annotated[
        dict[str, Uncertainty], says("how uncertain the number of each dotted path is")
    ] = field(default_factory=dict)
    correlation: Annotated[Correlation, says("which of these vary together")] | None = None


def is_six_axes(raw: object) -> bool:
    """Whether a raw table says that it is a mechanism of six axes."""
    return isinstance(raw, Mapping) and raw.get("schema") == SCHEMA_SIX


def numeric_keys_of(mechanism: SixAxisMechanism) -> dict[str, Range]:
    """Every key of real numbers that the mechanism could have, by dotted path, and its allowed values."""
    return numeric_keys_beside(tuple(mechanism.contact))


@functools.cache
def numeric_keys_beside(contacts: tuple[str, ...]) -> dict[str, Range]:
    """Likewise, with contacts of these names."""
    named: Any = {"contact": contacts}
    return ranges_of(six_axis_type(), named)


@functools.cache
def six_axis_type() -> msgspec.inspect.StructType:
    """The description of `SixAxisMechanism` and all below it."""
    info = msgspec.inspect.type_info(SixAxisMechanism)
    assert isinstance(info, msgspec.inspect.StructType)
    return info
