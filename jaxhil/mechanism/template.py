"""Text of a new mechanism file: the values of a mechanism, and every further key with its default.

Each key has a comment with its description, unit and range. A key at its default is commented out
(`#key = value`).
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

WIDTH, COLUMN = 110, 36  # length of lines, and column where comments begin
HEAD = """\
Mechanism file of jaxhil: one docking mechanism on one rig. Numbers are in SI units, natural frequencies
in Hz. A line such as "#key = value" is a key at its default: remove the "#" to change it."""
UNCERTAIN = """\
Distributions for tuning and sweeps: one line for any numeric key above, by its dotted path. One draw scales
a whole list, unless independent = true. uniform and loguniform need either factor, or low and high; normal
needs std, and its mean is the value above."""


def commented(mechanism: Mechanism) -> str:
    """Return the TOML text of a file that `jaxhil.mechanism.file.load` reads as an equal mechanism."""
    values = msgspec.to_builtins(mechanism)
    lines = _comment(HEAD)
    for table in tables():
        if table.path.startswith("uncertainty."):
            lines += ["", "[uncertainty]", *_uncertainty(table, values["uncertainty"])]
            continue
        entries: Any = values
        for part in filter(None, table.path.split(".")):
            entries = (entries or {}).get(part)
        if table.path:
            lines += ["", *_comment(table.meaning), f"{'' if entries else '#'}[{table.path}]"]
        for key in table.keys:
            lines += _lines(key, entries or {})
    return "\n".join(lines) + "\n"


def _uncertainty(table: Table, entries: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield the comment on the table ``[uncertainty]``, then one line for each entry."""
    yield from _comment(UNCERTAIN)
    for key in table.keys:
        yield from _wrapped(f"#   {key.name}", _described(key))
    for path, entry in entries.items():
        defaults = {key.name: key.default for key in table.keys}
        stated = (f"{name} = {_value(value)}" for name, value in entry.items() if value != defaults.get(name))
        yield f"{json.dumps(path)} = {{ {', '.join(stated)} }}"


def _lines(key: Key, values: Mapping[str, Any]) -> Iterator[str]:
    """Return the lines of a key with its comment; a key at its default is commented out."""
    value = values.get(key.name)
    is_active = key.required or value != key.default
    shown = value if is_active else key.default
    text = f"{key.name} = {'' if shown is None else _value(shown)}".rstrip()
    return _wrapped(text if is_active and shown is not None else f"#{text}", _described(key))


def _described(key: Key) -> str:
    return f"{key.meaning}: {key.allowed}"


def _wrapped(text: str, comment: str) -> Iterator[str]:
    """Yield a key with its comment, which continues on further lines if it is long."""
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
    """Return a text as comment lines."""
    return [f"# {part}" for line in text.splitlines() for part in textwrap.wrap(line, WIDTH - 2)]


def _value(value: Any) -> str:
    """Return a value as TOML text."""
    if isinstance(value, str):
        # JSON and TOML differ only in surrogates and DEL, which the texts of a mechanism do not contain.
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, float) and math.isinf(value):
        return "inf"
    return repr(value)
