"""What a mechanism file of six axes says, as plain frozen structs (schema `jaxhil/mechanism/2`).

Two rigid bodies, how they meet, where and by which laws they touch, and a rig of six axes. Conventions:
notebooks/guide/six_axes.md. T and C are the interface frames of target and chaser; both have z along the
docking axis, from the target to the chaser. As in `jaxhil.mechanism.structs`, a field's type carries its
meaning, unit and range.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct, defstruct, field

from jaxhil.contact.keys import says
from jaxhil.contact.laws import KEYS, laws_with
from jaxhil.mechanism.six_axes_rig import Inertia, Length, Metre, Radian, Rig, six, three, zeros
from jaxhil.mechanism.structs import (
    DAMPING_UNITS,
    STIFFNESS_UNITS,
    Correlation,
    Law,
    Range,
    Slopes,
    Stiffness,
    Uncertainty,
    ranges_of,
)

__all__ = [
    "KEYS_IN_SIX_AXES",
    "SCHEMA_SIX",
    "Approach",
    "BodyState",
    "Contact",
    "Friction",
    "Latch",
    "Pattern",
    "RigidBody",
    "Shape",
    "SixAxisMechanism",
    "Start",
    "TargetPattern",
    "is_six_axes",
    "numeric_keys_beside",
    "numeric_keys_of",
    "six_axis_type",
]

SCHEMA_SIX = "jaxhil/mechanism/2"

ShapeName = Literal["sphere", "plane", "drogue", "capsule", "box"]

# Entries of lists.
Speed = Annotated[float, says("component", "m/s")]
Rate = Annotated[float, says("component", "rad/s")]
Part = Annotated[float, says("component", "1")]
Spring = Annotated[float, says("of one axis", "N/m, N m", ge=0.0)]
SpringRow = Annotated[
    list[Annotated[float, says("entry of the stiffness", "N/m, N, N m")]], Meta(min_length=6, max_length=6)
]
Damper = Annotated[float, says("of one axis", "N s/m, N m s", ge=0.0)]


class RigidBody(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A free rigid body with its interface frame."""

    mass: Annotated[float, says("of the body", "kg", gt=0.0)]
    inertia: Annotated[Inertia, three("about the centre of mass, in body axes: three moments, or three rows")]
    interface: Annotated[list[Metre], three("from the centre of mass to the interface frame, in body axes")]
    interface_rotation: Annotated[
        list[Radian], three("rotation vector of the interface frame against the body axes")
    ] = field(default_factory=zeros(3))


class Approach(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the bodies meet: C against T at the first touch, in T axes, in free flight."""

    offset: Annotated[list[Metre], Meta(min_length=2, max_length=2, description="of C's origin, x and y")] = (
        field(default_factory=zeros(2))
    )
    attitude: Annotated[list[Radian], three("rotation vector of C against T")] = field(
        default_factory=zeros(3)
    )
    velocity: Annotated[list[Speed], three("of C's origin, as seen from T; z is negative")]
    angular_velocity: Annotated[list[Rate], three("of the chaser against the target")] = field(
        default_factory=zeros(3)
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


class ContactOfAnyLaw(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of a contact that all contact laws have."""

    chaser: Annotated[Shape, says("the chaser's shape, in C axes")]
    target: Annotated[Shape, says("the target's shape, in T axes")]
    pattern: Annotated[Pattern, says("copies of both")] | None = None
    target_pattern: Annotated[TargetPattern, says("how the target's copies are turned")] | None = None
    law: Law
    stiffness: Annotated[Stiffness | Slopes, says(STIFFNESS_UNITS, "N/m")]
    damping: Annotated[float, says(DAMPING_UNITS, "N s/m", ge=0.0)] = 0.0


KEYS_IN_SIX_AXES = {key.name: key.in_six_axes() for key in KEYS.values()}  # by their names on one axis

if TYPE_CHECKING:

    class Contact(ContactOfAnyLaw, frozen=True):
        """The contact, with a field for each of `KEYS_IN_SIX_AXES`."""

        friction: Friction | None = None

        def __getattr__(self, key: str) -> Any: ...

else:
    Contact = defstruct(
        "Contact",
        [
            *(key.struct_field(" and ".join(laws_with(key))) for key in KEYS_IN_SIX_AXES.values()),
            ("friction", Annotated[Friction, says("along the surface")] | None, None),
        ],
        bases=(ContactOfAnyLaw,),
        module=__name__,
        namespace={"__doc__": "A pair of shapes that may touch, or a pattern of such pairs, and its laws."},
        frozen=True,
        forbid_unknown_fields=True,
        kw_only=True,
    )


class Latch(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A point of the chaser that is caught, and from then on held by a spring of six axes."""

    chaser: Annotated[list[Metre], three("the point, in C axes")]
    pattern: Annotated[Pattern, says("copies of the point, held alike")] | None = None
    depth: Annotated[float, says("below T's plane z = 0 from which it is caught", "m", ge=0.0)] | None = None
    angle: Annotated[float, says("of C against T up to which it is caught", "rad", gt=0.0)] | None = None
    speed: Annotated[float, says("of receding up to which it is caught", "m/s", ge=0.0, infinite=True)] = (
        math.inf
    )
    stiffness: Annotated[list[Spring], six("of the spring, in T axes")] | None = None
    stiffness_matrix: (
        Annotated[
            list[SpringRow],
            Meta(min_length=6, max_length=6, description="instead, of force and moment in T axes"),
        ]
        | None
    ) = None
    damping: Annotated[list[Damper], six("beside the spring, in T axes")] = field(default_factory=zeros(6))
    latched: Annotated[bool, says("whether it holds from the start on")] = False


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
    latch: Annotated[dict[str, Latch], says("what holds the chaser once it is caught")] = field(
        default_factory=dict
    )
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
    return numeric_keys_beside(tuple(mechanism.contact), tuple(mechanism.latch))


@functools.cache
def numeric_keys_beside(contacts: tuple[str, ...], latches: tuple[str, ...]) -> dict[str, Range]:
    """Likewise, with contacts and latches of these names."""
    named: Any = {"contact": contacts, "latch": latches}
    return ranges_of(six_axis_type(), named)


@functools.cache
def six_axis_type() -> msgspec.inspect.StructType:
    """The description of `SixAxisMechanism` and all below it."""
    info = msgspec.inspect.type_info(SixAxisMechanism)
    assert isinstance(info, msgspec.inspect.StructType)
    return info
