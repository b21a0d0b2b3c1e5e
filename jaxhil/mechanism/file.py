"""Reading a mechanism file: bytes, TOML, overrides, validation.

`load` turns a file (or the name of a built-in one or suite), the ``PATH=VALUE`` overrides of ``--set`` and
the keys that ``--unset`` takes out into a validated `Mechanism`; `load_any` takes files of six axes as well.
Whatever is wrong with them raises `InputError` with one line.
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

from jaxhil.errors import InputError, one_line, shown
from jaxhil.mechanism import rules as mechanism_rules
from jaxhil.mechanism.conversion import KeyProblem, close_match, to_mechanism, to_struct
from jaxhil.mechanism.overrides import apply_override, parse_override
from jaxhil.mechanism.six_axes import SCHEMA_SIX, SixAxisMechanism, is_six_axes
from jaxhil.mechanism.six_axes_rules import check_legs, check_named, check_six_axes
from jaxhil.mechanism.structs import SCHEMA, Mechanism
from jaxhil.mechanism.toml_table import parse_toml, read_bytes

__all__ = [
    "DEFAULT",
    "AnyMechanism",
    "LoadedAny",
    "LoadedMechanism",
    "any_from_builtins",
    "builtin_names",
    "builtin_path",
    "from_builtins",
    "load",
    "load_any",
    "six_axis_names",
    "source_sha256",
    "suite_names",
    "to_builtins",
]

DEFAULT = "varying"

Overrides = Sequence[str] | Mapping[str, Any]
AnyMechanism = Mechanism | SixAxisMechanism
Kind = TypeVar("Kind", Mechanism, AnyMechanism)

SUITE = "suite-"  # begins the names of the standard suites

_UNLIMITED = [math.inf] * 6  # six numbers that are the default of their key
_sources: dict[str, str] = {}  # digests of the files read, by those of what was read

_FOLDER = Path(__file__).parent / "builtin"
_SIX_AXES = _FOLDER / "six_axes"


class LoadedMechanism(NamedTuple):
    """A validated mechanism, the SHA-256 of its file's bytes in hex, and what to call the file."""

    mechanism: Mechanism
    sha256: str
    label: str


class LoadedAny(NamedTuple):
    """A validated mechanism of one axis or of six; else as `LoadedMechanism`."""

    mechanism: AnyMechanism
    sha256: str
    label: str


def load(
    path_or_name: str | os.PathLike[str] | None = None, overrides: Overrides = (), unset: Sequence[str] = ()
) -> LoadedMechanism:
    """The mechanism of a TOML file or of a built-in's name (`None`: the default built-in), of one axis.

    `overrides` are ``PATH=VALUE`` texts as given to ``--set``, applied in order before validation:
    PATH a dotted TOML key, possibly with an index (``contact.stiffness[1]``), VALUE a TOML value; a
    bare word is a string. A table given as VALUE replaces the one there. A mapping of PATH to the value
    itself does the same, and takes out the key whose value is None. `unset` are PATHs as given to
    ``--unset``, keys that are then taken out.

    Raises `InputError`, one line, for whatever is wrong, and for a mechanism of six axes.
    """
    raw, sha256, label = _read(path_or_name)
    return LoadedMechanism(_noted(from_builtins(raw, label, overrides, unset), sha256), sha256, label)


def load_any(
    path_or_name: str | os.PathLike[str] | None = None, overrides: Overrides = (), unset: Sequence[str] = ()
) -> LoadedAny:
    """Like `load`, of one axis or of six."""
    raw, sha256, label = _read(path_or_name)
    return LoadedAny(_noted(any_from_builtins(raw, label, overrides, unset), sha256), sha256, label)


def source_sha256(mechanism: AnyMechanism) -> str:
    """SHA-256 in hex of the file that an equal mechanism was read from, or of its content if it was not read
    from any."""
    content = _content_sha256(mechanism)
    return _sources.get(content, content)


def from_builtins(
    raw: Mapping[str, Any], label: str, overrides: Overrides = (), unset: Sequence[str] = ()
) -> Mechanism:
    """The validated mechanism of plain data, such as a parsed TOML or JSON table, changed as by `load`.

    `label` is what an error calls its source. Raises `InputError`, for a mechanism of six axes too.
    """
    if is_six_axes(raw):
        allowed = f"{SCHEMA}: six axes are known to init, mechanisms, simulate, tune, sweep and report"
        raise InputError(f"{one_line(label)}: schema: found {SCHEMA_SIX}, six axes, allowed {allowed}")
    mechanism = any_from_builtins(raw, label, overrides, unset)
    assert isinstance(mechanism, Mechanism)
    return mechanism


def any_from_builtins(
    raw: Mapping[str, Any], label: str, overrides: Overrides = (), unset: Sequence[str] = ()
) -> AnyMechanism:
    """Like `from_builtins`, of one axis or of six, as the schema says."""
    changed, label = raw, one_line(label)
    given = _given(overrides, unset)
    for option, changes in given.items():
        for change in changes:
            try:
                changed = apply_override(changed, *parse_override(change))
            except KeyProblem as problem:
                raise InputError(f"{label}: {option} {_short(change)}: {problem}") from None
    try:
        return _validated(changed)
    except KeyProblem as problem:
        blamed = "" if str(problem) == _problem_of(raw) else _listed(given)
        raise InputError(f"{label}{blamed}: {problem}") from None


def to_builtins(mechanism: AnyMechanism) -> dict[str, Any]:
    """The mechanism as plain data fit for JSON; `from_builtins` makes an equal mechanism of it.

    Keys without a value and infinite numbers are left out: both are the defaults of their keys.
    """
    return _without_empty(msgspec.to_builtins(mechanism))


def builtin_names() -> list[str]:
    """The names of the built-in mechanism files of one axis, the standard suites apart."""
    return [name for name in _names() if not name.startswith(SUITE)]


def suite_names() -> list[str]:
    """The names of the standard suites: built-in mechanism files on which compensators are compared, each
    with one difficulty, drawn from the same rig."""
    return [name for name in _names() if name.startswith(SUITE)]


def six_axis_names() -> list[str]:
    """The names of the built-in mechanism files of six axes."""
    return sorted(path.stem for path in _SIX_AXES.glob("*.toml"))


def builtin_path(name: str) -> Path:
    """The file of a built-in mechanism or suite. Raises `InputError` for an unknown name."""
    names = [*builtin_names(), *suite_names(), *six_axis_names()]
    if name not in names:
        raise InputError(
            f"{one_line(name)}: found no built-in mechanism of this name, "
            f"allowed {', '.join(names)}{close_match(name, names)}"
        )
    return (_SIX_AXES if name in six_axis_names() else _FOLDER) / f"{name}.toml"


def _read(path_or_name: str | os.PathLike[str] | None) -> tuple[dict[str, Any], str, str]:
    """The table of a file, the digest of its bytes, and what to call it."""
    name = DEFAULT if path_or_name is None else path_or_name
    if isinstance(name, str) and name in (*builtin_names(), *suite_names(), *six_axis_names()):
        path, label = builtin_path(name), name
    else:
        path, label = Path(name), one_line(str(name)) or "''"
    try:
        data = read_bytes(path, label, "a mechanism")
    except FileNotFoundError:
        raise _missing(label) from None
    return parse_toml(data, label, "a mechanism"), hashlib.sha256(data).hexdigest(), label


def _noted(mechanism: Kind, sha256: str) -> Kind:
    """The mechanism, its content's digest kept with that of its file."""
    _sources[_content_sha256(mechanism)] = sha256
    return mechanism


def _content_sha256(mechanism: AnyMechanism) -> str:
    content = json.dumps(to_builtins(mechanism), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(content.encode()).hexdigest()


def _names() -> list[str]:
    return sorted(path.stem for path in _FOLDER.glob("*.toml"))


def _missing(label: str) -> InputError:
    names = [*builtin_names(), *six_axis_names()]
    hint = close_match(label, [*names, *suite_names()]) or f" (built-in: {', '.join(names)})"
    return InputError(f"{label}: found no such file, allowed a mechanism file{hint}")


def _validated(raw: Mapping[str, Any]) -> AnyMechanism:
    if is_six_axes(raw):
        check_named(raw)
        in_space = to_struct(SixAxisMechanism, raw)
        check_legs(raw)
        check_six_axes(in_space)
        return in_space
    if isinstance(raw, Mapping) and raw.get("schema", SCHEMA) != SCHEMA:
        raise KeyProblem(("schema",), shown(raw["schema"]), f"{SCHEMA}, or {SCHEMA_SIX} of six axes")
    if isinstance(raw, Mapping) and {"target", "chaser"} <= set(raw):
        found = f"{shown(raw['schema'])} beside" if "schema" in raw else "nothing beside"
        raise KeyProblem(("schema",), f"{found} target and chaser", f"{SCHEMA_SIX}, of six axes")
    mechanism = to_mechanism(raw)
    mechanism_rules.check(mechanism)
    return mechanism


def _problem_of(raw: Mapping[str, Any]) -> str:
    try:
        _validated(raw)
    except KeyProblem as problem:
        return str(problem)
    return ""


def _given(overrides: Overrides, unset: Sequence[str]) -> dict[str, list[Any]]:
    """The changes that are asked for, by what they are called where they are given: on the command line, or
    as an argument."""
    named = isinstance(overrides, Mapping)
    return {
        "overrides" if named else "--set": list(overrides.items() if named else overrides),
        "--unset": [(path, None) for path in unset],
    }


def _listed(given: Mapping[str, Sequence[Any]]) -> str:
    options = [
        " ".join([option, *map(_short, changes[:3]), *["..."][: len(changes) > 3]])
        for option, changes in given.items()
        if changes
    ]
    return f": {' '.join(options)}" if options else ""


def _short(given: object) -> str:
    """A change by its text, or by its key."""
    given = given[0] if isinstance(given, tuple) else given
    return one_line(given, 60) if isinstance(given, str) else shown(given)


def _without_empty(value: Any) -> Any:
    if isinstance(value, dict):
        entries = {key: _without_empty(entry) for key, entry in value.items()}
        return {key: entry for key, entry in entries.items() if entry not in (None, math.inf, _UNLIMITED)}
    return value
