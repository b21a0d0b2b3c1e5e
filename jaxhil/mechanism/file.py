"""Reading a mechanism file: bytes, TOML, overrides, validation.

`load` turns a file (or the name of a built-in one or suite), the ``PATH=VALUE`` overrides of ``--set`` and
the keys that ``--unset`` takes out into a validated `Mechanism`. Whatever is wrong with them raises
`InputError` with one line.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from jaxhil.errors import InputError, one_line, shown
from jaxhil.mechanism import rules as mechanism_rules
from jaxhil.mechanism.conversion import KeyProblem, close_match, to_mechanism
from jaxhil.mechanism.overrides import apply_override, parse_override
from jaxhil.mechanism.structs import Mechanism

__all__ = [
    "DEFAULT",
    "LoadedMechanism",
    "builtin_names",
    "builtin_path",
    "from_builtins",
    "load",
    "source_sha256",
    "suite_names",
    "to_builtins",
]

DEFAULT = "varying"
MAX_BYTES = 1 << 20
MAX_KEY_PARTS = 64

Overrides = Sequence[str] | Mapping[str, Any]

SUITE = "suite-"  # begins the names of the standard suites

_sources: dict[str, str] = {}  # digests of the files read, by those of what was read

_FOLDER = Path(__file__).parent / "builtin"
# The pieces of a TOML text that matter for where a dotted key begins and ends. An unclosed string
# is taken to where it would have to end, so that the scan stays linear.
_TOKENS = re.compile(
    r'(?P<long>"""(?:[^"\\]|\\.|"(?!""))*(?:""")?' + r"|'''(?:[^']|'(?!''))*(?:''')?)"
    r"|(?P<part>\"(?:[^\"\\\n]|\\[^\n])*\"?|'[^'\n]*'?|[A-Za-z0-9_-]+)"
    r"|(?P<dot>\.)|(?P<space>[ \t]+)|(?P<comment>#[^\n]*)|(?P<other>.)",
    re.DOTALL,
)


class LoadedMechanism(NamedTuple):
    """A validated mechanism, the SHA-256 of its file's bytes in hex, and what to call the file."""

    mechanism: Mechanism
    sha256: str
    label: str


def load(
    path_or_name: str | os.PathLike[str] | None = None, overrides: Overrides = (), unset: Sequence[str] = ()
) -> LoadedMechanism:
    """The mechanism of a TOML file or of a built-in's name (`None`: the default built-in).

    `overrides` are ``PATH=VALUE`` texts as given to ``--set``, applied in order before validation:
    PATH a dotted TOML key, possibly with an index (``contact.stiffness[1]``), VALUE a TOML value; a
    bare word is a string. A table given as VALUE replaces the one there. A mapping of PATH to the value
    itself does the same, and takes out the key whose value is None. `unset` are PATHs as given to
    ``--unset``, keys that are then taken out.

    Raises `InputError`, one line, for whatever is wrong.
    """
    name = DEFAULT if path_or_name is None else path_or_name
    if isinstance(name, str) and name in (*builtin_names(), *suite_names()):
        path, label = builtin_path(name), name
    else:
        path, label = Path(name), one_line(str(name)) or "''"
    data = _read(path, label)
    mechanism = from_builtins(_parse(data, label), label, overrides, unset)
    sha256 = hashlib.sha256(data).hexdigest()
    _sources[_content_sha256(mechanism)] = sha256
    return LoadedMechanism(mechanism, sha256, label)


def source_sha256(mechanism: Mechanism) -> str:
    """SHA-256 in hex of the file that an equal mechanism was read from, or of its content if it was not read
    from any."""
    content = _content_sha256(mechanism)
    return _sources.get(content, content)


def from_builtins(
    raw: Mapping[str, Any], label: str, overrides: Overrides = (), unset: Sequence[str] = ()
) -> Mechanism:
    """The validated mechanism of plain data, such as a parsed TOML or JSON table, changed as by `load`.

    `label` is what an error calls its source. Raises `InputError`.
    """
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


def to_builtins(mechanism: Mechanism) -> dict[str, Any]:
    """The mechanism as plain data fit for JSON; `from_builtins` makes an equal mechanism of it.

    Keys without a value and infinite numbers are left out: both are the defaults of their keys.
    """
    return _without_empty(msgspec.to_builtins(mechanism))


def builtin_names() -> list[str]:
    """The names of the built-in mechanism files, the standard suites apart."""
    return [name for name in _names() if not name.startswith(SUITE)]


def suite_names() -> list[str]:
    """The names of the standard suites: built-in mechanism files on which compensators are compared, each
    with one difficulty, drawn from the same rig."""
    return [name for name in _names() if name.startswith(SUITE)]


def builtin_path(name: str) -> Path:
    """The file of a built-in mechanism or suite. Raises `InputError` for an unknown name."""
    names = [*builtin_names(), *suite_names()]
    if name not in names:
        raise InputError(
            f"{one_line(name)}: found no built-in mechanism of this name, "
            f"allowed {', '.join(names)}{close_match(name, names)}"
        )
    return _FOLDER / f"{name}.toml"


def _content_sha256(mechanism: Mechanism) -> str:
    content = json.dumps(to_builtins(mechanism), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(content.encode()).hexdigest()


def _names() -> list[str]:
    return sorted(path.stem for path in _FOLDER.glob("*.toml"))


def _read(path: Path, label: str) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        names = builtin_names()
        hint = close_match(label, [*names, *suite_names()]) or f" (built-in: {', '.join(names)})"
        raise InputError(f"{label}: found no such file, allowed a mechanism file{hint}") from None
    except IsADirectoryError:
        raise InputError(f"{label}: found a directory, allowed a mechanism file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{label}: cannot be read: {one_line(str(reason), 100)}") from None
    if len(data) > MAX_BYTES:
        raise InputError(f"{label}: found more than {MAX_BYTES} bytes, allowed a file of at most 1 MiB")
    return data


def _parse(data: bytes, label: str) -> dict[str, Any]:
    if not data.strip():
        raise InputError(f"{label}: found an empty file, allowed a mechanism in TOML")
    try:
        # Some editors put a byte-order mark in front.
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{label}: found bytes that are not UTF-8 at byte {error.start}, allowed a mechanism in TOML"
        ) from None
    if _longest_key(text) > MAX_KEY_PARTS:
        # The parser's memory grows with the square of a dotted key's length.
        raise InputError(f"{label}: found a key of more than {MAX_KEY_PARTS} parts, allowed TOML keys")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{label}: found values nested too deeply, allowed plain TOML") from None
    except ValueError as error:
        # Also an integer of thousands of digits, which is no TOMLDecodeError.
        reason = one_line(str(error).split(";")[0], 120)
        raise InputError(f"{label}: not valid TOML: {reason}") from None


def _longest_key(text: str) -> int:
    """The number of parts of the longest run ``a.b.c`` outside comments and long strings."""
    longest = parts = 0
    joined = False
    for token in _TOKENS.finditer(text):
        if token.lastgroup == "part":
            parts = parts + 1 if joined else 1
            longest = max(longest, parts)
            joined = False
        elif token.lastgroup == "dot":
            joined = parts > 0
        elif token.lastgroup != "space":
            parts, joined = 0, False
    return longest


def _validated(raw: Mapping[str, Any]) -> Mechanism:
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
        return {key: entry for key, entry in entries.items() if entry is not None and entry != math.inf}
    return value
