"""What a mechanism file says, as plain frozen structs.

A `Mechanism` is one docking mechanism on one rig: the two bodies, how they approach, the contact,
the rig (motion simulator, sensors, period), and how uncertain each number is. Every number is in SI
units, natural frequencies in Hz. The type of a field carries its range, so that the reader of
files, the error messages and the truncation of random draws all take it from here.

The structs themselves hold what they are given; `jaxhil.mechanism.file` reads and validates.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta, Struct, field

__all__ = [
    "BUILT_IN_LAWS",
    "CONTACT_LAWS",
    "MAX_CONTACTS",
    "SCHEMA",
    "Approach",
    "Bodies",
    "Contact",
    "ForceSensor",
    "Mechanism",
    "PositionSensor",
    "Range",
    "Rig",
    "Simulator",
    "Uncertainty",
    "numeric_keys",
    "range_of",
    "schema_type",
    "value_at",
]

SCHEMA = "jaxhil/mechanism/1"
MAX_CONTACTS = 1000

BUILT_IN_LAWS = (
    "linear",
    "kelvin_voigt",
    "hunt_crossley",
    "piecewise_linear",
    "hardening",
    "depth_damped",
    "elastoplastic",
)
CONTACT_LAWS = [*BUILT_IN_LAWS]  # and those that `jaxhil.register` enters

Law = Annotated[str, Meta(extra={"one_of": CONTACT_LAWS})]
SimulatorModel = Literal["ideal", "first_order", "second_order", "third_order", "transfer_function"]
Integrator = Literal["semi_implicit_euler", "zoh", "explicit_euler"]
CommandHold = Literal["linear", "zoh"]
Distribution = Literal["uniform", "loguniform", "normal"]

# A number is finite unless its type says "infinite".
Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
PositiveOrInfinite = Annotated[float, Meta(gt=0.0, extra={"infinite": True})]
UnitInterval = Annotated[float, Meta(ge=0.0, le=1.0)]
Delay = Annotated[float, Meta(ge=0.0, le=1.0)]
ControlPeriod = Annotated[float, Meta(gt=0.0, le=0.1)]
Coefficients = Annotated[list[float], Meta(min_length=1, max_length=21)]
Slopes = Annotated[list[Positive], Meta(min_length=1, max_length=21)]


def _only(value: float) -> Callable[[], list[float]]:
    return lambda: [value]


class Bodies(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The two free bodies [kg]: their equivalent mass, or both masses."""

    equivalent_mass: Positive | None = None
    chaser_mass: Positive | None = None
    target_mass: Positive | None = None

    @property
    def mass(self) -> float:
        """Equivalent mass M = m1 m2 / (m1 + m2) [kg] of the relative motion."""
        if self.equivalent_mass is not None:
            return self.equivalent_mass
        if self.chaser_mass is None or self.target_mass is None:
            raise ValueError("bodies: needs equivalent_mass, or chaser_mass and target_mass")
        return self.chaser_mass * (self.target_mass / (self.chaser_mass + self.target_mass))


class Approach(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the bodies meet: speed [m/s], successive contacts, phase of the first one in a period."""

    velocity: Positive
    contacts: Annotated[int, Meta(ge=1, le=MAX_CONTACTS)] = 1
    phase: UnitInterval = 1.0 / 3.0


class Contact(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The contact law and its parameters, one entry per successive contact; the last repeats.

    `stiffness` in N/m (N/m^exponent for hunt_crossley and depth_damped); for piecewise_linear one list of
    slopes per contact, one slope more than there are `depths` [m]. `damping` in N s/m (s/m for
    hunt_crossley; none for elastoplastic). `clearance` [m] between two surfaces; infinite when there is one
    surface. `reference_depth` [m] of hardening and depth_damped, `unloading_ratio` [1] of elastoplastic.
    """

    law: Law
    stiffness: Annotated[list[Positive | Slopes], Meta(min_length=1, max_length=MAX_CONTACTS)]
    damping: Annotated[list[NonNegative], Meta(min_length=1, max_length=MAX_CONTACTS)] = field(
        default_factory=_only(0.0)
    )
    tension: bool = False
    clearance: PositiveOrInfinite = math.inf
    exponent: Annotated[float, Meta(ge=1.0)] = 1.5
    depths: Annotated[list[Positive], Meta(max_length=20)] = field(default_factory=list)
    reference_depth: Positive | None = None
    unloading_ratio: Annotated[float, Meta(ge=1.0)] | None = None


class Simulator(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The motion simulator, from commanded to actual position: G(s) exp(-s delay), and its limits.

    `natural_frequency` [Hz]; `coefficients` [a1, a2, a3] of 1/(1 + a1 s + a2 s^2 + a3 s^3);
    `numerator` and `denominator` in descending powers of s; limits in m/s and m/s^2.
    """

    model: SimulatorModel
    natural_frequency: Positive | None = None
    damping_ratio: Positive | None = None
    time_constant: NonNegative | None = None
    coefficients: Annotated[list[Positive], Meta(min_length=3, max_length=3)] | None = None
    numerator: Coefficients | None = None
    denominator: Coefficients | None = None
    delay: Delay = 0.0
    velocity_limit: PositiveOrInfinite = math.inf
    acceleration_limit: PositiveOrInfinite = math.inf


class ForceSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The force sensor: delay and lag [s], then bias, noise, quantum, dead zone and range [N]."""

    delay: Delay = 0.0
    time_constant: NonNegative = 0.0
    noise_std: NonNegative = 0.0
    quantum: NonNegative = 0.0
    dead_zone: NonNegative = 0.0
    bias: float = 0.0
    range: PositiveOrInfinite = math.inf


class PositionSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The position sensor: delay [s], noise and quantum [m]."""

    delay: Delay = 0.0
    noise_std: NonNegative = 0.0
    quantum: NonNegative = 0.0


class Rig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The controller: period [s], integrator, command; the motion simulator, the sensors.

    `contact_plane` [m] is where the hardware touches; the controller takes it to be at 0.
    """

    control_period: ControlPeriod
    integrator: Integrator = "semi_implicit_euler"
    command_latency: Annotated[int, Meta(ge=0, le=1)] = 0
    command_hold: CommandHold = "linear"
    contact_plane: float = 0.0
    simulator: Simulator
    force_sensor: ForceSensor = ForceSensor()
    position_sensor: PositionSensor = PositionSensor()


class Uncertainty(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How one number varies: see `jaxhil.mechanism.uncertainty`."""

    distribution: Distribution
    low: float | None = None
    high: float | None = None
    factor: Annotated[list[Positive], Meta(min_length=2, max_length=2)] | None = None
    std: Positive | None = None
    independent: bool = False


class Mechanism(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One docking mechanism on one rig."""

    schema: Literal["jaxhil/mechanism/1"]
    name: Annotated[str, Meta(min_length=1, max_length=100)]
    source: Annotated[str, Meta(max_length=10_000)] = "assumed"
    bodies: Bodies
    approach: Approach
    contact: Contact
    rig: Rig
    uncertainty: dict[str, Uncertainty] = field(default_factory=dict)


class Range(NamedTuple):
    """The allowed values of a number: the interval from low to high, each end in it or not."""

    low: float
    high: float
    low_open: bool
    high_open: bool

    def allows(self, value: float) -> bool:
        """Whether `value` is in the interval; never for NaN."""
        above = value > self.low if self.low_open else value >= self.low
        below = value < self.high if self.high_open else value <= self.high
        return above and below

    def __str__(self) -> str:
        if math.isinf(self.low):
            return "a finite number"
        if math.isinf(self.high):
            ending = "" if self.high_open else ", inf included"
            return f"a number {'>' if self.low_open else '>='} {self.low:g}{ending}"
        if self.low_open:
            return f"a number > {self.low:g} and <= {self.high:g}"
        return f"a number from {self.low:g} to {self.high:g}"


def range_of(kind: msgspec.inspect.FloatType | msgspec.inspect.IntType, infinite: bool) -> Range:
    """The allowed values that the type of a numeric field states."""
    low = kind.gt if kind.gt is not None else kind.ge
    high = kind.lt if kind.lt is not None else kind.le
    return Range(
        -math.inf if low is None else float(low),
        math.inf if high is None else float(high),
        low is None or kind.gt is not None,
        not infinite if high is None else kind.lt is not None,
    )


@functools.cache
def schema_type() -> msgspec.inspect.StructType:
    """The description of `Mechanism` and all below it that readers of files walk along."""
    info = msgspec.inspect.type_info(Mechanism)
    assert isinstance(info, msgspec.inspect.StructType)
    return info


@functools.cache
def numeric_keys() -> dict[str, Range]:
    """Every key of real numbers by dotted path, and its allowed values (or its entries')."""
    keys: dict[str, Range] = {}

    def visit(kind: msgspec.inspect.Type, path: str, infinite: bool = False) -> None:
        match kind:
            case msgspec.inspect.StructType(fields=fields):
                for entry in fields:
                    visit(entry.type, f"{path}.{entry.name}".lstrip("."))
            case msgspec.inspect.Metadata(type=inner, extra=extra):
                visit(inner, path, "infinite" in (extra or {}))
            case msgspec.inspect.UnionType(types=members):
                for member in members:
                    visit(member, path, infinite)
            case msgspec.inspect.ListType(item_type=item):
                visit(item, path)
            case msgspec.inspect.FloatType():
                keys[path] = range_of(kind, infinite)
            case _:
                pass

    visit(schema_type(), "")
    return keys


def value_at(mechanism: Mechanism, path: str) -> Any:
    """The value at a dotted path of struct fields, such as ``rig.simulator.delay``."""
    return functools.reduce(getattr, path.split("."), mechanism)
