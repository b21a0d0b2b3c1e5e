"""Columns of a sweep's store, with names, units and descriptions.

A metric has one column per contact (`error_1`, `error_2`, ...) or, for six axes, per episode: a contact with
all its touches. A drawn list has one column per entry (`contact.stiffness_1`). A metric that a failed or
unreached contact does not have is null.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.six_axes import numeric_keys_of
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import PHASE_KEY, count_dimensions
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation.contact_bounds import (
    MAX_DURATION_RATIO,
    MAX_PEAK_FORCE_RATIO,
    MIN_DURATION_RATIO,
    is_contact_out_of_bounds,
)
from jaxhil.simulation.metrics import CONTACT_STATUS_NAMES, DIVERGED, NON_FINITE, NOT_REACHED, OK, TIMEOUT
from jaxhil.simulation.outcome import Outcome

GOOD, BEYOND_LIMIT, UNLIKE_IDEAL, SATURATED = (
    "good",
    "error beyond limit",
    "unlike the ideal contact",
    "saturated",
)
UNLIKE_IDEAL_MEANING = (
    f"a real peak force above {MAX_PEAK_FORCE_RATIO:g} times, or a duration outside "
    f"{MIN_DURATION_RATIO:g} to {MAX_DURATION_RATIO:g} times "
    "that of the ideal contact"
)
SATURATED_MEANING = "a force beyond the sensor's range, or an active limit of the motion simulator"
CONTACT_STATUSES = tuple(CONTACT_STATUS_NAMES.values())
# In ascending order of severity; every status of a failed run is also an outcome.
SCENARIO_OUTCOMES = (
    GOOD,
    BEYOND_LIMIT,
    UNLIKE_IDEAL,
    SATURATED,
    *(CONTACT_STATUS_NAMES[s] for s in (NOT_REACHED, TIMEOUT, DIVERGED, NON_FINITE)),
)

ColumnKind = Literal["integer", "input", "number", "flag", "text"]


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Description of one column of a sweep's store."""

    name: str
    kind: ColumnKind  # type of the values; "input" is float64, "number" has the sweep's precision
    unit: str  # SI unit; "" if there is none, "1" for a ratio
    meaning: str  # description in words


class ContactMetric(NamedTuple):
    """Description of a metric that is stored for every contact."""

    name: str  # name of the column, without the contact's number
    unit: str  # SI unit; "1" for a ratio
    meaning: str  # description in words


CONTACT_METRICS = (
    ContactMetric("restitution", "1", "rebound speed divided by approach speed"),
    ContactMetric("reference_restitution", "1", "restitution of the ideal contact"),
    ContactMetric("error", "1", "restitution minus that of the ideal contact"),
    ContactMetric("peak_force", "N", "largest real contact force"),
    ContactMetric("reference_peak_force", "N", "largest force of the ideal contact"),
    ContactMetric("peak_command", "N", "largest force on the numerical model"),
    ContactMetric("peak_ratio", "1", "peak command divided by the ideal contact's peak force"),
    ContactMetric("position_shortfall", "m", "largest part of a command that the limits cut off"),
    ContactMetric("duration", "s", "duration of the contact"),
    ContactMetric("reference_duration", "s", "duration of the ideal contact; infinite if it never ends"),
    ContactMetric("approach_velocity", "m/s", "speed at the onset of the contact"),
    ContactMetric("energy_in", "J", "kinetic energy of the numerical model before the contact"),
    ContactMetric("energy_out", "J", "kinetic energy of the numerical model after the contact"),
)
# Metrics that are also stored for six-axis episodes, where `SIX_AXIS_ERRORS` replace the restitution error.
EPISODE_METRICS = ("restitution", "reference_restitution", "peak_force", "reference_peak_force", "peak_ratio")
EPISODE_METRICS = (*EPISODE_METRICS, "duration", "reference_duration", "approach_velocity")
SIX_AXIS_ERRORS = {
    "energy_error": "gain of kinetic energy minus the ideal contact's, divided by the energy of approach",
    "twist_error": "deviation of the twist from the ideal contact's, divided by the ideal change of twist",
}
WORK_METRICS = (
    ContactMetric("work_in", "J", "work done on the mechanism by the real contact force"),
    ContactMetric("work_out", "J", "work that the mechanism returns"),
)
# Metrics that are also stored for a contact that did not end; they cover the time until the run ended.
UNENDED_METRICS = (
    "peak_force",
    "peak_command",
    "position_shortfall",
    "duration",
    "approach_velocity",
    "energy_in",
)


class ContactColumns(NamedTuple):
    """Names of a contact's error column and status column; a six-axis episode has a pair for each error."""

    number: int  # number of the contact or episode, from 1
    error: str  # name of the error's column
    status: str  # name of the status's column


def list_contact_columns(mechanism: AnyMechanism) -> list[ContactColumns]:
    """Return the column names for every contact or, for six axes, for every error of every episode."""
    model = choose_rig_model(mechanism)
    return list_error_columns(model.errors, model.runs(mechanism))


def list_verdict_columns(mechanism: AnyMechanism) -> list[ContactColumns]:
    """Return the columns of the error to which the limit applies, one pair per contact or episode."""
    model = choose_rig_model(mechanism)
    return list_error_columns([model.verdict_error], model.runs(mechanism))


def list_error_columns(errors: Iterable[str], runs: int) -> list[ContactColumns]:
    """Return the column names for each error in `errors`, in each of `runs` contacts or episodes."""
    numbers = range(1, runs + 1)
    return [
        ContactColumns(number, f"{error}_{number}", f"status_{number}")
        for error in errors
        for number in numbers
    ]


def list_sweep_columns(mechanism: AnyMechanism, works: bool) -> list[Column]:
    """Return all columns of a sweep of `mechanism` in stored order; `works` adds those of mechanical work."""
    columns = [Column("index", "integer", "", "number of the scenario")]
    columns += [
        Column(name, "input", find_key_unit(mechanism, path), f"drawn value of {path}")
        for path in count_dimensions(mechanism)
        for name in list_input_columns(mechanism, path)
    ]
    run, error = choose_rig_model(mechanism).run_name, choose_rig_model(mechanism).verdict_error
    error = error.replace("_", " ")
    for number in sorted({slot.number for slot in list_contact_columns(mechanism)}):
        columns += [
            Column(f"{metric.name}_{number}", "number", metric.unit, f"{run} {number}: {metric.meaning}")
            for metric in _list_stored_metrics(mechanism, works)
        ]
        columns.append(Column(f"status_{number}", "text", "", f"{run} {number}: status at its end"))
    return [
        *columns,
        Column("worst_error", "number", "1", f"the {error} of largest magnitude of all {run}s that ended"),
        Column(
            "outcome",
            "text",
            "",
            f"good, or the reason why the scenario failed; {UNLIKE_IDEAL}: {UNLIKE_IDEAL_MEANING}; "
            f"{SATURATED}: {SATURATED_MEANING}",
        ),
        Column("failed", "flag", "", "whether the scenario failed"),
    ]


def list_allowed_texts(column: str) -> tuple[str, ...]:
    """Return a tuple of the texts that column `column` can hold; the rows store indices into this tuple."""
    return SCENARIO_OUTCOMES if column == "outcome" else CONTACT_STATUSES


def _list_stored_metrics(mechanism: AnyMechanism, works: bool) -> list[ContactMetric]:
    if choose_rig_model(mechanism).axes == 1:
        return [*CONTACT_METRICS, *(WORK_METRICS if works else ())]
    errors = [ContactMetric(name, "1", meaning) for name, meaning in SIX_AXIS_ERRORS.items()]
    return [*errors, *(metric for metric in CONTACT_METRICS if metric.name in EPISODE_METRICS)]


def find_key_unit(mechanism: AnyMechanism, path: str) -> str:
    """Return the SI unit of a numeric key of the mechanism file, given as a dotted path."""
    table, _, key = path.rpartition(".")
    contacts: dict[str, Any] = {"contact": mechanism.contact}
    if not isinstance(mechanism, Mechanism):
        contacts = {f"contact.{name}": contact for name, contact in mechanism.contact.items()}
    if key in ("stiffness", "damping") and table in contacts:
        law = find_contact_law(contacts[table].law)
        return law.stiffness_unit if key == "stiffness" else law.damping_unit
    return numeric_keys_of(mechanism)[path].unit


def list_input_columns(mechanism: AnyMechanism, path: str) -> list[str]:
    """Return the column names of a drawn key: `path` for a number, `path_1`, `path_2`, ... for a list."""
    if path == PHASE_KEY and isinstance(mechanism, Mechanism):
        shape: tuple[int, ...] = (mechanism.approach.contacts,)
    else:
        shape = np.shape(value_at(mechanism, path))
    return [path + "".join(f"_{entry + 1}" for entry in index) for index in np.ndindex(*shape)]


def select_read_fields(mechanism: AnyMechanism, works: bool, outcome: Outcome) -> Any:
    """Keep the fields of an outcome that `build_rows` reads; replace all others by None."""
    names = {
        "status",
        "restitution",
        "approach_velocity",
        *(m.name for m in _list_stored_metrics(mechanism, works)),
    }
    metrics = outcome.metrics
    unread_metrics: Any = dict.fromkeys(set(metrics._fields) - names)
    unread: Any = dict.fromkeys(("chatter", "is_scheduled", "good", "is_unlike_ideal"))
    return outcome._replace(metrics=metrics._replace(**unread_metrics), **unread)


def build_rows(
    mechanism: AnyMechanism,
    first: int,
    draws: Mapping[str, np.ndarray],
    scenarios: Any,
    outcome: Outcome,
    limit: float,
    works: bool,
) -> dict[str, np.ndarray]:
    """Build the rows of a store from the outcome of a batch of scenarios: one array (scenarios,) per column.

    Missing metrics are NaN. A text is stored as an index into `list_allowed_texts`.
    """
    metrics, contacts = outcome.metrics, list_contact_columns(mechanism)
    number = metrics.status.shape[-1]
    rows = {"index": np.arange(first, first + number)}
    for path, values in draws.items():
        entries = np.reshape(values, (number, -1)).T
        rows.update(zip(list_input_columns(mechanism, path), entries, strict=True))
    status = np.asarray(metrics.status[: len(contacts)])
    ended, reached = status == OK, status != NOT_REACHED
    values = {
        **{name: getattr(metrics, name) for name in metrics._fields},
        "reference_restitution": outcome.reference_restitution,
        "reference_peak_force": outcome.reference_peak_force,
        "reference_duration": outcome.reference_duration,
        "peak_ratio": outcome.peak_ratio,
        **_compute_energies(scenarios, metrics),
    }
    names = [metric.name for metric in _list_stored_metrics(mechanism, works)]
    codes = np.searchsorted(sorted(CONTACT_STATUS_NAMES), status).astype(np.int8)
    for index, slot in enumerate(contacts):
        for name in set(names) & set(values):
            valid = reached[index] if name in UNENDED_METRICS else ended[index]
            rows[f"{name}_{slot.number}"] = np.where(valid, values[name][index], np.nan)
        rows[slot.error] = np.where(ended[index], outcome.error[index], np.nan)
        rows[slot.status] = codes[index]
    period = np.asarray(scenarios.control_period)
    judged = list_verdict_columns(mechanism)
    columns = {**rows, **classify_outcomes(rows, judged, find_force_range(scenarios), period, limit)}
    names = [column.name for column in list_sweep_columns(mechanism, works)]
    return {name: columns[name] for name in names if name in columns}


def find_force_range(scenarios: Any) -> np.ndarray:
    """Return each scenario's force sensor range [N]; on six axes, the smallest range of a force channel."""
    if hasattr(scenarios, "sensor"):
        return np.min(np.asarray(scenarios.sensor.errors.range)[:3], axis=0)
    return np.asarray(scenarios.force_sensor.range)


def _compute_energies(scenarios: Any, metrics: Any) -> dict[str, np.ndarray]:
    """Return the kinetic energies [J] before and after each contact; empty for six axes."""
    if not hasattr(scenarios, "equivalent_mass"):
        return {}
    rebound = metrics.restitution * metrics.approach_velocity
    half_mass = (scenarios.equivalent_mass / 2).astype(rebound.dtype)
    return {"energy_in": half_mass * metrics.approach_velocity**2, "energy_out": half_mass * rebound**2}


def classify_outcomes(
    rows: Mapping[str, np.ndarray],
    made: Sequence[ContactColumns],
    force_range: np.ndarray,
    period: np.ndarray,
    limit: float,
) -> dict[str, np.ndarray]:
    """Compute the columns `worst_error`, `outcome` and `failed` from the columns of all contacts.

    Args:
        rows: columns by name. Stores of an earlier version lack the ideal contact's peak force and duration,
            so that no row becomes `UNLIKE_IDEAL`.
        made: column names of the contacts or episodes, for the error to which the limit applies.
        force_range: range of the force sensor [N], one value or one per row.
        period: control period [s], one value or one per row.
        limit: limit of the error [1].
    """

    def stacked(names: Iterable[str]) -> np.ndarray:
        return np.stack([rows[name] for name in names])

    status = np.array(sorted(CONTACT_STATUS_NAMES))[stacked(slot.status for slot in made)]
    error = stacked(slot.error for slot in made)
    peak = stacked(f"peak_force_{slot.number}" for slot in made)
    size = np.where(status == OK, np.abs(error), -1)
    worst = np.take_along_axis(error, np.argmax(size, axis=0)[None], axis=0)[0]
    # For an unreached contact, peak and shortfall are NaN, so that both comparisons are false.
    beyond_range = peak > force_range.astype(peak.dtype)
    saturated = np.any(beyond_range, axis=0)
    for name in {f"position_shortfall_{slot.number}" for slot in made} & set(rows):
        saturated = saturated | (rows[name] > 0)
    unlike = _find_unlike(rows, {slot.number for slot in made}, period)
    outcome = _choose_worst_outcomes(status, ~(np.abs(worst) <= limit), unlike, saturated)
    return {"worst_error": worst, "outcome": outcome, "failed": outcome != SCENARIO_OUTCOMES.index(GOOD)}


def _find_unlike(rows: Mapping[str, np.ndarray], numbers: Iterable[int], period: np.ndarray) -> np.ndarray:
    """Return for each row whether `is_contact_out_of_bounds` is true of one of the contacts `numbers`."""
    unlike = np.zeros(len(rows["index"]), bool)
    for number in numbers:
        ideal = [rows.get(f"reference_{name}_{number}") for name in ("peak_force", "duration")]
        if ideal[0] is not None and ideal[1] is not None:
            force, duration = rows[f"peak_force_{number}"], rows[f"duration_{number}"]
            unlike |= is_contact_out_of_bounds(
                force, ideal[0], duration, ideal[1], period.astype(duration.dtype)
            )
    return unlike


def _choose_worst_outcomes(
    status: np.ndarray, beyond: np.ndarray, unlike: np.ndarray, saturated: np.ndarray
) -> np.ndarray:
    """Return the most severe outcome of each scenario, as an index into `SCENARIO_OUTCOMES`."""
    outcome = np.where(beyond, SCENARIO_OUTCOMES.index(BEYOND_LIMIT), SCENARIO_OUTCOMES.index(GOOD))
    outcome = np.where(unlike, SCENARIO_OUTCOMES.index(UNLIKE_IDEAL), outcome)
    outcome = np.where(saturated, SCENARIO_OUTCOMES.index(SATURATED), outcome)
    for code, name in CONTACT_STATUS_NAMES.items():
        if code != OK:
            outcome = np.where(
                np.any(status == code, axis=0), np.maximum(outcome, SCENARIO_OUTCOMES.index(name)), outcome
            )
    return outcome.astype(np.int8)
