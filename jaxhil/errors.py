"""Errors a user can cause, reported in one line.

Whatever a person can get wrong (a file, a key, an option) ends as an `InputError` whose message is
a single printable line: where it is, what was found there, and what is allowed.
"""

from __future__ import annotations

__all__ = ["InputError", "one_line", "shown"]


class InputError(ValueError):
    """Unusable input. The message is one line: ``FILE: key.path: found X, allowed Y``."""


def one_line(text: str, limit: int | None = None) -> str:
    """`text` with every unprintable character escaped, cut to `limit` characters."""
    escaped = "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in text
    )
    if limit is not None and len(escaped) > limit:
        return escaped[: limit - 3] + "..."
    return escaped


def shown(value: object, limit: int = 60) -> str:
    """A found value in one short printable line, at most `limit` characters."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        # A table's text is long and may be nested deeper than `repr` can follow.
        return "a table"
    if isinstance(value, str):
        # Escaping multiplies the length: cut before it as well.
        value = value[: limit + 1]
    try:
        return one_line(repr(value), limit)
    except RecursionError:
        return "a deeply nested list"
    except ValueError:
        return "a number of thousands of digits"
