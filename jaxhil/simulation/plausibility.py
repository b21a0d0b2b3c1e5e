"""Plausibility of a mechanism file: its ideal contacts compared with the capabilities of the rig.

No run is simulated. The ideal contacts are computed by `ContactLaw.ideal_contact`, in closed form if the
contact law has one. The ideal contacts show which numbers of the file are implausible, and how many ticks a
run will take.
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
from jaxhil.simulation.mechanism_warnings import ContactSummary, find_warnings
from jaxhil.simulation.outcome import parameters_by_slot
from jaxhil.simulation.scenario import (
    MAX_CONTACT_DURATION,
    MotionSimulatorBatch,
    Scenario,
    TimingBatch,
    build_scenarios,
)
from jaxhil.simulation.timing import MAX_SERIES_POLE

MAX_CONTACT_TICKS = 1e7  # maximum number of ticks of a contact, including its approach
MAX_RUN_TICKS = 1e9  # maximum number of ticks of a run; ticks are counted in 32 bits

MOVING_AVERAGE_BANDWIDTH = 0.442946  # x with sin(pi x)/(pi x) = 1/sqrt(2) [1]: bandwidth times window
FAST_SIMULATOR = f"at most {MAX_POLE:g} / control_period; for a faster simulator use model = 'ideal'"
MAX_LISTED_FREQUENCIES = 4  # a summary lists at most this number of contact frequencies, or only their range

_TAIL_PROBABILITY = 1e-9  # probability of the values that are ignored at each end of a distribution [1]
# Prefixes of the keys that determine the number of ticks, the speed of the drives, and the motion simulator's
# poles.
_TICK_KEYS = ("bodies.", "approach.velocity", "contact.", "rig.contact_plane", "rig.control_period")
_SPEED_KEYS = ("approach.velocity", "rig.simulator.velocity_limit")
_POLE_KEYS = ("rig.simulator.", "rig.control_period")


class MechanismSummary(NamedTuple):
    """Summary of a mechanism with its nominal numbers.

    Attributes:
        equivalent_mass: Equivalent mass of both bodies [kg].
        contacts: Scheduled contacts; contacts with equal metrics are included only once.
        control_rate: Control rate [Hz].
        simulator_bandwidth: Bandwidth of the motion simulator [Hz]; infinite for an ideal motion simulator.
        force_range: Range of the force sensor [N]; infinite if unlimited.
        duration: Approximate duration of the run [s].
        warnings: One text per implausible number, with key, found value and expected value.
    """

    equivalent_mass: float
    contacts: tuple[ContactSummary, ...]
    control_rate: float
    simulator_bandwidth: float
    force_range: float
    duration: float
    warnings: tuple[str, ...]

    def line(self, name: str) -> str:
        """Return the summary as one line of text that begins with `name`, without the warnings."""
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
    """Compute the summary of a mechanism from its nominal numbers."""
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
        warnings=tuple(find_warnings(mechanism, contacts)),
    )


def check_run(mechanism: Mechanism, label: str | None = None, drawn: bool = False) -> None:
    """Raise `InputError` if a run of the mechanism cannot be simulated.

    A contact with its approach may take at most 1e7 ticks, and a run at most 1e9. No pole of the motion
    simulator may exceed `MAX_POLE`. The drives must be able to follow the first approach.

    Args:
        mechanism: Mechanism to be checked.
        label: Name of the mechanism in messages; None for the mechanism's own name.
        drawn: Whether to check all draws of the uncertain parameters, not only the nominal run.
    """
    name = label or mechanism.name
    lanes = build_scenarios(mechanism, _extreme_draws(mechanism, _POLE_KEYS) if drawn else None)
    check_poles(name, lanes.simulator.denominator, lanes.control_period)
    check_jitter_poles(name, lanes.timing, lanes.simulator.denominator, lanes.control_period)
    _check_velocity_limit(
        name, build_scenarios(mechanism, _extreme_draws(mechanism, _SPEED_KEYS) if drawn else None)
    )
    _check_ticks(
        name, mechanism, build_scenarios(mechanism, _extreme_draws(mechanism, _TICK_KEYS) if drawn else None)
    )


def check_jitter_poles(name: str, timing: TimingBatch | None, denominator: Any, control_period: Any) -> None:
    """Raise `InputError` if a pole of the motion simulator is too fast for readings with jitter.

    See `check_poles` for the arguments; `timing` contains the timing effects of the scenarios.
    """
    if timing is not None and timing.jitter is not None:
        allowed = "at most 1 / control_period for rig.force_sensor.jitter"
        check_poles(name, denominator, control_period, MAX_SERIES_POLE, allowed)


def _check_velocity_limit(name: str, scenarios: Scenario) -> None:
    """Raise `InputError` if the approach velocity of a scenario exceeds the drives' velocity limit."""
    limits = scenarios.simulator.velocity_limit
    lane = int(np.argmax(scenarios.velocity - limits))
    if limits[lane] < scenarios.velocity[lane]:
        found = f"rig.simulator.velocity_limit: found {limits[lane]:g}"
        raise InputError(
            f"{name}: {found}, expected {format_allowed_velocity_limit(float(scenarios.velocity[lane]))}"
        )


def check_poles(
    name: str, denominator: Any, control_period: Any, limit: float = MAX_POLE, expected: str = FAST_SIMULATOR
) -> None:
    """Raise `InputError` if a pole of the motion simulator exceeds a limit.

    Args:
        name: Name of the mechanism in the message.
        denominator: Denominators of the transfer functions, descending powers of s, (order + 1, lanes).
        control_period: Control periods [s], (lanes,).
        limit: Largest magnitude of a pole [rad per control period].
        expected: Text of the message that states the limit.
    """
    for lane, period in enumerate(control_period):
        coefficients = np.asarray(denominator)[:, lane]
        with np.errstate(all="ignore"):
            monic = coefficients / coefficients[0] * period ** np.arange(len(coefficients))
        fastest = np.max(np.abs(np.roots(monic)), initial=0.0) if np.all(np.isfinite(monic)) else math.inf
        if fastest > limit:
            pole = f"a pole of {fastest / period:.3g} rad/s at a control period of {period:g} s"
            raise InputError(f"{name}: rig.simulator: found {pole}, expected {expected}")


def compute_bandwidth(simulator: MotionSimulatorBatch) -> float:
    """Return the bandwidth [Hz] of the first lane: the lowest frequency with a gain of 1/sqrt(2).

    The bandwidth is infinite for an ideal motion simulator, and NaN if it cannot be computed.
    """
    if simulator.window is not None:
        return MOVING_AVERAGE_BANDWIDTH / float(simulator.window[0])
    numerator, denominator = (np.asarray(part, float)[:, 0] for part in simulator[:2])
    order = len(denominator) - 1
    if order == 0:
        return math.inf
    with np.errstate(all="ignore"):
        # Division by the poles' geometric mean gives all coefficients similar magnitudes.
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
    """Raise `InputError` if a contact exceeds `MAX_CONTACT_TICKS` or a run exceeds `MAX_RUN_TICKS`."""
    contacts = mechanism.approach.contacts
    allowed = min(MAX_CONTACT_TICKS, MAX_RUN_TICKS / contacts)
    # If this upper bound on the duration is within the limit, the contacts need not be computed.
    longest = APPROACH_TIME + scenarios.control_period + 2 * MAX_CONTACT_DURATION + _longest_wait(scenarios)
    if np.all(longest <= allowed * scenarios.control_period):
        return
    with jax_context():
        reference = _compute_ideal_contacts(mechanism, scenarios)
        approach_time, contact_time = _estimate_durations(scenarios, reference)
    with np.errstate(all="ignore"):
        ticks = (approach_time + contact_time) / scenarios.control_period
    slot, lane = np.unravel_index(np.argmax(ticks), ticks.shape)
    if ticks[slot, lane] <= MAX_CONTACT_TICKS and np.sum(ticks, axis=0).max() <= MAX_RUN_TICKS:
        return
    found = f"rig.control_period: found {scenarios.control_period[lane]:g} s"
    if approach_time[slot, lane] > MAX_CONTACT_DURATION:
        found = f"contact.clearance: found {scenarios.clearance[lane]:g} m"
    seconds = (approach_time + contact_time)[slot, lane]
    raise InputError(
        f"{name}: {found}, expected at most {MAX_CONTACT_TICKS:.0e} ticks per contact "
        f"and {MAX_RUN_TICKS:.0e} per run: "
        f"contact {slot + 1} takes about {seconds:.3g} s, {ticks[slot, lane]:.2g} ticks"
    )


def _squared(polynomial: np.ndarray) -> np.ndarray:
    """Return |p(jw)|^2 in descending powers of w^2; `polynomial` is p(s) in descending powers of s."""
    degrees = np.arange(len(polynomial) - 1, -1, -1)
    product = np.convolve(polynomial, polynomial * (-1.0) ** degrees)[::2]
    return product * (-1.0) ** degrees


def _compute_ideal_contacts(mechanism: Mechanism, scenarios: Scenario) -> IdealContact:
    """Return the ideal contacts, (contacts, lanes), all with the velocity of the first approach."""
    shape = scenarios.phase.shape
    mass, velocity = (np.broadcast_to(x, shape) for x in (scenarios.equivalent_mass, scenarios.velocity))
    law = find_contact_law(mechanism.contact.law).simulation_law
    reference = cached_programs.run_cached(_compute_reference, law, scenarios.contact, mass, velocity)
    numbers: Any = [np.asarray(leaf)[: mechanism.approach.contacts] for leaf in reference]
    return IdealContact(*numbers)


def _compute_reference(
    law: ContactLaw, parameters: ContactParameters, mass: Any, velocity: Any
) -> IdealContact:
    """Compute the ideal contacts of a contact law, (contacts, lanes); `run_cached` compiles this function."""
    return law.ideal_contact(parameters_by_slot(parameters), mass, velocity)


def _find_distinct_contacts(mechanism: Mechanism, reference: IdealContact) -> tuple[ContactSummary, ...]:
    """Summarise the first lane's contacts in scheduled order; contacts with equal metrics appear once."""
    durations = np.nan_to_num(reference.duration[:, 0], nan=math.inf, posinf=math.inf)
    contacts: dict[tuple[float, ...], ContactSummary] = {}
    for slot, duration in enumerate(durations):
        frequency = 1 / (2 * duration)
        if find_contact_law(mechanism.contact.law).is_linear:
            entries: Any = mechanism.contact.stiffness
            stiffness = entries[min(slot, len(entries) - 1)]
            frequency = math.sqrt(stiffness / mechanism.bodies.mass) / (2 * math.pi)
        metrics = float(frequency), float(duration), float(reference.peak_force[slot, 0])
        contacts.setdefault(metrics, ContactSummary(slot + 1, *metrics))
    return tuple(contacts.values())


def _estimate_durations(scenarios: Scenario, reference: IdealContact) -> tuple[np.ndarray, np.ndarray]:
    """Return approximate durations [s] of the approach to each contact and of each contact.

    Both arrays have the shape (contacts, lanes). The duration of a contact includes the time until the
    simulation detects that the contact has ended.
    """
    contacts = len(reference.duration)
    sensor, simulator, velocity = scenarios.force_sensor, scenarios.simulator, scenarios.velocity
    wait = simulator.delay + sensor.delay + 20 * sensor.time_constant + 2 * scenarios.control_period
    duration = np.nan_to_num(reference.duration, nan=math.inf, posinf=math.inf)
    approach_time = APPROACH_TIME + scenarios.phase[:contacts] * scenarios.control_period
    with np.errstate(all="ignore"):
        approach_time = approach_time + np.clip(
            np.abs(scenarios.contact_plane) / velocity, 0, MAX_CONTACT_DURATION + _longest_wait(scenarios)
        )
        speed_ratio = np.cumprod(np.nan_to_num(reference.restitution, nan=1.0), axis=0)
        speed_ratio = np.concatenate([np.ones_like(speed_ratio[:1]), speed_ratio[:-1]])
        crossing_time = scenarios.clearance / (velocity * speed_ratio)
        crossing_time = np.nan_to_num(crossing_time, nan=math.inf, posinf=math.inf)
        flight = np.minimum(crossing_time, _longest_wait(scenarios))
    later = np.arange(contacts)[:, None] > 0
    approach_time = np.where(later & np.isfinite(scenarios.clearance), flight, approach_time)
    return approach_time, np.minimum(duration + wait, MAX_CONTACT_DURATION)


def _longest_wait(scenarios: Scenario) -> np.ndarray:
    """Return the longest time [s] that the simulation waits for a contact to begin.

    With one surface, the simulation waits for this time in addition to `MAX_CONTACT_DURATION`. With two
    surfaces, this time includes `MAX_CONTACT_DURATION`.
    """
    with np.errstate(all="ignore"):
        crossing_time = 10 * scenarios.clearance / scenarios.velocity
        nearer = 10 * np.maximum(-scenarios.contact_plane, 0.0) / scenarios.velocity
    return np.where(np.isfinite(scenarios.clearance), MAX_CONTACT_DURATION + crossing_time, nearer)


def _extreme_draws(mechanism: Mechanism, prefixes: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return draws with all combinations of the extreme values of the parameters that `prefixes` select.

    A parameter is selected if its dotted path begins with one of `prefixes`. All other parameters have the
    median of their distribution.
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


def _format_ratio(value: float, whole: float) -> str:
    """Return value / whole as text; a ratio below 0.1 has the form "1/n"."""
    ratio = value / whole
    return f"1/{1 / ratio:.0f}" if 0 < ratio < 0.1 else f"{ratio:.2g}"


def _format_frequencies(frequencies: list[float]) -> str:
    """Return frequencies as text: as a list or, if there are many, as lowest and highest."""
    texts = list(dict.fromkeys(f"{frequency:.3g}" for frequency in frequencies))
    if len(texts) > MAX_LISTED_FREQUENCIES:
        return f"{min(frequencies):.3g} to {max(frequencies):.3g}"
    return ", ".join(texts)
