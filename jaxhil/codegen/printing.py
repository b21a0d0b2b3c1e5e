"""Layout of the C code (comments, indentation, line breaks), and C helpers for Python's operators."""

import inspect
import re
import textwrap
from collections.abc import Iterable

MAX_LINE_LENGTH = 116
# C functions that the output contains only if they are called; @ is replaced by the prefix.
C_HELPERS = {
    # Without volatile, a compiler may replace a power with products, whose rounding errors differ.
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
const int64_t rest = value % divisor;
return rest != 0 && (rest < 0) != (divisor < 0) ? rest + divisor : rest;
}""",
    "floor_division_int": """int64_t @floor_division_int(int64_t value, int64_t divisor) {
return value / divisor - (value % divisor != 0 && (value < 0) != (divisor < 0) ? 1 : 0);
}""",
}


def escape_comment(text: str) -> str:
    """Escape a text for a C comment: non-ASCII characters, and the marks that begin and end comments."""
    return text.replace("*/", "* /").replace("/*", "/ *").encode("ascii", "backslashreplace").decode()


def format_comment(text: str | None) -> str:
    """Format a docstring as a C comment; return "" for an empty docstring."""
    first, *lines = escape_comment(inspect.cleandoc(text or "")).split("\n")
    if not lines:
        return f"/* {first} */\n" if first else ""
    return "\n".join([f"/* {first}", *(f" * {line}".rstrip() for line in lines), " */\n"])


def indent_lines(lines: Iterable[str]) -> str:
    """Join lines of C code: indent them by the depth of their braces, and break long lines."""
    depth, result = 0, ""
    for line in lines:
        depth -= line.startswith("}")
        result += _break_line("    " * depth, line) + "\n"
        depth += line.endswith("{")
    return result


def _break_line(indent: str, line: str) -> str:
    """Break a long line after a comma or before an operator, at the lowest depth of parentheses."""
    line = indent + line
    if len(line) <= MAX_LINE_LENGTH:
        return line
    if line.lstrip().startswith("/*"):
        return "\n".join(textwrap.wrap(line, MAX_LINE_LENGTH, subsequent_indent=f"{indent} * "))
    breaks, depth = [], 0
    for index, character in enumerate(line[:MAX_LINE_LENGTH]):
        depth += (character == "(") - (character == ")")
        is_break = line[index - 1 : index + 1] == ", " or re.match(r" (&&|\|\||[-+*/?:]) ", line[index:])
        if is_break and index > len(indent) + 12:
            breaks.append((-depth, index))
    if not breaks:
        return line
    index = max(breaks)[1]
    return f"{line[:index].rstrip()}\n{_break_line(indent + ' ' * 8, line[index:].lstrip())}"
