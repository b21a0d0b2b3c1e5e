"""Types of the supported subset of Python, values of expressions, and the error for other constructs.

In C, a float is a `double`, an int is an `int64_t`, and a class is a struct. A list has a fixed length; or
`__init__` computes the length, and the capacity is the constant JAXHIL_<CLASS>_<ATTRIBUTE>. C has no
equivalent of `str`; the generator omits such values. Annotations:

    Annotated[float, ">= 0"]       number that is never negative; every assignment is checked (also "> 0")
    Annotated[int, "index"]        index that C does not compare with the length of the list
    Annotated[int, "uint32_t"]     int with this C type
    Annotated[list[float], 18]     list of 18 numbers; two lengths for a list of lists

Instead of raising an exception, a C function sets an error flag and returns. To do so, it tests divisors,
square roots, indices, conversions to int, and products and sums of ints. Ints are limited to 2^53. Because no
counter reaches this limit, sums with a small term are not tested.
"""

import types
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple, get_args, get_origin

C_RESERVED_WORDS = frozenset(
    "auto bool break case catch char class const continue default delete do double else enum explicit export "
    "extern false float for friend goto if inline int long mutable namespace new operator private protected "
    "public register restrict return short signed sizeof static struct switch template this throw true try "
    "typedef typename union unsigned using virtual void volatile while acos asin atan ceil cos exp fabs "
    "floor fmod isfinite isinf isnan log pow sin sqrt tan tanh copysign error result".split()
)
Locations = frozenset[tuple[Any, str]]  # memory locations: pairs of class, "local" or "parameter", and name


class Sign:
    """Bits for what is known about a number's sign; 0 if nothing is known. No bit excludes NaN."""

    NONNEGATIVE, NONZERO, POSITIVE = 1, 2, 3


SIGN_TEXTS = {Sign.NONNEGATIVE: ">= 0", Sign.NONZERO: "not 0", Sign.POSITIVE: "> 0"}


class SubsetError(ValueError):
    """Exception for an unsupported construct; the message is `FILE:LINE: found X, expected Y`."""

    def __init__(self, file: str, line: int, found: str, expected: str) -> None:
        super().__init__(f"{file}:{line}: found {found}, expected {expected}")


class ValueType(NamedTuple):
    """Type of a Python value, with the properties that its C type needs."""

    # float, int, bool, list, object, record, struct (of gains or limits), optional, none, or
    # non-number, which has no equivalent in C
    kind: str
    of: Any = None  # element type of a list, class of an object or record, name of a struct
    length: int | None = None  # length of a list; None if it is known only at run time
    sign: int = 0  # sign of a number
    c_int: str = "int64_t"  # C type of an int
    capacity: str = ""  # for a list of run-time length: C name of its capacity
    is_index: bool = False  # whether an int is an index that needs no test

    @property
    def plain(self) -> "ValueType":
        return self._replace(sign=0, c_int="int64_t", is_index=False)


FLOAT, INT, BOOL, TEXT, NONE = (ValueType(kind) for kind in ("float", "int", "bool", "non-number", "none"))


def type_of_annotation(hint: Any, bindings: Mapping[Any, Any]) -> ValueType | None:
    """Return the `ValueType` of an annotation; None if C has no equivalent."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        type_ = type_of_annotation(arguments[0], bindings)
        return type_ and _apply_notes(type_, arguments[1:])
    hint = bindings.get(hint, hint) if isinstance(hint, type) else hint
    simple = {float: FLOAT, int: INT, bool: BOOL, str: TEXT, None: NONE, type(None): NONE}
    if hint in simple:
        return simple[hint]
    if origin is tuple and {*arguments} == {float}:
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


def _apply_notes(type_: ValueType, notes: Sequence[Any]) -> ValueType:
    if not notes:
        return type_
    note, rest = notes[0], notes[1:]
    if isinstance(note, int):
        return type_._replace(length=note, of=_apply_notes(type_.of, rest))
    changes = {"index": {"is_index": True}} | {text: {"sign": sign} for sign, text in SIGN_TEXTS.items()}
    others = {"int": {"c_int": note}, "struct": {"of": note}}.get(type_.kind, {})
    return _apply_notes(type_._replace(**changes.get(note, others)), rest)
