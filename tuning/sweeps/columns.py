"""Columns of a sweep's store: what is kept of every scenario, with names, units and meanings.

A number per contact is a column per contact, `error_1`, `error_2`, ...; an entry of a list that is drawn
likewise, `contact.stiffness_1`. What a contact that failed or was not reached does not have is null.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from jaxhil.contact.laws import KEYS, contact_law
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism, numeric_keys_of
from jaxhil.mechanism.structs import Mechanism, value_at
from jaxhil.mechanism.uncertainty import PHASE, dimensions
from jaxhil.rig_models import rig_model
from jaxhil.simulation.contact_bounds import LONGEST, MOST_FORCE, SHORTEST, unlike_ideal
from jaxhil.simulation.metrics import DIVERGED, NON_FINITE, NOT_REACHED, OK, STATUS_NAMES, TIMEOUT
from jaxhil.simulation.outcome import Outcome

GOOD, BEYOND, UNLIKE, SATURATED = "good", "error beyond limit", "unlike the ideal contact", "saturated"
UNLIKENESS = (
    f"a real peak force beyond {MOST_FORCE:g} times, or a duration beyond {SHORTEST:g} to {LONGEST:g} times "
    "that of the ideal contact"
)
SATURATION = "a force beyond the sensor's range, or a limit of the motion simulator that bound"
STATUSES = tuple(STATUS_NAMES.values())
# From harmless to worst; the status of a run that failed is a cause by itself.
OUTCOMES = (
    GOOD,
    BEYOND,
    UNLIKE,
    SATURATED,
    *(STATUS_NAMES[s] for s in (NOT_REACHED, TIMEOUT, DIVERGED, NON_FINITE)),
)

Kind = Literal["integer", "input", "number", "flag", "text"]


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A column of the store."""

    name: str
    kind: Kind  # inputs are in float64, numbers in the sweep's precision
    unit: str  # SI; "" for none, "1" for a ratio
    meaning: str


class PerContact(NamedTuple):
    """A number that every contact has."""

    name: str  # of its column, without the contact's number
    unit: str  # as a column's
    meaning: str


PER_CONTACT = (
    PerContact("restitution", "1", "rebound speed over approach speed"),
    PerContact("reference_restitution", "1", "that of the same contact in space"),
    PerContact("error", "1", "restitution less the reference's"),
    PerContact("peak_force", "N", "largest real contact force"),
    PerContact("reference_peak_force", "N", "that of the ideal contact"),
    PerContact("peak_command", "N", "largest force on the numerical model"),
    PerContact("peak_ratio", "1", "peak command over the reference's peak force"),
    PerContact("position_shortfall", "m", "most that the motion simulator's limits took off its command"),
    PerContact("duration", "s", "time in touch"),
    PerContact("reference_duration", "s", "that of the ideal contact; infinite if it never ends"),
    PerContact("approach_velocity", "m/s", "speed at which the contact was entered"),
    PerContact("energy_in", "J", "kinetic energy of the numerical model before the contact"),
    PerContact("energy_out", "J", "kinetic energy of the numerical model after the contact"),
)
# What episodes of six axes have of these, and in the place of the error both of theirs.
PER_EPISODE = ("restitution", "reference_restitution", "peak_force", "reference_peak_force", "peak_ratio")
PER_EPISODE = (*PER_EPISODE, "duration", "reference_duration", "approach_velocity")
ERRORS_IN_SPACE = {
    "energy_error": "kinetic energy gained beyond that in space, over that of the approach",
    "twist_error": "deviation of the twist from that in space, over the change there",
}
WORKS = (
    PerContact("work_in", "J", "work done on the mechanism by the real contact force"),
    PerContact("work_out", "J", "work returned by the mechanism"),
)
# Of what did not end, as the run's state is then, these are still known.
KNOWN_UNENDED = (
    "peak_force",
    "peak_command",
    "position_shortfall",
    "duration",
    "approach_velocity",
    "energy_in",
)

_UNITS = {
    **dict.fromkeys(("equivalent_mass", "chaser_mass", "target_mass"), "kg"),
    **dict.fromkeys(("velocity", "velocity_limit"), "m/s"),
    "acceleration_limit": "m/s^2",
    "natural_frequency": "Hz",
    **dict.fromkeys(("control_period", "delay", "time_constant"), "s"),
    **dict.fromkeys(("dead_zone", "bias", "range"), "N"),
    **dict.fromkeys(("clearance", "contact_plane"), "m"),
    **dict.fromkeys(("phase", "damping_ratio"), "1"),
}


class Slot(NamedTuple):
    """Where a row says how one contact went, or one error of an episode."""

    number: int  # of the contact or the episode, from 1
    error: str  # column of its error
    status: str  # and of its status


def slots(mechanism: AnyMechanism) -> list[Slot]:
    """Return a slot for every row of an outcome: every contact, or every error of every episode."""
    model = rig_model(mechanism)
    return error_slots(model.errors, model.runs(mechanism))


def error_slots(errors: Iterable[str], runs: int) -> list[Slot]:
    """Return the slots of every error of so many contacts or episodes."""
    numbers = range(1, runs + 1)
    return [Slot(number, f"{error}_{number}", f"status_{number}") for error in errors for number in numbers]


def sweep_columns(mechanism: AnyMechanism, works: bool) -> list[Column]:
    """The columns of a sweep over `mechanism`, in their order."""
    columns = [Column("index", "integer", "", "number of the scenario")]
    columns += [
        Column(name, "input", unit_of(mechanism, path), f"{path}, drawn")
        for path in dimensions(mechanism)
        for name in input_names(mechanism, path)
    ]
    what = rig_model(mechanism).run_name
    for number in sorted({slot.number for slot in slots(mechanism)}):
        columns += [
            Column(f"{one.name}_{number}", "number", one.unit, f"{what} {number}: {one.meaning}")
            for one in _kept(mechanism, works)
        ]
        columns.append(Column(f"status_{number}", "text", "", f"{what} {number}: how it ended"))
    return [
        *columns,
        Column("worst_error", "number", "1", f"the error of largest magnitude of all {what}s that ended"),
        Column(
            "outcome",
            "text",
            "",
            f"good, or why the scenario counts as failed; {UNLIKE}: {UNLIKENESS}; {SATURATED}: {SATURATION}",
        ),
        Column("failed", "flag", "", "whether the scenario counts as failed"),
    ]


def texts_of(column: str) -> tuple[str, ...]:
    """What a column of texts may hold; rows hold the text's place in it."""
    return OUTCOMES if column == "outcome" else STATUSES


def _kept(mechanism: AnyMechanism, works: bool) -> list[PerContact]:
    """The numbers that every contact has."""
    if rig_model(mechanism).axes == 1:
        return [*PER_CONTACT, *(WORKS if works else ())]
    errors = [PerContact(name, "1", meaning) for name, meaning in ERRORS_IN_SPACE.items()]
    return [*errors, *(one for one in PER_CONTACT if one.name in PER_EPISODE)]


def unit_of(mechanism: AnyMechanism, path: str) -> str:
    """SI unit of the mechanism file's key."""
    table, _, key = path.rpartition(".")
    name = table.removeprefix("contact.")
    if not isinstance(mechanism, SixAxisMechanism):
        contact = mechanism.contact if table == "contact" else None
    else:
        contact = mechanism.contact.get(name) if name != table else None
    if contact is not None and key in ("stiffness", "damping"):
        law = contact_law(contact.law)
        return law.stiffness_unit if key == "stiffness" else law.damping_unit
    if contact is not None and key in KEYS:
        return KEYS[key].unit or ""
    if isinstance(mechanism, SixAxisMechanism):
        return numeric_keys_of(mechanism)[path].unit
    if key in ("noise_std", "quantum"):
        return "N" if "force" in path else "m"
    return _UNITS.get(key, "")


def input_names(mechanism: AnyMechanism, path: str) -> list[str]:
    """Names of the columns of a key that is drawn: the path itself, or one per entry, counted from 1."""
    if path == PHASE and isinstance(mechanism, Mechanism):
        shape: tuple[int, ...] = (mechanism.approach.contacts,)
    else:
        shape = np.shape(value_at(mechanism, path))
    return [path + "".join(f"_{place + 1}" for place in index) for index in np.ndindex(*shape)]


def read_of(mechanism: AnyMechanism, works: bool, outcome: Outcome) -> Any:
    """What `rows_of` reads of an outcome; None in the place of all else."""
    names = {"status", "restitution", "approach_velocity", *(one.name for one in _kept(mechanism, works))}
    metrics = outcome.metrics
    other: Any = dict.fromkeys(set(metrics._fields) - names)
    unread: Any = dict.fromkeys(("chatter", "wanted", "good", "unlike"))
    return outcome._replace(metrics=metrics._replace(**other), **unread)


def rows_of(
    mechanism: AnyMechanism,
    first: int,
    draws: Mapping[str, np.ndarray],
    scenarios: Any,
    outcome: Outcome,
    limit: float,
    works: bool,
) -> dict[str, np.ndarray]:
    """One array (number,) per column; NaN where there is nothing to say, texts as their places."""
    metrics, made = outcome.metrics, slots(mechanism)
    number = metrics.status.shape[-1]
    rows = {"index": np.arange(first, first + number)}
    for path, values in draws.items():
        entries = np.reshape(values, (number, -1)).T
        rows.update(zip(input_names(mechanism, path), entries, strict=True))
    status = np.asarray(metrics.status[: len(made)])
    ended, reached = status == OK, status != NOT_REACHED
    values = {
        **{name: getattr(metrics, name) for name in metrics._fields},
        "reference_restitution": outcome.reference_restitution,
        "reference_peak_force": outcome.reference_peak_force,
        "reference_duration": outcome.reference_duration,
        "peak_ratio": outcome.peak_ratio,
        **_energies(scenarios, metrics),
    }
    names = [one.name for one in _kept(mechanism, works)]
    codes = np.searchsorted(sorted(STATUS_NAMES), status).astype(np.int8)
    for place, slot in enumerate(made):
        for name in set(names) & set(values):
            known = reached[place] if name in KNOWN_UNENDED else ended[place]
            rows[f"{name}_{slot.number}"] = np.where(known, values[name][place], np.nan)
        rows[slot.error] = np.where(ended[place], outcome.error[place], np.nan)
        rows[slot.status] = codes[place]
    period = np.asarray(scenarios.control_period)
    found = {**rows, **judge(rows, made, force_range(scenarios), period, limit)}
    names = [column.name for column in sweep_columns(mechanism, works)]
    return {name: found[name] for name in names if name in found}


def force_range(scenarios: Any) -> np.ndarray:
    """Largest force [N] that the sensor reads, (number,); of three channels the least."""
    if hasattr(scenarios, "sensor"):
        return np.min(np.asarray(scenarios.sensor.errors.range)[:3], axis=0)
    return np.asarray(scenarios.force_sensor.range)


def _energies(scenarios: Any, metrics: Any) -> dict[str, np.ndarray]:
    """Kinetic energy [J] before and after a contact on one axis."""
    if not hasattr(scenarios, "equivalent_mass"):
        return {}
    rebound = metrics.restitution * metrics.approach_velocity
    half_mass = (scenarios.equivalent_mass / 2).astype(rebound.dtype)
    return {"energy_in": half_mass * metrics.approach_velocity**2, "energy_out": half_mass * rebound**2}


def judge(
    rows: Mapping[str, np.ndarray],
    made: Sequence[Slot],
    force_range: np.ndarray,
    period: np.ndarray,
    limit: float,
) -> dict[str, np.ndarray]:
    """Return `worst_error`, `outcome` and `failed`, which follow from the columns of every contact.

    Args:
        rows: columns by name. Those of a store that an earlier version wrote have no ideal contact's peak
            force and duration: its outcomes say nothing of them.
        made: contacts or episodes.
        force_range: of the force sensor [N], of every row or of all.
        period: control period [s], likewise.
        limit: of the error [1].
    """

    def each(names: Iterable[str]) -> np.ndarray:
        return np.stack([rows[name] for name in names])

    status = np.array(sorted(STATUS_NAMES))[each(slot.status for slot in made)]
    error = each(slot.error for slot in made)
    peak = each(f"peak_force_{slot.number}" for slot in made)
    size = np.where(status == OK, np.abs(error), -1)
    worst = np.take_along_axis(error, np.argmax(size, axis=0)[None], axis=0)[0]
    # What was not reached has no peak and no shortfall: they are beyond nothing.
    beyond_range = peak > force_range.astype(peak.dtype)
    saturated = np.any(beyond_range, axis=0)
    for name in {f"position_shortfall_{slot.number}" for slot in made} & set(rows):
        saturated = saturated | (rows[name] > 0)
    unlike = _unlike(rows, {slot.number for slot in made}, period)
    outcome = _outcomes(status, ~(np.abs(worst) <= limit), unlike, saturated)
    return {"worst_error": worst, "outcome": outcome, "failed": outcome != OUTCOMES.index(GOOD)}


def _unlike(rows: Mapping[str, np.ndarray], numbers: Iterable[int], period: np.ndarray) -> np.ndarray:
    """Return which rows have a real contact that is too hard, too short or too long."""
    found = np.zeros(len(rows["index"]), bool)
    for number in numbers:
        ideal = [rows.get(f"reference_{name}_{number}") for name in ("peak_force", "duration")]
        if ideal[0] is not None and ideal[1] is not None:
            force, duration = rows[f"peak_force_{number}"], rows[f"duration_{number}"]
            found |= unlike_ideal(force, ideal[0], duration, ideal[1], period.astype(duration.dtype))
    return found


def _outcomes(
    status: np.ndarray, beyond: np.ndarray, unlike: np.ndarray, saturated: np.ndarray
) -> np.ndarray:
    """Return the worst that can be said of every scenario, as its place in `OUTCOMES`."""
    found = np.where(beyond, OUTCOMES.index(BEYOND), OUTCOMES.index(GOOD))
    found = np.where(unlike, OUTCOMES.index(UNLIKE), found)
    found = np.where(saturated, OUTCOMES.index(SATURATED), found)
    for code, name in STATUS_NAMES.items():
        if code != OK:
            found = np.where(np.any(status == code, axis=0), np.maximum(found, OUTCOMES.index(name)), found)
    return found.astype(np.int8)
