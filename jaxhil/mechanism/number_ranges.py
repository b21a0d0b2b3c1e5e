"""Ranges of the numbers in a mechanism file, found by dotted path from the types in `structs`."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct

from jaxhil.mechanism.structs import MAGNITUDE_LIMITS, NO_METADATA, Mechanism


class Range(NamedTuple):
    """Interval of the allowed values of a number, with its unit."""

    low: float
    high: float
    low_open: bool  # whether `low` itself is excluded
    high_open: bool  # whether `high` itself is excluded
    unit: str = "1"

    def allows(self, value: float) -> bool:
        """Return whether `value` is in the interval; False for NaN."""
        above = value > self.low if self.low_open else value >= self.low
        below = value < self.high if self.high_open else value <= self.high
        return above and below

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        if math.isinf(self.low):
            return f"a finite number{' of' * bool(unit)}{unit}"
        if math.isinf(self.high):
            ending = "" if self.high_open else ", inf included"
            return f"a number {'>' if self.low_open else '>='} {self.low:g}{unit}{ending}"
        if self.low_open:
            return f"a number > {self.low:g}{unit} and {'<' if self.high_open else '<='} {self.high:g}{unit}"
        return f"a number from {self.low:g} to {self.high:g}{unit}"


def is_computable(value: float) -> bool:
    """Return whether a number is 0 or infinite, or its magnitude is within `MAGNITUDE_LIMITS`."""
    return value == 0.0 or math.isinf(value) or MAGNITUDE_LIMITS[0] <= abs(value) <= MAGNITUDE_LIMITS[1]


def range_of(kind: msgspec.inspect.FloatType | msgspec.inspect.IntType, extra: Mapping[str, Any]) -> Range:
    """Return the allowed values of a number from its msgspec type and the `extra` of its metadata."""
    low = kind.gt if kind.gt is not None else kind.ge
    high = kind.lt if kind.lt is not None else kind.le
    return Range(
        -math.inf if low is None else float(low),
        math.inf if high is None else float(high),
        low is None or kind.gt is not None,
        not extra.get("infinite") if high is None else kind.lt is not None,
        extra.get("unit", "1"),
    )


@functools.cache
def describe_struct(kind: type[Struct]) -> msgspec.inspect.StructType:
    """Return msgspec's description of a type, such as `Mechanism`."""
    info = msgspec.inspect.type_info(kind)
    assert isinstance(info, msgspec.inspect.StructType)
    return info


@functools.cache
def numeric_keys() -> dict[str, Range]:
    """Return the allowed values of the real numbers in a one-axis file, by the dotted path of the key."""
    return ranges_of(describe_struct(Mechanism), NO_METADATA)


def ranges_of(kind: msgspec.inspect.Type, names: Mapping[str, Sequence[str]]) -> dict[str, Range]:
    """Return the allowed values of every real-valued key of a struct type, by dotted path.

    `names` contains, for the path of each dictionary (such as ``contact``), the names of its tables.
    """
    keys: dict[str, Range] = {}

    def visit(kind: msgspec.inspect.Type, path: str, extra: Mapping[str, Any] = NO_METADATA) -> None:
        match kind:
            case msgspec.inspect.StructType(fields=fields):
                for entry in fields:
                    if entry.name not in ("correlation", "damping_ratio") or path == "rig.simulator":
                        # Correlations and damping ratios are skipped, because they only determine other keys.
                        visit(entry.type, f"{path}.{entry.encode_name}".lstrip("."))
            case msgspec.inspect.Metadata(type=inner):
                visit(inner, path, kind.extra or NO_METADATA)
            case msgspec.inspect.UnionType(types=members):
                for member in members:
                    visit(member, path, extra)
            case msgspec.inspect.ListType(item_type=item):
                visit(item, path)
            case msgspec.inspect.DictType(value_type=table):
                for name in names.get(path, ()):
                    visit(table, f"{path}.{name}")
            case msgspec.inspect.FloatType():
                keys[path] = range_of(kind, extra)
            case _:
                pass

    visit(kind, "")
    return keys


def value_at(mechanism: Struct, path: str) -> Any:
    """Return the value at a dotted path such as ``rig.simulator.delay``, or None if a table is missing."""
    return functools.reduce(_entry, path.split("."), mechanism)


def _entry(table: Any, key: str) -> Any:
    """Return the value of a table's key; None if the table is None, or is a dictionary without the key."""
    if table is None:
        return None
    if isinstance(table, dict):
        return table.get(key)
    if key in table.__struct_fields__:
        return getattr(table, key)
    fields = dict(zip(table.__struct_encode_fields__, table.__struct_fields__, strict=True))
    return getattr(table, fields[key])
