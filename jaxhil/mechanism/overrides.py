"""Overrides of a mechanism file: ``PATH=VALUE``, as given to ``--set``, and ``PATH`` as given to ``--unset``.

PATH is a dotted key as TOML writes it, possibly with indices into lists; VALUE is a TOML value, and
a bare word is a string, so that ``contact.law=linear`` needs no quotes within a shell's quotes. TOML has no
word for nothing: the value None takes a key out.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from typing import Any

from jaxhil.errors import shown
from jaxhil.mechanism.conversion import KeyProblem, Path, close_match, dotted, entry_count, step_into
from jaxhil.mechanism.correlation import remaining
from jaxhil.mechanism.six_axes import is_six_axes, numeric_keys_beside, six_axis_type
from jaxhil.mechanism.structs import MAX_CONTACTS, Range, numeric_keys, schema_type

__all__ = ["apply_override", "parse_key", "parse_override"]

_EXAMPLE = "PATH=VALUE, such as approach.velocity=0.01"
_EXAMPLE_KEY = "a dotted path, such as 'approach.velocity' or 'contact.stiffness[1]'"
_PART = re.compile(r"""\s*("(?:[^"\\]|\\.)*"|'[^']*'|[A-Za-z0-9_-]+)\s*""")
_INDEX = re.compile(r"\[\s*([0-9]{1,6})\s*\]\s*")
_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")
_MAX_LENGTH = 100_000


def parse_override(override: str | tuple[object, Any]) -> tuple[Path, Any]:
    """Path and value of a ``PATH=VALUE`` text, or of a pair of PATH and the value. Raises `KeyProblem`."""
    if not isinstance(override, str):
        key, value = override
        return parse_key(key), _plain(value)
    return _parse_text(override)


def parse_key(key: object) -> Path:
    """The path that a dotted key names. Raises `KeyProblem`."""
    if isinstance(key, str):
        path, end = _parse_path(f"{key}=", key)
        if end == len(key) + 1:
            return path
    raise KeyProblem((), shown(key), _EXAMPLE_KEY)


def _plain(value: Any) -> Any:
    """Numbers and arrays of NumPy and jax as those of Python."""
    if isinstance(value, (list, tuple)):
        if len(value) > MAX_CONTACTS:
            return value  # refused for its length, whatever is in it
        return [_plain(entry) for entry in value]
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value


def _parse_text(text: str) -> tuple[Path, Any]:
    path, position = _parse_path(text)
    written = text[position:].strip()
    if len(written) > _MAX_LENGTH:
        raise KeyProblem(path, f"{len(written)} characters", f"at most {_MAX_LENGTH}")
    try:
        table = tomllib.loads(f"value = {written}")
    except RecursionError:
        raise KeyProblem(path, "values nested too deeply", "a TOML value") from None
    except ValueError:
        if _WORD.fullmatch(written):
            return path, written
        found = shown(written) if written else "nothing after ="
        raise KeyProblem(
            path, found, 'a TOML value, such as 0.5, [1.0, 2.0], "text" or a bare word'
        ) from None
    if list(table) != ["value"]:
        raise KeyProblem(path, shown(written), "one TOML value")
    return path, table["value"]


def apply_override(raw: Mapping[str, Any], path: Path, value: Any) -> dict[str, Any]:
    """A copy of a raw table with the value at `path` replaced; tables on the way are made. None takes the key
    out, and with it what ``[uncertainty]`` and ``[correlation]`` say of it and of the keys below it.

    Raises `KeyProblem` when the schema has no such path, a list no such entry, or where there is no such key
    to take out.
    """
    in_space = is_six_axes(raw)
    kind = six_axis_type() if in_space else schema_type()
    for depth, part in enumerate(path):
        try:
            kind = step_into(kind, part, path[:depth])
        except KeyProblem as problem:
            hint = close_match(dotted(path), _numeric_keys(raw) if in_space else numeric_keys())
            if hint and "did you mean" not in problem.allowed:
                problem = KeyProblem(problem.path, problem.found, problem.allowed + hint)
            raise problem from None
    return _removed(raw, path) if value is None else _replaced(raw, path, 0, value)


def _numeric_keys(raw: Mapping[str, Any]) -> dict[str, Range]:
    """Of a raw table of six axes."""
    tables = (raw.get(key) for key in ("contact", "latch"))
    return numeric_keys_beside(*(tuple(map(str, one)) if isinstance(one, Mapping) else () for one in tables))


def _parse_path(text: str, key: str | None = None) -> tuple[Path, int]:
    """The path in front of ``=`` and the position behind it; problems speak of the `key`, if one is given."""
    given, example = (text, _EXAMPLE) if key is None else (key, _EXAMPLE_KEY)
    path: list[str | int] = []
    position = 0
    while True:
        part = _PART.match(text, position)
        if part is None or len(path) > 16:
            raise KeyProblem((), shown(given), example)
        word = part.group(1)
        try:
            path.append(next(iter(tomllib.loads(f"{word} = 0"))))
        except ValueError:
            raise KeyProblem((), shown(given), example) from None
        position = part.end()
        while index := _INDEX.match(text, position):
            path.append(int(index.group(1)))
            position = index.end()
        if text[position : position + 1] == "=":
            return tuple(path), position + 1
        if text[position : position + 1] != ".":
            raise KeyProblem((), shown(given), example)
        position += 1


def _replaced(node: Any, path: Path, depth: int, value: Any) -> Any:
    if depth == len(path):
        return value
    part = path[depth]
    if isinstance(part, int):
        # A bare number stands for a list of one entry.
        entries = list(node) if isinstance(node, (list, tuple)) else [node]
        if node is None or part >= len(entries):
            found = "no list to change" if node is None else entry_count(entries)
            raise KeyProblem(path[: depth + 1], found, "an index into the list, or a whole list")
        entries[part] = _replaced(entries[part], path, depth + 1, value)
        return entries
    if not isinstance(node, Mapping):
        raise KeyProblem(path[:depth], shown(node), "a table")
    missing = {} if depth + 1 < len(path) and isinstance(path[depth + 1], str) else None
    return {**node, part: _replaced(node.get(part, missing), path, depth + 1, value)}


def _removed(raw: Mapping[str, Any], path: Path) -> dict[str, Any]:
    left, key = _without(raw, path, 0), dotted(path)
    if isinstance(uncertain := left.get("uncertainty"), Mapping):
        kept = {name: one for name, one in uncertain.items() if not f"{name}.".startswith(f"{key}.")}
        left["uncertainty"] = kept
    gone = [name for name in raw.get("uncertainty") or () if name not in (left.get("uncertainty") or ())]
    return _uncorrelated(left, gone)


def _uncorrelated(raw: dict[str, Any], gone: list[str]) -> dict[str, Any]:
    """Without what ``[correlation]`` says of the keys that are gone."""
    table = raw.get("correlation")
    if not gone or table is None:
        return raw
    try:
        left = remaining(table["keys"], table["matrix"], gone)
    except (TypeError, LookupError):
        return raw  # no such table, which is refused when all is read
    rest = {name: value for name, value in raw.items() if name != "correlation"}
    return rest | ({"correlation": {**table, "keys": left[0], "matrix": left[1]}} if left else {})


def _without(node: Any, path: Path, depth: int) -> dict[str, Any]:
    part = path[depth]
    if isinstance(path[-1], int):
        raise KeyProblem(path, "an entry of a list", "a key: a list is replaced as a whole")
    if not isinstance(node, Mapping) or part not in node:
        raise KeyProblem(path, "no such key there", "a key that is there")
    others = {name: value for name, value in node.items() if name != part}
    return others | ({str(part): _without(node[part], path, depth + 1)} if depth + 1 < len(path) else {})
