"""False and missed alarms of the watchdog and the other guards in recorded runs.

A run is good if no contact's error exceeds a limit. A good run that is stopped is a false alarm, and a bad
run that continues after its bad contact is a missed alarm.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxhil.simulation.metrics import OK
from tuning.statistics.intervals import binomial_interval
from tuning.watchdog.audit import AuditedContacts, AuditRules, audit_contacts, find_first_true
from tuning.watchdog.expectation import ContactFeatures, Expectation, expected_restitution
from tuning.watchdog.recording import RecordedRuns
from tuning.watchdog.signal_extremes import SignalExtremes, find_signal_extremes

# Multiples of the limit: a run with errors up to the first is good, beyond the second it must be stopped.
GOOD_ERROR_FACTOR, BAD_ERROR_FACTOR = 0.5, 1.0
MIN_DETECTED_SHARE = 0.95  # share of alarms that defines the error from which contacts are noticed
MIN_DETECTED_CONTACTS = 20  # least number of contacts for such a share


class EvaluatedRuns(NamedTuple):
    """Evaluation of recorded runs."""

    index: Int[np.ndarray, "lanes"]  # index of each run in its sweep
    error: Float[np.ndarray, "slots lanes"]  # restitution error; NaN if the contact did not end
    reference: Float[np.ndarray, "slots lanes"]  # restitution e* of the ideal contact
    status: Int[np.ndarray, "slots lanes"]  # status of each contact, as in `jaxhil.simulation.metrics`
    audited: AuditedContacts  # the watchdog's audit of each contact
    extent: SignalExtremes  # extreme values of the signals


def evaluate_runs(chunk: RecordedRuns, rules: AuditRules, free_distance: float) -> EvaluatedRuns:
    """Evaluate recorded runs; `free_distance` [m] is that of `find_signal_extremes`."""
    contacts, slots = chunk.contacts, len(chunk.contacts.status)
    return EvaluatedRuns(
        chunk.first + np.arange(contacts.status.shape[1]),
        contacts.error,
        contacts.reference,
        contacts.status,
        audit_contacts(chunk.signals, rules, slots),
        find_signal_extremes(chunk.signals, rules.period, rules.clearance, free_distance, rules.settling),
    )


def find_good_runs(runs: EvaluatedRuns, limit: float) -> Bool[np.ndarray, "lanes"]:
    """Return the runs whose contacts all ended, with errors within the limit."""
    return np.all((runs.status == OK) & (np.abs(runs.error) <= limit), axis=0)


def find_reached_contacts(runs: EvaluatedRuns, limit: float) -> Bool[np.ndarray, "slots lanes"]:
    """Return the contacts that the rig would reach, since no earlier contact of the run had to be stopped."""
    bad = (runs.status != OK) | ~(np.abs(runs.error) <= limit)
    first = find_first_true(bad)
    return (np.arange(len(bad))[:, None] <= first) & runs.audited.begun


def extract_features(audited: AuditedContacts) -> ContactFeatures:
    """Return the features of the expectation, 0 if a contact gave no estimate."""
    return ContactFeatures(
        np.nan_to_num(audited.stiffness), np.nan_to_num(audited.damping), np.nan_to_num(audited.approach)
    )


def compute_alarm_rates(
    runs: EvaluatedRuns,
    expectation: Expectation,
    limits: Mapping[str, float | None],
    limit: float,
    mass: float,
    chosen: Bool[np.ndarray, "lanes"],
) -> dict[str, Any]:
    """Return rates of false and missed alarms in the chosen runs, with exact 95 % intervals, as plain data.

    A run is good if no error exceeds half the limit; it is a false alarm if the watchdog or another guard
    stops it. A run must be stopped if a contact does not end or has an error beyond the limit; it is missed
    if the watchdog has not tripped by the end of that contact. The intervals are valid for independent
    scenarios, even if the number of failures decides their number; Sobol points are spread more evenly. The
    result also holds the error from which contacts are noticed (`find_detectable_error`).
    """
    alarmed = find_alarms(runs, expectation, limits, mass)
    first_alarm = find_first_true(alarmed)
    stopped = np.any(alarmed, axis=0) | find_guard_trips(runs.extent, limits)
    good = chosen & find_good_runs(runs, GOOD_ERROR_FACTOR * limit)
    bad = (runs.status != OK) | ~(np.abs(runs.error) <= BAD_ERROR_FACTOR * limit)
    first_bad = find_first_true(bad)
    bad_runs = chosen & np.any(bad, axis=0)
    use = find_reached_contacts(runs, limit) & (runs.status == OK) & chosen
    expected = expected_restitution(expectation, extract_features(runs.audited), mass)
    difference = np.abs((expected - runs.reference)[use])
    return {
        "limit": limit,
        "restitution_margin": limits["restitution_margin"],
        "terms": [term for term, value in expectation.coefficients.items() if value],
        "expectation_rms": float(np.sqrt(np.mean(difference**2))) if len(difference) else None,
        "expectation_largest": float(np.max(difference)) if len(difference) else None,
        "false_alarms": _compute_alarm_rate(stopped[good]),
        "missed_alarms": _compute_alarm_rate(first_alarm[bad_runs] > first_bad[bad_runs]),
        "noticed_from": find_detectable_error(runs.error[use], alarmed[use]),
        "held_out_runs": int(np.sum(chosen)),
    }


def find_alarms(
    runs: EvaluatedRuns, expectation: Expectation, limits: Mapping[str, float | None], mass: float
) -> Bool[np.ndarray, "slots lanes"]:
    """Return the contacts for which the watchdog raises an alarm."""
    audited = runs.audited
    expected = expected_restitution(expectation, extract_features(audited), mass)
    margin, balance, longest = (
        np.inf if limits[name] is None else float(limits[name] or 0.0)
        for name in ("restitution_margin", "energy_balance", "longest_contact")
    )
    with np.errstate(invalid="ignore"):
        quiet = (
            (np.abs(audited.restitution - expected) <= margin)
            & (audited.imbalance <= balance)
            & (audited.duration <= longest)
        )
    return audited.begun & ~quiet & ~(audited.approach == 0)


def find_guard_trips(extent: SignalExtremes, limits: Mapping[str, float | None]) -> Bool[np.ndarray, "lanes"]:
    """Return the runs that a guard other than the watchdog would stop, or whose readings it would flag."""

    def limit(name: str, unlimited: float = np.inf) -> float:
        value = limits[name]
        return unlimited if value is None else value

    return (
        (extent.reading >= limit("force_range"))
        | (extent.measured_lowest < limit("measured_lowest", -np.inf))
        | (extent.measured_highest > limit("measured_highest"))
        | (extent.sent_lowest < limit("command_lowest", -np.inf))
        | (extent.sent_highest > limit("command_highest"))
        | (extent.force_stuck > limit("force_stuck_travel"))
        | (extent.position_stuck > limit("position_stuck_travel"))
        | (extent.flight_force > limit("free_force"))
        | (extent.command > limit("force_limit"))
        | (extent.slew > limit("force_slew"))
        | (extent.sent_speed > limit("velocity_limit"))
    )


def find_detectable_error(
    error: Float[np.ndarray, "contacts"], alarmed: Bool[np.ndarray, "contacts"]
) -> dict[str, Any]:
    """Return the least |error| from which 95 % of the contacts raise an alarm.

    The result holds this `error` (None if there is none, or fewer than 20 such contacts), the number of these
    `contacts`, and the `largest` |error| of all contacts.
    """
    size = np.abs(error)
    order = np.argsort(-size)
    number = np.arange(1, len(size) + 1)
    enough = (np.cumsum(alarmed[order]) >= MIN_DETECTED_SHARE * number) & (number >= MIN_DETECTED_CONTACTS)
    largest = float(size[order[0]]) if len(size) else None
    if not np.any(enough):
        return {"error": None, "contacts": 0, "largest": largest}
    last = int(np.max(np.nonzero(enough)[0]))
    return {"error": float(size[order[last]]), "contacts": last + 1, "largest": largest}


def _compute_alarm_rate(alarmed: Bool[np.ndarray, "runs"]) -> dict[str, Any]:
    number, count = len(alarmed), int(np.sum(alarmed))
    _, low, high = binomial_interval(count, number)
    rate = count / number if number else None
    return {"runs": number, "alarms": count, "rate": rate, "low": float(low), "high": float(high)}
