"""Gain files: what tuning writes and what every later command and the rig read (`schema = "jaxhil/gains/1"`).

A gain file holds a compensator's gains with units and bounds, the whole mechanism that they were tuned for,
what they were tuned over and what they reach. `build_document` makes one, `write_gain_file` signs and writes
it; `load_gain_file`, of `jaxhil.simulation.gain_file`, reads it back.
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

from jaxhil.contact.laws import contact_law
from jaxhil.errors import InputError, shown
from jaxhil.files import write_whole, writing
from jaxhil.laws.simulation_base import Gain
from jaxhil.mechanism.file import AnyMechanism, to_builtins
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import digest
from jaxhil.rig.gain_file import SCHEMA
from jaxhil.simulation.gain_file import bounds_of, check_names, look_up
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.sources import versions

VERSIONED = ("jaxhil", "jax", "numpy", "optimistix")


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
    """The content of a gain file, signed: plain data that JSON can express, what is not finite as null.

    Units and bounds come from the registry of compensators; a gain that rounding put beyond a bound is put
    on it. Raises `InputError` for an unknown compensator, gains that are not its own, a gain that is not
    finite or not within its bounds.
    """
    source = "gains"
    law = look_up(compensator, source).gains
    check_names(gains, law, source)
    document = {
        "schema": SCHEMA,
        "compensator": compensator,
        "gains": {gain.name: _gain_entry(gain, gains[gain.name], mechanism) for gain in law},
        **({"axes": 6} if isinstance(mechanism, SixAxisMechanism) else {}),
        "control_period": mechanism.rig.control_period,
        "mechanism": to_builtins(mechanism),
        "mechanism_sha256": mechanism_sha256,
        "envelope": plain(envelope),
        "figures": plain(figures),
        "seed": int(seed),
        "versions": versions(VERSIONED),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "timings": plain(timings),
    }
    return {**document, "sha256": digest(document)}


def write_gain_file(path: str | os.PathLike[str], document: Mapping[str, Any]) -> None:
    """Sign the document and write it: the file is there as a whole or, after an error, as it was.

    Raises `InputError` when the file cannot be written, ValueError or TypeError for what JSON cannot express.
    """
    target = Path(path)
    signed = {**document, "sha256": digest(document)}
    text = json.dumps(signed, indent=2, sort_keys=True, allow_nan=False) + "\n"
    with writing(target):
        write_whole(target, text.encode("ascii"))


def validity_envelope(mechanism: Mechanism, scenarios: Scenario) -> dict[str, dict[str, Any]]:
    """What a batch of scenarios spans, as {"low", "high", "unit"} of each of four quantities.

    contact_frequency sqrt(k/M)/(2 pi) [Hz], delay of force sensor and motion simulator together [s],
    approach_velocity of the first contact [m/s], force v sqrt(k M) [N]. k is the stiffness of the linear
    contact with the same peak force, entered undamped at the same speed v: k = (F_peak/v)^2/M, with F_peak
    from the energy M v^2/2 = integral of F. Scenario arrays are NumPy's, batch of one axis.
    """
    peak = _peak_forces(mechanism, scenarios)
    mass, velocity = np.asarray(scenarios.equivalent_mass), np.asarray(scenarios.velocity)
    slots = np.arange(len(peak))[:, None]
    made = slots < np.asarray(scenarios.contacts)
    # F_peak = v sqrt(k M), hence sqrt(k/M) = F_peak/(v M).
    frequency = peak / (velocity * mass) / (2 * math.pi)
    delay = np.asarray(scenarios.force_sensor.delay) + np.asarray(scenarios.simulator.delay)
    return {
        "contact_frequency": _span(frequency[made], "Hz"),
        "delay": _span(delay, "s"),
        "approach_velocity": _span(velocity, "m/s"),
        "force": _span(peak[made], "N"),
    }


def envelope_in_space(scenarios: Any, outcome: Any) -> dict[str, dict[str, Any]]:
    """What a batch of scenarios of six axes spans, likewise: contact frequency 1/(2 duration) [Hz] and
    approach velocity [m/s] at the first touches, delay of force sensor and axes together [s], peak force in
    space [N]; of the contacts of an outcome that ended."""
    ended = outcome.good
    known = {
        "contact_frequency": (1 / (2 * np.maximum(outcome.metrics.duration, 1e-9)), "Hz"),
        "approach_velocity": (outcome.metrics.approach_velocity, "m/s"),
        "force": (outcome.reference_peak_force, "N"),
    }
    delay = np.asarray(scenarios.sensor.delay) + np.asarray(scenarios.simulator.delay)
    spans = {name: _span(values[ended], unit) for name, (values, unit) in known.items() if np.any(ended)}
    return {**spans, "delay": _span(delay, "s")}


def plain(value: Any) -> Any:
    """`value` as JSON can express it: mappings, lists, numbers; null for what is not finite.

    Takes arrays and scalars of NumPy and jax and named tuples too; raises TypeError for anything else.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple) and (fields := getattr(value, "_fields", None)):
        return {name: plain(entry) for name, entry in zip(fields, value, strict=True)}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if not hasattr(value, "__array__"):
        raise TypeError(f"a {type(value).__name__} has no place in a gain file")
    return plain(np.asarray(value).tolist())


def _peak_forces(mechanism: Mechanism, scenarios: Scenario) -> np.ndarray:
    """Return the peak force [N] of every contact, (slots, lanes), entered undamped at the approach speed."""
    contact = jax.tree.map(np.asarray, scenarios.contact)
    motion = np.asarray(scenarios.equivalent_mass), np.asarray(scenarios.velocity)
    return contact_law(mechanism.contact.law).undamped_peak_force(contact, *motion)


def _span(values: np.ndarray, unit: str) -> dict[str, Any]:
    return {"low": float(np.min(values)), "high": float(np.max(values)), "unit": unit}


def _gain_entry(gain: Gain, value: float, mechanism: AnyMechanism) -> dict[str, Any]:
    lower, upper, margin = bounds_of(gain, mechanism)
    number = float(value)
    if not lower - margin <= number <= upper + margin:
        allowed = f"{lower:.12g} to {upper:.12g} {gain.unit}"
        raise InputError(f"gains: {gain.name}: found {shown(number)}, allowed {allowed}")
    return {"value": min(max(number, lower), upper), "unit": gain.unit, "lower": lower, "upper": upper}
