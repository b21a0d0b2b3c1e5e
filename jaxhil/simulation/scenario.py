"""Scenarios: nominal or drawn mechanisms as a batch of arrays, for one compiled program.

Every number of a mechanism file is an array leaf here, including the control period and the delays. Another
mechanism, draw or batch of equal shape can therefore reuse the compiled loop, and the result can be
differentiated. The batch is the trailing axis; contacts, segments and polynomial coefficients come first.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.contact.ideal_contact import IdealContact
from jaxhil.contact.keys import ContactKey
from jaxhil.contact.laws import CONTACT_KEYS, ContactParameters, find_contact_law
from jaxhil.mechanism.structs import Mechanism, value_at
from jaxhil.simulation.probe import Probe

MAX_CONTACT_DURATION = 10.0  # s; limit on the duration of a contact


class MotionSimulatorBatch(NamedTuple):
    """Motion simulator num(s)/den(s) e^(-s delay)."""

    numerator: Float[Array, "order *batch"]  # coefficients in descending powers of s [rad/s]
    denominator: Float[Array, "order_plus_1 *batch"]  # likewise
    delay: Float[Array, "*batch"]  # transport delay [s]
    velocity_limit: Float[Array, "*batch"]  # [m/s]; infinite if none
    acceleration_limit: Float[Array, "*batch"]  # [m/s^2]; infinite if none


class ForceSensorBatch(NamedTuple):
    """Force sensor."""

    delay: Float[Array, "*batch"]  # transport delay [s]
    time_constant: Float[Array, "*batch"]  # time constant of the first-order lag [s]
    noise_std: Float[Array, "*batch"]  # standard deviation of white noise [N]
    quantum: Float[Array, "*batch"]  # [N]; 0 without quantisation
    dead_zone: Float[Array, "*batch"]  # [N]; 0 for none
    bias: Float[Array, "*batch"]  # [N]
    range: Float[Array, "*batch"]  # [N]; infinite if unlimited


class PositionSensorBatch(NamedTuple):
    """Position sensor."""

    delay: Float[Array, "*batch"]  # [s]
    noise_std: Float[Array, "*batch"]  # standard deviation of white noise [m]
    quantum: Float[Array, "*batch"]  # [m]; 0 without quantisation


class Scenario(NamedTuple):
    """Batch of scenarios, one run per lane."""

    equivalent_mass: Float[Array, "*batch"]  # M [kg]
    velocity: Float[Array, "*batch"]  # velocity of the first approach [m/s]
    contacts: Int[Array, "*batch"]  # number of contacts
    phase: Float[Array, "slots *batch"]  # phase of each contact within a control period [1]
    clearance: Float[Array, "*batch"]  # distance between two surfaces [m]; infinite for one surface
    contact: ContactParameters  # contact law's parameters for each contact
    control_period: Float[Array, "*batch"]  # T [s]
    # position of the hardware's surface [m]; the controller assumes 0
    contact_plane: Float[Array, "*batch"]
    simulator: MotionSimulatorBatch  # motion simulator
    force_sensor: ForceSensorBatch  # force sensor
    position_sensor: PositionSensorBatch  # position sensor
    time_limit: Float[Array, "*batch"]  # limit on the duration of a contact [s]
    key: UInt32[Array, "2 *batch"]  # key of the sensors' noise: seed, index of the scenario
    probe: Probe | None = None  # probe of the run; None without one
    # ideal contacts that are known beforehand, NaN for others; None if none is known
    reference: IdealContact | None = None


def count_contact_slots(contacts: int) -> int:
    """Return the number of result slots: a power of two, so that similar counts share a program."""
    return max(4, 1 << (contacts - 1).bit_length())


def build_scenarios(
    mechanism: Mechanism, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
) -> Scenario:
    """Return a batch of scenarios of a mechanism, as NumPy arrays, or JAX arrays if draws are such.

    `draws` maps dotted paths to values, (number,), or (number, entries) for lists; other numbers are nominal.
    Without draws the batch is the nominal run alone. Noise keys depend only on `seed` and `first` + lane.
    """
    table = _MechanismNumbers(mechanism, dict(draws or {}))
    contact, rig, number = mechanism.contact, mechanism.rig, table.number
    indices = np.arange(first, first + number, dtype=np.uint32)
    key: Any = np.stack([np.full(number, seed & 0xFFFFFFFF, np.uint32), indices])
    contacts: Any = np.full(number, mechanism.approach.contacts, np.int32)
    return Scenario(
        equivalent_mass=_build_mass(mechanism, table),
        velocity=table.scalar("approach.velocity"),
        contacts=contacts,
        phase=_build_phases(mechanism, table),
        clearance=table.scalar("contact.clearance"),
        contact=ContactParameters(
            stiffness=table.successive("contact.stiffness"),
            damping=table.successive("contact.damping") * float(find_contact_law(contact.law).damped),
            **{key.name: table.repeated(table.of_law(key)) for key in CONTACT_KEYS.values()},
        ),
        control_period=table.scalar("rig.control_period"),
        contact_plane=table.scalar("rig.contact_plane"),
        simulator=_build_motion_simulator(rig.simulator, table),
        force_sensor=ForceSensorBatch(
            *(table.scalar(f"rig.force_sensor.{name}") for name in ForceSensorBatch._fields)
        ),
        position_sensor=PositionSensorBatch(
            *(table.scalar(f"rig.position_sensor.{name}") for name in PositionSensorBatch._fields)
        ),
        time_limit=table.constant(MAX_CONTACT_DURATION),
        key=key,
    )


class _MechanismNumbers:
    """Numbers of a mechanism by dotted path, drawn or nominal, one per lane."""

    def __init__(self, mechanism: Mechanism, draws: dict[str, Any]) -> None:
        # Namespace of the arrays: JAX or NumPy.
        self.np: Any = jnp if any(isinstance(drawn, jax.Array) for drawn in draws.values()) else np
        self.number = len(next(iter(draws.values()))) if draws else 1
        self.slots = count_contact_slots(mechanism.approach.contacts)
        self._mechanism, self._draws = mechanism, draws

    def drawn(self, path: str, default: Any = None) -> Any:
        """Return the drawn value, else the nominal one or, without one in the file, the `default`."""
        value = self._draws.get(path)
        if value is None:
            value = value_at(self._mechanism, path)
        return self.np.asarray(default if value is None else value, float)

    def scalar(self, path: str, default: float | None = None) -> Any:
        """Return a number, (number,)."""
        return self.np.broadcast_to(self.drawn(path, default), (self.number,))

    def constant(self, value: float) -> Any:
        """Return the same number in every lane, (number,)."""
        return self.np.broadcast_to(self.np.asarray(value, float), (self.number,))

    def entries(self, path: str) -> Any:
        """Return a list, (entries, ..., number)."""
        nominal = np.asarray(value_at(self._mechanism, path), float)
        repeated = np.broadcast_to(nominal, (self.number, *nominal.shape))
        value = self.np.asarray(self._draws.get(path, repeated))
        return self.np.moveaxis(value.reshape(self.number, *nominal.shape), 0, -1)

    def of_law(self, key: ContactKey) -> Any:
        """Return a key that only some contact laws have, (..., number)."""
        path = f"contact.{key.name}"
        if isinstance(key.default, bool):
            return np.full(self.number, value_at(self._mechanism, path))
        return self.entries(path) if isinstance(key.default, list) else self.scalar(path, key.neutral)

    def successive(self, path: str) -> Any:
        """Return a list with one entry per slot; the last entry is repeated."""
        entries = self.entries(path)
        return entries[np.minimum(np.arange(self.slots), len(entries) - 1)]

    def repeated(self, entry: Any) -> Any:
        """Return the same entry in every slot."""
        return self.np.broadcast_to(entry, (self.slots, *entry.shape))


def _build_phases(mechanism, table) -> Any:
    """Return phases (slots, number); draws may contain one phase or one per contact."""
    phase = table.drawn("approach.phase")
    phase = table.np.atleast_2d(phase.T).T  # (number or 1, contacts or 1)
    phase = table.np.broadcast_to(phase, (table.number, phase.shape[1]))
    return phase[:, np.minimum(np.arange(table.slots), phase.shape[1] - 1)].T


def _build_mass(mechanism, table) -> Any:
    """Return the equivalent mass [kg]."""
    if mechanism.bodies.equivalent_mass is not None:
        return table.scalar("bodies.equivalent_mass")
    chaser, target = table.scalar("bodies.chaser_mass"), table.scalar("bodies.target_mass")
    return chaser * target / (chaser + target)


def _build_motion_simulator(simulator, table) -> MotionSimulatorBatch:
    """Return the motion simulator as a transfer function; `ideal` has order 0."""
    path = "rig.simulator."
    ones = table.constant(1.0)
    numerator: Any
    denominator: Any
    if simulator.model == "ideal":
        numerator, denominator = np.zeros((0, len(ones))), ones[None]
    elif simulator.model == "first_order":
        time_constant = table.scalar(path + "time_constant")
        numerator, denominator = ones[None], table.np.stack([time_constant, ones])
    elif simulator.model == "second_order":
        frequency = 2 * np.pi * table.scalar(path + "natural_frequency")
        damping = table.scalar(path + "damping_ratio")
        numerator = table.np.stack([0 * ones, frequency**2])
        denominator = table.np.stack([ones, 2 * damping * frequency, frequency**2])
    elif simulator.model == "third_order":
        a_1, a_2, a_3 = table.entries(path + "coefficients")
        numerator = table.np.stack([0 * ones, 0 * ones, ones])
        denominator = table.np.stack([a_3, a_2, a_1, ones])
    else:
        denominator = table.entries(path + "denominator")
        numerator = table.entries(path + "numerator")
        missing = len(denominator) - 1 - len(numerator)
        numerator = table.np.concatenate([np.zeros((max(missing, 0), len(ones))), numerator])
        numerator = numerator[len(numerator) - (len(denominator) - 1) :]
    return MotionSimulatorBatch(
        numerator,
        denominator,
        table.scalar(path + "delay"),
        table.scalar(path + "velocity_limit"),
        table.scalar(path + "acceleration_limit"),
    )
