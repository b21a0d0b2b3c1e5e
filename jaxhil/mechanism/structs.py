"""Content of a one-axis mechanism file as plain frozen structs.

A `Mechanism` is one docking mechanism on one rig: the two bodies, their approach, the contact, the rig
(motion simulator, sensors, control period), and the uncertainty of the numbers. All numbers are in SI units,
natural frequencies in Hz. The type of a field contains its description, unit and range, for validation,
messages and random draws.

The structs do not validate their fields; `jaxhil.mechanism.file` reads and validates files.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta, Struct, defstruct, field

from jaxhil.contact.keys import key_metadata
from jaxhil.contact.laws import CONTACT_KEYS, CONTACT_LAWS, laws_with_key

__all__ = [
    "MAGNITUDE_LIMITS",
    "MAX_CONTACTS",
    "SCHEMA",
    "Approach",
    "Bodies",
    "Contact",
    "Correlation",
    "ForceSensor",
    "Mechanism",
    "PositionSensor",
    "Rig",
    "SensorFilter",
    "Simulator",
    "Uncertainty",
]

SCHEMA = "jaxhil/mechanism/1"
MAX_CONTACTS = 1000
MAX_LATENCY = 4  # maximum command latency, including the periods that a co-simulation adds [periods]
# limits on the magnitude of nonzero numbers; a product of three such numbers neither overflows nor underflows
MAGNITUDE_LIMITS = 1e-100, 1e100
NO_METADATA: Mapping[str, Any] = {}

# The type refers to the registry itself, because `jaxhil.register` adds laws later.
ContactLawName = Annotated[str, Meta(description="contact law", extra={"one_of": CONTACT_LAWS})]
SimulatorModel = Literal[
    "ideal", "first_order", "second_order", "third_order", "transfer_function", "moving_average"
]
Integrator = Literal["semi_implicit_euler", "zoh", "explicit_euler"]
CommandHold = Literal["linear", "zoh"]
DeadZoneKind = Literal["continuous", "cut"]
FilterKind = Literal["butterworth", "bessel"]
MAX_FILTER_ORDER = 4
Distribution = Literal["uniform", "loguniform", "normal"]

BIAS_RANDOM_WALK = "random walk of the bias: standard deviation of its change in a second"
DEAD_ZONE_KINDS = "forces above the dead zone: reduced by it (continuous) or unchanged (cut)"

# Types of the entries of lists. A number must be finite unless its metadata contains `infinite`.
Stiffness = Annotated[float, key_metadata("slope of the force", "N/m", gt=0.0)]
Slopes = Annotated[list[Stiffness], Meta(min_length=1, max_length=21)]
Damping = Annotated[float, key_metadata("damping of the contact", "N s/m", ge=0.0)]
DampingRatio = Annotated[float, key_metadata("damping ratio of the contact", "1", ge=0.0)]
# Laws whose damping follows from a damping ratio, a stiffness and the equivalent mass.
DAMPING_RATIO_LAWS = tuple(
    law.name
    for law in CONTACT_LAWS.values()
    if law.is_damped and not law.is_segmented and (law.stiffness_unit, law.damping_unit) == ("N/m", "N s/m")
)
# Parts of the descriptions of stiffness and damping, for the laws with other units.
STIFFNESS_UNITS = "in N/m^exponent for " + " and ".join(
    law.name for law in CONTACT_LAWS.values() if law.stiffness_unit == "N/m^n"
)
DAMPING_UNITS = "in s/m for {}, none for {}".format(
    " and ".join(law.name for law in CONTACT_LAWS.values() if law.damping_unit == "s/m"),
    " and ".join(law.name for law in CONTACT_LAWS.values() if law.dissipation_process),
)
Factor = Annotated[float, key_metadata("factor on the nominal value", "1", gt=0.0)]
CubicCoefficients = Annotated[
    list[Annotated[float, key_metadata("coefficient of the n-th power of s", "s^n", gt=0.0)]],
    Meta(min_length=3, max_length=3, description="[a1, a2, a3] of 1/(1 + a1 s + a2 s^2 + a3 s^3)"),
]
Polynomial = Annotated[
    list[Annotated[float, key_metadata("coefficient of the n-th power of s", "s^n")]],
    Meta(min_length=1, max_length=21),
]
Numerator = Annotated[Polynomial, Meta(description="numerator of G(s), in descending powers of s")]
Denominator = Annotated[Polynomial, Meta(description="denominator of G(s), in descending powers of s")]
# Timing effects (`jaxhil.simulation.timing`).
Jitter = Annotated[
    float, key_metadata("largest deviation of the delay, uniform for each tick", "s", ge=0.0, le=1.0)
]
LossProbability = Annotated[
    float, key_metadata("probability that a reading is lost; the last one is repeated", "1", ge=0.0, le=0.9)
]
MissedTickProbability = Annotated[
    float, key_metadata("probability that the controller does not run at a tick", "1", ge=0.0, le=0.5)
]
UncertainKey = Annotated[str, Meta(min_length=1, max_length=100)]
CorrelationRow = Annotated[
    list[Annotated[float, key_metadata("correlation of two keys' normal numbers", "1", ge=-1.0, le=1.0)]],
    Meta(min_length=1, max_length=100),
]


def _single_entry(value: float) -> Callable[[], list[float]]:
    return lambda: [value]


class Bodies(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Masses of the two free bodies: their equivalent mass, or both masses."""

    equivalent_mass: Annotated[float, key_metadata("mass of the relative motion", "kg", gt=0.0)] | None = None
    chaser_mass: Annotated[float, key_metadata("mass of the chaser", "kg", gt=0.0)] | None = None
    target_mass: Annotated[float, key_metadata("mass of the target", "kg", gt=0.0)] | None = None

    @property
    def mass(self) -> float:
        """Return the equivalent mass M = m1 m2 / (m1 + m2) [kg] of the relative motion."""
        if self.equivalent_mass is not None:
            return self.equivalent_mass
        if self.chaser_mass is None or self.target_mass is None:
            raise ValueError("bodies: needs equivalent_mass, or chaser_mass and target_mass")
        return self.chaser_mass * (self.target_mass / (self.chaser_mass + self.target_mass))


class Approach(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Approach: its speed, the number of contacts, and when within a control period the first one begins."""

    velocity: Annotated[float, key_metadata("speed of the first approach", "m/s", gt=0.0)]
    contacts: Annotated[
        int, key_metadata("number of successive contacts in a run", "1", ge=1, le=MAX_CONTACTS)
    ] = 1
    phase: Annotated[
        float, key_metadata("phase of the first contact within a control period", "1", ge=0.0, le=1.0)
    ] = 1.0 / 3.0


class ContactOfAnyLaw(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the table `[contact]` that all contact laws have."""

    law: ContactLawName
    stiffness: Annotated[
        list[Stiffness | Slopes],
        Meta(
            min_length=1,
            max_length=MAX_CONTACTS,
            description=f"stiffness of each contact; {STIFFNESS_UNITS}",
        ),
    ]
    damping: Annotated[
        list[Damping],
        Meta(
            min_length=1,
            max_length=MAX_CONTACTS,
            description=f"damping of each contact; {DAMPING_UNITS}",
        ),
    ] = field(default_factory=_single_entry(0.0))
    damping_ratio: (
        Annotated[
            list[DampingRatio],
            Meta(
                min_length=1,
                max_length=MAX_CONTACTS,
                description="instead of damping: damping / (2 sqrt(stiffness * equivalent mass)) of each "
                f"contact; for {', '.join(DAMPING_RATIO_LAWS)}",
            ),
        ]
        | None
    ) = None
    clearance: Annotated[
        float, key_metadata("gap between two surfaces; infinite for one surface", "m", gt=0.0, infinite=True)
    ] = math.inf


CONTACT_DESCRIPTION = """Contact law and its parameters, with one entry per contact; the last entry repeats.

For piecewise_linear, `stiffness` has one list of slopes per contact, with one slope more than depths.
"""

if TYPE_CHECKING:

    class Contact(ContactOfAnyLaw, frozen=True):
        """Table `[contact]`, with a field for each key in `jaxhil.contact.laws.CONTACT_KEYS`."""

        def __getattr__(self, key: str) -> Any: ...

else:
    Contact = defstruct(
        "Contact",
        [key.struct_field(" and ".join(laws_with_key(key))) for key in CONTACT_KEYS.values()],
        bases=(ContactOfAnyLaw,),
        module=__name__,
        namespace={"__doc__": CONTACT_DESCRIPTION},
        frozen=True,
        forbid_unknown_fields=True,
        kw_only=True,
    )


class Simulator(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Motion simulator G(s) exp(-s delay) from commanded to actual position, and its limits."""

    model: Annotated[SimulatorModel, key_metadata("form of G(s)")]
    natural_frequency: (
        Annotated[float, key_metadata("natural frequency of second_order", "Hz", gt=0.0)] | None
    ) = None
    damping_ratio: Annotated[float, key_metadata("damping ratio of second_order", "1", gt=0.0)] | None = None
    time_constant: Annotated[float, key_metadata("time constant of first_order", "s", ge=0.0)] | None = None
    coefficients: CubicCoefficients | None = None
    numerator: Numerator | None = None
    denominator: Denominator | None = None
    window: (
        Annotated[float, key_metadata("time span over which moving_average averages", "s", gt=0.0, le=1.0)]
        | None
    ) = None
    delay: Annotated[float, key_metadata("transport delay of the motion", "s", ge=0.0, le=1.0)] = 0.0
    velocity_limit: Annotated[
        float, key_metadata("velocity limit of the position command", "m/s", gt=0.0, infinite=True)
    ] = math.inf
    acceleration_limit: Annotated[
        float, key_metadata("acceleration limit of the position command", "m/s^2", gt=0.0, infinite=True)
    ] = math.inf


class SensorFilter(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Optional low-pass filter of the force sensor, which replaces its time constant."""

    kind: Annotated[FilterKind, key_metadata("kind of filter")]
    order: Annotated[int, key_metadata("order of the filter", "1", ge=1, le=MAX_FILTER_ORDER)]
    cutoff: Annotated[float, key_metadata("frequency at which the gain is -3 dB", "Hz", gt=0.0)]


class ForceSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Force sensor. Its effects, in order: delay, lag, noise and bias, rounding, dead zone, saturation."""

    delay: Annotated[float, key_metadata("transport delay of the reading", "s", ge=0.0, le=1.0)] = 0.0
    jitter: Jitter = 0.0
    loss_probability: LossProbability = 0.0
    time_constant: Annotated[
        float, key_metadata("time constant of the reading's first-order lag", "s", ge=0.0)
    ] = 0.0
    noise_std: Annotated[float, key_metadata("standard deviation of white noise", "N", ge=0.0)] = 0.0
    quantum: Annotated[float, key_metadata("resolution: readings are multiples of this", "N", ge=0.0)] = 0.0
    dead_zone: Annotated[float, key_metadata("magnitude below which the reading is 0", "N", ge=0.0)] = 0.0
    dead_zone_kind: Annotated[DeadZoneKind, key_metadata(DEAD_ZONE_KINDS)] = "continuous"
    bias: Annotated[float, key_metadata("bias added to every reading", "N")] = 0.0
    bias_random_walk: Annotated[float, key_metadata(BIAS_RANDOM_WALK, "N/sqrt(s)", ge=0.0)] = 0.0
    range: Annotated[
        float, key_metadata("magnitude at which a reading saturates", "N", gt=0.0, infinite=True)
    ] = math.inf
    filter: Annotated[SensorFilter, key_metadata("low-pass filter of the reading")] | None = None


class PositionSensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Position sensor of the motion simulator."""

    delay: Annotated[float, key_metadata("transport delay of the reading", "s", ge=0.0, le=1.0)] = 0.0
    noise_std: Annotated[float, key_metadata("standard deviation of white noise", "m", ge=0.0)] = 0.0
    quantum: Annotated[float, key_metadata("resolution: readings are multiples of this", "m", ge=0.0)] = 0.0


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
    contact_plane: Annotated[
        float, key_metadata("position of the hardware's surface; the controller assumes 0", "m")
    ] = 0.0
    simulator: Annotated[Simulator, key_metadata("the motion simulator")]
    force_sensor: Annotated[ForceSensor, key_metadata("the force sensor")] = ForceSensor()
    position_sensor: Annotated[PositionSensor, key_metadata("the position sensor")] = PositionSensor()


class Uncertainty(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Distribution of an uncertain number (`jaxhil.mechanism.uncertainty`)."""

    distribution: Annotated[Distribution, key_metadata("kind of distribution")]
    low: Annotated[float, key_metadata("least value, in the key's unit", "")] | None = None
    high: Annotated[float, key_metadata("greatest value, in the key's unit", "")] | None = None
    factor: (
        Annotated[
            list[Factor],
            Meta(min_length=2, max_length=2, description="least and greatest factor on the nominal value"),
        ]
        | None
    ) = None
    std: Annotated[float, key_metadata("standard deviation, in the key's unit", "", gt=0.0)] | None = None
    independent: Annotated[bool, key_metadata("whether each entry of a list has a draw of its own")] = False


class Correlation(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Correlation of uncertain numbers by a Gaussian copula; each number keeps its distribution."""

    keys: Annotated[
        list[UncertainKey], Meta(min_length=1, max_length=100, description="keys that are correlated")
    ]
    matrix: Annotated[
        list[CorrelationRow],
        Meta(min_length=1, max_length=100, description="lower triangle of the matrix, one row for each key"),
    ]


class Mechanism(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Docking mechanism on a one-axis rig, as described by a mechanism file, in SI units."""

    schema: Annotated[Literal["jaxhil/mechanism/1"], key_metadata("kind of file")]
    name: Annotated[str, key_metadata("name of the mechanism", min_length=1, max_length=100)]
    source: Annotated[str, key_metadata("source of the numbers", max_length=10_000)] = "assumed"
    bodies: Annotated[Bodies, key_metadata("the two bodies")]
    approach: Annotated[Approach, key_metadata("approach of the bodies")]
    contact: Annotated[Contact, key_metadata("the contact")]
    rig: Annotated[Rig, key_metadata("the rig")]
    uncertainty: Annotated[
        dict[str, Uncertainty], key_metadata("uncertainty of the numbers, by dotted path")
    ] = field(default_factory=dict)
    correlation: Annotated[Correlation, key_metadata("correlation of the uncertain numbers")] | None = None
