"""Reading of TOML files, with limits on their size and nesting and with one-line error messages."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, to_one_line
from jaxhil.files import open_input

__all__ = ["parse_toml", "read_bytes"]

MAX_BYTES = 1 << 20  # 1 MiB, far more than a mechanism file needs
MAX_KEY_PARTS = 64  # limit, because the parser's memory grows with the square of the number of parts

# Tokens of a TOML text that delimit dotted keys. An unclosed string extends to the end of its line or of the
# text, so that the scan takes linear time.
_TOKENS = re.compile(
    r'(?P<long>"""(?:[^"\\]|\\.|"(?!""))*(?:""")?' + r"|'''(?:[^']|'(?!''))*(?:''')?)"
    r"|(?P<part>\"(?:[^\"\\\n]|\\[^\n])*\"?|'[^'\n]*'?|[A-Za-z0-9_-]+)"
    r"|(?P<dot>\.)|(?P<space>[ \t]+)|(?P<comment>#[^\n]*)|(?P<other>.)",
    re.DOTALL,
)


def read_bytes(path: Path, label: str, content: str) -> bytes:
    """Read a file of at most 1 MiB; messages state its name `label` and its kind `content` ("a mechanism").

    Raise FileNotFoundError if there is no such file, and `InputError` for any other problem.
    """
    try:
        with open_input(path) as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise
    except IsADirectoryError:
        raise InputError(f"{label}: found a directory, expected {content} file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{label}: cannot be read: {to_one_line(str(reason), 100)}") from None
    if len(data) > MAX_BYTES:
        raise InputError(f"{label}: found more than {MAX_BYTES} bytes, expected a file of at most 1 MiB")
    return data


def parse_toml(data: bytes, label: str, content: str) -> dict[str, Any]:
    """Parse the bytes of a TOML file; an `InputError` states the file's name `label` and kind `content`."""
    if not data.strip():
        raise InputError(f"{label}: found an empty file, expected {content} in TOML")
    try:
        # Some editors write a byte-order mark at the start.
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{label}: found bytes that are not UTF-8 at byte {error.start}, expected {content} in TOML"
        ) from None
    if _longest_key(text) > MAX_KEY_PARTS:
        raise InputError(f"{label}: found too many parts in a key, expected at most {MAX_KEY_PARTS}")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{label}: found values nested too deeply, expected fewer nested brackets") from None
    except ValueError as error:
        # An integer with thousands of digits raises a ValueError instead of a TOMLDecodeError.
        reason = to_one_line(str(error).split(";")[0], 120)
        raise InputError(f"{label}: not valid TOML: {reason}{_quote_line(text, reason)}") from None


def _quote_line(text: str, reason: str) -> str:
    """Return the line of `text` that the parser's error `reason` refers to, for the end of a message."""
    match = re.search(r"at line (\d+)", reason)
    lines = text.split("\n")[int(match[1]) - 1 :] if match else []
    line = to_one_line(lines[0].strip(), 60) if lines else ""
    return f": found {line!r}; texts need quotes, numbers a decimal point" if line else ""


def _longest_key(text: str) -> int:
    """Return the number of parts of the longest dotted key outside comments and multi-line strings."""
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
