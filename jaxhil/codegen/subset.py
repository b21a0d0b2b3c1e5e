"""Types of the supported subset of Python, values of expressions, and the error for other constructs.

In C, a float is a `double`, an int is an `int64_t`, and a class is a struct. A list has a fixed length, or a
capacity that an annotation of its owner specifies. C has no equivalent of `str`; the generator omits such
values. Annotations:

    Annotated[float, ">= 0"]       number that is never negative; every assignment is checked (also "> 0")
    Annotated[int, "index"]        index that C does not compare with the length of the list
    Annotated[int, "uint32_t"]     int with this C type
    Annotated[list[float], 18]     list of 18 numbers; two lengths for a list of lists
    Annotated[DelayLine, "lag"]    delay line with the capacity JAXHIL_LAG_SAMPLES

Instead of raising an exception, a C function sets an error flag and returns. To do so, it tests divisors,
square roots, indices, conversions to int, and products and sums of ints. Ints are limited to 2^53. Because no
counter reaches this limit, sums with a small term are not tested.
"""

import types
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple, get_args, get_origin

ATOM, UNARY, PRODUCT, SUM, RELATION, EQUALITY, BITS, AND, OR, CONDITIONAL = 16, 14, 13, 12, 10, 9, 8, 5, 4, 3
C_RESERVED_WORDS = frozenset(
    "auto bool break case catch char class const continue default delete do double else enum explicit export "
    "extern false float for friend goto if inline int long mutable namespace new operator private protected "
    "public register restrict return short signed sizeof static struct switch template this throw true try "
    "typedef typename union unsigned using virtual void volatile while acos asin atan ceil cos exp fabs "
    "floor fmod isfinite isinf isnan log pow sin sqrt tan tanh copysign error result".split()
)


class SubsetError(ValueError):
    """Exception for an unsupported construct; the message is `FILE:LINE: found X, expected Y`."""


class ValueType(NamedTuple):
    """Type of a Python value, with the properties that its C type needs."""

    kind: str  # float, int, bool, text, none, list, object, record, struct (of gains or limits), optional
    of: Any = None  # element type of a list, class of an object or record, name of a struct
    length: int | None = None  # length of a list; None if it is known only at run time
    sign: str = ""  # sign of a number: "> 0", ">= 0", "not 0", or "" if unknown; NaN counts as every sign
    c_int: str = "int64_t"  # C type of an int
    key: str = ""  # name of the gain or limit that determines the capacity of an object's samples
    is_index: bool = False  # whether an int is an index that needs no test


FLOAT, INT, BOOL, TEXT, NONE = (ValueType(kind) for kind in ("float", "int", "bool", "text", "none"))
Locations = frozenset[tuple[Any, str]]  # memory locations: pairs of class, "local" or "parameter", and name


class CExpression(NamedTuple):
    """C expression for the value of a Python expression."""

    text: str  # C code
    type: ValueType  # type of the value
    rank: int = ATOM  # precedence of the expression's outermost operator in C
    reads: Locations = frozenset()  # variables and attributes that are read when the expression is evaluated
    writes: Locations = frozenset()  # variables and attributes that the evaluation changes
    fails: bool = False  # whether the error flag must be tested after the evaluation
    sign: str = ""  # sign of the value, as in `ValueType`
    span: tuple[Any, Any] | None = None  # least and largest value, if known at export
    below: str = ""  # for the index of a loop: C code of the length that limits the index
    constant: Any = None  # value, if known at export
    is_pointer: bool = False  # for an object: whether `text` is a pointer
    samples: tuple[str, ...] = ()  # for an object: C code of its lists of run-time length
    length: str = ""  # for a list of run-time length: C code of the length

    def at(self, rank: int) -> str:
        """Return the C code, in parentheses if its operator has a lower precedence than `rank`."""
        return self.text if self.rank >= rank else f"({self.text})"

    @property
    def is_number(self) -> bool:
        """Return whether the value is a float or an int."""
        return self.type.kind in ("float", "int")


def as_float(value: CExpression) -> CExpression:
    """Convert an int expression to a double; return other expressions unchanged."""
    if value.type.kind != "int":
        return value
    if value.constant is not None and value.text.lstrip("-").isdigit():
        return value._replace(text=f"{value.text}.0", type=FLOAT, constant=float(value.constant))
    return value._replace(text=f"(double){value.at(UNARY)}", type=FLOAT, rank=UNARY)


def refusal(file: str, line: int, found: str, expected: str) -> SubsetError:
    """Return the `SubsetError` for an unsupported construct."""
    return SubsetError(f"{file}:{line}: found {found}, expected {expected}")


def type_of_annotation(hint: Any, bindings: Mapping[Any, Any]) -> ValueType | None:
    """Return the `ValueType` of an annotation; None if C has no equivalent."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        type_ = type_of_annotation(arguments[0], bindings)
        return type_ and _apply_annotations(type_, arguments[1:])
    hint = bindings.get(hint, hint) if isinstance(hint, type) else hint
    simple = {float: FLOAT, int: INT, bool: BOOL, str: TEXT, None: NONE, type(None): NONE}
    if hint is None or (isinstance(hint, type) and hint in simple):
        return simple[hint]
    if origin is tuple and arguments and all(argument is float for argument in arguments):
        return ValueType("list", FLOAT, len(arguments))
    if origin in (list, Sequence):
        element = type_of_annotation(arguments[0], bindings)
        return element and ValueType("list", element)
    if origin is Mapping:
        return ValueType("struct", "gains")
    if origin is types.UnionType and arguments == (float, type(None)):
        return ValueType("optional", FLOAT)
    if isinstance(hint, type) and hint.__module__ != "builtins":
        return ValueType("record" if issubclass(hint, tuple) else "object", hint)
    return None


def _apply_annotations(type_: ValueType, notes: Sequence[Any]) -> ValueType:
    for index, note in enumerate(notes):
        if isinstance(note, int):
            inner = type_.of if index + 1 == len(notes) else _apply_annotations(type_.of, notes[index + 1 :])
            return type_._replace(length=note, of=inner)
        if note in (">= 0", "> 0"):
            type_ = type_._replace(sign=note)
        elif note == "index":
            type_ = type_._replace(is_index=True)
        else:
            name = {"int": "c_int", "object": "key", "struct": "of"}[type_.kind]
            type_ = type_._replace(**{name: note})
    return type_


def sign_of(value: Any) -> str:
    """Return the sign of a constant; "" if the constant is not a number or is NaN."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return ""
    return "> 0" if value > 0 else ">= 0" if value == 0 else "not 0" if value < 0 else ""


def implies_sign(sign: str, required: str) -> bool:
    """Return whether the sign `sign` of a number implies `required`, for example "> 0" implies ">= 0"."""
    return required in ("", sign) or sign == "> 0"


def common_sign(signs: Sequence[str]) -> str:
    """Return the strongest sign that every one of `signs` implies; "" if there is none."""
    return next(
        (s for s in ("> 0", ">= 0", "not 0") if all(sign and implies_sign(sign, s) for sign in signs)), ""
    )
