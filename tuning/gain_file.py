"""Gain files: what tuning writes and what every later command and the rig read (`schema = "jaxhil/gains/1"`).

A gain file holds a compensator's gains with units and bounds, the whole mechanism that they were tuned for,
what they were tuned over and what they reach. `build_document` makes one, `write_gain_file` signs and writes
it, `load_gain_file` reads it back or says in one line what is wrong: first the checks that the rig makes too
(`jaxhil.runtime`), then those that need the mechanism and the registry of compensators.
"""

import json
import math
import os
import platform
import re
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxhil.compensators import COMPENSATORS, Gain
from jaxhil.errors import InputError, one_line, shown
from jaxhil.mechanism.file import from_builtins, to_builtins
from jaxhil.mechanism.structs import Mechanism
from jaxhil.runtime import GainFileError, digest
from jaxhil.runtime.gain_file import SCHEMA, check_gain_document, read_gain_document
from jaxhil.simulation.scenario import Scenario
from tuning.files import write_whole, writing

VERSIONED = ("jaxhil", "jax", "numpy", "optimistix")
ROUNDING = 1e-9  # by which a bound worked out elsewhere may differ


class LoadedGains(NamedTuple):
    """A checked gain file: its whole content, compensator, gains [SI units], mechanism."""

    document: dict[str, Any]
    compensator: str
    gains: dict[str, float]
    mechanism: Mechanism


def build_document(
    compensator: str,
    gains: Mapping[str, float],
    mechanism: Mechanism,
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
    law = _registered(compensator, source)
    _same_names(gains, law, source)
    document = {
        "schema": SCHEMA,
        "compensator": compensator,
        "gains": {gain.name: _gain_entry(gain, gains[gain.name], mechanism) for gain in law},
        "control_period": mechanism.rig.control_period,
        "mechanism": to_builtins(mechanism),
        "mechanism_sha256": mechanism_sha256,
        "envelope": plain(envelope),
        "figures": plain(figures),
        "seed": int(seed),
        "versions": versions(),
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


def load_gain_file(path: str | os.PathLike[str]) -> LoadedGains:
    """The gain file at `path`, checked as a whole. Raises `InputError`, one line, for whatever is wrong."""
    source = one_line(os.fspath(path))
    try:
        document = read_gain_document(path)
    except GainFileError as error:
        raise InputError(str(error)) from None
    return check_document(document, source)


def check_document(document: dict[str, Any], source: str = "gain document") -> LoadedGains:
    """The content of a gain file, checked as a whole; errors call it `source`. Raises `InputError`."""
    try:
        on_the_rig = check_gain_document(document, source)
    except GainFileError as error:
        raise InputError(str(error)) from None
    for key, (fits, allowed) in _REQUIRED.items():
        if key not in document:
            raise _refusal(source, key, "nothing", "this key is required")
        if not fits(document[key]):
            raise _refusal(source, key, shown(document[key]), allowed)
    mechanism = from_builtins(document["mechanism"], f"{source}: mechanism")
    law = _registered(on_the_rig.compensator, source)
    _same_names(on_the_rig.gains, law, f"{source}: gains")
    for gain in law:
        _check_entry(gain, document["gains"][gain.name], mechanism, source)
    return LoadedGains(document, on_the_rig.compensator, dict(on_the_rig.gains), mechanism)


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


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on, and of Python."""
    found = {"python": platform.python_version()}
    for name in VERSIONED:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


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
    """Peak force [N] of every contact, (slots, lanes), entered undamped at the approach speed."""
    contact = scenarios.contact
    stiffness = np.asarray(contact.stiffness)
    energy = np.asarray(scenarios.equivalent_mass) * np.asarray(scenarios.velocity) ** 2 / 2
    law = mechanism.contact.law
    if law == "hardening":
        # M v^2/2 = k d^2/2 + k d^4/(4 d_0^2), in units of d_0
        unit = np.asarray(contact.reference_depth)
        square = np.sqrt(1 + 4 * energy / (stiffness * unit**2)) - 1
        return stiffness * unit * np.sqrt(square) * (1 + square)
    if law in ("hunt_crossley", "depth_damped"):
        # M v^2/2 = k d^(n+1)/(n+1)
        exponent = np.asarray(contact.exponent)
        depth = ((exponent + 1) * energy / stiffness) ** (1 / (exponent + 1))
        return stiffness * depth**exponent
    if law != "piecewise_linear":
        return np.sqrt(2 * energy * stiffness)
    # Segment by segment: the force F at its beginning becomes sqrt(F^2 + 2 k E) if the energy E ends in it.
    depths = np.asarray(contact.depths)
    slots, segments = stiffness.shape[:2]
    energy = np.broadcast_to(energy, (slots, stiffness.shape[-1]))
    force, begin = np.zeros_like(energy), np.zeros_like(energy)
    for segment in range(segments):
        slope = stiffness[:, segment]
        width = depths[:, segment] - begin if segment < segments - 1 else np.inf
        whole = force * width + slope * width**2 / 2
        spent = np.minimum(whole, energy)
        force = np.sqrt(force**2 + 2 * slope * spent)
        energy, begin = energy - spent, begin + width
    return force


def _span(values: np.ndarray, unit: str) -> dict[str, Any]:
    return {"low": float(np.min(values)), "high": float(np.max(values)), "unit": unit}


def _registered(compensator: str, source: str) -> tuple[Gain, ...]:
    if compensator not in COMPENSATORS:
        raise _refusal(source, "compensator", shown(compensator), f"one of {', '.join(COMPENSATORS)}")
    return COMPENSATORS[compensator].gains


def _same_names(gains: Mapping[str, Any], law: tuple[Gain, ...], source: str) -> None:
    names = [gain.name for gain in law]
    if set(gains) != set(names):
        wrong = sorted(set(gains) ^ set(names))[0]
        found = "an extra gain" if wrong in gains else "nothing"
        raise _refusal(source, one_line(str(wrong), 60), found, ", ".join(names) or "no gains")


def _bounds(gain: Gain, mechanism: Mechanism) -> tuple[float, float]:
    return float(gain.lower(mechanism)), float(gain.upper(mechanism))


def _gain_entry(gain: Gain, value: float, mechanism: Mechanism) -> dict[str, Any]:
    lower, upper = _bounds(gain, mechanism)
    margin = ROUNDING * max(abs(lower), abs(upper))
    number = float(value)
    if not lower - margin <= number <= upper + margin:
        raise _refusal("gains", gain.name, shown(number), f"{lower:.12g} to {upper:.12g} {gain.unit}")
    return {"value": min(max(number, lower), upper), "unit": gain.unit, "lower": lower, "upper": upper}


def _check_entry(gain: Gain, entry: Mapping[str, Any], mechanism: Mechanism, source: str) -> None:
    key = f"gains.{gain.name}"
    if entry["unit"] != gain.unit:
        raise _refusal(source, f"{key}.unit", shown(entry["unit"]), f"'{gain.unit}'")
    lower, upper = _bounds(gain, mechanism)
    margin = ROUNDING * max(abs(lower), abs(upper))
    for bound in ("lower", "upper"):
        if not lower - margin <= entry[bound] <= upper + margin:
            allowed = f"{lower:.12g} to {upper:.12g} for this mechanism"
            raise _refusal(source, f"{key}.{bound}", shown(entry[bound]), allowed)


def _refusal(source: str, key: str, found: str, allowed: str) -> InputError:
    return InputError(f"{source}: {key}: found {found}, allowed {allowed}")


def _is_date(value: object) -> bool:
    try:
        return isinstance(value, str) and datetime.fromisoformat(value).tzinfo is not None
    except ValueError:
        return False


def _is_envelope(value: object) -> bool:
    return isinstance(value, Mapping) and all(
        isinstance(span, Mapping) and {"low", "high", "unit"} <= span.keys() for span in value.values()
    )


def _is_object(value: object) -> bool:
    return isinstance(value, Mapping)


def _is_table_of_texts(value: object) -> bool:
    return isinstance(value, Mapping) and all(isinstance(text, str) for text in value.values())


# Of each further key of a gain file: whether its value will do, and what is allowed.
_REQUIRED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "mechanism_sha256": (
        lambda value: isinstance(value, str) and re.fullmatch("[0-9a-f]{64}", value) is not None,
        "64 hexadecimal digits",
    ),
    "envelope": (_is_envelope, "an object of {low, high, unit} objects"),
    "figures": (_is_object, "an object"),
    "seed": (
        lambda value: isinstance(value, int) and not isinstance(value, bool) and value >= 0,
        "an integer >= 0",
    ),
    "versions": (_is_table_of_texts, "an object of texts"),
    "created": (_is_date, "a date and time with time zone, as 2030-01-31T12:00:00+00:00"),
    "timings": (_is_object, "an object"),
}
