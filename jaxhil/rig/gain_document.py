"""Reader and checks of the entries that one-axis and six-axis gain documents share.

The digest is the SHA-256 of the document's canonical JSON without date, timings and digest. The message of a
`GainFileError` has one line.
"""

import errno
import hashlib
import json
import os
import stat
from collections.abc import Callable, Mapping
from math import inf, isfinite
from typing import Any

from jaxhil.rig.bounds import CONTROL_PERIODS, format_range
from jaxhil.rig.errors import GainFileError, format_value, make_gain_file_error, printable
from jaxhil.rig.limits import Limit
from jaxhil.rig.registry import GainSpecification

SCHEMA = "jaxhil/gains/1"
MAX_FILE_BYTES = 4 * 1024 * 1024  # much larger than any gain file [bytes]
MAX_NESTING = 32  # levels of nested JSON objects and lists; keeps recursive code safe
KEYS_OUTSIDE_DIGEST = ("created", "timings", "sha256")  # keys that the digest does not cover


def digest(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 in hexadecimal of a gain document without `created`, `timings` and `sha256`.

    Args:
        document: content of a gain file.

    Raises:
        TypeError: if the document contains objects that JSON cannot express.
        ValueError: if the document contains numbers that JSON cannot express (NaN, infinity).

    Example:
        >>> digest({"schema": "jaxhil/gains/1"}) == digest({"schema": "jaxhil/gains/1", "created": "now"})
        True
    """
    content = {key: value for key, value in document.items() if key not in KEYS_OUTSIDE_DIGEST}
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def read_gain_document(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the JSON object in a gain file. Raise GainFileError if this is not possible."""
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
            source, "", f"bytes that are not UTF-8 at byte {error.start}", "UTF-8"
        ) from None
    try:
        document = json.loads(text, parse_constant=_no_constant, object_pairs_hook=_unique_keys)
    except RecursionError:
        raise make_gain_file_error(source, "", "deeper nesting", f"at most {MAX_NESTING} levels") from None
    except ValueError as error:
        raise make_gain_file_error(
            source, "", f"not JSON ({error})", f"a JSON object with the schema {SCHEMA}"
        ) from None
    if not isinstance(document, dict):
        raise make_gain_file_error(
            source, "", format_value(document), f"a JSON object with the schema {SCHEMA}"
        )
    return document


def check_form(document: Mapping[str, Any], source: str) -> None:
    """Raise GainFileError if schema, nesting depth or digest of a gain document is wrong."""
    if not isinstance(document, Mapping):
        raise make_gain_file_error(
            source, "", format_value(document), f"a JSON object with the schema {SCHEMA}"
        )
    schema = read_entry(document, "schema", source, "")
    if schema != SCHEMA:
        raise make_gain_file_error(source, "schema", format_value(schema), f"'{SCHEMA}'")
    if not _is_shallow(document):
        raise make_gain_file_error(source, "", "deeper nesting", f"at most {MAX_NESTING} levels")
    stated = read_entry(document, "sha256", source, "")
    try:
        actual = digest(document)
    except (TypeError, ValueError, RecursionError) as error:
        raise make_gain_file_error(source, "", f"an invalid value ({error})", "JSON values") from None
    if stated != actual:
        allowed = f"'{actual}', the digest of its content (was it edited?)"
        raise make_gain_file_error(source, "sha256", format_value(stated, 80), allowed)


def read_control_period(document: Mapping[str, Any], source: str) -> float:
    """Return the control period [s]. Raise GainFileError if it differs from the period in `mechanism`."""
    period = read_number(read_entry(document, "control_period", source, ""), "control_period", source)
    check_within(period, *CONTROL_PERIODS, "control_period", source)
    mechanism = read_object(document, "mechanism", source, "")
    rig = read_object(mechanism, "rig", source, "mechanism.")
    key = "mechanism.rig.control_period"
    if read_number(read_entry(rig, "control_period", source, "mechanism.rig."), key, source) != period:
        allowed = f"{rig['control_period']!r}, as {key} says"
        raise make_gain_file_error(source, "control_period", format_value(period), allowed)
    return period


def read_gains(
    document: Mapping[str, Any], law: str, specifications: Mapping[str, GainSpecification], source: str
) -> dict[str, float]:
    """Return the gains of a document by name. Raise GainFileError if one is missing or out of bounds."""
    entries = read_object(document, "gains", source, "")
    for name in entries:
        if name not in specifications:
            allowed = ", ".join(specifications) or "no gains"
            raise make_gain_file_error(source, "gains", f"an extra gain {format_value(name)}", allowed)
    gains = {}
    for name, specification in specifications.items():
        if name not in entries:
            allowed = f"all gains of {law} (for a file of an earlier version, run `jaxhil tune` again)"
            raise make_gain_file_error(source, f"gains.{name}", "nothing", allowed)
        entry = read_object(entries, name, source, "gains.")
        prefix = f"gains.{name}."
        unit = read_entry(entry, "unit", source, prefix)
        if unit != specification.unit:
            raise make_gain_file_error(source, f"{prefix}unit", format_value(unit), f"'{specification.unit}'")
        value, lower, upper = (
            read_number(read_entry(entry, key, source, prefix), prefix + key, source)
            for key in ("value", "lower", "upper")
        )
        check_within(value, lower, upper, f"{prefix}value", source)
        check_within(value, specification.lowest, specification.highest, f"{prefix}value", source)
        gains[name] = value
    return gains


def read_limits(
    document: Mapping[str, Any],
    source: str,
    table: Mapping[str, Limit],
    complete: Callable[[Mapping[str, float]], dict[str, float]],
) -> dict[str, float]:
    """Check and return the limits of a gain document, including defaults.

    Args:
        document: content of a gain file.
        source: name of the document in error messages.
        table: all limits by name.
        complete: function that adds the defaults, and raises ValueError if two limits contradict each other.
    """
    limits = {}
    entries = read_object(document, "limits", source, "") if "limits" in document else {}
    for name, entry in entries.items():
        if name not in table:
            raise make_gain_file_error(
                source, "limits", f"an unknown limit {format_value(name)}", ", ".join(table)
            )
        specification = table[name]
        prefix = f"limits.{name}."
        if not isinstance(entry, Mapping):
            raise make_gain_file_error(source, prefix[:-1], format_value(entry), "an object")
        unit = read_entry(entry, "unit", source, prefix)
        if unit != specification.unit:
            raise make_gain_file_error(source, f"{prefix}unit", format_value(unit), f"'{specification.unit}'")
        value = read_entry(entry, "value", source, prefix)
        if value is None:
            continue
        limits[name] = read_number(value, f"{prefix}value", source)
        check_within(limits[name], specification.lowest, specification.highest, f"{prefix}value", source)
    try:
        return complete(limits)
    except ValueError as error:
        raise make_gain_file_error(source, "limits", str(error), "consistent limits") from None


def read_entry(mapping: Mapping[str, Any], key: str, source: str, prefix: str) -> Any:
    """Return `mapping[key]`. Raise GainFileError if this entry is missing."""
    if key not in mapping:
        raise make_gain_file_error(source, prefix + key, "nothing", "a value")
    return mapping[key]


def read_object(mapping: Mapping[str, Any], key: str, source: str, prefix: str) -> Mapping[str, Any]:
    """Return `mapping[key]`. Raise GainFileError if this entry is missing or not a JSON object."""
    value = read_entry(mapping, key, source, prefix)
    if not isinstance(value, Mapping):
        raise make_gain_file_error(source, prefix + key, format_value(value), "an object")
    return value


def read_number(value: object, key: str, source: str) -> float:
    """Convert a value to a float. Raise GainFileError if it is not a finite number."""
    # In Python, bool is a subclass of int. A JSON integer may be too large for a float.
    if not isinstance(value, bool) and isinstance(value, (int, float)):
        try:
            number = float(value)
        except OverflowError:
            number = inf
        if isfinite(number):
            return number
    raise make_gain_file_error(source, key, format_value(value), "a finite number")


def check_within(value: float, lowest: float, highest: float, key: str, source: str) -> None:
    """Raise GainFileError unless a value is within its bounds."""
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
