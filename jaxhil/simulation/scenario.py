"""Scenarios: the numbers of nominal or drawn mechanisms, as a batch of arrays.

Every number of a mechanism file is an array here, including the control period and the delays. Scenarios of
a different mechanism or draw can therefore reuse a compiled program if the arrays have equal shapes. Results
can be differentiated with respect to every number.

The batch is the last axis. Axes for contacts, segments of a contact law and polynomial coefficients come
before it.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.contact.ideal_contact import IdealContact
from jaxhil.contact.keys import ContactKey
from jaxhil.contact.laws import CONTACT_KEYS, ContactParameters, find_contact_law
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.sensor_filter import find_modes
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.probe import Probe

MAX_CONTACT_DURATION = 10.0  # longest contact [s]; a longer one ends with the status "timeout"


class MotionSimulatorBatch(NamedTuple):
    """Parameters of the motion simulator G(s) e^(-s delay), with s in rad/s.

    G(s) is num(s)/den(s) or, with a window, the moving average (1 - e^(-s window))/(s window).
    """

    numerator: Float[Array, "order *batch"]  # coefficients of num(s), descending powers
    denominator: Float[Array, "order_plus_1 *batch"]  # coefficients of den(s), descending powers
    delay: Float[Array, "*batch"]  # transport delay [s]
    velocity_limit: Float[Array, "*batch"]  # velocity limit [m/s]; infinite if there is none
    acceleration_limit: Float[Array, "*batch"]  # acceleration limit [m/s^2]; infinite if there is none
    # window of a moving average [s]; None for a transfer function. With a window, num and den have order 0.
    window: Float[Array, "*batch"] | None = None


class ForceSensorBatch(NamedTuple):
    """Parameters of the force sensor."""

    delay: Float[Array, "*batch"]  # transport delay [s]
    time_constant: Float[Array, "*batch"]  # time constant of the first-order lag [s]
    noise_std: Float[Array, "*batch"]  # standard deviation of white noise [N]
    quantum: Float[Array, "*batch"]  # quantisation step [N]; 0 without quantisation
    dead_zone: Float[Array, "*batch"]  # half-width of the dead zone [N]; 0 without dead zone
    bias: Float[Array, "*batch"]  # bias [N]
    range: Float[Array, "*batch"]  # largest |reading| [N]; infinite if unlimited
    # cutoff frequency of the low-pass filter [rad/s], (*batch); None without a filter. With a filter,
    # `time_constant` is that of the filter's slowest mode.
    cutoff: Any = None
    # random walk of the bias [N/sqrt(s)], (*batch); None if no scenario of the batch has one
    bias_walk: Any = None


class PositionSensorBatch(NamedTuple):
    """Parameters of the position sensor."""

    delay: Float[Array, "*batch"]  # transport delay [s]
    noise_std: Float[Array, "*batch"]  # standard deviation of white noise [m]
    quantum: Float[Array, "*batch"]  # quantisation step [m]; 0 without quantisation


class TimingBatch(NamedTuple):
    """Timing effects of the rig; None for an effect that no scenario of the batch has."""

    jitter: Float[Array, "*batch"] | None  # largest deviation of the force reading's delay [s]
    loss: Float[Array, "*batch"] | None  # probability that a frame of the force sensor is lost
    missed: Float[Array, "*batch"] | None  # probability that the controller misses a tick


class Scenario(NamedTuple):
    """Batch of scenarios; each element of the batch (lane) is one series of contacts."""

    equivalent_mass: Float[Array, "*batch"]  # equivalent mass M of both bodies [kg]
    velocity: Float[Array, "*batch"]  # velocity of the first approach [m/s]
    contacts: Int[Array, "*batch"]  # number of contacts
    # additional duration of each contact's approach, as a fraction of the control period [1]
    phase: Float[Array, "slots *batch"]
    clearance: Float[Array, "*batch"]  # distance between two surfaces [m]; infinite for one surface
    contact: ContactParameters  # parameters of the contact law for each contact
    control_period: Float[Array, "*batch"]  # control period T [s]
    # position of the real mechanism's surface [m]; the compensator assumes 0
    contact_plane: Float[Array, "*batch"]
    simulator: MotionSimulatorBatch  # parameters of the motion simulator
    force_sensor: ForceSensorBatch  # parameters of the force sensor
    position_sensor: PositionSensorBatch  # parameters of the position sensor
    time_limit: Float[Array, "*batch"]  # limit on the duration of a contact [s]
    key: UInt32[Array, "2 *batch"]  # key of the sensors' noise: seed and index of the scenario
    probe: Probe | None = None  # push and reference trajectory for each contact; None without a probe
    # metrics of ideal contacts computed in advance; NaN for the other contacts; None if there are none
    reference: IdealContact | None = None
    timing: TimingBatch | None = None  # timing effects; None if there are none


def count_contact_slots(contacts: int) -> int:
    """Return the length of arrays with one entry per contact.

    The length is a power of two, so that mechanisms with similar numbers of contacts share a compiled
    program.
    """
    return max(4, 1 << (contacts - 1).bit_length())


def build_scenarios(
    mechanism: Mechanism, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
) -> Scenario:
    """Return a batch of scenarios of a mechanism.

    The arrays are JAX arrays if one of the draws is a JAX array, else NumPy arrays.

    Args:
        mechanism: Mechanism with the nominal numbers.
        draws: Values by dotted path, (scenarios,), or (scenarios, entries) for a list. Numbers that are not
            drawn are nominal. None for a batch with the nominal scenario only.
        seed: Seed of the sensors' noise.
        first: Index of the first scenario. The noise of a scenario depends only on seed and index.
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
            damping=table.successive("contact.damping") * float(find_contact_law(contact.law).is_damped),
            **{key.name: table.repeated(table.of_law(key)) for key in CONTACT_KEYS.values()},
        ),
        control_period=table.scalar("rig.control_period"),
        contact_plane=table.scalar("rig.contact_plane"),
        simulator=_build_motion_simulator(rig.simulator, table),
        force_sensor=_build_force_sensor(rig.force_sensor, table),
        position_sensor=PositionSensorBatch(
            *(table.scalar(f"rig.position_sensor.{name}") for name in PositionSensorBatch._fields)
        ),
        time_limit=table.constant(MAX_CONTACT_DURATION),
        key=key,
        timing=build_timing(table.optional),
    )


def build_timing(optional: Callable[[str], Any]) -> TimingBatch | None:
    """Return the timing effects of a mechanism with one axis or six axes; None if it has none.

    `optional` returns a parameter as an array (lanes,), or None if it is 0 in every draw.
    """
    paths = "rig.force_sensor.jitter", "rig.force_sensor.loss_probability", "rig.missed_tick_probability"
    timing = TimingBatch(*map(optional, paths))
    return None if all(effect is None for effect in timing) else timing


def add_jitter(delay: Any, timing: TimingBatch | None) -> Any:
    """Return the longest delay [s] of a force reading: the nominal `delay` plus the jitter."""
    return delay if timing is None or timing.jitter is None else delay + timing.jitter


class _MechanismNumbers:
    """Access to the numbers of a mechanism by dotted path: drawn values, else the nominal value."""

    def __init__(self, mechanism: Mechanism, draws: dict[str, Any]) -> None:
        # Module that creates the arrays: jax.numpy or numpy.
        self.np: Any = jnp if any(isinstance(drawn, jax.Array) for drawn in draws.values()) else np
        self.number = len(next(iter(draws.values()))) if draws else 1
        self.slots = count_contact_slots(mechanism.approach.contacts)
        self._mechanism, self._draws = mechanism, draws

    def drawn(self, path: str, default: Any = None) -> Any:
        """Return the drawn values for a `path`, else the nominal value, else `default`."""
        value = self._draws.get(path)
        if value is None:
            value = value_at(self._mechanism, path)
        return self.np.asarray(default if value is None else value, float)

    def scalar(self, path: str, default: float | None = None) -> Any:
        """Return a parameter that is a single number, as an array (lanes,)."""
        return self.np.broadcast_to(self.drawn(path, default), (self.number,))

    def constant(self, value: float) -> Any:
        """Return an array (lanes,) with the same value in every lane."""
        return self.np.broadcast_to(self.np.asarray(value, float), (self.number,))

    def optional(self, path: str) -> Any:
        """Return a parameter, as an array (lanes,); None if it is 0 in every draw."""
        is_used = path in self._draws or path in self._mechanism.uncertainty
        return self.scalar(path) if is_used or value_at(self._mechanism, path) else None

    def entries(self, path: str) -> Any:
        """Return a parameter that is a list, as an array (entries, ..., lanes)."""
        nominal = np.asarray(value_at(self._mechanism, path), float)
        repeated = np.broadcast_to(nominal, (self.number, *nominal.shape))
        value = self.np.asarray(self._draws.get(path, repeated))
        return self.np.moveaxis(value.reshape(self.number, *nominal.shape), 0, -1)

    def of_law(self, key: ContactKey) -> Any:
        """Return a parameter that only some contact laws have, as an array (..., lanes)."""
        path = f"contact.{key.name}"
        if isinstance(key.default, bool):
            return np.full(self.number, value_at(self._mechanism, path))
        return self.entries(path) if isinstance(key.default, list) else self.scalar(path, key.neutral)

    def successive(self, path: str) -> Any:
        """Return a list parameter with one entry per contact; the last entry is repeated if necessary."""
        entries = self.entries(path)
        return entries[np.minimum(np.arange(self.slots), len(entries) - 1)]

    def repeated(self, entry: Any) -> Any:
        """Return an array with the same entry for every contact."""
        return self.np.broadcast_to(entry, (self.slots, *entry.shape))


def _build_phases(mechanism, table) -> Any:
    """Return each contact's phase (extra time of the approach [control periods]), (contacts, lanes)."""
    phase = table.drawn("approach.phase")
    # A draw contains one phase for all contacts or one phase per contact: (lanes or 1, contacts or 1).
    phase = table.np.atleast_2d(phase.T).T
    phase = table.np.broadcast_to(phase, (table.number, phase.shape[1]))
    return phase[:, np.minimum(np.arange(table.slots), phase.shape[1] - 1)].T


def _build_mass(mechanism, table) -> Any:
    """Return the equivalent mass [kg] from the file, or from the masses of both bodies."""
    if mechanism.bodies.equivalent_mass is not None:
        return table.scalar("bodies.equivalent_mass")
    chaser, target = table.scalar("bodies.chaser_mass"), table.scalar("bodies.target_mass")
    return chaser * target / (chaser + target)


def _build_force_sensor(sensor, table) -> ForceSensorBatch:
    """Return the force sensor; the time constant of a filter is that of its slowest mode."""
    path, names = "rig.force_sensor.", ForceSensorBatch._fields[:-2]
    walk = table.optional(path + "bias_random_walk")
    batch = ForceSensorBatch(*(table.scalar(path + name) for name in names), bias_walk=walk)
    if sensor.filter is None:
        return batch
    cutoff = 2 * np.pi * table.scalar(path + "filter.cutoff")
    slowest = find_modes(sensor.filter.kind, sensor.filter.order).slowest
    return batch._replace(time_constant=1 / (slowest * cutoff), cutoff=cutoff)


def _build_motion_simulator(simulator, table) -> MotionSimulatorBatch:
    """Return the motion simulator; for `ideal` and `moving_average`, num(s)/den(s) has order 0."""
    path = "rig.simulator."
    ones = table.constant(1.0)
    numerator: Any
    denominator: Any
    if simulator.model in ("ideal", "moving_average"):
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
        table.scalar(path + "window") if simulator.model == "moving_average" else None,
    )
