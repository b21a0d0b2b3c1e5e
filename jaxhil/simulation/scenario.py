"""Scenarios: a mechanism, nominal or drawn, as a batch of plain arrays that one compiled program serves.

Every number of a mechanism file is an array leaf here, the control period and the delays included, so that
another mechanism, draw or batch of the same shape reuses the compiled loop and can be differentiated.
The batch is the trailing axis; successive contacts, segments and polynomial coefficients come first.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.contact.keys import Key
from jaxhil.contact.laws import KEYS, ContactParameters, contact_law
from jaxhil.contact.reference import Reference
from jaxhil.mechanism.structs import Mechanism, value_at
from jaxhil.simulation.probe import Probe

LONGEST_CONTACT = 10.0  # s


class MotionSimulator(NamedTuple):
    """The motion simulator num(s)/den(s) e^(-s delay)."""

    numerator: Float[Array, "order *batch"]  # coefficients in descending powers of s [rad/s]
    denominator: Float[Array, "order_plus_1 *batch"]  # likewise
    delay: Float[Array, "*batch"]  # transport delay [s]
    velocity_limit: Float[Array, "*batch"]  # [m/s]; infinite if none
    acceleration_limit: Float[Array, "*batch"]  # [m/s^2]; infinite if none


class ForceSensor(NamedTuple):
    """The force sensor."""

    delay: Float[Array, "*batch"]  # transport delay [s]
    time_constant: Float[Array, "*batch"]  # of its first-order lag [s]
    noise_std: Float[Array, "*batch"]  # standard deviation of white noise [N]
    quantum: Float[Array, "*batch"]  # [N]; 0 for none
    dead_zone: Float[Array, "*batch"]  # [N]
    bias: Float[Array, "*batch"]  # [N]
    range: Float[Array, "*batch"]  # [N]; infinite for none


class PositionSensor(NamedTuple):
    """The position sensor."""

    delay: Float[Array, "*batch"]  # [s]
    noise_std: Float[Array, "*batch"]  # standard deviation of white noise [m]
    quantum: Float[Array, "*batch"]  # [m]; 0 for none


class Scenario(NamedTuple):
    """One run per lane."""

    equivalent_mass: Float[Array, "*batch"]  # M [kg]
    velocity: Float[Array, "*batch"]  # of the first approach [m/s]
    contacts: Int[Array, "*batch"]  # how many there are
    phase: Float[Array, "slots *batch"]  # of each contact within a control period [1]
    clearance: Float[Array, "*batch"]  # between two surfaces [m]; infinite for one
    contact: ContactParameters  # parameters of the contact law, of each contact
    control_period: Float[Array, "*batch"]  # T [s]
    # where the hardware's surface is [m]; the controller takes it to be at 0
    contact_plane: Float[Array, "*batch"]
    simulator: MotionSimulator  # motion simulator
    force_sensor: ForceSensor  # force sensor
    position_sensor: PositionSensor  # position sensor
    time_limit: Float[Array, "*batch"]  # of a contact [s]
    key: UInt32[Array, "2 *batch"]  # of the sensors' noise: seed, index of the scenario
    probe: Probe | None = None  # what the run is probed with; None if not at all
    # the contacts in space where they are known beforehand, NaN where not; None if nowhere
    reference: Reference | None = None


def contact_slots(contacts: int) -> int:
    """Number of result slots: a power of two, so that neighbouring counts share a compiled program."""
    return max(4, 1 << (contacts - 1).bit_length())


def build_scenarios(
    mechanism: Mechanism, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
) -> Scenario:
    """Batch of scenarios of a mechanism, as NumPy arrays; as jax arrays where draws are such.

    `draws` maps dotted paths to values, (number,) or for lists (number, entries); what it lacks is nominal.
    Without it, a batch of one: the nominal run. Noise keys depend on `seed` and `first` + lane alone.
    """
    table = _Table(mechanism, dict(draws or {}))
    contact, rig, number = mechanism.contact, mechanism.rig, table.number
    indices = np.arange(first, first + number, dtype=np.uint32)
    key: Any = np.stack([np.full(number, seed & 0xFFFFFFFF, np.uint32), indices])
    contacts: Any = np.full(number, mechanism.approach.contacts, np.int32)
    return Scenario(
        equivalent_mass=_mass(mechanism, table),
        velocity=table.scalar("approach.velocity"),
        contacts=contacts,
        phase=_phase(mechanism, table),
        clearance=table.scalar("contact.clearance"),
        contact=ContactParameters(
            stiffness=table.successive("contact.stiffness"),
            damping=table.successive("contact.damping") * float(contact_law(contact.law).damped),
            **{key.name: table.repeated(table.of_law(key)) for key in KEYS.values()},
        ),
        control_period=table.scalar("rig.control_period"),
        contact_plane=table.scalar("rig.contact_plane"),
        simulator=_simulator(rig.simulator, table),
        force_sensor=ForceSensor(*(table.scalar(f"rig.force_sensor.{name}") for name in ForceSensor._fields)),
        position_sensor=PositionSensor(
            *(table.scalar(f"rig.position_sensor.{name}") for name in PositionSensor._fields)
        ),
        time_limit=table.constant(LONGEST_CONTACT),
        key=key,
    )


class _Table:
    """The numbers of a mechanism by dotted path, drawn or nominal, one per lane."""

    def __init__(self, mechanism: Mechanism, draws: dict[str, Any]) -> None:
        # The namespace of the arrays.
        self.np: Any = jnp if any(isinstance(drawn, jax.Array) for drawn in draws.values()) else np
        self.number = len(next(iter(draws.values()))) if draws else 1
        self.slots = contact_slots(mechanism.approach.contacts)
        self._mechanism, self._draws = mechanism, draws

    def drawn(self, path: str, default: Any = None) -> Any:
        """What was drawn, else the nominal value or, where the file has none, the `default`."""
        value = self._draws.get(path)
        if value is None:
            value = value_at(self._mechanism, path)
        return self.np.asarray(default if value is None else value, float)

    def scalar(self, path: str, default: float | None = None) -> Any:
        return self.np.broadcast_to(self.drawn(path, default), (self.number,))

    def constant(self, value: float) -> Any:
        return self.np.broadcast_to(self.np.asarray(value, float), (self.number,))

    def entries(self, path: str) -> Any:
        """A list, (entries, ..., number)."""
        nominal = np.asarray(value_at(self._mechanism, path), float)
        repeated = np.broadcast_to(nominal, (self.number, *nominal.shape))
        value = self.np.asarray(self._draws.get(path, repeated))
        return self.np.moveaxis(value.reshape(self.number, *nominal.shape), 0, -1)

    def of_law(self, key: Key) -> Any:
        """A key of some contact laws alone, (..., number)."""
        path = f"contact.{key.name}"
        if isinstance(key.default, bool):
            return np.full(self.number, value_at(self._mechanism, path))
        return self.entries(path) if isinstance(key.default, list) else self.scalar(path, key.neutral)

    def successive(self, path: str) -> Any:
        """A list as one entry per slot, the last repeated."""
        entries = self.entries(path)
        return entries[np.minimum(np.arange(self.slots), len(entries) - 1)]

    def repeated(self, entry: Any) -> Any:
        """The same entry in every slot."""
        return self.np.broadcast_to(entry, (self.slots, *entry.shape))


def _phase(mechanism, table) -> Any:
    """(slots, number); a phase of its own for every contact where it is drawn so."""
    phase = table.drawn("approach.phase")
    phase = table.np.atleast_2d(phase.T).T  # (number or 1, contacts or 1)
    phase = table.np.broadcast_to(phase, (table.number, phase.shape[1]))
    return phase[:, np.minimum(np.arange(table.slots), phase.shape[1] - 1)].T


def _mass(mechanism, table) -> Any:
    if mechanism.bodies.equivalent_mass is not None:
        return table.scalar("bodies.equivalent_mass")
    chaser, target = table.scalar("bodies.chaser_mass"), table.scalar("bodies.target_mass")
    return chaser * target / (chaser + target)


def _simulator(simulator, table) -> MotionSimulator:
    """Every model as a transfer function; `ideal` has order 0."""
    path = "rig.simulator."
    one = table.constant(1.0)
    numerator: Any
    denominator: Any
    if simulator.model == "ideal":
        numerator, denominator = np.zeros((0, len(one))), one[None]
    elif simulator.model == "first_order":
        time_constant = table.scalar(path + "time_constant")
        numerator, denominator = one[None], table.np.stack([time_constant, one])
    elif simulator.model == "second_order":
        frequency = 2 * np.pi * table.scalar(path + "natural_frequency")
        damping = table.scalar(path + "damping_ratio")
        numerator = table.np.stack([0 * one, frequency**2])
        denominator = table.np.stack([one, 2 * damping * frequency, frequency**2])
    elif simulator.model == "third_order":
        a_1, a_2, a_3 = table.entries(path + "coefficients")
        numerator = table.np.stack([0 * one, 0 * one, one])
        denominator = table.np.stack([a_3, a_2, a_1, one])
    else:
        denominator = table.entries(path + "denominator")
        numerator = table.entries(path + "numerator")
        missing = len(denominator) - 1 - len(numerator)
        numerator = table.np.concatenate([np.zeros((max(missing, 0), len(one))), numerator])
        numerator = numerator[len(numerator) - (len(denominator) - 1) :]
    return MotionSimulator(
        numerator,
        denominator,
        table.scalar(path + "delay"),
        table.scalar(path + "velocity_limit"),
        table.scalar(path + "acceleration_limit"),
    )
