"""Error of an invalid gain file, with a message of one printable line."""


class GainFileError(ValueError):
    """Error of an invalid gain file; the message names file, key, what was found and what is allowed."""


def printable(text: str) -> str:
    """Return the text with all non-printable characters escaped, line breaks included."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


def format_value(value: object, longest: int = 60) -> str:
    """Return a value as short ASCII text on one line, for an error message."""
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
    """Return the error for `key` of the file `source`; an empty key stands for the whole file."""
    location = f"{source}: {key}" if key else source
    return GainFileError(printable(f"{location}: found {found}, expected {allowed}"))
