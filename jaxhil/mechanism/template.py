"""A mechanism file to start from: the values of a mechanism, with every key that it could have besides, each
with its meaning, unit, range and default, as the key's type states them.

A key that is at its default stands in a comment (`#key = value`): the rest is what this mechanism needs.
"""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from jaxhil.mechanism.keys import Key, Table, tables
from jaxhil.mechanism.structs import Mechanism

__all__ = ["commented"]

WIDTH, COLUMN = 110, 36  # of lines, and where comments begin
HEAD = """\
A mechanism file of jaxhil: one docking mechanism on one rig. Numbers are in SI units, natural frequencies
in Hz. A line such as "#key = value" is a key at its default: take the "#" away to change it."""
UNCERTAIN = """\
What tuning and sweeps draw from: a line for any numeric key above, by its dotted path. On a list one draw
scales the whole list, unless independent = true. uniform and loguniform take either factor, or low and
high; normal takes std, and has the value above as its mean."""


def commented(mechanism: Mechanism) -> str:
    """The TOML text of a file that `jaxhil.mechanism.file.load` reads as an equal mechanism."""
    values = msgspec.to_builtins(mechanism)
    lines = _comment(HEAD)
    for table in tables():
        if table.path.startswith("uncertainty."):
            lines += ["", "[uncertainty]", *_uncertainty(table, values["uncertainty"])]
            continue
        found: Any = values
        for part in filter(None, table.path.split(".")):
            found = (found or {}).get(part)
        if table.path:
            lines += ["", *_comment(table.meaning), f"{'' if found else '#'}[{table.path}]"]
        for key in table.keys:
            lines += _lines(key, found or {})
    return "\n".join(lines) + "\n"


def _uncertainty(table: Table, entries: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    yield from _comment(UNCERTAIN)
    for key in table.keys:
        yield from _wrapped(f"#   {key.name}", _described(key))
    for path, entry in entries.items():
        defaults = {key.name: key.default for key in table.keys}
        stated = (f"{name} = {_value(value)}" for name, value in entry.items() if value != defaults.get(name))
        yield f"{json.dumps(path)} = {{ {', '.join(stated)} }}"


def _lines(key: Key, values: Mapping[str, Any]) -> Iterator[str]:
    value = values.get(key.name)
    stated = key.required or value != key.default
    shown = value if stated else key.default
    text = f"{key.name} = {'' if shown is None else _value(shown)}".rstrip()
    return _wrapped(text if stated and shown is not None else f"#{text}", _described(key))


def _described(key: Key) -> str:
    return f"{key.meaning}: {key.allowed}"


def _wrapped(text: str, comment: str) -> Iterator[str]:
    """A key and its comment, on further lines what does not fit."""
    column = max(COLUMN, len(text) + 2)
    column = column if column <= WIDTH // 2 else COLUMN
    parts = textwrap.wrap(comment, WIDTH - column - 2)
    if len(text) + 2 > column:  # a long value has its comment below
        yield text
    else:
        yield f"{text:<{column}}# {parts.pop(0)}"
    for part in parts:
        yield f"{'':<{column}}# {part}"


def _comment(text: str) -> list[str]:
    return [f"# {part}" for line in text.splitlines() for part in textwrap.wrap(line, WIDTH - 2)]


def _value(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, str):
        # JSON's escapes are TOML's, but for a surrogate and for DEL, which a mechanism's texts do not have.
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, float) and math.isinf(value):
        return "inf"
    return repr(value)
