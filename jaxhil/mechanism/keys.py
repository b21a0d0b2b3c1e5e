"""Descriptions of all keys of a mechanism file, for the reference pages and the comments in a new file.

The descriptions come from the types of the keys. A key without a description, or a number without a unit,
raises ValueError.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import msgspec
from msgspec import NODEFAULT, inspect

from jaxhil.contact.laws import CONTACT_KEYS, CONTACT_LAWS, laws_with_key
from jaxhil.mechanism.conversion import describe_allowed
from jaxhil.mechanism.rules import KEYS_OF_MODELS
from jaxhil.mechanism.structs import DAMPING_RATIO_LAWS, Mechanism

__all__ = ["KeyDescription", "TableDescription", "describe_tables"]


class KeyDescription(NamedTuple):
    """Description of one key in a table of a mechanism file."""

    name: str
    meaning: str  # description
    unit: str | None  # None: not a number; "1": dimensionless; "": unit depends on another key
    allowed: str  # the allowed values, in words
    required: bool
    default: Any  # None: no value by default
    users: tuple[str, ...]  # contact laws or motion simulator models that use the key; () if all do


class TableDescription(NamedTuple):
    """Description of one table of a mechanism file, with its keys."""

    path: str  # dotted path; '' for the head of the file
    meaning: str  # description
    keys: tuple[KeyDescription, ...]


def describe_tables(kind: type[msgspec.Struct] = Mechanism) -> tuple[TableDescription, ...]:
    """Describe the tables of a struct type, each table before its subtables.

    In paths, `"KEY"` stands for any key of a dictionary. Raise ValueError for a key without a description, or
    a number without a unit.
    """
    return tuple(_describe_tables(inspect.type_info(kind), ""))


def _describe_tables(kind: inspect.Type, path: str) -> Iterator[TableDescription]:
    """Yield the description of a struct type at a path, then the descriptions of its subtables."""
    assert isinstance(kind, inspect.StructType)
    keys, subtables = [], []
    for field in kind.fields:
        key_path = f"{path}.{field.encode_name}".lstrip(".")
        inner = _table_of(field.type)
        if inner is None:
            keys.append(_describe_key(field, key_path))
        elif isinstance(inner, inspect.DictType):
            subtables.append((inner.value_type, f'{key_path}."KEY"'))
        else:
            subtables.append((inner, key_path))
    yield TableDescription(path, _first_paragraph(kind), tuple(keys))
    for inner, key_path in subtables:
        yield from _describe_tables(inner, key_path)


def _first_paragraph(kind: inspect.StructType) -> str:
    return " ".join((kind.cls.__doc__ or "").split("\n\n")[0].split())


def _table_of(kind: inspect.Type) -> inspect.StructType | inspect.DictType | None:
    """Return the struct or dictionary type of a key that is a table; None for any other key."""
    match kind:
        case inspect.Metadata(type=inner):
            return _table_of(inner)
        case inspect.UnionType(types=members):
            return next((table for member in members if (table := _table_of(member))), None)
        case inspect.StructType() | inspect.DictType():
            return kind
        case _:
            return None


def _describe_key(field: inspect.Field, path: str) -> KeyDescription:
    """Describe the key at a path. Raise ValueError if it has no description, or is a number without unit."""
    meaning = next(_find_descriptions(field.type), "")
    if not meaning:
        raise ValueError(f"{path}: found no description in the type annotation, expected one")
    default = None if field.default is NODEFAULT else field.default
    if field.default_factory is not NODEFAULT:
        default = field.default_factory()
    return KeyDescription(
        field.encode_name,
        meaning,
        _unit(field.type, path),
        describe_allowed(field.type),
        field.required,
        default,
        _find_users(path),
    )


def _find_descriptions(kind: inspect.Type) -> Iterator[str]:
    """Yield the descriptions of a type and of the types within it, the outermost first."""
    match kind:
        case inspect.Metadata(type=inner, extra_json_schema=schema):
            if schema and schema.get("description"):
                yield schema["description"]
            yield from _find_descriptions(inner)
        case inspect.UnionType(types=members):
            for member in members:
                yield from _find_descriptions(member)
        case _:
            return


def _unit(kind: inspect.Type, path: str, extra: Mapping[str, Any] | None = None) -> str | None:
    """Return the unit of a type of numbers; None for other types. Raise ValueError if a number has none."""
    match kind:
        case inspect.Metadata(type=inner, extra=metadata):
            return _unit(inner, path, metadata)
        case inspect.UnionType(types=members):
            return next((unit for member in members if (unit := _unit(member, path)) is not None), None)
        case inspect.ListType(item_type=item):
            return _unit(item, path)
        case inspect.FloatType() | inspect.IntType():
            if not extra or extra.get("unit") is None:
                raise ValueError(f"{path}: found no unit in the type of the number, expected one")
            return extra["unit"]
        case _:
            return None


def _find_users(path: str) -> tuple[str, ...]:
    """Return the contact laws or simulator models that use the key at a path; () if all of them use it."""
    table, _, name = path.rpartition(".")
    if table == "contact":
        if name == "damping":
            return tuple(law.name for law in CONTACT_LAWS.values() if not law.dissipation_process)
        if name == "damping_ratio":
            return DAMPING_RATIO_LAWS
        return laws_with_key(CONTACT_KEYS[name]) if name in CONTACT_KEYS else ()
    if table == "rig.simulator":
        return tuple(model for model, keys in KEYS_OF_MODELS.items() if name in keys)
    return ()
