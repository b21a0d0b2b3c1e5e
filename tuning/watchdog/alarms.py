"""Rates of false and missed alarms of the watchdog and the other guards in recorded runs.

A run is good if no restitution error of its contacts exceeds a limit. A false alarm is a good run that the
controller stops. A missed alarm is a bad run that the controller does not stop by the end of its bad contact.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxhil.simulation.metrics import OK
from tuning.statistics.intervals import binomial_interval
from tuning.watchdog.audit import AuditedContacts, AuditRules, audit_contacts, find_first_true
from tuning.watchdog.expectation import ContactFeatures, ExpectationFit, expected_restitution
from tuning.watchdog.recording import RecordedRuns
from tuning.watchdog.signal_extremes import SignalExtremes, find_signal_extremes

# Largest error of a run that counts as good, and largest error of a run that need not be stopped, both
# divided by the limit.
GOOD_ERROR_FACTOR, BAD_ERROR_FACTOR = 0.5, 1.0
MIN_DETECTED_SHARE = 0.95  # fraction of contacts that must raise an alarm for an error to be detectable [1]
MIN_DETECTED_CONTACTS = 20  # smallest number of contacts for an estimate of this fraction


class EvaluatedRuns(NamedTuple):
    """Errors, audits and extreme signals of recorded runs; slots are contacts, lanes are runs."""

    index: Int[np.ndarray, "lanes"]  # index of each run in its sweep
    error: Float[np.ndarray, "slots lanes"]  # restitution error e - e* [1]; NaN if the contact did not end
    reference: Float[np.ndarray, "slots lanes"]  # restitution e* of the ideal contact [1]
    status: Int[np.ndarray, "slots lanes"]  # status of each contact, as in `jaxhil.simulation.metrics`
    audited: AuditedContacts  # values that the watchdog computes for each contact
    extent: SignalExtremes  # extreme values of the signals of each run


def evaluate_runs(chunk: RecordedRuns, rules: AuditRules, free_distance: float) -> EvaluatedRuns:
    """Compute the restitution errors, contact audits and extreme signal values of recorded runs.

    Farther than `free_distance` [m] from all surfaces, the mechanism counts as in free flight.
    """
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
    """Return for each run whether all its contacts have ended with errors within `limit`."""
    return np.all((runs.status == OK) & (np.abs(runs.error) <= limit), axis=0)


def find_reached_contacts(runs: EvaluatedRuns, limit: float) -> Bool[np.ndarray, "slots lanes"]:
    """Return for each contact whether the rig reaches it: no earlier contact of its run is bad.

    A contact is bad if it does not end, or if its error exceeds `limit`.
    """
    bad = (runs.status != OK) | ~(np.abs(runs.error) <= limit)
    first = find_first_true(bad)
    return (np.arange(len(bad))[:, None] <= first) & runs.audited.occurred


def extract_features(audited: AuditedContacts) -> ContactFeatures:
    """Return stiffness, damping and approach speed of audited contacts; a missing estimate becomes 0."""
    return ContactFeatures(
        np.nan_to_num(audited.stiffness), np.nan_to_num(audited.damping), np.nan_to_num(audited.approach)
    )


def compute_alarm_rates(
    runs: EvaluatedRuns,
    expectation: ExpectationFit,
    limits: Mapping[str, float | None],
    limit: float,
    mass: float,
    chosen: Bool[np.ndarray, "lanes"],
) -> dict[str, Any]:
    """Compute the rates of false and missed alarms, with exact 95 % intervals, as JSON data.

    A good run has no error above half the limit. A false alarm is a good run that the watchdog or another
    guard stops. A bad contact does not end, or has an error beyond the limit. A missed alarm is a run in
    which the watchdog does not trip up to and including the first bad contact. The intervals are exact for
    independent scenarios; for points of a Sobol sequence, they are wider than necessary. The result also
    contains the smallest detectable error (`find_detectable_error`).

    Args:
        runs: recorded runs.
        expectation: expected restitution of the watchdog.
        limits: limits of the gain file by name.
        limit: limit of the restitution error [1].
        mass: equivalent mass [kg].
        chosen: which runs to use, (lanes,).
    """
    alarmed = find_alarms(runs, expectation, limits, mass)
    first_alarm = find_first_true(alarmed)
    stopped = np.any(alarmed, axis=0) | find_guard_trips(runs.extent, limits)
    good = chosen & find_good_runs(runs, GOOD_ERROR_FACTOR * limit)
    bad = (runs.status != OK) | ~(np.abs(runs.error) <= BAD_ERROR_FACTOR * limit)
    first_bad = find_first_true(bad)
    bad_runs = chosen & np.any(bad, axis=0)
    is_used = find_reached_contacts(runs, limit) & (runs.status == OK) & chosen
    expected = expected_restitution(expectation, extract_features(runs.audited), mass)
    difference = np.abs((expected - runs.reference)[is_used])
    return {
        "limit": limit,
        "restitution_margin": limits["restitution_margin"],
        "terms": [term for term, value in expectation.coefficients.items() if value],
        "expectation_rms": float(np.sqrt(np.mean(difference**2))) if len(difference) else None,
        "expectation_largest": float(np.max(difference)) if len(difference) else None,
        "false_alarms": _compute_alarm_rate(stopped[good]),
        "missed_alarms": _compute_alarm_rate(first_alarm[bad_runs] > first_bad[bad_runs]),
        "noticed_from": find_detectable_error(runs.error[is_used], alarmed[is_used]),
        "held_out_runs": int(np.sum(chosen)),
    }


def find_alarms(
    runs: EvaluatedRuns, expectation: ExpectationFit, limits: Mapping[str, float | None], mass: float
) -> Bool[np.ndarray, "slots lanes"]:
    """Return for each contact whether the watchdog raises an alarm."""
    audited = runs.audited
    expected = expected_restitution(expectation, extract_features(audited), mass)
    margin, balance, longest = (
        np.inf if limits[name] is None else float(limits[name] or 0.0)
        for name in ("restitution_margin", "energy_balance", "longest_contact")
    )
    with np.errstate(invalid="ignore"):
        passes = (
            (np.abs(audited.restitution - expected) <= margin)
            & (audited.imbalance <= balance)
            & (audited.duration <= longest)
        )
    return audited.occurred & ~passes & ~(audited.approach == 0)


def find_guard_trips(extent: SignalExtremes, limits: Mapping[str, float | None]) -> Bool[np.ndarray, "lanes"]:
    """Return for each run whether a reading or a command violates a limit; omit the watchdog's limits."""

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
    """Return the smallest |error| from which on at least 95 % of the contacts raise an alarm.

    The result contains `error` (this value; None if there is none with at least 20 contacts), `contacts`
    (number of contacts from this value on) and `largest` (largest |error| of all contacts).
    """
    magnitude = np.abs(error)
    order = np.argsort(-magnitude)
    number = np.arange(1, len(magnitude) + 1)
    enough = (np.cumsum(alarmed[order]) >= MIN_DETECTED_SHARE * number) & (number >= MIN_DETECTED_CONTACTS)
    largest = float(magnitude[order[0]]) if len(magnitude) else None
    if not np.any(enough):
        return {"error": None, "contacts": 0, "largest": largest}
    last = int(np.max(np.nonzero(enough)[0]))
    return {"error": float(magnitude[order[last]]), "contacts": last + 1, "largest": largest}


def _compute_alarm_rate(alarmed: Bool[np.ndarray, "runs"]) -> dict[str, Any]:
    number, count = len(alarmed), int(np.sum(alarmed))
    _, low, high = binomial_interval(count, number)
    rate = count / number if number else None
    return {"runs": number, "alarms": count, "rate": rate, "low": float(low), "high": float(high)}
