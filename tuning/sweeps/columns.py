"""Columns of a sweep's store: what is kept of every scenario, with names, units and meanings.

A number per contact is a column per contact, `error_1`, `error_2`, ...; an entry of a list that is drawn
likewise, `contact.stiffness_1`. What a contact that failed or was not reached does not have is null.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from jaxhil.mechanism.structs import Mechanism, value_at
from jaxhil.mechanism.uncertainty import PHASE, dimensions
from jaxhil.simulation.evaluation import Outcome
from jaxhil.simulation.metrics import DIVERGED, NON_FINITE, NOT_REACHED, OK, STATUS_NAMES, TIMEOUT
from jaxhil.simulation.scenario import Scenario

GOOD, BEYOND, SATURATED = "good", "error beyond limit", "saturated"
SATURATION = "a force beyond the sensor's range, or a limit of the motion simulator that bound"
STATUSES = tuple(STATUS_NAMES.values())
# From harmless to worst; the status of a run that failed is a cause by itself.
OUTCOMES = (GOOD, BEYOND, SATURATED, *(STATUS_NAMES[s] for s in (NOT_REACHED, TIMEOUT, DIVERGED, NON_FINITE)))

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
    PerContact("peak_command", "N", "largest force on the numerical model"),
    PerContact("peak_ratio", "1", "peak command over the reference's peak force"),
    PerContact("position_shortfall", "m", "most that the motion simulator's limits took off its command"),
    PerContact("duration", "s", "time in touch"),
    PerContact("approach_velocity", "m/s", "speed at which the contact was entered"),
    PerContact("energy_in", "J", "kinetic energy of the numerical model before the contact"),
    PerContact("energy_out", "J", "kinetic energy of the numerical model after the contact"),
)
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
    **dict.fromkeys(("depths", "clearance", "reference_depth", "contact_plane"), "m"),
    **dict.fromkeys(("phase", "damping_ratio", "exponent", "unloading_ratio"), "1"),
}


def sweep_columns(mechanism: Mechanism, works: bool) -> list[Column]:
    """The columns of a sweep over `mechanism`, in their order."""
    columns = [Column("index", "integer", "", "number of the scenario")]
    columns += [
        Column(name, "input", unit_of(mechanism, path), f"{path}, drawn")
        for path in dimensions(mechanism)
        for name in input_names(mechanism, path)
    ]
    for number in range(1, mechanism.approach.contacts + 1):
        columns += [
            Column(f"{one.name}_{number}", "number", one.unit, f"contact {number}: {one.meaning}")
            for one in (*PER_CONTACT, *(WORKS if works else ()))
        ]
        columns.append(Column(f"status_{number}", "text", "", f"contact {number}: how it ended"))
    return [
        *columns,
        Column("worst_error", "number", "1", "the error of largest magnitude of all contacts that ended"),
        Column(
            "outcome", "text", "", f"good, or why the scenario counts as failed; {SATURATED}: {SATURATION}"
        ),
        Column("failed", "flag", "", "whether the scenario counts as failed"),
    ]


def texts_of(column: str) -> tuple[str, ...]:
    """What a column of texts may hold; rows hold the text's place in it."""
    return OUTCOMES if column == "outcome" else STATUSES


def unit_of(mechanism: Mechanism, path: str) -> str:
    """SI unit of the mechanism file's key."""
    key = path.rpartition(".")[2]
    law = mechanism.contact.law
    if path == "contact.stiffness":
        return "N/m^n" if law in ("hunt_crossley", "depth_damped") else "N/m"
    if path == "contact.damping":
        return "s/m" if law == "hunt_crossley" else "N s/m"
    if key in ("noise_std", "quantum"):
        return "N" if "force" in path else "m"
    return _UNITS.get(key, "")


def input_names(mechanism: Mechanism, path: str) -> list[str]:
    """Names of the columns of a key that is drawn: the path itself, or one per entry, counted from 1."""
    if path == PHASE:
        shape: tuple[int, ...] = (mechanism.approach.contacts,)
    else:
        shape = np.shape(value_at(mechanism, path))
    return [path + "".join(f"_{place + 1}" for place in index) for index in np.ndindex(*shape)]


def rows_of(
    mechanism: Mechanism,
    first: int,
    draws: Mapping[str, np.ndarray],
    scenarios: Scenario,
    outcome: Outcome,
    limit: float,
    works: bool,
) -> dict[str, np.ndarray]:
    """One array (number,) per column; NaN where there is nothing to say, texts as their places."""
    metrics, made = outcome.metrics, mechanism.approach.contacts
    number = metrics.status.shape[-1]
    rows = {"index": np.arange(first, first + number)}
    for path, values in draws.items():
        entries = np.reshape(values, (number, -1)).T
        rows.update(zip(input_names(mechanism, path), entries, strict=True))
    status = np.asarray(metrics.status[:made])
    ended, reached = status == OK, status != NOT_REACHED
    rebound = metrics.restitution * metrics.approach_velocity
    half_mass = (scenarios.equivalent_mass / 2).astype(rebound.dtype)
    values = {
        **{name: getattr(metrics, name) for name in metrics._fields},
        "reference_restitution": outcome.reference_restitution,
        "error": outcome.error,
        "peak_ratio": outcome.peak_ratio,
        "energy_in": half_mass * metrics.approach_velocity**2,
        "energy_out": half_mass * rebound**2,
    }
    names = [one.name for one in (*PER_CONTACT, *(WORKS if works else ()))]
    codes = np.searchsorted(sorted(STATUS_NAMES), status).astype(np.int8)
    for contact in range(made):
        for name in names:
            known = reached[contact] if name in KNOWN_UNENDED else ended[contact]
            rows[f"{name}_{contact + 1}"] = np.where(known, values[name][contact], np.nan)
        rows[f"status_{contact + 1}"] = codes[contact]
    return {**rows, **judge(rows, made, np.asarray(scenarios.force_sensor.range), limit)}


def judge(
    rows: Mapping[str, np.ndarray], contacts: int, force_range: np.ndarray, limit: float
) -> dict[str, np.ndarray]:
    """`worst_error`, `outcome` and `failed`, which follow from the columns of every contact.

    `force_range` [N] is the force sensor's, of every row or of all; `limit` [1] that of the error.
    """

    def each(name: str) -> np.ndarray:
        return np.stack([rows[f"{name}_{contact + 1}"] for contact in range(contacts)])

    status, error, peak = np.array(sorted(STATUS_NAMES))[each("status")], each("error"), each("peak_force")
    size = np.where(status == OK, np.abs(error), -1)
    worst = np.take_along_axis(error, np.argmax(size, axis=0)[None], axis=0)[0]
    # What was not reached has no peak and no shortfall: they are beyond nothing.
    beyond_range = peak > force_range.astype(peak.dtype)
    saturated = np.any(beyond_range | (each("position_shortfall") > 0), axis=0)
    outcome = _outcomes(status, ~(np.abs(worst) <= limit), saturated)
    return {"worst_error": worst, "outcome": outcome, "failed": outcome != OUTCOMES.index(GOOD)}


def _outcomes(status: np.ndarray, beyond: np.ndarray, saturated: np.ndarray) -> np.ndarray:
    """The worst that can be said of every scenario, as its place in `OUTCOMES`."""
    found = np.where(beyond, OUTCOMES.index(BEYOND), OUTCOMES.index(GOOD))
    found = np.where(saturated, OUTCOMES.index(SATURATED), found)
    for code, name in STATUS_NAMES.items():
        if code != OK:
            found = np.where(np.any(status == code, axis=0), np.maximum(found, OUTCOMES.index(name)), found)
    return found.astype(np.int8)
