"""Types of the subset of Python, values of expressions, and the error for other constructs.

A float is a `double`, an int an `int64_t`; a list has a fixed length, or a capacity that its owner states; a
class is a struct. Values of type `str` have no equivalent in C and are omitted. Annotations:

    Annotated[float, ">= 0"]            never below 0, checked wherever it is assigned (also "> 0")
    Annotated[int, "index"]             trusted as an index: not tested against the length of the list
    Annotated[int, "uint32_t"]          the type in C
    Annotated[list[float], 18]          a list of 18 numbers; two lengths for a list of lists
    Annotated[DelayLine, "lag"]         its samples have the capacity JAXHIL_LAG_SAMPLES

Exceptions of Python become an error flag: a function that may raise tests the operands (divisors, square
roots, indices, conversions to int, products and sums of ints) and returns at once. An int ends at 2^53,
which counts do not reach: sums with a small term are not tested.
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
    """Error for a construct outside the subset: one line with file, line, what was found and expected."""


class ValueType(NamedTuple):
    """Type of a value."""

    kind: str  # float, int, bool, text, none, list, object, record, struct (of gains or limits), optional
    of: Any = None  # element type of a list, class of an object or record, name of a struct
    length: int | None = None  # of a list; None if known only at run time
    sign: str = ""  # of a number: "> 0", ">= 0", "not 0" (NaN has every sign), or unknown
    c_int: str = "int64_t"  # type of an int in C
    key: str = ""  # of an object with samples: the gain or limit that sizes them
    is_index: bool = False  # of an int: trusted as an index


FLOAT, INT, BOOL, TEXT, NONE = (ValueType(kind) for kind in ("float", "int", "bool", "text", "none"))
Locations = frozenset[tuple[Any, str]]  # attributes, local lists and parameters: owner and name


class CExpression(NamedTuple):
    """Expression in C."""

    text: str  # C text
    type: ValueType
    rank: int = ATOM  # precedence of its operator in C
    reads: Locations = frozenset()
    writes: Locations = frozenset()  # what its evaluation changes
    fails: bool = False  # whether the error flag must be tested afterwards
    sign: str = ""
    span: tuple[Any, Any] | None = None  # least and largest value, if known at export
    below: str = ""  # C text of a length above a loop's index
    constant: Any = None  # value, if known at export
    is_pointer: bool = False  # of an object: the text is a pointer
    samples: tuple[str, ...] = ()  # of an object: C texts of its lists of run-time length
    length: str = ""  # of a list of run-time length: C text of the length

    def at(self, rank: int) -> str:
        """Return the text, in parentheses if its operator has a lower precedence than `rank`."""
        return self.text if self.rank >= rank else f"({self.text})"

    @property
    def is_number(self) -> bool:
        """Return whether the value is a float or an int."""
        return self.type.kind in ("float", "int")


def as_float(value: CExpression) -> CExpression:
    """Convert an int to a double."""
    if value.type.kind != "int":
        return value
    if value.constant is not None and value.text.lstrip("-").isdigit():
        return value._replace(text=f"{value.text}.0", type=FLOAT, constant=float(value.constant))
    return value._replace(text=f"(double){value.at(UNARY)}", type=FLOAT, rank=UNARY)


def refusal(file: str, line: int, found: str, expected: str) -> SubsetError:
    """Return the error for a construct outside the subset."""
    return SubsetError(f"{file}:{line}: found {found}, expected {expected}")


def type_of_annotation(hint: Any, bindings: Mapping[Any, Any]) -> ValueType | None:
    """Return the type of an annotation, None if it has no equivalent in C."""
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
    """Return the sign of a constant."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return ""
    return "> 0" if value > 0 else ">= 0" if value == 0 else "not 0" if value < 0 else ""


def implies_sign(sign: str, wanted: str) -> bool:
    """Return whether every number of one sign also has the wanted sign."""
    return wanted in ("", sign) or sign == "> 0"


def common_sign(signs: Sequence[str]) -> str:
    """Return the strongest sign that all these signs imply, "" if there is none."""
    return next(
        (s for s in ("> 0", ">= 0", "not 0") if all(sign and implies_sign(sign, s) for sign in signs)), ""
    )
