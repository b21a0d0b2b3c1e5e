"""Reader of mechanism files: bytes, TOML, overrides and validation.

`load` reads a one-axis mechanism file or a built-in mechanism, applies the ``PATH=VALUE`` overrides of
``--set``, removes the keys of ``--unset``, and returns a validated `Mechanism`. `load_any` also reads
six-axis files. Every error raises `InputError` with a one-line message.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.mechanism import rules as mechanism_rules
from jaxhil.mechanism.conversion import KeyProblem, suggest_names, to_mechanism, to_struct
from jaxhil.mechanism.overrides import apply_override, parse_override
from jaxhil.mechanism.six_axes import SIX_AXIS_SCHEMA, AnyMechanism, SixAxisMechanism, is_six_axes
from jaxhil.mechanism.six_axes_rules import check_contact_names, check_leg_values, check_six_axes
from jaxhil.mechanism.structs import SCHEMA, Mechanism
from jaxhil.mechanism.toml_table import parse_toml, read_bytes

__all__ = [
    "DEFAULT_MECHANISM",
    "AnyMechanism",
    "LoadedAnyMechanism",
    "LoadedMechanism",
    "any_from_plain_data",
    "builtin_names",
    "builtin_path",
    "from_plain_data",
    "load",
    "load_any",
    "six_axis_names",
    "source_sha256",
    "suite_names",
    "to_plain_data",
]

DEFAULT_MECHANISM = "varying"

Overrides = Sequence[str] | Mapping[str, Any]
MechanismType = TypeVar("MechanismType", Mechanism, AnyMechanism)

MAX_PROBLEMS = 20  # maximum number of invalid keys of a file in a message
SUITE_PREFIX = "suite-"  # prefix of the names of the mechanisms for benchmarks

_SIX_INFINITIES = [math.inf] * 6  # default of limits for six axes
# SHA-256 of the file from which a mechanism was read; the key is the SHA-256 of the mechanism's content
_file_hashes: dict[str, str] = {}

_BUILTIN_FOLDER = Path(__file__).parent / "builtin"
_SIX_AXIS_FOLDER = _BUILTIN_FOLDER / "six_axes"


class LoadedMechanism(NamedTuple):
    """Validated one-axis mechanism, with hash and name of its file."""

    mechanism: Mechanism
    sha256: str  # SHA-256 of the file's bytes, in hexadecimal digits
    label: str  # printable name of the file, for messages


class LoadedAnyMechanism(NamedTuple):
    """Validated one-axis or six-axis mechanism, with the fields of `LoadedMechanism`."""

    mechanism: AnyMechanism
    sha256: str
    label: str


def load(
    path_or_name: str | os.PathLike[str] | None = None, overrides: Overrides = (), unset: Sequence[str] = ()
) -> LoadedMechanism:
    """Load and validate a one-axis mechanism from a TOML file, or a built-in mechanism by its name.

    Args:
        path_or_name: path of a file, name of a built-in mechanism, or None for the default one.
        overrides: ``PATH=VALUE`` texts as for ``--set``, applied in order before validation. PATH is a dotted
            TOML key, possibly with an index (``contact.stiffness[1]``); VALUE is a TOML value, or a bare word
            for a string. A table as VALUE replaces the whole table. Alternatively, a mapping from PATH to a
            Python value, where the value None removes the key.
        unset: PATHs of keys to remove afterwards, as for ``--unset``.

    Returns:
        The mechanism, with hash and name of its file.

    Raises:
        InputError: if the file or a change is invalid, or the mechanism has six axes. The message has one
            line for each invalid key.
    """
    raw, sha256, label = _read_table(path_or_name)
    _check_one_axis(raw, label)
    mechanism = _convert_table(raw, label, overrides, unset, MAX_PROBLEMS)
    assert isinstance(mechanism, Mechanism)
    return LoadedMechanism(_store_file_hash(mechanism, sha256), sha256, label)


def load_any(
    path_or_name: str | os.PathLike[str] | None = None, overrides: Overrides = (), unset: Sequence[str] = ()
) -> LoadedAnyMechanism:
    """Load and validate a one-axis or six-axis mechanism; for the arguments, see `load`."""
    raw, sha256, label = _read_table(path_or_name)
    mechanism = _convert_table(raw, label, overrides, unset, MAX_PROBLEMS)
    return LoadedAnyMechanism(_store_file_hash(mechanism, sha256), sha256, label)


def source_sha256(mechanism: AnyMechanism) -> str:
    """Return the hexadecimal SHA-256 of a mechanism's file, or of its content if it comes from no file."""
    content = _content_sha256(mechanism)
    return _file_hashes.get(content, content)


def from_plain_data(
    raw: Mapping[str, Any], label: str, overrides: Overrides = (), unset: Sequence[str] = ()
) -> Mechanism:
    """Convert plain data, such as a parsed TOML or JSON table, to a validated one-axis mechanism.

    `label` names the source in messages; for `overrides` and `unset`, see `load`. Raise `InputError` if the
    data are invalid or describe a six-axis mechanism.
    """
    _check_one_axis(raw, label)
    mechanism = any_from_plain_data(raw, label, overrides, unset)
    assert isinstance(mechanism, Mechanism)
    return mechanism


def any_from_plain_data(
    raw: Mapping[str, Any], label: str, overrides: Overrides = (), unset: Sequence[str] = ()
) -> AnyMechanism:
    """Convert plain data to a validated one-axis or six-axis mechanism, as `from_plain_data` does."""
    return _convert_table(raw, label, overrides, unset, 1)


def _check_one_axis(raw: Mapping[str, Any], label: str) -> None:
    """Raise `InputError` if a parsed table describes a six-axis mechanism."""
    if is_six_axes(raw):
        expected = f"{SCHEMA}, because this command or function supports one axis only"
        raise InputError(
            f"{to_one_line(label)}: schema: found {SIX_AXIS_SCHEMA} (six axes), expected {expected}"
        )


def _convert_table(
    raw: Mapping[str, Any], label: str, overrides: Overrides, unset: Sequence[str], problems: int
) -> AnyMechanism:
    """Apply the requested changes to a parsed table and convert the table to a mechanism.

    Raise `InputError` if a key is invalid. The message has one line for each invalid key, at most `problems`.
    """
    changed, label = raw, to_one_line(label)
    all_changes = _requested_changes(overrides, unset)
    for option, changes in all_changes.items():
        for change in changes:
            try:
                changed = apply_override(changed, *parse_override(change))
            except KeyProblem as problem:
                raise InputError(f"{label}: {option} {_format_change(change)}: {problem}") from None
    try:
        return _validate(changed)
    except KeyProblem as problem:
        options = "" if str(problem) == _find_problem(raw) else _format_changes(all_changes)
        lines = [f"{label}{options}: {invalid}" for invalid in (problem, *problem.further)]
        raise InputError("\n".join(lines[:problems])) from None


def to_plain_data(mechanism: AnyMechanism) -> dict[str, Any]:
    """Convert a mechanism to plain data for JSON; `from_plain_data` converts the data back.

    The data omit keys whose value is None or infinite, because None or infinity is their default.
    """
    return _drop_empty(msgspec.to_builtins(mechanism))


def builtin_names() -> list[str]:
    """Return the names of the built-in one-axis mechanisms, except the mechanisms of `suite_names`."""
    return [name for name in _builtin_paths() if not name.startswith(SUITE_PREFIX)]


def suite_names() -> list[str]:
    """Return the names of the built-in mechanisms for comparing compensators.

    All these mechanisms have the same rig. Each mechanism adds one difficulty, such as a dead zone of the
    force sensor.
    """
    return [name for name in _builtin_paths() if name.startswith(SUITE_PREFIX)]


def six_axis_names() -> list[str]:
    """Return the names of the built-in six-axis mechanisms."""
    return sorted(path.stem for path in _SIX_AXIS_FOLDER.glob("*.toml"))


def builtin_path(name: str) -> Path:
    """Return the path of a built-in mechanism. Raise `InputError` for an unknown name."""
    names = [*builtin_names(), *suite_names(), *six_axis_names()]
    if name not in names:
        raise InputError(
            f"{to_one_line(name)}: found no built-in mechanism of this name, "
            f"expected one of {', '.join(names)}{suggest_names(name, names)}"
        )
    return (_SIX_AXIS_FOLDER if name in six_axis_names() else _BUILTIN_FOLDER) / f"{name}.toml"


def _read_table(path_or_name: str | os.PathLike[str] | None) -> tuple[dict[str, Any], str, str]:
    """Return the parsed table of a mechanism file, the SHA-256 of its bytes, and its printable name."""
    name = DEFAULT_MECHANISM if path_or_name is None else path_or_name
    if isinstance(name, str) and name in (*builtin_names(), *suite_names(), *six_axis_names()):
        path, label = builtin_path(name), name
    else:
        path, label = Path(name), to_one_line(str(name)) or "''"
    try:
        data = read_bytes(path, label, "a mechanism")
    except FileNotFoundError:
        raise _make_missing_error(label) from None
    return parse_toml(data, label, "a mechanism"), hashlib.sha256(data).hexdigest(), label


def _store_file_hash(mechanism: MechanismType, sha256: str) -> MechanismType:
    """Store the SHA-256 of the mechanism's file for `source_sha256`; return the mechanism unchanged."""
    _file_hashes[_content_sha256(mechanism)] = sha256
    return mechanism


def _content_sha256(mechanism: AnyMechanism) -> str:
    content = json.dumps(to_plain_data(mechanism), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(content.encode()).hexdigest()


def _builtin_paths() -> list[str]:
    return sorted(path.stem for path in _BUILTIN_FOLDER.glob("*.toml"))


def _make_missing_error(label: str) -> InputError:
    names = [*builtin_names(), *six_axis_names()]
    hint = suggest_names(label, [*names, *suite_names()]) or f" (built-in: {', '.join(names)})"
    return InputError(f"{label}: found no such file, expected a mechanism file{hint}")


def _validate(raw: Mapping[str, Any]) -> AnyMechanism:
    """Convert a parsed table to a mechanism and check all rules. Raise `KeyProblem` for an invalid key."""
    if is_six_axes(raw):
        check_contact_names(raw)
        six_axis_mechanism = to_struct(SixAxisMechanism, raw)
        check_leg_values(raw)
        check_six_axes(six_axis_mechanism)
        return six_axis_mechanism
    if isinstance(raw, Mapping) and raw.get("schema", SCHEMA) != SCHEMA:
        raise KeyProblem(
            ("schema",), format_value(raw["schema"]), f"{SCHEMA}, or {SIX_AXIS_SCHEMA} for six axes"
        )
    if isinstance(raw, Mapping) and {"target", "chaser"} <= set(raw):
        found = format_value(raw["schema"]) if "schema" in raw else "no schema"
        expected = f"{SIX_AXIS_SCHEMA}, because target and chaser are six-axis keys"
        raise KeyProblem(("schema",), f"{found} with the tables target and chaser", expected)
    mechanism = mechanism_rules.resolve_damping_ratio(to_mechanism(raw))
    mechanism_rules.check_mechanism_rules(mechanism)
    return mechanism


def _find_problem(raw: Mapping[str, Any]) -> str:
    """Return the message about the first invalid key of a parsed table, or an empty text."""
    try:
        _validate(raw)
    except KeyProblem as problem:
        return str(problem)
    return ""


def _requested_changes(overrides: Overrides, unset: Sequence[str]) -> dict[str, list[Any]]:
    """Return the lists of changes to a mechanism, each under the name of the option that requests it."""
    is_mapping = isinstance(overrides, Mapping)
    return {
        "overrides" if is_mapping else "--set": list(overrides.items() if is_mapping else overrides),
        "--unset": [(path, None) for path in unset],
    }


def _format_changes(all_changes: Mapping[str, Sequence[Any]]) -> str:
    """Format the first three changes of each option for a message."""
    options = [
        " ".join([option, *map(_format_change, changes[:3]), *["..."][: len(changes) > 3]])
        for option, changes in all_changes.items()
        if changes
    ]
    return f": {' '.join(options)}" if options else ""


def _format_change(change: object) -> str:
    """Return a change as text for a message: the change itself or, for a pair (key, value), the key."""
    text = change[0] if isinstance(change, tuple) else change
    return to_one_line(text, 60) if isinstance(text, str) else format_value(text)


def _drop_empty(value: Any) -> Any:
    """Return plain data without the keys whose value is None or infinite."""
    if isinstance(value, dict):
        entries = {key: _drop_empty(entry) for key, entry in value.items()}
        return {
            key: entry for key, entry in entries.items() if entry not in (None, math.inf, _SIX_INFINITIES)
        }
    return value
