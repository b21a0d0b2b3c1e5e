"""Warnings about numbers of a mechanism file that are implausible compared with its ideal contacts."""

import math
from typing import NamedTuple

from jaxhil.contact.laws import find_contact_law
from jaxhil.laws.shared.nominal_values import force_delay
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.structs import Mechanism

PLAUSIBLE_FREQUENCIES = 0.15, 50.0  # lowest and highest plausible contact frequency [Hz]
MIN_FREQUENCY_RATIO = 1e-4  # lowest plausible contact frequency as a fraction of the control rate [1]
MAX_PLAUSIBLE_BANDWIDTH = 50.0  # highest plausible natural frequency of a motion simulator [Hz]
MAX_FREQUENCY_RATIO = 0.1  # highest plausible contact frequency as a fraction of the control rate [1]
MAX_PLAUSIBLE_VELOCITY = 1.0  # highest plausible approach velocity [m/s]
# largest plausible distances by key [m]
MAX_PLAUSIBLE_DISTANCES = {"rig.contact_plane": 0.1, "contact.clearance": 1.0}


class ContactSummary(NamedTuple):
    """Metrics of an ideal contact at the velocity of the first approach.

    Attributes:
        number: Number of the first scheduled contact with these metrics, from 1.
        frequency: Contact frequency [Hz]: sqrt(stiffness/mass)/(2 pi) for a spring, else 1/(2 duration).
        duration: Duration [s]; infinite if the bodies do not separate.
        peak_force: Peak force [N].
    """

    number: int
    frequency: float
    duration: float
    peak_force: float


def find_warnings(mechanism: Mechanism, contacts: tuple[ContactSummary, ...]) -> list[str]:
    """Return one line for each implausible number: key, found and expected value, and a likely cause."""
    rig, contact, warnings = mechanism.rig, mechanism.contact, []
    fastest = max(contacts, key=lambda item: item.frequency)
    slowest = min(contacts, key=lambda item: item.frequency)
    strongest = max(contacts, key=lambda item: item.peak_force)
    lowest, highest = PLAUSIBLE_FREQUENCIES
    limit = MAX_FREQUENCY_RATIO / rig.control_period
    if fastest.frequency > limit:
        warnings.append(
            f"{_format_frequency(fastest)}, expected at most {limit:.4g} Hz, 1/10 of the control rate"
        )
    elif fastest.frequency > highest:
        warnings.append(f"{_format_frequency(fastest)}, expected at most {highest:g} Hz")
    lowest = max(lowest, MIN_FREQUENCY_RATIO / rig.control_period)
    if slowest.frequency < lowest:
        hint = "is the stiffness in N/mm, or a mass in g?"
        if find_contact_law(contact.law).is_linear:
            hint += f" then it is {math.sqrt(1000) * slowest.frequency:.2g} Hz"
        lasts = f", which lasts {slowest.duration:.2g} s" if math.isfinite(slowest.duration) else ""
        warnings.append(f"{_format_frequency(slowest)}{lasts}, expected at least {lowest:g} Hz ({hint})")
    for key, largest in MAX_PLAUSIBLE_DISTANCES.items():
        distance = abs(value_at(mechanism, key))
        if math.isfinite(distance) and distance > largest:
            warnings.append(f"{key}: found {distance:.4g} m, expected at most {largest:g} m (is it in mm?)")
    if mechanism.approach.velocity > MAX_PLAUSIBLE_VELOCITY:
        velocity = f"{mechanism.approach.velocity:.4g} m/s"
        warnings.append(
            f"approach.velocity: found {velocity}, expected at most {MAX_PLAUSIBLE_VELOCITY:g} m/s (is it in "
            "mm/s?)"
        )
    if strongest.peak_force > rig.force_sensor.range:
        peak = f"{strongest.peak_force:.3g} N, the peak force of ideal contact {strongest.number}"
        warnings.append(
            f"rig.force_sensor.range: found {rig.force_sensor.range:.4g} N, expected more than {peak} (is it "
            "in kN?)"
        )
    frequency = rig.simulator.natural_frequency
    if frequency is not None and frequency > MAX_PLAUSIBLE_BANDWIDTH:
        warnings.append(
            f"rig.simulator.natural_frequency: found {frequency:.4g} Hz, expected at most "
            f"{MAX_PLAUSIBLE_BANDWIDTH:g} Hz (is it in rad/s? then it is {frequency / (2 * math.pi):.3g} Hz)"
        )
    warnings += _check_sensors(mechanism, strongest)
    if not find_contact_law(contact.law).is_damped and any(contact.damping):
        largest = max(contact.damping)
        warnings.append(
            f"contact.damping: found {largest:.4g} N s/m, expected 0: law {contact.law} has no damping"
        )
    return warnings + _check_delays(mechanism, min(contacts, key=lambda item: item.duration))


def _check_sensors(mechanism: Mechanism, strongest: ContactSummary) -> list[str]:
    """Return a warning for each sensor error that is at least the strongest ideal contact's signal."""
    frequency = strongest.frequency  # 0 if the contact does not end
    depth = mechanism.approach.velocity / (2 * math.pi * frequency) if frequency else math.inf
    limits = (
        ("force_sensor", strongest.peak_force, "N", "the peak force", "mN"),
        ("position_sensor", depth, "m", "about the depth", "um or mm"),
    )
    warnings = []
    for sensor, limit, unit, meaning, smaller in limits:
        for key in ("noise_std", "quantum", "dead_zone", "bias", "bias_random_walk"):
            value = getattr(getattr(mechanism.rig, sensor), key, 0.0)
            units = f"{unit}/sqrt(s)" if key == "bias_random_walk" else unit
            if 0.0 < limit <= abs(value):
                warnings.append(
                    f"rig.{sensor}.{key}: found {value:.4g} {units}, expected less than {limit:.3g} {units}, "
                    f"{meaning} of ideal contact {strongest.number} (is it in {smaller}?)"
                )
    return warnings


def _format_frequency(contact: ContactSummary) -> str:
    frequency = f"a contact frequency of {contact.frequency:.3g} Hz (contact {contact.number})"
    return f"contact.stiffness: found {frequency}"


def _check_delays(mechanism: Mechanism, shortest: ContactSummary) -> list[str]:
    """Return one warning if a delay exceeds the duration of the shortest contact, else an empty list."""
    rig = mechanism.rig
    force = force_delay(mechanism)
    allowed = f"less than {shortest.duration:.3g} s, the duration of contact {shortest.number}"
    for key, sensor_delay, suffix in (
        ("simulator", 0.0, ""),
        ("force_sensor", force, " with its lag and the motion simulator's delay"),
        ("position_sensor", rig.position_sensor.delay, " with the motion simulator's"),
    ):
        delay = rig.simulator.delay + sensor_delay
        if delay > shortest.duration:
            return [f"rig.{key}.delay: found {delay:.3g} s{suffix}, expected {allowed}"]
    return []
