"""C expressions with what the generator knows about their values."""

import math
from typing import Any, NamedTuple

from .subset import BOOL, FLOAT, INT, TEXT, Locations, Sign, ValueType

ZEROS = {"float": "0.0", "int": "0", "bool": "false"}


class Rank:
    """Precedence of C's operators; an operand of a lower rank than its operator needs parentheses."""

    CONDITIONAL, OR, AND, BITS, EQUALITY, RELATION, SUM, PRODUCT, UNARY, ATOM = range(1, 11)


class CExpression(NamedTuple):
    """C expression for the value of a Python expression."""

    text: str  # C code
    type: ValueType
    rank: int = Rank.ATOM  # precedence of the expression's outermost operator in C
    reads: Locations = frozenset()  # variables and attributes that are read when the expression is evaluated
    writes: Locations = frozenset()  # variables and attributes that the evaluation changes
    fails: bool = False  # whether the error flag must be tested after the evaluation
    sign: int = 0
    span: tuple[Any, Any] | None = (
        None  # least and largest value, if known at export; the value is then never NaN
    )
    below: str = ""  # for the index of a loop: C code of the length that limits the index
    constant: Any = None  # value, if known at export
    is_pointer: bool = False  # for an object: whether `text` is a pointer
    length: str = ""  # for a list of run-time length: C code of the length

    def at(self, rank: int) -> str:
        return self.text if self.rank >= rank else f"({self.text})"

    @property
    def is_number(self) -> bool:
        return self.type.kind in ("float", "int")

    @property
    def pointer(self) -> str:
        return self.text if self.is_pointer else f"&{self.text}"

    def attribute(self, name: str) -> str:
        return f"{self.text}->{name}" if self.is_pointer else f"{self.text}.{name}"

    def stored(self, required: ValueType) -> str:
        """Return the C code for an assignment to a variable or parameter of the required type."""
        if required.kind == "object":
            return self.pointer
        if required.kind == "float":
            return as_float(self).text
        is_cast = required.kind == "int" and required.c_int not in ("int64_t", self.type.c_int)
        return f"({required.c_int}){self.at(Rank.UNARY)}" if is_cast and self.constant is None else self.text


def combine(text: str, type_: ValueType, rank: int, *parts: CExpression, **more: Any) -> CExpression:
    """Return a C expression that contains `parts`; it reads and writes all that they read and write."""
    reads: Locations = frozenset().union(*(part.reads for part in parts))
    writes: Locations = frozenset().union(*(part.writes for part in parts))
    return CExpression(text, type_, rank, reads, writes, **more)


def constant(value: Any) -> CExpression:
    """Return the C expression for a constant; its C code is empty if C has no equivalent."""
    if isinstance(value, bool):
        return CExpression("true" if value else "false", BOOL, constant=value)
    if not isinstance(value, (int, float)):
        return CExpression("", TEXT, constant=value)
    text = "NAN" if math.isnan(value) else repr(value).replace("inf", "INFINITY")
    span = (value, value) if math.isfinite(value) else None
    rank = Rank.UNARY if text.startswith("-") else Rank.ATOM
    type_ = INT if isinstance(value, int) else FLOAT
    return CExpression(text, type_, rank, sign=sign_of(value), span=span, constant=value)


def sign_of(value: float) -> int:
    """Return the sign of a number."""
    return Sign.POSITIVE if value > 0 else Sign.NONNEGATIVE if value == 0 else Sign.NONZERO * (value < 0)


def as_float(value: CExpression) -> CExpression:
    """Convert an int expression to a double; return other expressions unchanged."""
    if value.type.kind != "int":
        return value
    if value.constant is not None and value.text.lstrip("-").isdigit():
        return value._replace(text=f"{value.text}.0", type=FLOAT, constant=float(value.constant))
    return value._replace(text=f"(double){value.at(Rank.UNARY)}", type=FLOAT, rank=Rank.UNARY)
