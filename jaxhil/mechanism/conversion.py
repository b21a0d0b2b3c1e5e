"""Conversion of a table parsed from TOML or JSON into a `Mechanism`, key by key.

The table is compared with the struct types of `jaxhil.mechanism.structs`. A message about an invalid key
states the key's path, the value found and the allowed values. Rules that involve several keys are in
`jaxhil.mechanism.rules`.
"""

from __future__ import annotations

import difflib
import functools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from jaxhil.errors import format_value, to_one_line
from jaxhil.mechanism.number_ranges import describe_struct, is_computable, range_of
from jaxhil.mechanism.structs import MAGNITUDE_LIMITS, NO_METADATA, Mechanism

__all__ = [
    "SCALAR_LIST_KEYS",
    "KeyPath",
    "KeyProblem",
    "add_magnitude_limits",
    "describe_allowed",
    "describe_allowed_at",
    "find_member_type",
    "format_entry_count",
    "format_key_path",
    "raise_problems",
    "run_checks",
    "suggest_names",
    "to_mechanism",
    "to_struct",
]

AnyStruct = TypeVar("AnyStruct", bound=msgspec.Struct)
KeyPath = tuple[str | int, ...]
TypeMetadata = Mapping[str, Any]  # `extra` of the metadata from `jaxhil.contact.keys.key_metadata`

# Lists for which a bare number stands for a list of one entry.
SCALAR_LIST_KEYS = ("contact", "stiffness"), ("contact", "damping"), ("contact", "damping_ratio")
# Polynomials, whose leading zeros have no effect and are dropped.
_POLYNOMIALS = {("rig", "simulator", "numerator"), ("rig", "simulator", "denominator")}


_type_info = functools.cache(inspect.type_info)


class KeyProblem(Exception):
    """Exception for an invalid key: its path, the value found, and the expected values in words.

    Attributes:
        further: Problems of other keys in the same table or file.
    """

    def __init__(self, path: KeyPath, found: str, expected: str):
        super().__init__(path, found, expected)
        self.path = path
        self.found = found
        self.expected = expected
        self.further: tuple[KeyProblem, ...] = ()

    def __str__(self) -> str:
        where = f"{format_key_path(self.path)}: " if self.path else ""
        return f"{where}found {self.found}, expected {self.expected}"


def raise_problems(problems: Sequence[KeyProblem]) -> None:
    """Raise the first problem, with all others in its attribute `further`. Do nothing if there are none."""
    if problems:
        first, *others = problems
        further = [problem for other in others for problem in (other, *other.further)]
        first.further = (*first.further, *further)
        raise first


def run_checks(checks: Iterable[Callable[[], object]]) -> None:
    """Run all checks, and raise `KeyProblem` with the problems of all checks that fail."""
    problems = []
    for check in checks:
        try:
            check()
        except KeyProblem as problem:
            problems.append(problem)
    raise_problems(problems)


def format_key_path(path: KeyPath) -> str:
    """Format a key's path as TOML text, such as ``uncertainty."contact.stiffness".factor[0]``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
            continue
        bare = re.fullmatch(r"[A-Za-z0-9_-]+", part) and len(part) <= 60
        quoted = to_one_line(part[:61].replace("\\", "\\\\").replace('"', '\\"'), 60)
        text += "." * bool(text) + (part if bare else f'"{quoted}"')
    return text


def suggest_names(word: str, names: Iterable[str]) -> str:
    """Return ` (did you mean X?)` with the `names` most similar to `word`, or an empty text."""
    matches = difflib.get_close_matches(word[:200], list(names), n=3, cutoff=0.6)
    return f" (did you mean {' or '.join(matches)}?)" if matches else ""


def format_entry_count(entries: Sequence[object]) -> str:
    """Return the text "a list of N entries", where N is the length of `entries`."""
    return f"a list of {len(entries)} entr{'y' if len(entries) == 1 else 'ies'}"


def add_magnitude_limits(allowed: object) -> str:
    """Append the supported range of magnitudes to `allowed`, the text of a key's allowed values."""
    return f"{allowed}, of a magnitude from {MAGNITUDE_LIMITS[0]:g} to {MAGNITUDE_LIMITS[1]:g}"


def to_mechanism(raw: Mapping[str, Any]) -> Mechanism:
    """Convert a parsed table to a `Mechanism`. Raise `KeyProblem` for unknown or invalid keys.

    Integers are accepted as numbers. `contact.stiffness`, `contact.damping` and `contact.damping_ratio` may
    be a single number instead of a list. Leading zeros of a transfer function's polynomials are dropped.
    """
    return msgspec.convert(_convert(describe_struct(Mechanism), raw, (), NO_METADATA), Mechanism)


def to_struct(kind: type[AnyStruct], raw: Mapping[str, Any]) -> AnyStruct:
    """Convert a parsed table to a struct of type `kind`. Raise `KeyProblem` for an unknown or invalid key."""
    return msgspec.convert(_convert(_type_info(kind), raw, (), NO_METADATA), kind)


def find_member_type(kind: inspect.Type, part: str | int, path: KeyPath) -> inspect.Type:
    """Return the type of the value at the key or list index `part` in a value of the type `kind`.

    Raise `KeyProblem` if the type has no such key or index.
    """
    match kind:
        case inspect.Metadata(type=inner, extra={"six": names}) if part in names:
            return find_member_type(inner, 0, path)
        case inspect.Metadata(type=inner):
            return find_member_type(inner, part, path)
        case inspect.UnionType(types=members):
            inside = inspect.ListType if isinstance(part, int) else (inspect.ListType, inspect.StructType)
            inner = [member for member in members if isinstance(_strip_metadata(member), inside)]
            if inner:
                return find_member_type(inner[0], part, path)
        case inspect.StructType(fields=fields) if isinstance(part, str):
            for entry in fields:
                if entry.encode_name == part:
                    return entry.type
            raise _unknown_key(kind, part, path)
        case inspect.DictType(value_type=value) if isinstance(part, str):
            return value
        case inspect.ListType(item_type=item) if isinstance(part, int):
            return item
        case _:
            pass
    raise KeyProblem(
        (*path, part), "no such key", describe_allowed(kind, NO_METADATA) + f" at {format_key_path(path)}"
    )


def describe_allowed(kind: inspect.Type, extra: TypeMetadata = NO_METADATA) -> str:
    """Describe the allowed values of a msgspec type in words."""
    match kind:
        case inspect.Metadata(extra={"one_of": names}):
            return f"one of {', '.join(names)}"
        case inspect.Metadata(type=inner, extra={"six": names}):
            entry = (
                describe_allowed(inner.item_type, NO_METADATA) if isinstance(inner, inspect.ListType) else ""
            )
            return f"{entry}, {{ {', '.join(names)} }} of two, or a list of six"
        case inspect.Metadata(type=inner, extra={"square": size}):
            return f"one number for all entries, or a list of {size} rows of {size} entries"
        case inspect.Metadata(type=inner):
            return describe_allowed(inner, kind.extra or NO_METADATA)
        case inspect.UnionType(types=members):
            kinds = [describe_allowed(m, extra) for m in members if not isinstance(m, inspect.NoneType)]
            return " or ".join(kinds)
        case inspect.FloatType():
            return str(range_of(kind, extra))
        case inspect.IntType():
            return f"an integer from {kind.ge} to {kind.le}"
        case inspect.BoolType():
            return "true or false"
        case inspect.StrType():
            return f"a text of {kind.min_length or 0} to {kind.max_length} characters"
        case inspect.LiteralType(values=values):
            return "one of " * (len(values) > 1) + ", ".join(map(str, values))
        case inspect.ListType(item_type=item):
            shortest, longest = kind.min_length or 0, kind.max_length
            length = f"{shortest}" if shortest == longest else f"{shortest} to {longest}"
            return f"a list of {length} entries, each {describe_allowed(item, NO_METADATA)}"
        case _:
            return "a table"


def describe_allowed_at(kind: type[msgspec.Struct], key: str) -> str:
    """Describe the allowed values of one key of a struct type in words."""
    info = _type_info(kind)
    assert isinstance(info, inspect.StructType)
    [key_type] = (entry.type for entry in info.fields if entry.encode_name == key)
    return describe_allowed(key_type)


def _strip_metadata(kind: inspect.Type) -> inspect.Type:
    return _strip_metadata(kind.type) if isinstance(kind, inspect.Metadata) else kind


def _unknown_key(kind: inspect.StructType, key: str, path: KeyPath) -> KeyProblem:
    names = [entry.encode_name for entry in kind.fields]
    expected = f"one of {', '.join(names)}{suggest_names(key, names)}"
    return KeyProblem((*path, key), "an unknown key", expected)


def _convert(kind: inspect.Type, value: Any, path: KeyPath, extra: TypeMetadata) -> Any:
    """Convert `value` to plain data of type `kind`, with numbers as floats.

    Raise `KeyProblem` if the value is invalid.
    """
    if path in SCALAR_LIST_KEYS and isinstance(value, (int, float)) and not isinstance(value, bool):
        value = [value]
    match kind:
        case inspect.Metadata(extra={"one_of": names}):
            if isinstance(value, str) and value in names:
                return value
        case inspect.Metadata(type=inner, extra={"six": names}):
            return _convert(inner, _expand_six_entries(kind, names, value, path), path, NO_METADATA)
        case inspect.Metadata(type=inner, extra={"square": size}):
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            return _convert(inner, [[value] * size] * size if number else value, path, NO_METADATA)
        case inspect.Metadata(type=inner):
            return _convert(inner, value, path, kind.extra or NO_METADATA)
        case inspect.UnionType(types=members):
            return _convert(_choose_member(members, value), value, path, extra)
        case inspect.NoneType():
            return None
        case inspect.StructType() if isinstance(value, Mapping):
            return _convert_struct(kind, value, path)
        case inspect.DictType(value_type=inner) if isinstance(value, Mapping):
            return {key: _convert(inner, entry, (*path, key), NO_METADATA) for key, entry in value.items()}
        case inspect.ListType(item_type=item) if isinstance(value, (list, tuple)):
            shortest, longest = kind.min_length or 0, kind.max_length
            if len(value) < shortest or (longest is not None and len(value) > longest):
                raise KeyProblem(path, format_entry_count(value), describe_allowed(kind, NO_METADATA))
            converted = [_convert(item, entry, (*path, i), NO_METADATA) for i, entry in enumerate(value)]
            while path in _POLYNOMIALS and len(converted) > 1 and converted[0] == 0.0:
                del converted[0]
            return converted
        case inspect.FloatType() if isinstance(value, (int, float)) and not isinstance(value, bool):
            try:
                number = float(value)
            except OverflowError:
                number = math.nan
            if range_of(kind, extra).allows(number):
                if not is_computable(number):
                    raise KeyProblem(path, format_value(value), add_magnitude_limits(range_of(kind, extra)))
                return number
        case inspect.IntType() if isinstance(value, int) and not isinstance(value, bool):
            if range_of(kind, NO_METADATA).allows(value):
                return value
        case inspect.BoolType() if isinstance(value, bool):
            return value
        case inspect.StrType() if isinstance(value, str):
            shortest, longest = kind.min_length or 0, kind.max_length or math.inf
            if shortest <= len(value) <= longest:
                return value
        case inspect.LiteralType(values=values) if isinstance(value, str) and value in values:
            return value
        case _:
            pass
    raise KeyProblem(path, format_value(value), describe_allowed(kind, extra))


def _convert_struct(kind: inspect.StructType, value: Mapping[Any, Any], path: KeyPath) -> dict[str, Any]:
    """Convert a table to plain data of the struct type `kind`. Raise `KeyProblem` for all invalid keys."""
    names = {entry.encode_name for entry in kind.fields}
    problems = [_unknown_key(kind, str(key), path) for key in value if key not in names]
    has_unknown, converted = bool(problems), {}
    for entry in kind.fields:
        name = entry.encode_name
        if name in value:
            try:
                converted[name] = _convert(entry.type, value[name], (*path, name), NO_METADATA)
            except KeyProblem as problem:
                problems.append(problem)
        elif entry.required and not has_unknown:
            # If there is an unknown key, it may be a misspelling of this key.
            problems.append(KeyProblem((*path, name), "nothing", describe_allowed(entry.type, NO_METADATA)))
    raise_problems(problems)
    return converted


def _expand_six_entries(kind: inspect.Metadata, names: Sequence[str], value: Any, path: KeyPath) -> Any:
    """Expand one number, or a table of two numbers with the keys `names`, to a list of six numbers.

    Return a list unchanged. Raise `KeyProblem` for any other value.
    """
    if isinstance(value, (list, tuple)):
        return value
    if isinstance(value, Mapping) and set(value) == set(names):
        return [value[name] for name in names for _ in range(3)]
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return [value] * 6
    raise KeyProblem(path, format_value(value), describe_allowed(kind, NO_METADATA))


def _choose_member(members: Iterable[inspect.Type], value: Any) -> inspect.Type:
    """Return the member of a union type that suits a value: None, a list, or a scalar."""
    kinds = list(members)
    none = [kind for kind in kinds if isinstance(kind, inspect.NoneType)]
    if value is None and none:
        return none[0]
    lists = [kind for kind in kinds if isinstance(kind, inspect.ListType)]
    scalars = [kind for kind in kinds if kind not in none and kind not in lists]
    return (lists or scalars if isinstance(value, (list, tuple)) else scalars or lists)[0]
