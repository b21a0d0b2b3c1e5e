"""Text of a new mechanism file, with the values of a mechanism, and the defaults of all other keys.

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

from jaxhil.mechanism.keys import KeyDescription, TableDescription, describe_tables
from jaxhil.mechanism.structs import Mechanism

__all__ = ["format_mechanism_file"]

MAX_LINE_LENGTH, COMMENT_COLUMN = 110, 36  # limit on the length, and column of the comments
FILE_HEADER = """\
Mechanism file of jaxhil: one docking mechanism on one rig. Numbers are in SI units, natural frequencies
in Hz. A line such as "#key = value" is a key at its default: remove the "#" to change it."""
UNCERTAINTY_COMMENT = """\
Distributions for tuning and sweeps: one line for any numeric key above, by its dotted path. One draw scales
a whole list, unless independent = true. uniform and loguniform need either factor, or low and high; normal
needs std, and its mean is the value above."""


def format_mechanism_file(mechanism: Mechanism) -> str:
    """Return the TOML text of a file that `jaxhil.mechanism.file.load` reads as an equal mechanism."""
    values = msgspec.to_builtins(mechanism)
    lines = _format_comment(FILE_HEADER)
    for table in describe_tables():
        if table.path.startswith("uncertainty."):
            lines += ["", "[uncertainty]", *_format_uncertainty(table, values["uncertainty"])]
            continue
        entries: Any = values
        for part in filter(None, table.path.split(".")):
            entries = (entries or {}).get(part)
        if table.path:
            lines += ["", *_format_comment(table.meaning), f"{'' if entries else '#'}[{table.path}]"]
        for key in table.keys:
            lines += _format_key_lines(key, entries or {})
    return "\n".join(lines) + "\n"


def _format_uncertainty(table: TableDescription, entries: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield the comment of the table ``[uncertainty]``, then one line for each uncertain key."""
    yield from _format_comment(UNCERTAINTY_COMMENT)
    for key in table.keys:
        yield from _wrap_comment(f"#   {key.name}", _describe_key(key))
    for path, entry in entries.items():
        defaults = {key.name: key.default for key in table.keys}
        assignments = (
            f"{name} = {_format_value(value)}" for name, value in entry.items() if value != defaults.get(name)
        )
        yield f"{json.dumps(path)} = {{ {', '.join(assignments)} }}"


def _format_key_lines(key: KeyDescription, values: Mapping[str, Any]) -> Iterator[str]:
    """Return the lines for a key and its comment; a key with its default value is commented out."""
    value = values.get(key.name)
    is_active = key.required or value != key.default
    shown = value if is_active else key.default
    text = f"{key.name} = {'' if shown is None else _format_value(shown)}".rstrip()
    return _wrap_comment(text if is_active and shown is not None else f"#{text}", _describe_key(key))


def _describe_key(key: KeyDescription) -> str:
    return f"{key.meaning}: {key.allowed}"


def _wrap_comment(text: str, comment: str) -> Iterator[str]:
    """Yield the lines for a key and its comment; a long comment continues on further lines."""
    column = max(COMMENT_COLUMN, len(text) + 2)
    column = column if column <= MAX_LINE_LENGTH // 2 else COMMENT_COLUMN
    parts = textwrap.wrap(comment, MAX_LINE_LENGTH - column - 2)
    if len(text) + 2 > column:  # a long value has its comment below
        yield text
    else:
        yield f"{text:<{column}}# {parts.pop(0)}"
    for part in parts:
        yield f"{'':<{column}}# {part}"


def _format_comment(text: str) -> list[str]:
    return [f"# {part}" for line in text.splitlines() for part in textwrap.wrap(line, MAX_LINE_LENGTH - 2)]


def _format_value(value: Any) -> str:
    if isinstance(value, str):
        # JSON and TOML differ only in surrogates and DEL, which the texts of a mechanism do not contain.
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(map(_format_value, value))}]"
    if isinstance(value, float) and math.isinf(value):
        return "inf"
    return repr(value)
