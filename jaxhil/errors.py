"""Error class for wrong input, and functions that put values into its one-line messages.

Wrong input (a file, a key, an option) raises an `InputError`. Its message is a single printable line that
names the place, the value found there and the allowed values.
"""

from __future__ import annotations

__all__ = ["InputError", "format_value", "to_one_line"]


class InputError(ValueError):
    """Error for unusable input, with a message of one line: ``FILE: key.path: found X, expected Y``."""


def to_one_line(text: str, limit: int | None = None) -> str:
    """Return `text` with every unprintable character escaped, cut to `limit` characters."""
    escaped = "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in text
    )
    if limit is not None and len(escaped) > limit:
        return escaped[: limit - 3] + "..."
    return escaped


def format_value(value: object, limit: int = 60) -> str:
    """Return a printable description of a value for a message, at most `limit` characters."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        # The text of a table is long, and `repr` fails on deeply nested tables.
        return "a table"
    if isinstance(value, str):
        # Cutting before the escaping as well limits the work for a long text.
        value = value[: limit + 1]
    try:
        return to_one_line(repr(value), limit)
    except RecursionError:
        return "a deeply nested list"
    except ValueError:
        return "a number of thousands of digits"
