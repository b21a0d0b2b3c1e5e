"""Writing of gain files (`schema = "jaxhil/gains/1"`), which later commands and the rig read.

A gain file contains a compensator's gains with units and bounds, the mechanism for which they were tuned, the
ranges of the scenarios on which they were evaluated, and the metrics. `build_document` builds the content,
`write_gain_file` writes the file with a checksum, and `jaxhil.simulation.gain_file.load_gain_file` reads it.
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
    """Return the content of a gain file, including its checksum, as JSON data; null for non-finite numbers.

    Units and bounds come from the registry of compensators. A gain that exceeds a bound by a rounding error
    is set to the bound. Raise `InputError` if the compensator is unknown, if the gains are not those of this
    compensator, or if a gain is not finite or not within its bounds.
    """
    source = "gains"
    law = find_compensator(compensator, source, axes_of(mechanism)).gains
    check_gain_names(gains, law, source)
    document = {
        "schema": SCHEMA,
        "compensator": compensator,
        "gains": {gain.name: _gain_entry(gain, gains[gain.name], mechanism) for gain in law},
        **_six_axis_entries(mechanism),
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


def _six_axis_entries(mechanism: AnyMechanism) -> dict[str, Any]:
    """Return the entries that only a gain file in six axes has."""
    if not isinstance(mechanism, SixAxisMechanism):
        return {}
    from jaxhil.sixdof.model_constants import model_constants

    return {"axes": 6, "constants": model_constants(mechanism)}


def write_gain_file(path: str | os.PathLike[str], document: Mapping[str, Any]) -> None:
    """Write a gain file with its checksum; if this fails, an existing file remains unchanged.

    Raise `InputError` if the file cannot be written, and ValueError or TypeError if JSON cannot represent a
    value of the document.
    """
    target = Path(path)
    signed = {**document, "sha256": digest(document)}
    text = json.dumps(signed, indent=2, sort_keys=True, allow_nan=False) + "\n"
    with report_write_errors(target):
        write_atomically(target, text.encode("ascii"))


def validity_envelope(mechanism: Mechanism, scenarios: Scenario) -> dict[str, dict[str, Any]]:
    """Return the ranges of contact frequency, delay, approach velocity and force in a batch of scenarios.

    Args:
        mechanism: mechanism of the scenarios.
        scenarios: scenarios as NumPy arrays with one batch axis.

    Returns:
        A dictionary {"low", "high", "unit"} for each of four quantities: `contact_frequency`, sqrt(k/M)/(2
        pi) [Hz]; `delay`, the delay of force sensor plus motion simulator [s]; `approach_velocity`, the speed
        v before the first contact [m/s]; `force`, the peak force F_peak of the undamped contact [N], at which
        the contact has stored the whole energy M v^2/2. The frequency is that of the linear contact with this
        peak force, whose stiffness is k = (F_peak/v)^2/M.
    """
    peak = _peak_forces(mechanism, scenarios)
    mass, velocity = np.asarray(scenarios.equivalent_mass), np.asarray(scenarios.velocity)
    slots = np.arange(len(peak))[:, None]
    is_used = slots < np.asarray(scenarios.contacts)
    # F_peak = v sqrt(k M), hence sqrt(k/M) = F_peak/(v M).
    frequency = peak / (velocity * mass) / (2 * math.pi)
    delay = np.asarray(scenarios.force_sensor.delay) + np.asarray(scenarios.simulator.delay)
    return {
        "contact_frequency": _range_with_unit(frequency[is_used], "Hz"),
        "delay": _range_with_unit(delay, "s"),
        "approach_velocity": _range_with_unit(velocity, "m/s"),
        "force": _range_with_unit(peak[is_used], "N"),
    }


def six_axis_validity_envelope(scenarios: Any, outcome: Any) -> dict[str, dict[str, Any]]:
    """Return the ranges of contact frequency, delay, approach velocity and force of six-axis scenarios.

    Args:
        scenarios: batch of six-axis scenarios.
        outcome: outcome of these scenarios; contacts that did not end are ignored.

    Returns:
        A dictionary {"low", "high", "unit"} for each of four quantities: `contact_frequency`, 1/(2 d) with
        the contact's duration d [Hz]; `approach_velocity` at the first touch [m/s]; `force`, the ideal
        contact's peak force [N]; `delay`, the delay of force sensor plus motion simulator [s].
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
    """Convert `value` to JSON data, with null for non-finite numbers.

    Accept numbers, texts, mappings, sequences, named tuples, and NumPy and JAX arrays; raise TypeError for
    any other type.
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
        raise TypeError(f"gain file: found a {type(value).__name__}, expected data that JSON can represent")
    return to_json_data(np.asarray(value).tolist())


def _peak_forces(mechanism: Mechanism, scenarios: Scenario) -> np.ndarray:
    """Return the peak force [N] that every contact would have without damping, (contacts, scenarios)."""
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
