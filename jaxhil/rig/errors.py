"""The error of an unusable gain file: always one printable line."""


class GainFileError(ValueError):
    """An unusable gain file; the message names file, key, what was found and what is allowed."""


def printable(text: str) -> str:
    """`text` with every character that would not print, line breaks included, escaped."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


def shown(value: object, longest: int = 60) -> str:
    """A value as an error message shows it: short, ASCII, on one line."""
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


def refusal(source: str, key: str, found: str, allowed: str) -> GainFileError:
    """The error for `key` of the file `source`; the empty key is the file as a whole."""
    place = f"{source}: {key}" if key else source
    return GainFileError(printable(f"{place}: found {found}, allowed {allowed}"))
