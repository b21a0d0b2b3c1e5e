"""Writing of gain files (`schema = "jaxhil/gains/1"`), which later commands and the rig read.

A gain file holds a compensator's gains with units and bounds, the mechanism that they were tuned for, the
range of the scenarios and the metrics reached. `build_document` builds its content, `write_gain_file` writes
it with a checksum, and `jaxhil.simulation.gain_file.load_gain_file` reads it.
"""

import json
import math
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxhil.contact.laws import find_contact_law
from jaxhil.errors import InputError, format_value
from jaxhil.files import report_write_errors, write_atomically
from jaxhil.laws.compensators import axes_of
from jaxhil.laws.simulation_base import Gain
from jaxhil.mechanism.file import AnyMechanism, to_plain_data
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import digest
from jaxhil.rig.gain_file import SCHEMA
from jaxhil.simulation.gain_file import check_gain_names, find_compensator, resolve_gain_bounds
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.source_fingerprint import dependency_versions

VERSIONED_PACKAGES = ("jaxhil", "jax", "numpy", "optimistix")


def build_document(
    compensator: str,
    gains: Mapping[str, float],
    mechanism: AnyMechanism,
    mechanism_sha256: str,
    envelope: Mapping[str, Any],
    figures: Mapping[str, Any],
    seed: int,
    timings: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the content of a gain file with its checksum, as JSON data with null for non-finite numbers.

    Units and bounds come from the registry of compensators. A gain that exceeds a bound by rounding is set to
    the bound. Raise `InputError` for an unknown compensator, gains of another compensator, or a gain that is
    not finite or not within its bounds.
    """
    source = "gains"
    law = find_compensator(compensator, source, axes_of(mechanism)).gains
    check_gain_names(gains, law, source)
    document = {
        "schema": SCHEMA,
        "compensator": compensator,
        "gains": {gain.name: _gain_entry(gain, gains[gain.name], mechanism) for gain in law},
        **({"axes": 6} if isinstance(mechanism, SixAxisMechanism) else {}),
        "control_period": mechanism.rig.control_period,
        "mechanism": to_plain_data(mechanism),
        "mechanism_sha256": mechanism_sha256,
        "envelope": to_json_data(envelope),
        "figures": to_json_data(figures),
        "seed": int(seed),
        "versions": dependency_versions(VERSIONED_PACKAGES),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "timings": to_json_data(timings),
    }
    return {**document, "sha256": digest(document)}


def write_gain_file(path: str | os.PathLike[str], document: Mapping[str, Any]) -> None:
    """Write the document with its checksum; after an error an existing file is unchanged.

    Raise `InputError` if the file cannot be written, ValueError or TypeError for values that JSON lacks.
    """
    target = Path(path)
    signed = {**document, "sha256": digest(document)}
    text = json.dumps(signed, indent=2, sort_keys=True, allow_nan=False) + "\n"
    with report_write_errors(target):
        write_atomically(target, text.encode("ascii"))


def validity_envelope(mechanism: Mechanism, scenarios: Scenario) -> dict[str, dict[str, Any]]:
    """Return the range {"low", "high", "unit"} of four quantities over a batch of scenarios.

    The quantities are contact_frequency sqrt(k/M)/(2 pi) [Hz], delay of force sensor plus motion simulator
    [s], approach_velocity of the first contact [m/s], and force v sqrt(k M) [N]. k is the stiffness of the
    undamped linear contact with the same peak force at the same approach speed v: k = (F_peak/v)^2/M, with
    F_peak from the energy M v^2/2 = integral of F. `scenarios` holds NumPy arrays with one batch axis.
    """
    peak = _peak_forces(mechanism, scenarios)
    mass, velocity = np.asarray(scenarios.equivalent_mass), np.asarray(scenarios.velocity)
    slots = np.arange(len(peak))[:, None]
    made = slots < np.asarray(scenarios.contacts)
    # F_peak = v sqrt(k M), hence sqrt(k/M) = F_peak/(v M).
    frequency = peak / (velocity * mass) / (2 * math.pi)
    delay = np.asarray(scenarios.force_sensor.delay) + np.asarray(scenarios.simulator.delay)
    return {
        "contact_frequency": _range_with_unit(frequency[made], "Hz"),
        "delay": _range_with_unit(delay, "s"),
        "approach_velocity": _range_with_unit(velocity, "m/s"),
        "force": _range_with_unit(peak[made], "N"),
    }


def six_axis_validity_envelope(scenarios: Any, outcome: Any) -> dict[str, dict[str, Any]]:
    """Return the range {"low", "high", "unit"} of four quantities over a batch of six-axis scenarios.

    The quantities are the contact frequency 1/(2 duration) [Hz] and approach velocity [m/s] at the first
    touches, the delay of force sensor plus axes [s], and the peak force of the ideal contact [N]. Only the
    contacts of `outcome` that ended count.
    """
    ended = outcome.good
    quantities = {
        "contact_frequency": (1 / (2 * np.maximum(outcome.metrics.duration, 1e-9)), "Hz"),
        "approach_velocity": (outcome.metrics.approach_velocity, "m/s"),
        "force": (outcome.reference_peak_force, "N"),
    }
    delay = np.asarray(scenarios.sensor.delay) + np.asarray(scenarios.simulator.delay)
    spans = {
        name: _range_with_unit(values[ended], unit)
        for name, (values, unit) in quantities.items()
        if np.any(ended)
    }
    return {**spans, "delay": _range_with_unit(delay, "s")}


def to_json_data(value: Any) -> Any:
    """Convert `value` to JSON data: mappings, lists and numbers, with null for non-finite numbers.

    Accept NumPy and JAX arrays and scalars, and named tuples; raise TypeError for any other type.
    """
    if isinstance(value, Mapping):
        return {str(key): to_json_data(entry) for key, entry in value.items()}
    if isinstance(value, tuple) and (fields := getattr(value, "_fields", None)):
        return {name: to_json_data(entry) for name, entry in zip(fields, value, strict=True)}
    if isinstance(value, (list, tuple)):
        return [to_json_data(entry) for entry in value]
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if not hasattr(value, "__array__"):
        raise TypeError(f"a {type(value).__name__} has no place in a gain file")
    return to_json_data(np.asarray(value).tolist())


def _peak_forces(mechanism: Mechanism, scenarios: Scenario) -> np.ndarray:
    """Return the peak force [N] of every contact, (slots, lanes), entered undamped at the approach speed."""
    contact = jax.tree.map(np.asarray, scenarios.contact)
    motion = np.asarray(scenarios.equivalent_mass), np.asarray(scenarios.velocity)
    return find_contact_law(mechanism.contact.law).undamped_peak_force(contact, *motion)


def _range_with_unit(values: np.ndarray, unit: str) -> dict[str, Any]:
    return {"low": float(np.min(values)), "high": float(np.max(values)), "unit": unit}


def _gain_entry(gain: Gain, value: float, mechanism: AnyMechanism) -> dict[str, Any]:
    lower, upper, margin = resolve_gain_bounds(gain, mechanism)
    number = float(value)
    if not lower - margin <= number <= upper + margin:
        allowed = f"{lower:.12g} to {upper:.12g} {gain.unit}"
        raise InputError(f"gains: {gain.name}: found {format_value(number)}, expected {allowed}")
    return {"value": min(max(number, lower), upper), "unit": gain.unit, "lower": lower, "upper": upper}
