"""Reader of gain files: returns checked values or raises a `GainFileError` with a message of one line.

The reader first checks the form (JSON, schema, digest), then the content (compensator, gains, units, bounds,
control period). The digest is the SHA-256 of the document's canonical JSON without date, timings and digest.
A digest does not prevent edits, because anyone can recompute it. Therefore gains must be within the bounds in
the file and in the code (`bounds`), and limits within the bounds in the code.
"""

import errno
import hashlib
import json
import os
import stat
from collections.abc import Mapping
from math import inf, isfinite
from typing import Any, NamedTuple

from jaxhil.rig.bounds import CONTROL_PERIODS, DISTANCES, format_range
from jaxhil.rig.errors import GainFileError, format_value, make_gain_file_error, printable
from jaxhil.rig.limits import LIMITS, NO_LIMITS, complete_limits
from jaxhil.rig.registry import COMPENSATORS, GainSpecification

SCHEMA = "jaxhil/gains/1"
MAX_FILE_BYTES = 4 * 1024 * 1024  # bytes; much larger than any gain file
MAX_NESTING = 32  # levels of nested JSON objects and lists; keeps recursive code safe
KEYS_OUTSIDE_DIGEST = ("created", "timings", "sha256")  # keys that the digest does not cover
RETIRED_COMPENSATORS = ("retrospective_reference", "retrospective_delay_bank")  # replaced by `impulse_ledger`
NO_FURTHER_GAINS: Mapping[str, Mapping[str, GainSpecification]] = {}


class GainFile(NamedTuple):
    """Checked values of a gain file that the controller needs."""

    compensator: str  # name of the compensator
    gains: Mapping[str, float]  # gains by name, in SI units
    control_period: float  # control period [s]
    clearance: float  # clearance of a two-sided contact [m]; infinite for a one-sided contact
    limits: Mapping[str, float] = NO_LIMITS  # limits by name, in SI units


def digest(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 in hexadecimal of a gain document without `created`, `timings` and `sha256`.

    Args:
        document: content of a gain file.

    Raises:
        TypeError: if the document has objects that JSON cannot express.
        ValueError: if the document has numbers that JSON cannot express (NaN, infinity).

    Example:
        >>> digest({"schema": "jaxhil/gains/1"}) == digest({"schema": "jaxhil/gains/1", "created": "now"})
        True
    """
    content = {key: value for key, value in document.items() if key not in KEYS_OUTSIDE_DIGEST}
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def read_gain_document(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the JSON object in a gain file. Raise GainFileError if the file has none or is unreadable."""
    source = os.fspath(path)
    try:
        mode = os.stat(source).st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            # Reading a pipe waits for its writer, and a device may never end.
            raise OSError(errno.EINVAL, "found a pipe or a device, expected a plain file")
        with open(source, "rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise GainFileError(printable(f"{source}: cannot be read: {reason}")) from None
    if len(content) > MAX_FILE_BYTES:
        raise make_gain_file_error(source, "", "a larger file", f"at most {MAX_FILE_BYTES} bytes")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise make_gain_file_error(
            source, "", f"bytes that are not UTF-8 at {error.start}", "UTF-8"
        ) from None
    try:
        document = json.loads(text, parse_constant=_no_constant, object_pairs_hook=_unique_keys)
    except RecursionError:
        raise make_gain_file_error(source, "", "deeper nesting", f"at most {MAX_NESTING} levels") from None
    except ValueError as error:
        raise make_gain_file_error(source, "", f"not JSON ({error})", f"a JSON object, {SCHEMA}") from None
    if not isinstance(document, dict):
        raise make_gain_file_error(source, "", format_value(document), f"a JSON object, {SCHEMA}")
    return document


def check_gain_document(
    document: Mapping[str, Any],
    source: str = "gain document",
    others: Mapping[str, Mapping[str, GainSpecification]] = NO_FURTHER_GAINS,
    axes: tuple[int, ...] = (1,),
) -> GainFile:
    """Check a gain document and return the values that the controller needs.

    Args:
        document: content of a gain file.
        source: name of the document in error messages.
        others: gain specifications of compensators that can only be simulated, by compensator name. They
            take precedence over those of the registered compensators.
        axes: accepted numbers of axes.

    Raises:
        GainFileError: if the document is invalid.
    """
    _check_form(document, source)
    number = document.get("axes", 1)
    if number not in axes:
        allowed = f"{' or '.join(map(str, axes))}: gains of six axes are simulated only so far"
        raise make_gain_file_error(source, "axes", format_value(number), allowed)
    name = _entry(document, "compensator", source, "")
    if name in RETIRED_COMPENSATORS:
        message = f"compensator: found {format_value(name)}, expected 'impulse_ledger', which replaces it"
        raise GainFileError(printable(f"{source}: {message}"))
    specifications = {**{law: compensator.gains for law, compensator in COMPENSATORS.items()}, **others}
    if not isinstance(name, str) or name not in specifications:
        raise make_gain_file_error(
            source, "compensator", format_value(name), f"one of {', '.join(specifications)}"
        )
    gains = _gains(document, name, specifications[name], source)
    period = _number(_entry(document, "control_period", source, ""), "control_period", source)
    _check_within(period, *CONTROL_PERIODS, "control_period", source)
    mechanism = _object(document, "mechanism", source, "")
    rig = _object(mechanism, "rig", source, "mechanism.")
    key = "mechanism.rig.control_period"
    if _number(_entry(rig, "control_period", source, "mechanism.rig."), key, source) != period:
        allowed = f"{rig['control_period']!r}, as {key} says"
        raise make_gain_file_error(source, "control_period", format_value(period), allowed)
    contact = _object(mechanism, "contact", source, "mechanism.") if number == 1 else {}
    clearance = inf
    if "clearance" in contact:
        clearance = _number(contact["clearance"], "mechanism.contact.clearance", source)
        _check_within(clearance, *DISTANCES, "mechanism.contact.clearance", source)
    return GainFile(name, gains, period, clearance, _limits(document, source))


def _check_form(document: Mapping[str, Any], source: str) -> None:
    if not isinstance(document, Mapping):
        raise make_gain_file_error(source, "", format_value(document), f"a JSON object, {SCHEMA}")
    schema = _entry(document, "schema", source, "")
    if schema != SCHEMA:
        raise make_gain_file_error(source, "schema", format_value(schema), f"'{SCHEMA}'")
    if not _is_shallow(document):
        raise make_gain_file_error(source, "", "deeper nesting", f"at most {MAX_NESTING} levels")
    stated = _entry(document, "sha256", source, "")
    try:
        actual = digest(document)
    except (TypeError, ValueError, RecursionError) as error:
        raise make_gain_file_error(source, "", f"a value not of JSON ({error})", "JSON values") from None
    if stated != actual:
        allowed = f"'{actual}', the digest of its content (was it edited?)"
        raise make_gain_file_error(source, "sha256", format_value(stated, 80), allowed)


def _gains(
    document: Mapping[str, Any], law: str, specifications: Mapping[str, GainSpecification], source: str
) -> dict[str, float]:
    entries = _object(document, "gains", source, "")
    for name in entries:
        if name not in specifications:
            allowed = ", ".join(specifications) or "no gains"
            raise make_gain_file_error(source, "gains", f"an extra gain {format_value(name)}", allowed)
    gains = {}
    for name, specification in specifications.items():
        if name not in entries:
            allowed = f"all gains of {law} (for a file of an earlier version, run `jaxhil tune` again)"
            raise make_gain_file_error(source, f"gains.{name}", "nothing", allowed)
        entry = _object(entries, name, source, "gains.")
        prefix = f"gains.{name}."
        unit = _entry(entry, "unit", source, prefix)
        if unit != specification.unit:
            raise make_gain_file_error(source, f"{prefix}unit", format_value(unit), f"'{specification.unit}'")
        value, lower, upper = (
            _number(_entry(entry, key, source, prefix), prefix + key, source)
            for key in ("value", "lower", "upper")
        )
        _check_within(value, lower, upper, f"{prefix}value", source)
        _check_within(value, specification.lowest, specification.highest, f"{prefix}value", source)
        gains[name] = value
    return gains


def _limits(document: Mapping[str, Any], source: str) -> dict[str, float]:
    if "limits" not in document:
        return dict(NO_LIMITS)
    limits = {}
    for name, entry in _object(document, "limits", source, "").items():
        if name not in LIMITS:
            raise make_gain_file_error(
                source, "limits", f"an unknown limit {format_value(name)}", ", ".join(LIMITS)
            )
        specification = LIMITS[name]
        prefix = f"limits.{name}."
        if not isinstance(entry, Mapping):
            raise make_gain_file_error(source, prefix[:-1], format_value(entry), "an object")
        unit = _entry(entry, "unit", source, prefix)
        if unit != specification.unit:
            raise make_gain_file_error(source, f"{prefix}unit", format_value(unit), f"'{specification.unit}'")
        value = _entry(entry, "value", source, prefix)
        if value is None:
            continue
        limits[name] = _number(value, f"{prefix}value", source)
        _check_within(limits[name], specification.lowest, specification.highest, f"{prefix}value", source)
    try:
        return complete_limits(limits)
    except ValueError as error:
        raise make_gain_file_error(source, "limits", str(error), "consistent limits") from None


def _entry(mapping: Mapping[str, Any], key: str, source: str, prefix: str) -> Any:
    if key not in mapping:
        raise make_gain_file_error(source, prefix + key, "nothing", "a value")
    return mapping[key]


def _object(mapping: Mapping[str, Any], key: str, source: str, prefix: str) -> Mapping[str, Any]:
    value = _entry(mapping, key, source, prefix)
    if not isinstance(value, Mapping):
        raise make_gain_file_error(source, prefix + key, format_value(value), "an object")
    return value


def _number(value: object, key: str, source: str) -> float:
    # In Python, bool is a subclass of int. An integer in JSON may be too large for a float.
    if not isinstance(value, bool) and isinstance(value, (int, float)):
        try:
            number = float(value)
        except OverflowError:
            number = inf
        if isfinite(number):
            return number
    raise make_gain_file_error(source, key, format_value(value), "a finite number")


def _check_within(value: float, lowest: float, highest: float, key: str, source: str) -> None:
    if not lowest <= value <= highest:
        raise make_gain_file_error(source, key, format_value(value), format_range(lowest, highest))


def _is_shallow(document: Mapping[str, Any]) -> bool:
    level: list[Any] = [document]
    for _ in range(MAX_NESTING):
        deeper: list[Any] = []
        for value in level:
            if isinstance(value, Mapping):
                deeper.extend(value.values())
            elif isinstance(value, (list, tuple)):
                deeper.extend(value)
        if not deeper:
            return True
        level = deeper
    return False


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) != len(pairs):
        raise ValueError("a key occurs twice in one object")
    return entries
