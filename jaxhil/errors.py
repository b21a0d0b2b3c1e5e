"""Error class for invalid input, and functions that format values for its one-line messages.

Invalid input (a file, a key, an option) raises an `InputError`. Its message is one printable line that
names the file and the key (or the option), the found value, and the expected values.
"""

from __future__ import annotations

__all__ = ["InputError", "format_value", "to_one_line"]


class InputError(ValueError):
    """Error for invalid input, with a one-line message: ``FILE: key.path: found X, expected Y``."""


def to_one_line(text: str, limit: int | None = None) -> str:
    """Escape every unprintable character of `text`; shorten the result to at most `limit` characters."""
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
        # Shortening a long text before escaping it saves time.
        value = value[: limit + 1]
    if isinstance(value, float):
        value = float(value)  # `repr` of a NumPy number would show its type
    try:
        return to_one_line(repr(value), limit)
    except RecursionError:
        return "a deeply nested list"
    except ValueError:
        return "a number of thousands of digits"
