"""Overrides of a mechanism file: ``PATH=VALUE`` of the option ``--set``, and ``PATH`` of ``--unset``.

PATH is a dotted TOML key, possibly with indices into lists. VALUE is a TOML value; a bare word is a string,
so that ``contact.law=linear`` needs no quotes in a shell. In Python, the value None removes a key.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from typing import Any

from jaxhil.errors import format_value
from jaxhil.mechanism.conversion import (
    KeyPath,
    KeyProblem,
    find_member_type,
    format_entry_count,
    format_key_path,
    suggest_names,
)
from jaxhil.mechanism.correlation import remove_keys
from jaxhil.mechanism.number_ranges import Range, describe_struct, numeric_keys
from jaxhil.mechanism.six_axes import SixAxisMechanism, is_six_axes, numeric_keys_with
from jaxhil.mechanism.structs import MAX_CONTACTS, Mechanism

__all__ = ["apply_override", "parse_key", "parse_override"]

_EXAMPLE = "PATH=VALUE, such as approach.velocity=0.01"
_EXAMPLE_KEY = "a dotted path, such as 'approach.velocity' or 'contact.stiffness[1]'"
_KEY_PATTERN = re.compile(r"""\s*("(?:[^"\\]|\\.)*"|'[^']*'|[A-Za-z0-9_-]+)\s*""")
_INDEX_PATTERN = re.compile(r"\[\s*([0-9]{1,6})\s*\]\s*")
_WORD_PATTERN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")
_MAX_OVERRIDE_LENGTH = 100_000


def parse_override(override: str | tuple[object, Any]) -> tuple[KeyPath, Any]:
    """Parse a ``PATH=VALUE`` text or a pair (PATH, value). Raise `KeyProblem` if it is malformed."""
    if not isinstance(override, str):
        key, value = override
        return parse_key(key), _to_python(value)
    return _parse_text(override)


def parse_key(key: object) -> KeyPath:
    """Parse a dotted key, such as ``contact.stiffness[1]``. Raise `KeyProblem` if it is malformed."""
    if isinstance(key, str):
        path, end = _parse_path(f"{key}=", key)
        if end == len(key) + 1:
            return path
    raise KeyProblem((), format_value(key), _EXAMPLE_KEY)


def _to_python(value: Any) -> Any:
    """Convert the NumPy and JAX numbers and arrays in a value to Python numbers and lists."""
    if isinstance(value, (list, tuple)):
        if len(value) > MAX_CONTACTS:
            return value  # validation rejects the length without reading the entries
        return [_to_python(entry) for entry in value]
    if isinstance(value, Mapping):
        return {key: _to_python(entry) for key, entry in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value


def _parse_text(text: str) -> tuple[KeyPath, Any]:
    path, position = _parse_path(text)
    value_text = text[position:].strip()
    if len(value_text) > _MAX_OVERRIDE_LENGTH:
        raise KeyProblem(path, f"{len(value_text)} characters", f"at most {_MAX_OVERRIDE_LENGTH}")
    try:
        table = tomllib.loads(f"value = {value_text}")
    except RecursionError:
        raise KeyProblem(path, "values nested too deeply", "fewer levels of brackets") from None
    except ValueError:
        if _WORD_PATTERN.fullmatch(value_text):
            return path, value_text
        found = format_value(value_text) if value_text else "nothing after ="
        raise KeyProblem(
            path, found, 'a TOML value, such as 0.5, [1.0, 2.0], "text" or a bare word'
        ) from None
    if list(table) != ["value"]:
        raise KeyProblem(path, format_value(value_text), "one TOML value")
    return path, table["value"]


def apply_override(raw: Mapping[str, Any], path: KeyPath, value: Any) -> dict[str, Any]:
    """Return a copy of a parsed table with a new value at `path`; create the missing tables on the path.

    The value None removes the key with all keys below it, and their entries in ``[uncertainty]`` and
    ``[correlation]``. Raise `KeyProblem` if the schema has no such path, a list has no such entry, or the key
    to remove does not exist.
    """
    has_six_axes = is_six_axes(raw)
    kind = describe_struct(SixAxisMechanism if has_six_axes else Mechanism)
    for depth, part in enumerate(path):
        try:
            kind = find_member_type(kind, part, path[:depth])
        except KeyProblem as problem:
            hint = suggest_names(
                format_key_path(path), _numeric_keys(raw) if has_six_axes else numeric_keys()
            )
            if hint and "did you mean" not in problem.expected:
                problem = KeyProblem(problem.path, problem.found, problem.expected + hint)
            raise problem from None
    return _remove_key(raw, path) if value is None else _replace_value(raw, path, 0, value)


def _numeric_keys(raw: Mapping[str, Any]) -> dict[str, Range]:
    """Return the numeric keys that a parsed six-axis table may have, with their allowed ranges."""
    tables = (raw.get(key) for key in ("contact", "latch"))
    return numeric_keys_with(*(tuple(map(str, t)) if isinstance(t, Mapping) else () for t in tables))


def _parse_path(text: str, key: str | None = None) -> tuple[KeyPath, int]:
    """Parse the path at the start of `text`, and return it with the index of the character after ``=``.

    Error messages show `key` or, if `key` is None, `text`.
    """
    source, example = (text, _EXAMPLE) if key is None else (key, _EXAMPLE_KEY)
    path: list[str | int] = []
    position = 0
    while True:
        part = _KEY_PATTERN.match(text, position)
        if part is None or len(path) > 16:
            raise KeyProblem((), format_value(source), example)
        word = part.group(1)
        try:
            path.append(next(iter(tomllib.loads(f"{word} = 0"))))
        except ValueError:
            raise KeyProblem((), format_value(source), example) from None
        position = part.end()
        while index := _INDEX_PATTERN.match(text, position):
            path.append(int(index.group(1)))
            position = index.end()
        if text[position : position + 1] == "=":
            return tuple(path), position + 1
        if text[position : position + 1] != ".":
            raise KeyProblem((), format_value(source), example)
        position += 1


def _replace_value(node: Any, path: KeyPath, depth: int, value: Any) -> Any:
    """Return a copy of `node` (the data at `path[:depth]`) with a new value at `path`."""
    if depth == len(path):
        return value
    part = path[depth]
    if isinstance(part, int):
        # A bare number stands for a list of one entry.
        entries = list(node) if isinstance(node, (list, tuple)) else [node]
        if node is None or part >= len(entries):
            found = "no list" if node is None else format_entry_count(entries)
            raise KeyProblem(path[: depth + 1], found, "an index into the list, or a whole list")
        entries[part] = _replace_value(entries[part], path, depth + 1, value)
        return entries
    if not isinstance(node, Mapping):
        raise KeyProblem(path[:depth], format_value(node), "a table")
    missing = {} if depth + 1 < len(path) and isinstance(path[depth + 1], str) else None
    return {**node, part: _replace_value(node.get(part, missing), path, depth + 1, value)}


def _remove_key(raw: Mapping[str, Any], path: KeyPath) -> dict[str, Any]:
    """Return a parsed table without the key at `path`, its uncertainty and its correlation."""
    changed, key = _remove_from_table(raw, path, 0), format_key_path(path)
    if isinstance(table := changed.get("uncertainty"), Mapping):
        entries = {name: entry for name, entry in table.items() if not f"{name}.".startswith(f"{key}.")}
        changed["uncertainty"] = entries
    certain = [
        name for name in raw.get("uncertainty") or () if name not in (changed.get("uncertainty") or ())
    ]
    return _remove_correlations(changed, certain)


def _remove_correlations(raw: dict[str, Any], certain: list[str]) -> dict[str, Any]:
    """Return a parsed table without the correlations of the keys `certain`, which are no longer uncertain."""
    table = raw.get("correlation")
    if not certain or table is None:
        return raw
    try:
        correlation = remove_keys(table["keys"], table["matrix"], certain)
    except (TypeError, LookupError):
        return raw  # The table is malformed; validation reports it later.
    others = {name: value for name, value in raw.items() if name != "correlation"}
    if correlation is None:
        return others
    return others | {"correlation": {**table, "keys": correlation[0], "matrix": correlation[1]}}


def _remove_from_table(node: Any, path: KeyPath, depth: int) -> dict[str, Any]:
    """Return a copy of `node` (the table at `path[:depth]`) without the key at `path`."""
    part = path[depth]
    if isinstance(path[-1], int):
        raise KeyProblem(path, "an entry of a list", "a key (set the whole list instead)")
    if not isinstance(node, Mapping) or part not in node:
        raise KeyProblem(path, "no such key", "a key that the mechanism has")
    others = {name: value for name, value in node.items() if name != part}
    return others | (
        {str(part): _remove_from_table(node[part], path, depth + 1)} if depth + 1 < len(path) else {}
    )
