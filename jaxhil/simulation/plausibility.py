"""What a mechanism file means: its contacts as they are in space, beside what the rig can do.

The figures are those of `ContactLaw.reference`, the closed forms where a law has them: no tick is run. From
them follow the warnings of what can hardly be meant, and how many ticks a run takes.
"""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from jaxhil.contact.laws import ContactLaw, ContactParameters, contact_law
from jaxhil.contact.reference import Reference
from jaxhil.errors import InputError
from jaxhil.mechanism.rules import velocity_limit_allowed
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import dimensions, quantiles
from jaxhil.simulation import kept_programs
from jaxhil.simulation.cells import FASTEST_POLE
from jaxhil.simulation.environment import computing
from jaxhil.simulation.free_flight import APPROACH
from jaxhil.simulation.outcome import parameters_by_slot
from jaxhil.simulation.scenario import LONGEST_CONTACT, MotionSimulator, Scenario, build_scenarios

MOST_TICKS = 1e7  # of a contact
MOST_TICKS_OF_A_RUN = 1e9  # they are counted in 32 bits

FREQUENCIES = 0.05, 50.0  # Hz, of contacts that can be meant
FASTEST = 0.1  # contact frequency over control rate, likewise
LARGEST_VELOCITY = 1.0  # m/s, likewise
SHOWN = 4  # contact frequencies in the line, beyond which only their range is said

_RARELY = 1e-9  # the share of draws beyond either end of what is taken to be drawn
# Keys that decide on the number of ticks, and on the motion simulator's poles.
_TICKS = ("bodies.", "approach.velocity", "contact.", "rig.contact_plane", "rig.control_period")
_SPEEDS = ("approach.velocity", "rig.simulator.velocity_limit")
_POLES = ("rig.simulator.", "rig.control_period")


class ContactFigures(NamedTuple):
    """A contact in space, entered at the speed of the first approach."""

    number: int  # of the first contact of the schedule that is so, from 1
    frequency: float  # of a spring sqrt(k/M)/(2 pi), of other laws 1/(2 duration) [Hz]
    duration: float  # [s]; infinite if the bodies do not separate
    peak_force: float  # [N]


class Meaning(NamedTuple):
    """What a mechanism file means, nominally."""

    equivalent_mass: float  # [kg]
    contacts: tuple[ContactFigures, ...]  # those that differ
    control_rate: float  # [Hz]
    simulator_bandwidth: float  # of the motion simulator [Hz]; infinite for an ideal one
    force_range: float  # of the force sensor [N]; infinite for none
    duration: float  # of the run, about [s]
    warnings: tuple[str, ...]  # what can hardly be meant: key, what was found, what is expected

    def line(self, name: str) -> str:
        """All of it in one line, the warnings apart."""
        frequencies = [one.frequency for one in self.contacts]
        fastest = max(frequencies)
        rates = f"{_share(fastest, self.control_rate)} of the control rate ({self.control_rate:.4g} Hz)"
        if math.isfinite(self.simulator_bandwidth):
            bandwidth = f"the motion simulator's bandwidth ({self.simulator_bandwidth:.3g} Hz)"
            rates += f" and {_share(fastest, self.simulator_bandwidth)} of {bandwidth}"
        peak = max(one.peak_force for one in self.contacts)
        part = "the sensor has no range"
        if math.isfinite(self.force_range):
            part = f"{_share(peak, self.force_range)} of the sensor's range ({self.force_range:.4g} N)"
        return (
            f"{name}: equivalent mass {self.equivalent_mass:.4g} kg; contact at {_listed(frequencies)} Hz, "
            f"{'at most ' * (len(frequencies) > 1)}{rates}; peak force {peak:.3g} N ({part}); "
            f"the run lasts about {self.duration:.3g} s"
        )


def meaning(mechanism: Mechanism) -> Meaning:
    """What a valid mechanism means, nominally."""
    with computing():
        scenarios = build_scenarios(mechanism)
        reference = _in_space(mechanism, scenarios)
    contacts = _contacts(mechanism, reference)
    rig = mechanism.rig
    return Meaning(
        equivalent_mass=mechanism.bodies.mass,
        contacts=contacts,
        control_rate=1 / rig.control_period,
        simulator_bandwidth=bandwidth(scenarios.simulator),
        force_range=rig.force_sensor.range,
        duration=float(np.sum(_seconds(scenarios, reference))),
        warnings=tuple(_warnings(mechanism, contacts)),
    )


def check_run(mechanism: Mechanism, label: str | None = None, drawn: bool = False) -> None:
    """A run can be computed, nominally or also where the uncertain numbers are `drawn`: no contact takes more
    than 1e7 ticks, its approach included, nor all of them more than 1e9, no pole of the motion simulator is
    beyond `FASTEST_POLE`, and the drives can follow the first approach.

    `label` is what an error calls the mechanism. Raises `InputError`.
    """
    name = label or mechanism.name
    lanes = build_scenarios(mechanism, _corners(mechanism, _POLES) if drawn else None)
    check_poles(name, lanes.simulator.denominator, lanes.control_period)
    _check_velocity_limit(name, build_scenarios(mechanism, _corners(mechanism, _SPEEDS) if drawn else None))
    _check_ticks(name, mechanism, build_scenarios(mechanism, _corners(mechanism, _TICKS) if drawn else None))


def _check_velocity_limit(name: str, scenarios: Scenario) -> None:
    limits = scenarios.simulator.velocity_limit
    lane = int(np.argmax(scenarios.velocity - limits))
    if limits[lane] < scenarios.velocity[lane]:
        found = f"rig.simulator.velocity_limit: found {limits[lane]:g}"
        raise InputError(
            f"{name}: {found}, allowed {velocity_limit_allowed(float(scenarios.velocity[lane]))}"
        )


def check_poles(name: str, denominator: Any, control_period: Any) -> None:
    """No pole of motion simulators, (order + 1, lanes), is beyond `FASTEST_POLE`. Raises `InputError`."""
    for lane, period in enumerate(control_period):
        coefficients = np.asarray(denominator)[:, lane]
        with np.errstate(all="ignore"):
            monic = coefficients / coefficients[0] * period ** np.arange(len(coefficients))
        fastest = np.max(np.abs(np.roots(monic)), initial=0.0) if np.all(np.isfinite(monic)) else math.inf
        if fastest > FASTEST_POLE:
            allowed = f"at most {FASTEST_POLE:g} / control_period; a faster one is ideal"
            pole = f"a pole of {fastest / period:.3g} rad/s at a control period of {period:g} s"
            raise InputError(f"{name}: rig.simulator: found {pole}, allowed {allowed}")


def bandwidth(simulator: MotionSimulator) -> float:
    """Frequency [Hz] at which the gain of the first lane's G first is 1/sqrt(2); infinite for an ideal one,
    NaN where it cannot be computed."""
    numerator, denominator = (np.asarray(one, float)[:, 0] for one in simulator[:2])
    order = len(denominator) - 1
    if order == 0:
        return math.inf
    with np.errstate(all="ignore"):
        # In units of the poles' mean frequency, in which coefficients are of like size.
        unit = abs(denominator[-1] / denominator[0]) ** (1 / order)
        powers = unit ** np.arange(order, -1, -1.0) / denominator[-1]
        twice, once = 2 * _squared(numerator * powers[1:]), _squared(denominator * powers)
        excess = np.polysub(twice, once)
    if not np.all(np.isfinite(excess)):
        return math.nan
    roots = np.roots(excess)
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(unit * math.sqrt(min(squares)) / (2 * math.pi)) if len(squares) else math.nan


def _check_ticks(name: str, mechanism: Mechanism, scenarios: Scenario) -> None:
    contacts = mechanism.approach.contacts
    allowed = min(MOST_TICKS, MOST_TICKS_OF_A_RUN / contacts)
    # As a rule there is no need to know how long the contacts are.
    longest = APPROACH + scenarios.control_period + 2 * LONGEST_CONTACT + _patience(scenarios)
    if np.all(longest <= allowed * scenarios.control_period):
        return
    with computing():
        way, lasts = _seconds(scenarios, _in_space(mechanism, scenarios))
    with np.errstate(all="ignore"):
        ticks = (way + lasts) / scenarios.control_period
    slot, lane = np.unravel_index(np.argmax(ticks), ticks.shape)
    if ticks[slot, lane] <= MOST_TICKS and np.sum(ticks, axis=0).max() <= MOST_TICKS_OF_A_RUN:
        return
    found = f"rig.control_period: found {scenarios.control_period[lane]:g} s"
    if way[slot, lane] > LONGEST_CONTACT:
        found = f"contact.clearance: found {scenarios.clearance[lane]:g} m"
    seconds, most = (way + lasts)[slot, lane], f"{MOST_TICKS:.0e} ticks a contact"
    raise InputError(
        f"{name}: {found}, allowed at most {most} and {MOST_TICKS_OF_A_RUN:.0e} a run: "
        f"contact {slot + 1} takes about {seconds:.3g} s, {ticks[slot, lane]:.2g} ticks"
    )


def _squared(polynomial: np.ndarray) -> np.ndarray:
    """|p(jw)|^2 as a polynomial in w^2, descending powers."""
    degrees = np.arange(len(polynomial) - 1, -1, -1)
    product = np.convolve(polynomial, polynomial * (-1.0) ** degrees)[::2]
    return product * (-1.0) ** degrees


def _in_space(mechanism: Mechanism, scenarios: Scenario) -> Reference:
    """The contacts in space, (contacts, lanes), each entered at the speed of the first approach."""
    shape = scenarios.phase.shape
    mass, velocity = (np.broadcast_to(one, shape) for one in (scenarios.equivalent_mass, scenarios.velocity))
    law = contact_law(mechanism.contact.law).simulated
    found = kept_programs.run(_reference, law, scenarios.contact, mass, velocity)
    numbers: Any = [np.asarray(leaf)[: mechanism.approach.contacts] for leaf in found]
    return Reference(*numbers)


def _reference(law: ContactLaw, parameters: ContactParameters, mass: Any, velocity: Any) -> Reference:
    return law.reference(parameters_by_slot(parameters), mass, velocity)


def _contacts(mechanism: Mechanism, reference: Reference) -> tuple[ContactFigures, ...]:
    """The first lane's contacts that differ, in the order of the schedule."""
    durations = np.nan_to_num(reference.duration[:, 0], nan=math.inf, posinf=math.inf)
    contacts: dict[tuple[float, ...], ContactFigures] = {}
    for slot, duration in enumerate(durations):
        frequency = 1 / (2 * duration)
        if contact_law(mechanism.contact.law).is_linear:
            entries: Any = mechanism.contact.stiffness
            stiffness = entries[min(slot, len(entries) - 1)]
            frequency = math.sqrt(stiffness / mechanism.bodies.mass) / (2 * math.pi)
        figures = float(frequency), float(duration), float(reference.peak_force[slot, 0])
        contacts.setdefault(figures, ContactFigures(slot + 1, *figures))
    return tuple(contacts.values())


def _seconds(scenarios: Scenario, reference: Reference) -> tuple[np.ndarray, np.ndarray]:
    """About how long the way to each contact takes, and the contact with the wait for its end [s], each
    (contacts, lanes)."""
    contacts = len(reference.duration)
    sensor, simulator, velocity = scenarios.force_sensor, scenarios.simulator, scenarios.velocity
    wait = simulator.delay + sensor.delay + 20 * sensor.time_constant + 2 * scenarios.control_period
    duration = np.nan_to_num(reference.duration, nan=math.inf, posinf=math.inf)
    way = APPROACH + scenarios.phase[:contacts] * scenarios.control_period
    with np.errstate(all="ignore"):
        way = way + np.clip(
            np.abs(scenarios.contact_plane) / velocity, 0, LONGEST_CONTACT + _patience(scenarios)
        )
        left = np.cumprod(np.nan_to_num(reference.restitution, nan=1.0), axis=0)
        crossing = scenarios.clearance / (velocity * np.concatenate([np.ones_like(left[:1]), left[:-1]]))
        flight = np.minimum(np.nan_to_num(crossing, nan=math.inf, posinf=math.inf), _patience(scenarios))
    later = np.arange(contacts)[:, None] > 0
    way = np.where(later & np.isfinite(scenarios.clearance), flight, way)
    return way, np.minimum(duration + wait, LONGEST_CONTACT)


def _patience(scenarios: Scenario) -> np.ndarray:
    """For how long [s] the next touch is waited for between two surfaces, and by how much longer than for a
    contact where there is but one."""
    with np.errstate(all="ignore"):
        crossing = 10 * scenarios.clearance / scenarios.velocity
        nearer = 10 * np.maximum(-scenarios.contact_plane, 0.0) / scenarios.velocity
    return np.where(np.isfinite(scenarios.clearance), LONGEST_CONTACT + crossing, nearer)


def _corners(mechanism: Mechanism, prefixes: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Draws with every uncertain number whose path begins so at either end: all combinations of them."""
    columns = dimensions(mechanism)
    paths = [path for path in columns if path.startswith(prefixes)]
    corners = list(itertools.product((_RARELY, 1 - _RARELY), repeat=len(paths)))
    points = [
        np.full((len(corners), count), 0.5)
        if path not in paths
        else np.repeat([[corner[paths.index(path)]] for corner in corners], count, axis=1)
        for path, count in columns.items()
    ]
    return quantiles(mechanism, np.concatenate(points, axis=1))


def _warnings(mechanism: Mechanism, contacts: tuple[ContactFigures, ...]) -> list[str]:
    rig, contact, found = mechanism.rig, mechanism.contact, []
    fastest = max(contacts, key=lambda one: one.frequency)
    slowest = min(contacts, key=lambda one: one.frequency)
    strongest = max(contacts, key=lambda one: one.peak_force)
    least, most = FREQUENCIES
    limit = FASTEST / rig.control_period
    if fastest.frequency > limit:
        found.append(f"{_frequency(fastest)}, expected at most {limit:.4g} Hz, 1/10 of the control rate")
    elif fastest.frequency > most:
        found.append(f"{_frequency(fastest)}, expected at most {most:g} Hz")
    if slowest.frequency < least:
        found.append(f"{_frequency(slowest)}, expected at least {least:g} Hz")
    if mechanism.approach.velocity > LARGEST_VELOCITY:
        velocity = f"{mechanism.approach.velocity:.4g} m/s"
        found.append(f"approach.velocity: found {velocity}, expected at most {LARGEST_VELOCITY:g} m/s")
    if strongest.peak_force > rig.force_sensor.range:
        peak = f"the {strongest.peak_force:.3g} N of contact {strongest.number} in space"
        found.append(f"rig.force_sensor.range: found {rig.force_sensor.range:.4g} N, expected beyond {peak}")
    if not contact_law(contact.law).damped and any(contact.damping):
        largest = max(contact.damping)
        found.append(
            f"contact.damping: found {largest:.4g} N s/m, expected 0: law {contact.law} has no damping"
        )
    return found + _late(mechanism, min(contacts, key=lambda one: one.duration))


def _frequency(contact: ContactFigures) -> str:
    frequency = f"a contact frequency of {contact.frequency:.3g} Hz (contact {contact.number})"
    return f"contact.stiffness: found {frequency}"


def _late(mechanism: Mechanism, shortest: ContactFigures) -> list[str]:
    """A warning of readings that come when the shortest contact is over."""
    rig = mechanism.rig
    force = rig.force_sensor.delay + rig.force_sensor.time_constant
    lasts = f"less than contact {shortest.number} lasts, {shortest.duration:.3g} s"
    for key, own, others in (
        ("simulator", 0.0, ""),
        ("force_sensor", force, " with its lag and the motion simulator's delay"),
        ("position_sensor", rig.position_sensor.delay, " with the motion simulator's"),
    ):
        delay = rig.simulator.delay + own
        if delay > shortest.duration:
            return [f"rig.{key}.delay: found {delay:.3g} s{others}, expected {lasts}"]
    return []


def _share(value: float, whole: float) -> str:
    """`value` as a part of `whole`, in words."""
    share = value / whole
    return f"1/{1 / share:.0f}" if 0 < share < 0.1 else f"{share:.2g}"


def _listed(frequencies: list[float]) -> str:
    texts = list(dict.fromkeys(f"{one:.3g}" for one in frequencies))
    if len(texts) > SHOWN:
        return f"{min(frequencies):.3g} to {max(frequencies):.3g}"
    return ", ".join(texts)
