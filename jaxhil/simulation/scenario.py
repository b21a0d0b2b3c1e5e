"""Scenarios: a mechanism, nominal or drawn, as a batch of plain arrays that one compiled program serves.

Every number of a mechanism file is an array leaf here, the control period and the delays included, so that
another mechanism, draw or batch of the same shape reuses the compiled loop and can be differentiated.
The batch is the trailing axis; successive contacts, segments and polynomial coefficients come first.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.contact.laws import ContactParameters
from jaxhil.contact.reference import Reference
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.probe import Probe

LONGEST_CONTACT = 10.0  # s


class MotionSimulator(NamedTuple):
    """num(s)/den(s) in descending powers of s [rad/s], delay [s], limits [m/s, m/s^2] (inf if none)."""

    numerator: Float[Array, "order *batch"]
    denominator: Float[Array, "order_plus_1 *batch"]
    delay: Float[Array, "*batch"]
    velocity_limit: Float[Array, "*batch"]
    acceleration_limit: Float[Array, "*batch"]


class ForceSensor(NamedTuple):
    """delay, time_constant [s]; noise_std, quantum, dead_zone, bias, range [N]."""

    delay: Float[Array, "*batch"]
    time_constant: Float[Array, "*batch"]
    noise_std: Float[Array, "*batch"]
    quantum: Float[Array, "*batch"]
    dead_zone: Float[Array, "*batch"]
    bias: Float[Array, "*batch"]
    range: Float[Array, "*batch"]


class PositionSensor(NamedTuple):
    """delay [s]; noise_std, quantum [m]."""

    delay: Float[Array, "*batch"]
    noise_std: Float[Array, "*batch"]
    quantum: Float[Array, "*batch"]


class Scenario(NamedTuple):
    """One run per lane: equivalent_mass [kg], velocity [m/s] of the first approach, number of contacts,
    phase of each contact [1], clearance [m] (inf if one-sided), the contacts' parameters, the rig with the
    contact_plane [m] in which it touches, the time_limit [s] of a contact, a random key (seed, index) for
    sensor noise; what it is probed with; the contacts in space, where they are known beforehand (else NaN).
    """

    equivalent_mass: Float[Array, "*batch"]
    velocity: Float[Array, "*batch"]
    contacts: Int[Array, "*batch"]
    phase: Float[Array, "slots *batch"]
    clearance: Float[Array, "*batch"]
    contact: ContactParameters
    control_period: Float[Array, "*batch"]
    contact_plane: Float[Array, "*batch"]
    simulator: MotionSimulator
    force_sensor: ForceSensor
    position_sensor: PositionSensor
    time_limit: Float[Array, "*batch"]
    key: UInt32[Array, "2 *batch"]
    probe: Probe | None = None
    reference: Reference | None = None


def contact_slots(contacts: int) -> int:
    """Number of result slots: a power of two, so that neighbouring counts share a compiled program."""
    return max(4, 1 << (contacts - 1).bit_length())


def build_scenarios(
    mechanism: Mechanism,
    draws: Mapping[str, np.ndarray] | None = None,
    seed: int = 0,
    first: int = 0,
) -> Scenario:
    """Batch of scenarios of a mechanism, as NumPy arrays.

    `draws` maps dotted paths to values, (number,) or for lists (number, entries); what it lacks is nominal.
    Without it, a batch of one: the nominal run. Noise keys depend on `seed` and `first` + lane alone.
    """
    draws = dict(draws or {})
    number = len(next(iter(draws.values()))) if draws else 1
    contacts = mechanism.approach.contacts
    slots = contact_slots(contacts)
    contact, rig = mechanism.contact, mechanism.rig

    def scalar(path: str, nominal) -> Any:
        value = draws.get(path, nominal)
        return np.broadcast_to(np.asarray(value, float), (number,))

    def table(path: str, nominal) -> Any:
        """(entries, ..., number)"""
        nominal = np.asarray(nominal, float)
        value = np.asarray(draws.get(path, np.broadcast_to(nominal, (number, *nominal.shape))))
        return np.moveaxis(value.reshape(number, *nominal.shape), 0, -1)

    def successive(path: str, nominal) -> Any:
        """One entry per slot, the last repeated."""
        entries = table(path, nominal)
        return entries[np.minimum(np.arange(slots), len(entries) - 1)]

    def every(entry: np.ndarray) -> Any:
        """The same entry in every slot."""
        return np.broadcast_to(entry, (slots, *entry.shape))

    phase = np.asarray(draws.get("approach.phase", mechanism.approach.phase), float)
    phase = np.atleast_2d(phase.T).T  # (number or 1, contacts or 1)
    phase = np.broadcast_to(phase, (number, phase.shape[1]))
    phase: Any = phase[:, np.minimum(np.arange(slots), phase.shape[1] - 1)].T
    simulator = _simulator(rig.simulator, scalar, table)
    indices = np.arange(first, first + number, dtype=np.uint32)
    key: Any = np.stack([np.full(number, seed & 0xFFFFFFFF, np.uint32), indices])
    return Scenario(
        equivalent_mass=_mass(mechanism, scalar),
        velocity=scalar("approach.velocity", mechanism.approach.velocity),
        contacts=every(np.full(number, contacts, np.int32))[0],
        phase=phase,
        clearance=scalar("contact.clearance", contact.clearance),
        contact=ContactParameters(
            stiffness=successive("contact.stiffness", contact.stiffness),
            damping=successive("contact.damping", contact.damping) * (contact.law != "linear"),
            exponent=every(scalar("contact.exponent", contact.exponent)),
            depths=every(table("contact.depths", contact.depths)),
            tension=every(np.full(number, contact.tension and contact.law == "kelvin_voigt")),
            reference_depth=every(scalar("contact.reference_depth", contact.reference_depth or 1.0)),
            unloading_ratio=every(scalar("contact.unloading_ratio", contact.unloading_ratio or 1.0)),
        ),
        control_period=scalar("rig.control_period", rig.control_period),
        contact_plane=scalar("rig.contact_plane", rig.contact_plane),
        simulator=simulator,
        force_sensor=ForceSensor(
            *(
                scalar(f"rig.force_sensor.{name}", getattr(rig.force_sensor, name))
                for name in ForceSensor._fields
            )
        ),
        position_sensor=PositionSensor(
            *(
                scalar(f"rig.position_sensor.{name}", getattr(rig.position_sensor, name))
                for name in PositionSensor._fields
            )
        ),
        time_limit=scalar("", LONGEST_CONTACT),
        key=key,
    )


def _mass(mechanism, scalar):
    bodies = mechanism.bodies
    if bodies.equivalent_mass is not None:
        return scalar("bodies.equivalent_mass", bodies.equivalent_mass)
    chaser = scalar("bodies.chaser_mass", bodies.chaser_mass)
    target = scalar("bodies.target_mass", bodies.target_mass)
    return chaser * target / (chaser + target)


def _simulator(simulator, scalar, table) -> MotionSimulator:
    """Every model as a transfer function; `ideal` has order 0."""
    path = "rig.simulator."
    one = scalar("", 1.0)
    numerator: Any
    denominator: Any
    if simulator.model == "ideal":
        numerator, denominator = np.zeros((0, len(one))), one[None]
    elif simulator.model == "first_order":
        time_constant = scalar(path + "time_constant", simulator.time_constant)
        numerator, denominator = one[None], np.stack([time_constant, one])
    elif simulator.model == "second_order":
        frequency = 2 * np.pi * scalar(path + "natural_frequency", simulator.natural_frequency)
        damping = scalar(path + "damping_ratio", simulator.damping_ratio)
        numerator = np.stack([0 * one, frequency**2])
        denominator = np.stack([one, 2 * damping * frequency, frequency**2])
    elif simulator.model == "third_order":
        a_1, a_2, a_3 = table(path + "coefficients", simulator.coefficients)
        numerator = np.stack([0 * one, 0 * one, one])
        denominator = np.stack([a_3, a_2, a_1, one])
    else:
        denominator = table(path + "denominator", simulator.denominator)
        numerator = table(path + "numerator", simulator.numerator)
        missing = len(denominator) - 1 - len(numerator)
        numerator = np.concatenate([np.zeros((max(missing, 0), len(one))), numerator])
        numerator = numerator[len(numerator) - (len(denominator) - 1) :]
    return MotionSimulator(
        numerator,
        denominator,
        scalar(path + "delay", simulator.delay),
        scalar(path + "velocity_limit", simulator.velocity_limit),
        scalar(path + "acceleration_limit", simulator.acceleration_limit),
    )
