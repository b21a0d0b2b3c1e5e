"""Simulation of a mechanism's contacts on the rig: function `simulate`, and the results of a run."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, format_value
from jaxhil.files import report_write_errors, resolve_output_path, to_path, write_csv
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Compensator
from jaxhil.mechanism.loading import as_mechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.contact_bounds import (
    MAX_DURATION_RATIO,
    MAX_PEAK_FORCE_RATIO,
    MIN_DURATION_RATIO,
    is_duration_out_of_bounds,
    is_peak_force_excessive,
)
from jaxhil.simulation.gain_choice import choose_gains
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import CONTACT_STATUS_NAMES, CONTACT_STATUS_REASONS, NOT_REACHED, OK
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.plausibility import MechanismSummary, check_run, summarise_mechanism
from jaxhil.simulation.recording import record_lanes
from jaxhil.simulation.scenario import build_scenarios

PLOT_SUFFIXES = (".png", ".pdf", ".svg")


class ContactResult(NamedTuple):
    """Results of one contact on the rig and of the ideal contact; NaN if a result does not exist.

    The ideal contact is the contact without any delay at the same approach velocity.

    Attributes:
        restitution: Restitution e [1]: rebound speed divided by approach speed of the numerical model.
        reference_restitution: Restitution e* of the ideal contact [1].
        error: Restitution error e - e* [1], positive if the rebound is too fast.
        peak_force: Largest real contact force [N].
        reference_peak_force: Peak force of the ideal contact [N].
        peak_force_ratio: Peak force divided by the ideal contact's peak force [1].
        peak_command: Largest magnitude of the force command, which acts on the numerical model [N].
        position_shortfall: Largest amount by which the simulator's limits change the position command [m].
        duration: Time during which a real contact force acts [s].
        reference_duration: Duration of the ideal contact [s].
        duration_ratio: Duration divided by the ideal contact's duration [1].
        approach_velocity: Velocity of the numerical model at the tick before the contact [m/s].
        force_delay: Delay of the force measurement as estimated by the compensator [s]; None if the
            compensator estimates no delay.
        status: "ok", or why there is no restitution: "timeout" (not ended after 10 s), "diverged",
            "non-finite", or "not reached" (the run ended before this contact, or no force was measured).
    """

    restitution: float
    reference_restitution: float
    error: float
    peak_force: float
    reference_peak_force: float
    peak_force_ratio: float
    peak_command: float
    position_shortfall: float
    duration: float
    reference_duration: float
    duration_ratio: float
    approach_velocity: float
    force_delay: float | None
    status: str


class Ticks(NamedTuple):
    """Signals at all ticks of a run, from the first approach to the end of the last contact.

    Attributes:
        time: Time since the first tick [s], (ticks,); one control period per tick.
        force_measured: Reading of the force sensor [N], (ticks,).
        force_command: Force command F_c of the compensator, which acts on the numerical model [N], (ticks,).
        position_desired: Position of the numerical model [m], (ticks,).
        velocity_desired: Velocity of the numerical model [m/s], (ticks,).
        position_measured: Reading of the position sensor [m], (ticks,).
        contact: Index of the current contact or, in free flight, of the next contact, from 0, (ticks,).
    """

    time: np.ndarray
    force_measured: np.ndarray
    force_command: np.ndarray
    position_desired: np.ndarray
    velocity_desired: np.ndarray
    position_measured: np.ndarray
    contact: np.ndarray


@dataclass(frozen=True, eq=False)
class Run:
    """Simulated run of a mechanism's contacts with a compensator.

    The signals at all ticks (see `Ticks`) are also attributes of the run, such as `run.force_measured`. All
    signals are computed when one of them is first used.

    Attributes:
        mechanism: Simulated mechanism.
        compensator: Name of the compensator.
        gains: Gains of the compensator by name [SI units].
        seed: Seed of the sensors' noise.
        contacts: Results of every scheduled contact.
        status: "ok" if every contact has the status "ok"; else the first status that is not "ok".
    """

    mechanism: Mechanism = field(repr=False)
    compensator: str
    gains: dict[str, float]
    seed: int
    contacts: tuple[ContactResult, ...]
    status: str

    @cached_property
    def summary(self) -> MechanismSummary:
        """Return the mechanism's summary: mass, ideal contacts, control rate, and implausible numbers."""
        return summarise_mechanism(self.mechanism)

    def reasons(self, limit: float = 0.01) -> list[str]:
        """Return why the run is bad, one text per reason; an empty list if the run is good.

        A run is good if all contacts have ended, if no restitution error exceeds the limit, and if peak force
        and duration of every real contact are within the bounds of `jaxhil.simulation.contact_bounds`.

        Args:
            limit: Largest allowed magnitude of a restitution error [1].
        """
        if self.status != CONTACT_STATUS_NAMES[OK]:
            return [f"the run ended with status '{self.status}': {CONTACT_STATUS_REASONS[self.status]}"]
        return [*_error_reasons(self.contacts, limit), *_bound_reasons(self.contacts, self.mechanism)]

    @cached_property
    def ticks(self) -> Ticks:
        """Return the signals at all ticks until the last contact ends, or until a number is not finite."""
        with jax_context():
            scenarios = build_scenarios(self.mechanism, seed=self.seed)
            loaded = LoadedGains({}, self.compensator, self.gains, self.mechanism)
            _, [lane] = record_lanes(loaded, scenarios)
        signals = lane.signals
        return Ticks(
            time=np.arange(len(signals.age)) * self.mechanism.rig.control_period,
            force_measured=np.asarray(signals.force_measured, float),
            force_command=np.asarray(lane.command, float),
            position_desired=np.asarray(signals.position_desired, float),
            velocity_desired=np.asarray(signals.velocity_desired, float),
            position_measured=np.asarray(signals.position_measured, float),
            contact=np.asarray(lane.contact, np.int64),
        )

    @property
    def time(self) -> np.ndarray:
        """Return the time of every tick [s]."""
        return self.ticks.time

    @property
    def force_measured(self) -> np.ndarray:
        """Return the reading of the force sensor at every tick [N]."""
        return self.ticks.force_measured

    @property
    def force_command(self) -> np.ndarray:
        """Return the compensator's force command at every tick [N]."""
        return self.ticks.force_command

    @property
    def position_desired(self) -> np.ndarray:
        """Return the position of the numerical model at every tick [m]."""
        return self.ticks.position_desired

    @property
    def velocity_desired(self) -> np.ndarray:
        """Return the velocity of the numerical model at every tick [m/s]."""
        return self.ticks.velocity_desired

    @property
    def position_measured(self) -> np.ndarray:
        """Return the reading of the position sensor at every tick [m]."""
        return self.ticks.position_measured

    @property
    def contact(self) -> np.ndarray:
        """Return the index, from 0, of the current or next contact at every tick."""
        return self.ticks.contact

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the signals to a CSV file: one line of names, then one line per tick, in SI units.

        Numbers have all digits, so that reading them back gives exactly equal values. Raise `InputError` if
        the file cannot be written.
        """
        write_csv(path, {name: column.tolist() for name, column in self.ticks._asdict().items()})

    def plot(self, path: str | os.PathLike[str]) -> None:
        """Plot force and position against time for each contact, together with the ideal contact.

        The suffix of the file, .png, .pdf or .svg, selects the format. Parent folders are created. Raise
        `InputError` if the file has a different suffix or cannot be written.
        """
        target = to_path(path)
        if target.suffix.lower() not in PLOT_SUFFIXES:
            allowed = f"a name that ends in {', '.join(PLOT_SUFFIXES)}"
            raise InputError(f"plot: found {format_value(str(target))}, expected {allowed}")
        from jaxhil.simulation.contact_plot import plot_contacts, save_figure
        from jaxhil.simulation.motion_curves import compute_nominal_motion

        with jax_context():
            motion = compute_nominal_motion(
                self.mechanism, {"rig": (self.compensator, self.gains)}, self.seed
            )
        title = f"{self.mechanism.name}, compensation: {self.compensator}"
        with report_write_errors(target):
            save_figure(plot_contacts(motion, title, sensors="rig"), resolve_output_path(target))


def simulate(
    mechanism: Mechanism | str | os.PathLike[str],
    compensator: str = "none",
    gains: Mapping[str, float] | str | os.PathLike[str] | None = None,
    *,
    seed: int = 0,
) -> Run:
    """Simulate the nominal contacts of a mechanism with one axis.

    See `jaxhil.simulate` for the arguments; that function accepts mechanisms with six axes too. Raise
    `InputError` if an argument is invalid.
    """
    checked = as_mechanism(mechanism)
    number = check_seed(seed)
    name, values = choose_gains(checked, compensator, gains)
    check_run(checked)
    with jax_context():
        scenarios = build_scenarios(checked, seed=number)
        outcome = evaluate(build_loop(checked, name, scenarios, exact=True), values, scenarios)
    law = COMPENSATORS[name]
    contacts = tuple(_build_contact_result(outcome, slot, law) for slot in range(checked.approach.contacts))
    status = next(
        (contact.status for contact in contacts if contact.status != CONTACT_STATUS_NAMES[OK]), "ok"
    )
    return Run(checked, name, values, number, contacts, status)


def check_seed(seed: Any) -> int:
    """Return the seed as an `int`; raise `InputError` unless it is an integer >= 0."""
    number = seed.item() if isinstance(seed, np.integer) else seed
    if isinstance(number, bool) or not isinstance(number, int) or number < 0:
        raise InputError(f"seed: found {format_value(seed)}, expected an integer >= 0")
    return number


def _error_reasons(contacts: Sequence[ContactResult], limit: float) -> Iterator[str]:
    worst = max((contact.error for contact in contacts), key=abs)
    if not abs(worst) <= limit:
        kind = "divergence" if worst > 0 else "convergence"
        yield f"the largest error is {worst:+.4f} ({kind}), limit {limit:g}"


def _bound_reasons(contacts: Sequence[ContactResult], mechanism: Mechanism) -> Iterator[str]:
    """Yield a text for each real contact that is too hard, too short or too long."""
    for number, contact in enumerate(contacts, start=1):
        force, ideal_force = contact.peak_force, contact.reference_peak_force
        if is_peak_force_excessive(force, ideal_force):
            yield (
                f"contact {number}: real peak force {force:.4g} N, expected at most "
                f"{MAX_PEAK_FORCE_RATIO * ideal_force:.4g} N, {MAX_PEAK_FORCE_RATIO:g} times "
                "the ideal contact's"
            )
        duration, ideal_duration = contact.duration, contact.reference_duration
        if is_duration_out_of_bounds(duration, ideal_duration, mechanism.rig.control_period):
            yield (
                f"contact {number}: real contact of {1e3 * duration:.4g} ms, expected "
                f"{1e3 * MIN_DURATION_RATIO * ideal_duration:.4g} to "
                f"{1e3 * MAX_DURATION_RATIO * ideal_duration:.4g} ms, "
                f"{MIN_DURATION_RATIO:g} to {MAX_DURATION_RATIO:g} times the ideal contact's"
            )


def _build_contact_result(outcome: Outcome, slot: int, law: Compensator) -> ContactResult:
    """Return the results of the contact with index `slot`, from a batch with one scenario."""
    metrics = outcome.metrics
    status = int(metrics.status[slot, 0])
    ended = status == OK

    def value(array: Any, is_valid: bool) -> float:
        return float(array[slot, 0]) if is_valid else float("nan")

    reached = status != NOT_REACHED
    return ContactResult(
        restitution=value(metrics.restitution, ended),
        reference_restitution=value(outcome.reference_restitution, ended),
        error=value(outcome.error, ended),
        peak_force=value(metrics.peak_force, reached),
        reference_peak_force=value(outcome.reference_peak_force, ended),
        peak_force_ratio=value(outcome.peak_force_ratio, ended),
        peak_command=value(metrics.peak_command, reached),
        position_shortfall=value(metrics.position_shortfall, reached),
        duration=value(metrics.duration, reached),
        reference_duration=value(outcome.reference_duration, ended),
        duration_ratio=value(outcome.duration_ratio, ended),
        approach_velocity=value(metrics.approach_velocity, reached),
        force_delay=value(metrics.force_delay, reached) if law.estimates_delay else None,
        status=CONTACT_STATUS_NAMES[status],
    )
