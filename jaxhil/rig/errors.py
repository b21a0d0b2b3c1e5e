"""Exception for an invalid gain file, and helpers that format its message as one printable line."""


class GainFileError(ValueError):
    """Exception for an invalid gain file; the message is `FILE: KEY: found X, expected Y`."""


def printable(text: str) -> str:
    """Escape all non-printable characters of the text, including line breaks."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


def format_value(value: object, longest: int = 60) -> str:
    """Format a value for an error message, as one line of at most `longest` ASCII characters."""
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, (list, tuple)):
        return "a list"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int) and abs(value) >= 10**18:
        return f"an integer of {value.bit_length()} bits"
    if not isinstance(value, (str, int, float)):
        return f"a {type(value).__name__}"
    text = ascii(value)
    return text if len(text) <= longest else text[: longest - 3] + "..."


def make_gain_file_error(source: str, key: str, found: str, allowed: str) -> GainFileError:
    """Return the error about `key` in the file `source`; an empty key means the whole file."""
    location = f"{source}: {key}" if key else source
    return GainFileError(printable(f"{location}: found {found}, expected {allowed}"))
