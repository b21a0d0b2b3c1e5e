"""Plausibility of a mechanism file: its ideal contacts compared with the abilities of the rig.

The metrics are those of `ContactLaw.reference`, in closed form if the law has one; no tick is run. They give
warnings about implausible numbers, and the number of ticks of a run.
"""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from jaxhil.contact.ideal_contact import IdealContact
from jaxhil.contact.laws import ContactLaw, ContactParameters, find_contact_law
from jaxhil.errors import InputError
from jaxhil.mechanism.rules import format_allowed_velocity_limit
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import compute_quantiles, count_dimensions
from jaxhil.simulation import cached_programs
from jaxhil.simulation.cells import MAX_POLE
from jaxhil.simulation.free_flight import APPROACH_TIME
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.simulation.outcome import parameters_by_slot
from jaxhil.simulation.scenario import MAX_CONTACT_DURATION, MotionSimulatorBatch, Scenario, build_scenarios

MAX_CONTACT_TICKS = 1e7  # limit on the ticks of a contact
MAX_RUN_TICKS = 1e9  # limit on the ticks of a run, which are counted in 32 bits

PLAUSIBLE_FREQUENCIES = 0.05, 50.0  # Hz; plausible contact frequencies
MAX_FREQUENCY_RATIO = 0.1  # greatest plausible contact frequency, over the control rate
MAX_PLAUSIBLE_VELOCITY = 1.0  # m/s; greatest plausible approach velocity
MAX_LISTED_FREQUENCIES = 4  # greatest number of contact frequencies in the line; for more, only their range

_TAIL_PROBABILITY = 1e-9  # share of draws that are ignored at either end of a distribution
# Prefixes of keys that determine the number of ticks, the drives' speeds, and the motion simulator's poles.
_TICK_KEYS = ("bodies.", "approach.velocity", "contact.", "rig.contact_plane", "rig.control_period")
_SPEED_KEYS = ("approach.velocity", "rig.simulator.velocity_limit")
_POLE_KEYS = ("rig.simulator.", "rig.control_period")


class ContactSummary(NamedTuple):
    """Ideal contact, entered at the velocity of the first approach."""

    number: int  # index of the first contact of the schedule with these metrics, from 1
    frequency: float  # sqrt(k/M)/(2 pi) for a spring, 1/(2 duration) for other laws [Hz]
    duration: float  # [s]; infinite if the bodies do not separate
    peak_force: float  # [N]


class MechanismSummary(NamedTuple):
    """Summary of a nominal mechanism."""

    equivalent_mass: float  # [kg]
    contacts: tuple[ContactSummary, ...]  # distinct contacts of the schedule
    control_rate: float  # [Hz]
    simulator_bandwidth: float  # bandwidth of the motion simulator [Hz]; infinite for an ideal one
    force_range: float  # range of the force sensor [N]; infinite for none
    duration: float  # approximate duration of the run [s]
    warnings: tuple[str, ...]  # implausible numbers: key, found value, expected value

    def line(self, name: str) -> str:
        """Return the summary in one line, without the warnings."""
        frequencies = [contact.frequency for contact in self.contacts]
        fastest = max(frequencies)
        rates = (
            f"{_format_ratio(fastest, self.control_rate)} of the control rate ({self.control_rate:.4g} Hz)"
        )
        if math.isfinite(self.simulator_bandwidth):
            bandwidth = f"the motion simulator's bandwidth ({self.simulator_bandwidth:.3g} Hz)"
            rates += f" and {_format_ratio(fastest, self.simulator_bandwidth)} of {bandwidth}"
        peak = max(contact.peak_force for contact in self.contacts)
        part = "the sensor has no range"
        if math.isfinite(self.force_range):
            part = f"{_format_ratio(peak, self.force_range)} of the sensor's range ({self.force_range:.4g} N)"
        return (
            f"{name}: equivalent mass {self.equivalent_mass:.4g} kg; contact at "
            f"{_format_frequencies(frequencies)} Hz, "
            f"{'at most ' * (len(frequencies) > 1)}{rates}; peak force {peak:.3g} N ({part}); "
            f"the run lasts about {self.duration:.3g} s"
        )


def summarise_mechanism(mechanism: Mechanism) -> MechanismSummary:
    """Return the summary of a valid mechanism."""
    with jax_context():
        scenarios = build_scenarios(mechanism)
        reference = _compute_ideal_contacts(mechanism, scenarios)
    contacts = _find_distinct_contacts(mechanism, reference)
    rig = mechanism.rig
    return MechanismSummary(
        equivalent_mass=mechanism.bodies.mass,
        contacts=contacts,
        control_rate=1 / rig.control_period,
        simulator_bandwidth=compute_bandwidth(scenarios.simulator),
        force_range=rig.force_sensor.range,
        duration=float(np.sum(_estimate_durations(scenarios, reference))),
        warnings=tuple(_find_warnings(mechanism, contacts)),
    )


def check_run(mechanism: Mechanism, label: str | None = None, drawn: bool = False) -> None:
    """Raise `InputError` if a run cannot be computed, nominally or, with `drawn`, for any draw.

    A contact may take at most 1e7 ticks, its approach included, and a run at most 1e9. No pole of the motion
    simulator may exceed `MAX_POLE`, and the drives must be able to follow the first approach. An error
    calls the mechanism `label`.
    """
    name = label or mechanism.name
    lanes = build_scenarios(mechanism, _extreme_draws(mechanism, _POLE_KEYS) if drawn else None)
    check_poles(name, lanes.simulator.denominator, lanes.control_period)
    _check_velocity_limit(
        name, build_scenarios(mechanism, _extreme_draws(mechanism, _SPEED_KEYS) if drawn else None)
    )
    _check_ticks(
        name, mechanism, build_scenarios(mechanism, _extreme_draws(mechanism, _TICK_KEYS) if drawn else None)
    )


def _check_velocity_limit(name: str, scenarios: Scenario) -> None:
    """Raise `InputError` if an approach is faster than the drives' velocity limit."""
    limits = scenarios.simulator.velocity_limit
    lane = int(np.argmax(scenarios.velocity - limits))
    if limits[lane] < scenarios.velocity[lane]:
        found = f"rig.simulator.velocity_limit: found {limits[lane]:g}"
        raise InputError(
            f"{name}: {found}, expected {format_allowed_velocity_limit(float(scenarios.velocity[lane]))}"
        )


def check_poles(name: str, denominator: Any, control_period: Any) -> None:
    """Raise `InputError` if a pole of a motion simulator exceeds `MAX_POLE`.

    `denominator` is (order + 1, lanes), `control_period` (lanes,) [s].
    """
    for lane, period in enumerate(control_period):
        coefficients = np.asarray(denominator)[:, lane]
        with np.errstate(all="ignore"):
            monic = coefficients / coefficients[0] * period ** np.arange(len(coefficients))
        fastest = np.max(np.abs(np.roots(monic)), initial=0.0) if np.all(np.isfinite(monic)) else math.inf
        if fastest > MAX_POLE:
            allowed = f"at most {MAX_POLE:g} / control_period; a faster one is ideal"
            pole = f"a pole of {fastest / period:.3g} rad/s at a control period of {period:g} s"
            raise InputError(f"{name}: rig.simulator: found {pole}, expected {allowed}")


def compute_bandwidth(simulator: MotionSimulatorBatch) -> float:
    """Return the lowest frequency [Hz] at which the gain of the first lane's G is 1/sqrt(2).

    It is infinite for an ideal motion simulator, and NaN if it cannot be computed.
    """
    numerator, denominator = (np.asarray(part, float)[:, 0] for part in simulator[:2])
    order = len(denominator) - 1
    if order == 0:
        return math.inf
    with np.errstate(all="ignore"):
        # Dividing by the poles' mean frequency gives coefficients of similar size.
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
    """Raise `InputError` if a contact or a run takes too many ticks."""
    contacts = mechanism.approach.contacts
    allowed = min(MAX_CONTACT_TICKS, MAX_RUN_TICKS / contacts)
    # This upper bound usually suffices, without computing the contacts.
    longest = APPROACH_TIME + scenarios.control_period + 2 * MAX_CONTACT_DURATION + _longest_wait(scenarios)
    if np.all(longest <= allowed * scenarios.control_period):
        return
    with jax_context():
        way, lasts = _estimate_durations(scenarios, _compute_ideal_contacts(mechanism, scenarios))
    with np.errstate(all="ignore"):
        ticks = (way + lasts) / scenarios.control_period
    slot, lane = np.unravel_index(np.argmax(ticks), ticks.shape)
    if ticks[slot, lane] <= MAX_CONTACT_TICKS and np.sum(ticks, axis=0).max() <= MAX_RUN_TICKS:
        return
    found = f"rig.control_period: found {scenarios.control_period[lane]:g} s"
    if way[slot, lane] > MAX_CONTACT_DURATION:
        found = f"contact.clearance: found {scenarios.clearance[lane]:g} m"
    seconds, most = (way + lasts)[slot, lane], f"{MAX_CONTACT_TICKS:.0e} ticks a contact"
    raise InputError(
        f"{name}: {found}, expected at most {most} and {MAX_RUN_TICKS:.0e} a run: "
        f"contact {slot + 1} takes about {seconds:.3g} s, {ticks[slot, lane]:.2g} ticks"
    )


def _squared(polynomial: np.ndarray) -> np.ndarray:
    """Return |p(jw)|^2 as a polynomial in w^2, descending powers."""
    degrees = np.arange(len(polynomial) - 1, -1, -1)
    product = np.convolve(polynomial, polynomial * (-1.0) ** degrees)[::2]
    return product * (-1.0) ** degrees


def _compute_ideal_contacts(mechanism: Mechanism, scenarios: Scenario) -> IdealContact:
    """Return the ideal contacts, (contacts, lanes), each entered at the first approach's velocity."""
    shape = scenarios.phase.shape
    mass, velocity = (np.broadcast_to(x, shape) for x in (scenarios.equivalent_mass, scenarios.velocity))
    law = find_contact_law(mechanism.contact.law).simulated
    reference = cached_programs.run_cached(_compute_reference, law, scenarios.contact, mass, velocity)
    numbers: Any = [np.asarray(leaf)[: mechanism.approach.contacts] for leaf in reference]
    return IdealContact(*numbers)


def _compute_reference(
    law: ContactLaw, parameters: ContactParameters, mass: Any, velocity: Any
) -> IdealContact:
    """Return the ideal contacts of a law, (slots, lanes)."""
    return law.reference(parameters_by_slot(parameters), mass, velocity)


def _find_distinct_contacts(mechanism: Mechanism, reference: IdealContact) -> tuple[ContactSummary, ...]:
    """Return the first lane's distinct contacts, in the order of the schedule."""
    durations = np.nan_to_num(reference.duration[:, 0], nan=math.inf, posinf=math.inf)
    contacts: dict[tuple[float, ...], ContactSummary] = {}
    for slot, duration in enumerate(durations):
        frequency = 1 / (2 * duration)
        if find_contact_law(mechanism.contact.law).is_linear:
            entries: Any = mechanism.contact.stiffness
            stiffness = entries[min(slot, len(entries) - 1)]
            frequency = math.sqrt(stiffness / mechanism.bodies.mass) / (2 * math.pi)
        figures = float(frequency), float(duration), float(reference.peak_force[slot, 0])
        contacts.setdefault(figures, ContactSummary(slot + 1, *figures))
    return tuple(contacts.values())


def _estimate_durations(scenarios: Scenario, reference: IdealContact) -> tuple[np.ndarray, np.ndarray]:
    """Return approximate durations [s], (contacts, lanes), of the way to each contact and of the contact.

    The contact's duration includes the wait for its end.
    """
    contacts = len(reference.duration)
    sensor, simulator, velocity = scenarios.force_sensor, scenarios.simulator, scenarios.velocity
    wait = simulator.delay + sensor.delay + 20 * sensor.time_constant + 2 * scenarios.control_period
    duration = np.nan_to_num(reference.duration, nan=math.inf, posinf=math.inf)
    way = APPROACH_TIME + scenarios.phase[:contacts] * scenarios.control_period
    with np.errstate(all="ignore"):
        way = way + np.clip(
            np.abs(scenarios.contact_plane) / velocity, 0, MAX_CONTACT_DURATION + _longest_wait(scenarios)
        )
        left = np.cumprod(np.nan_to_num(reference.restitution, nan=1.0), axis=0)
        crossing = scenarios.clearance / (velocity * np.concatenate([np.ones_like(left[:1]), left[:-1]]))
        flight = np.minimum(np.nan_to_num(crossing, nan=math.inf, posinf=math.inf), _longest_wait(scenarios))
    later = np.arange(contacts)[:, None] > 0
    way = np.where(later & np.isfinite(scenarios.clearance), flight, way)
    return way, np.minimum(duration + wait, MAX_CONTACT_DURATION)


def _longest_wait(scenarios: Scenario) -> np.ndarray:
    """Return the longest wait [s] for a touch.

    With two surfaces this is the wait for the next touch; with one, the wait in excess of a contact's limit.
    """
    with np.errstate(all="ignore"):
        crossing = 10 * scenarios.clearance / scenarios.velocity
        nearer = 10 * np.maximum(-scenarios.contact_plane, 0.0) / scenarios.velocity
    return np.where(np.isfinite(scenarios.clearance), MAX_CONTACT_DURATION + crossing, nearer)


def _extreme_draws(mechanism: Mechanism, prefixes: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return draws with every uncertain number at either end of its distribution, in all combinations.

    Only numbers whose paths begin with one of the prefixes are varied.
    """
    columns = count_dimensions(mechanism)
    paths = [path for path in columns if path.startswith(prefixes)]
    corners = list(itertools.product((_TAIL_PROBABILITY, 1 - _TAIL_PROBABILITY), repeat=len(paths)))
    points = [
        np.full((len(corners), count), 0.5)
        if path not in paths
        else np.repeat([[corner[paths.index(path)]] for corner in corners], count, axis=1)
        for path, count in columns.items()
    ]
    return compute_quantiles(mechanism, np.concatenate(points, axis=1))


def _find_warnings(mechanism: Mechanism, contacts: tuple[ContactSummary, ...]) -> list[str]:
    """Return warnings about implausible numbers."""
    rig, contact, warnings = mechanism.rig, mechanism.contact, []
    fastest = max(contacts, key=lambda item: item.frequency)
    slowest = min(contacts, key=lambda item: item.frequency)
    strongest = max(contacts, key=lambda item: item.peak_force)
    least, most = PLAUSIBLE_FREQUENCIES
    limit = MAX_FREQUENCY_RATIO / rig.control_period
    if fastest.frequency > limit:
        warnings.append(
            f"{_format_frequency(fastest)}, expected at most {limit:.4g} Hz, 1/10 of the control rate"
        )
    elif fastest.frequency > most:
        warnings.append(f"{_format_frequency(fastest)}, expected at most {most:g} Hz")
    if slowest.frequency < least:
        warnings.append(f"{_format_frequency(slowest)}, expected at least {least:g} Hz")
    if mechanism.approach.velocity > MAX_PLAUSIBLE_VELOCITY:
        velocity = f"{mechanism.approach.velocity:.4g} m/s"
        warnings.append(
            f"approach.velocity: found {velocity}, expected at most {MAX_PLAUSIBLE_VELOCITY:g} m/s"
        )
    if strongest.peak_force > rig.force_sensor.range:
        peak = f"the {strongest.peak_force:.3g} N of contact {strongest.number} in space"
        warnings.append(
            f"rig.force_sensor.range: found {rig.force_sensor.range:.4g} N, expected beyond {peak}"
        )
    if not find_contact_law(contact.law).damped and any(contact.damping):
        largest = max(contact.damping)
        warnings.append(
            f"contact.damping: found {largest:.4g} N s/m, expected 0: law {contact.law} has no damping"
        )
    return warnings + _check_delays(mechanism, min(contacts, key=lambda item: item.duration))


def _format_frequency(contact: ContactSummary) -> str:
    """Return the beginning of a warning about a contact's frequency."""
    frequency = f"a contact frequency of {contact.frequency:.3g} Hz (contact {contact.number})"
    return f"contact.stiffness: found {frequency}"


def _check_delays(mechanism: Mechanism, shortest: ContactSummary) -> list[str]:
    """Return a warning if readings arrive after the shortest contact is over."""
    rig = mechanism.rig
    force = rig.force_sensor.delay + rig.force_sensor.time_constant
    lasts = f"less than contact {shortest.number} lasts, {shortest.duration:.3g} s"
    for key, sensor_delay, suffix in (
        ("simulator", 0.0, ""),
        ("force_sensor", force, " with its lag and the motion simulator's delay"),
        ("position_sensor", rig.position_sensor.delay, " with the motion simulator's"),
    ):
        delay = rig.simulator.delay + sensor_delay
        if delay > shortest.duration:
            return [f"rig.{key}.delay: found {delay:.3g} s{suffix}, expected {lasts}"]
    return []


def _format_ratio(value: float, whole: float) -> str:
    """Return `value` as a fraction of `whole`, as text."""
    share = value / whole
    return f"1/{1 / share:.0f}" if 0 < share < 0.1 else f"{share:.2g}"


def _format_frequencies(frequencies: list[float]) -> str:
    """Return the frequencies, or their range, as text."""
    texts = list(dict.fromkeys(f"{frequency:.3g}" for frequency in frequencies))
    if len(texts) > MAX_LISTED_FREQUENCIES:
        return f"{min(frequencies):.3g} to {max(frequencies):.3g}"
    return ", ".join(texts)
