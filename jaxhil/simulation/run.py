"""One run of a mechanism's contacts: what became of each contact, and every tick of the way there."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, shown
from jaxhil.files import as_path, follow, write_csv, writing
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Compensator
from jaxhil.mechanism.loading import as_mechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.contact_bounds import LONGEST, MOST_FORCE, SHORTEST, duration_off, too_hard
from jaxhil.simulation.environment import computing
from jaxhil.simulation.gain_choice import choose_gains
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.metrics import NOT_REACHED, OK, STATUS_NAMES, STATUS_REASONS
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.plausibility import Meaning, check_run, meaning
from jaxhil.simulation.recording import record_lanes
from jaxhil.simulation.scenario import build_scenarios

PICTURES = (".png", ".pdf", ".svg")


class ContactResult(NamedTuple):
    """What became of one contact; NaN for what it does not have."""

    restitution: float  # e, rebound speed over approach speed of the numerical model [1]
    reference_restitution: float  # e*, that of the same contact in space, entered at the same speed [1]
    error: float  # e - e* [1]; above 0 the contact diverges
    peak_force: float  # of the real contact force [N]
    reference_peak_force: float  # of the ideal contact [N]
    peak_force_ratio: float  # peak force over the ideal contact's [1]
    peak_command: float  # of |F_c|, the force on the numerical model [N]
    position_shortfall: float  # by which the motion simulator's limits cut the position command [m]
    duration: float  # time with a real contact force [s]
    reference_duration: float  # of the ideal contact [s]
    duration_ratio: float  # duration over the ideal contact's [1]
    approach_velocity: float  # of the numerical model, on the tick before the contact [m/s]
    force_delay: float | None  # of the measurement, as the compensator estimates it [s]; None if it does not
    # "ok", or why it has no restitution: "timeout" (not over within 10 s), "diverged", "non-finite", "not
    # reached" (the run ended before it, or no force of it was measured)
    status: str


class Ticks(NamedTuple):
    """Every tick of a run, all contacts one after the other; arrays of shape (ticks,)."""

    time: np.ndarray  # [s], from 0 on, a control period a tick
    force_measured: np.ndarray  # what the force sensor reads [N]
    force_command: np.ndarray  # F_c, what the compensator makes of it: the force on the numerical model [N]
    position_desired: np.ndarray  # of the numerical model [m]
    velocity_desired: np.ndarray  # of the numerical model [m/s]
    position_measured: np.ndarray  # what the position sensor reads of the motion simulator [m]
    contact: np.ndarray  # index of the contact under way or ahead, from 0


@dataclass(frozen=True, eq=False)
class Run:
    """The contacts of a mechanism under a compensator, run once.

    The ticks (`time`, `force_measured`, ...: see `Ticks`) are recorded when first asked for.
    """

    mechanism: Mechanism = field(repr=False)
    compensator: str  # its name
    gains: dict[str, float]  # by name, in SI units
    seed: int  # of the sensors' noise
    contacts: tuple[ContactResult, ...]  # one for every contact of the schedule
    status: str  # "ok", or the status of the first contact that is not

    @cached_property
    def meaning(self) -> Meaning:
        """What the mechanism means: mass, contacts in space, rates; `warnings` of what cannot be meant."""
        return meaning(self.mechanism)

    def reasons(self, limit: float = 0.01) -> list[str]:
        """Return why the run is bad, in words; an empty list if it is good.

        A run is good if every contact ended, no restitution error is beyond `limit` [1], and every real
        contact's peak force and duration are within `contact_bounds` of the ideal contact's.
        """
        if self.status != STATUS_NAMES[OK]:
            return [f"the run ended with status '{self.status}': {STATUS_REASONS[self.status]}"]
        return [*_error_reasons(self.contacts, limit), *_unlike(self.contacts, self.mechanism)]

    @cached_property
    def ticks(self) -> Ticks:
        """Every tick up to the end of the last contact, or to the first number that is not finite."""
        with computing():
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
        """Time of every tick [s]."""
        return self.ticks.time

    @property
    def force_measured(self) -> np.ndarray:
        """What the force sensor reads at every tick [N]."""
        return self.ticks.force_measured

    @property
    def force_command(self) -> np.ndarray:
        """The force on the numerical model at every tick [N]."""
        return self.ticks.force_command

    @property
    def position_desired(self) -> np.ndarray:
        """Position of the numerical model at every tick [m]."""
        return self.ticks.position_desired

    @property
    def velocity_desired(self) -> np.ndarray:
        """Velocity of the numerical model at every tick [m/s]."""
        return self.ticks.velocity_desired

    @property
    def position_measured(self) -> np.ndarray:
        """What the position sensor reads at every tick [m]."""
        return self.ticks.position_measured

    @property
    def contact(self) -> np.ndarray:
        """Index of the contact at every tick."""
        return self.ticks.contact

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the ticks, a line each, under a line of their names; numbers in SI units, to the last bit.

        Raises `InputError` when the file cannot be written.
        """
        write_csv(path, {name: column.tolist() for name, column in self.ticks._asdict().items()})

    def plot(self, path: str | os.PathLike[str]) -> None:
        """Draw force and position over time, contact by contact, beside the same contacts in space.

        The name ends in .png, .pdf or .svg; folders on the way are made. Raises `InputError` when the file
        cannot be written.
        """
        target = as_path(path)
        if target.suffix.lower() not in PICTURES:
            allowed = f"a name that ends in {', '.join(PICTURES)}"
            raise InputError(f"plot: found {shown(str(target))}, allowed {allowed}")
        from jaxhil.simulation.contact_plot import contact_plot, save
        from jaxhil.simulation.motion import nominal_motion

        with computing():
            motion = nominal_motion(self.mechanism, {"rig": (self.compensator, self.gains)}, self.seed)
        title = f"{self.mechanism.name}, compensation: {self.compensator}"
        with writing(target):
            save(contact_plot(motion, title, sensors="rig"), follow(target))


def simulate(
    mechanism: Mechanism | str | os.PathLike[str],
    compensator: str = "none",
    gains: Mapping[str, float] | str | os.PathLike[str] | None = None,
    *,
    seed: int = 0,
) -> Run:
    """Run the contacts of a mechanism once, as it is nominally.

    `mechanism` is a `Mechanism`, the name of a built-in one, or a path. `compensator` is a law's name.
    `gains` is None (what the literature's rules say), a dict of some of them (the others are the
    literature's), the name of one of the law's settings, or the path of a gain file; with a file, "none"
    stands for its law. `seed` is that of the sensors' noise.

    Raises `InputError`, one line, for whatever is wrong with them.
    """
    checked = as_mechanism(mechanism)
    number = check_seed(seed)
    name, values = choose_gains(checked, compensator, gains)
    check_run(checked)
    with computing():
        scenarios = build_scenarios(checked, seed=number)
        outcome = evaluate(build_loop(checked, name, scenarios, exact=True), values, scenarios)
    law = COMPENSATORS[name]
    contacts = tuple(_contact(outcome, slot, law) for slot in range(checked.approach.contacts))
    status = next((contact.status for contact in contacts if contact.status != STATUS_NAMES[OK]), "ok")
    return Run(checked, name, values, number, contacts, status)


def check_seed(seed: Any) -> int:
    """The seed, an integer >= 0. Raises `InputError`."""
    number = seed.item() if isinstance(seed, np.integer) else seed
    if isinstance(number, bool) or not isinstance(number, int) or number < 0:
        raise InputError(f"seed: found {shown(seed)}, allowed an integer >= 0")
    return number


def _error_reasons(contacts: Sequence[ContactResult], limit: float) -> Iterator[str]:
    """Name the largest restitution error, if it is beyond the limit."""
    worst = max((contact.error for contact in contacts), key=abs)
    if not abs(worst) <= limit:
        kind = "divergence" if worst > 0 else "convergence"
        yield f"the largest error is {worst:+.4f} ({kind}), allowed {limit:g}"


def _unlike(contacts: Sequence[ContactResult], mechanism: Mechanism) -> Iterator[str]:
    """Name the real contacts that are too hard, too short or too long."""
    for number, one in enumerate(contacts, start=1):
        if too_hard(one.peak_force, one.reference_peak_force):
            yield (
                f"contact {number}: real peak force {one.peak_force:.4g} N, {one.peak_force_ratio:.3g} times "
                f"the ideal contact's {one.reference_peak_force:.4g} N, allowed {MOST_FORCE:g} times"
            )
        if duration_off(one.duration, one.reference_duration, mechanism.rig.control_period):
            yield (
                f"contact {number}: real contact of {1e3 * one.duration:.4g} ms, {one.duration_ratio:.3g} "
                f"times the ideal contact's {1e3 * one.reference_duration:.4g} ms, allowed {SHORTEST:g} to "
                f"{LONGEST:g} times"
            )


def _contact(outcome: Outcome, slot: int, law: Compensator) -> ContactResult:
    metrics = outcome.metrics
    status = int(metrics.status[slot, 0])
    ended = status == OK

    def value(array: Any, known: bool) -> float:
        return float(array[slot, 0]) if known else float("nan")

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
        status=STATUS_NAMES[status],
    )
