"""Layout of the C text: comments, indentation, long lines, and helpers that stand for Python's operators."""

import inspect
import re
import textwrap
from collections.abc import Iterable

WIDTH = 116
# Each is printed only if something needs it, with the prefix for @.
HELPERS = {
    # Without volatile a compiler makes other products of constant exponents.
    "power": """double @power(double base, double exponent) {
const volatile double exact = exponent;
return pow(base, exact);
}""",
    "modulo": """double @modulo(double value, double divisor) {
const double rest = fmod(value, divisor);
if (rest == 0.0) {
return copysign(0.0, divisor);
}
return (divisor < 0.0) != (rest < 0.0) ? rest + divisor : rest;
}""",
    "floor_division": """double @floor_division(double value, double divisor) {
const double rest = fmod(value, divisor);
const bool is_below = rest != 0.0 && (divisor < 0.0) != (rest < 0.0);
const double quotient = (value - rest) / divisor - (is_below ? 1.0 : 0.0);
const double whole = floor(quotient);
return quotient == 0.0 ? copysign(0.0, value / divisor) : quotient - whole > 0.5 ? whole + 1.0 : whole;
}""",
    "modulo_int": """int64_t @modulo_int(int64_t value, int64_t divisor) {
const int64_t rest = divisor == -1 ? 0 : value % divisor;
return rest != 0 && (rest < 0) != (divisor < 0) ? rest + divisor : rest;
}""",
    "floor_division_int": """int64_t @floor_division_int(int64_t value, int64_t divisor) {
const int64_t quotient = divisor == -1 ? -value : value / divisor;
const int64_t rest = divisor == -1 ? 0 : value % divisor;
return rest != 0 && (rest < 0) != (divisor < 0) ? quotient - 1 : quotient;
}""",
}


def plain(text: str) -> str:
    """Return a text that may stand in a comment: ASCII, without the marks of comments."""
    return text.replace("*/", "* /").replace("/*", "/ *").encode("ascii", "backslashreplace").decode()


def comment(text: str | None) -> str:
    """Return a docstring as a comment in C, "" if there is none."""
    lines = plain(inspect.cleandoc(text or "")).splitlines()
    if len(lines) < 2:
        return f"/* {lines[0]} */\n" if lines else ""
    return "\n".join([f"/* {lines[0]}", *(f" * {line}".rstrip() for line in lines[1:]), " */\n"])


def indented(lines: Iterable[str]) -> str:
    """Return lines indented by their braces, and broken where they are too long."""
    depth, found = 0, []
    for line in lines:
        depth -= line.startswith("}")
        found.append(_broken("    " * depth + line))
        depth += line.endswith("{")
    return "\n".join(found) + "\n"


def _broken(line: str) -> str:
    """Break a long line behind a comma or before an operator, where the fewest parentheses are open."""
    indent = " " * (len(line) - len(line.lstrip()))
    if len(line) <= WIDTH:
        return line
    if line.lstrip().startswith("/*"):
        return "\n".join(textwrap.wrap(line, WIDTH, initial_indent="", subsequent_indent=f"{indent} * "))
    places, depth = [], 0
    for place, character in enumerate(line[:WIDTH]):
        depth += {"(": 1, ")": -1}.get(character, 0)
        is_place = line[place - 1 : place + 1] == ", " or re.match(r" (&&|\|\||[-+*/?:]) ", line[place:])
        if is_place and place > len(indent) + 12:
            places.append((-depth, place))
    if not places:
        return line
    place = max(places)[1]
    return (
        line[:place].rstrip()
        + "\n"
        + _broken(indent + " " * 8 * (len(indent) % 8 != 4 or 1) + line[place:].lstrip())
    )
