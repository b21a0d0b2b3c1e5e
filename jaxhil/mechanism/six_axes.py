"""Content of a six-axis mechanism file as plain frozen structs (schema `jaxhil/mechanism/2`).

The file describes two rigid bodies, their approach, the shapes and laws of their contacts, and a six-axis
rig; notebooks/guide/six_axes.md defines the conventions. T and C are the interface frames of target and
chaser. The z axis of both frames is the docking axis and points from the target to the chaser. As in
`jaxhil.mechanism.structs`, the type of a field contains its description, unit and range.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta, Struct, defstruct, field

from jaxhil.contact.keys import key_metadata
from jaxhil.contact.laws import CONTACT_KEYS, laws_with_key
from jaxhil.mechanism.number_ranges import Range, describe_struct, numeric_keys, ranges_of
from jaxhil.mechanism.six_axes_rig import (
    Inertia,
    Length,
    Metre,
    Radian,
    Rig,
    six_axis_metadata,
    vector_metadata,
    zeros,
)
from jaxhil.mechanism.structs import (
    DAMPING_UNITS,
    STIFFNESS_UNITS,
    ContactLawName,
    Correlation,
    Mechanism,
    Slopes,
    Stiffness,
    Uncertainty,
)

__all__ = [
    "KEYS_IN_SIX_AXES",
    "SIX_AXIS_SCHEMA",
    "AnyMechanism",
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
    "numeric_keys_of",
    "numeric_keys_with",
]

SIX_AXIS_SCHEMA = "jaxhil/mechanism/2"

ShapeName = Literal["sphere", "plane", "drogue", "capsule", "box"]

# Types of the entries of lists.
VelocityComponent = Annotated[float, key_metadata("component", "m/s")]
AngularVelocityComponent = Annotated[float, key_metadata("component", "rad/s")]
UnitComponent = Annotated[float, key_metadata("component", "1")]
AxisStiffness = Annotated[float, key_metadata("stiffness of one axis", "N/m, N m", ge=0.0)]
StiffnessRow = Annotated[
    list[Annotated[float, key_metadata("entry of the stiffness", "N/m, N, N m")]],
    Meta(min_length=6, max_length=6),
]
AxisDamping = Annotated[float, key_metadata("damping of one axis", "N s/m, N m s", ge=0.0)]


class RigidBody(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Free rigid body: its mass, inertia and interface frame."""

    mass: Annotated[float, key_metadata("mass of the body", "kg", gt=0.0)]
    inertia: Annotated[
        Inertia,
        vector_metadata("inertia about the centre of mass, in body axes: three moments, or three rows"),
    ]
    interface: Annotated[
        list[Metre], vector_metadata("vector from the centre of mass to the interface frame, in body axes")
    ]
    interface_rotation: Annotated[
        list[Radian], vector_metadata("rotation vector of the interface frame relative to the body axes")
    ] = field(default_factory=zeros(3))


class Approach(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Approach in free flight: motion of the chaser's frame C in the target's frame T at the first touch."""

    offset: Annotated[
        list[Metre], Meta(min_length=2, max_length=2, description="x and y of the origin of C")
    ] = field(default_factory=zeros(2))
    attitude: Annotated[list[Radian], vector_metadata("rotation vector of C relative to T")] = field(
        default_factory=zeros(3)
    )
    velocity: Annotated[
        list[VelocityComponent], vector_metadata("velocity of the origin of C as seen from T; z is negative")
    ]
    angular_velocity: Annotated[
        list[AngularVelocityComponent],
        vector_metadata("angular velocity of the chaser relative to the target"),
    ] = field(default_factory=zeros(3))
    episodes: Annotated[
        int, key_metadata("largest number of chains of touches in a run", "1", ge=1, le=100)
    ] = 1
    duration: Annotated[float, key_metadata("longest duration of the run", "s", gt=0.0, le=1000.0)] = 3.0
    phase: Annotated[
        float, key_metadata("phase of the first touch within a control period", "1", ge=0.0, le=1.0)
    ] = 1.0 / 3.0


class BodyState(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Position, attitude and velocities of a body at the start of the run."""

    position: Annotated[list[Metre], vector_metadata("position of the centre of mass, in world axes")]
    attitude: Annotated[
        list[UnitComponent],
        Meta(min_length=4, max_length=4, description="quaternion (w, x, y, z) from body to world axes"),
    ]
    velocity: Annotated[
        list[VelocityComponent], vector_metadata("velocity of the centre of mass, in world axes")
    ]
    angular_velocity: Annotated[
        list[AngularVelocityComponent], vector_metadata("angular velocity, in body axes")
    ]


class Start(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """States of both bodies at the start of the run, instead of an approach."""

    duration: (
        Annotated[float, key_metadata("duration of the run, rounded to ticks", "s", gt=0.0, le=1000.0)] | None
    ) = None
    target: Annotated[BodyState, key_metadata("state of the target")]
    chaser: Annotated[BodyState, key_metadata("state of the chaser")]


class Shape(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True,
            rename={"start": "from", "end": "to"}):  # fmt: skip
    """Shape on a body, in the axes of the body's interface frame."""

    shape: Annotated[ShapeName, key_metadata("kind of shape")]
    centre: Annotated[list[Metre], vector_metadata("centre of the sphere or box")] | None = None
    radius: Annotated[float, key_metadata("radius of the sphere or capsule", "m", ge=0.0)] | None = None
    inside: Annotated[bool, key_metadata("whether the sphere is touched from inside, as for a tether")] = (
        False
    )
    point: Annotated[list[Metre], vector_metadata("point on the plane")] | None = None
    normal: (
        Annotated[list[UnitComponent], vector_metadata("outward normal of the plane, of any length")] | None
    ) = None
    half_angle: (
        Annotated[float, key_metadata("half angle of the drogue's cone", "rad", gt=0.0, lt=math.pi / 2)]
        | None
    ) = None
    bottom_radius: (
        Annotated[float, key_metadata("radius of the drogue's rounded bottom", "m", gt=0.0)] | None
    ) = None
    bottom: Annotated[float, key_metadata("z of the centre of the drogue's bottom", "m")] | None = None
    mouth_radius: (
        Annotated[float, key_metadata("radius where the drogue's wall ends", "m", gt=0.0)] | None
    ) = None
    start: Annotated[list[Metre], vector_metadata("first end point of the capsule")] | None = None
    end: Annotated[list[Metre], vector_metadata("second end point of the capsule")] | None = None
    half_lengths: (
        Annotated[list[Length], vector_metadata("half lengths of the box's edges, with the rounding")] | None
    ) = None
    rounding: Annotated[float, key_metadata("radius of the box's rounded edges", "m", gt=0.0)] | None = None
    rotation: Annotated[list[Radian], vector_metadata("rotation vector of the box")] | None = None


class Pattern(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Circular pattern: copies of a pair of shapes, or of a latch point, at equal angles about z."""

    count: Annotated[int, key_metadata("number of copies", "1", ge=1, le=256)]
    phase: Annotated[float, key_metadata("angle of the first copy", "rad")] = 0.0


class TargetPattern(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Rotation about z of the target's shapes in a circular pattern, in addition to the pattern's angles."""

    phase: Annotated[float, key_metadata("angle about z", "rad")]


class Friction(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Friction law of a contact, for the tangential force."""

    law: Annotated[Literal["regularised", "bristle"], key_metadata("friction law")]
    coefficient: Annotated[float, key_metadata("Coulomb's friction coefficient", "1", ge=0.0, le=10.0)]
    slip: (
        Annotated[float, key_metadata("slip speed below which regularised creeps", "m/s", gt=0.0)] | None
    ) = None
    stiffness: Annotated[float, key_metadata("stiffness of the bristle", "N/m", gt=0.0)] | None = None
    damping: Annotated[float, key_metadata("damping of the bristle", "N s/m", ge=0.0)] | None = None


class ContactOfAnyLaw(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the table `[contact.NAME]` that all contact laws have."""

    chaser: Annotated[Shape, key_metadata("the chaser's shape, in C axes")]
    target: Annotated[Shape, key_metadata("the target's shape, in T axes")]
    pattern: Annotated[Pattern, key_metadata("copies of both shapes")] | None = None
    target_pattern: (
        Annotated[TargetPattern, key_metadata("additional rotation of the target's copies")] | None
    ) = None
    law: ContactLawName
    stiffness: Annotated[Stiffness | Slopes, key_metadata(STIFFNESS_UNITS, "N/m")]
    damping: Annotated[float, key_metadata(DAMPING_UNITS, "N s/m", ge=0.0)] = 0.0


# Keys that only some contact laws have, as they are in six-axis files. The dict's keys are the names in
# one-axis files.
KEYS_IN_SIX_AXES = {key.name: key.in_six_axes() for key in CONTACT_KEYS.values()}

if TYPE_CHECKING:

    class Contact(ContactOfAnyLaw, frozen=True):
        """Table `[contact.NAME]`, with a field for each key in `KEYS_IN_SIX_AXES`."""

        friction: Friction | None = None

        def __getattr__(self, key: str) -> Any: ...

else:
    Contact = defstruct(
        "Contact",
        [
            *(key.struct_field(" and ".join(laws_with_key(key))) for key in KEYS_IN_SIX_AXES.values()),
            ("friction", Annotated[Friction, key_metadata("friction along the surface")] | None, None),
        ],
        bases=(ContactOfAnyLaw,),
        module=__name__,
        namespace={"__doc__": "Pair of shapes that may touch, or a pattern of such pairs, with their laws."},
        frozen=True,
        forbid_unknown_fields=True,
        kw_only=True,
    )


class Latch(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Latch that catches a point of the chaser and then holds the chaser by a six-axis spring."""

    chaser: Annotated[list[Metre], vector_metadata("the point, in C axes")]
    pattern: Annotated[Pattern, key_metadata("copies of the point, with the same spring")] | None = None
    depth: (
        Annotated[float, key_metadata("least depth below the plane z = 0 of T for catching", "m", ge=0.0)]
        | None
    ) = None
    angle: (
        Annotated[float, key_metadata("largest angle between C and T for catching", "rad", gt=0.0)] | None
    ) = None
    speed: Annotated[
        float, key_metadata("largest receding speed for catching", "m/s", ge=0.0, infinite=True)
    ] = math.inf
    stiffness: (
        Annotated[list[AxisStiffness], six_axis_metadata("stiffness of the spring, in T axes")] | None
    ) = None
    stiffness_matrix: (
        Annotated[
            list[StiffnessRow],
            Meta(min_length=6, max_length=6, description="stiffness matrix in T axes, instead of stiffness"),
        ]
        | None
    ) = None
    damping: Annotated[list[AxisDamping], six_axis_metadata("damping parallel to the spring, in T axes")] = (
        field(default_factory=zeros(6))
    )
    latched: Annotated[bool, key_metadata("whether the latch holds from the start on")] = False


class SixAxisMechanism(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Docking mechanism on a six-axis rig, as described by a mechanism file, in SI units."""

    schema: Annotated[Literal["jaxhil/mechanism/2"], key_metadata("kind of file")]
    name: Annotated[str, key_metadata("name of the mechanism", min_length=1, max_length=100)]
    source: Annotated[str, key_metadata("source of the numbers", max_length=10_000)] = "assumed"
    target: Annotated[RigidBody, key_metadata("the body with the frame T")]
    chaser: Annotated[RigidBody, key_metadata("the body with the frame C")]
    approach: Annotated[Approach, key_metadata("relative motion at the first touch")] | None = None
    start: Annotated[Start, key_metadata("states at the start, instead of approach")] | None = None
    contact: Annotated[dict[str, Contact], key_metadata("shapes that may touch")] = field(
        default_factory=dict
    )
    latch: Annotated[dict[str, Latch], key_metadata("latches that catch and hold the chaser")] = field(
        default_factory=dict
    )
    rig: Annotated[Rig, key_metadata("the rig")]
    uncertainty: Annotated[
        dict[str, Uncertainty], key_metadata("uncertainty of the numbers, by dotted path")
    ] = field(default_factory=dict)
    correlation: Annotated[Correlation, key_metadata("correlation of the uncertain numbers")] | None = None


AnyMechanism = Mechanism | SixAxisMechanism


def is_six_axes(raw: object) -> bool:
    """Return whether the key `schema` of a parsed table is the six-axis schema."""
    return isinstance(raw, Mapping) and raw.get("schema") == SIX_AXIS_SCHEMA


def numeric_keys_of(mechanism: AnyMechanism) -> dict[str, Range]:
    """Return the allowed values of every real-valued key of the mechanism's schema, by dotted path."""
    if isinstance(mechanism, Mechanism):
        return numeric_keys()
    return numeric_keys_with(tuple(mechanism.contact), tuple(mechanism.latch))


@functools.cache
def numeric_keys_with(contacts: tuple[str, ...], latches: tuple[str, ...]) -> dict[str, Range]:
    """Return the allowed values of every real-valued key, given the names of all contacts and latches."""
    names: Any = {"contact": contacts, "latch": latches}
    return ranges_of(describe_struct(SixAxisMechanism), names)
