"""Every key of a mechanism file, as its type describes it: reference pages and a new file's comments are made
of this.

A key whose meaning, or a number whose unit nobody stated has no place there: both raise ValueError.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import msgspec
from msgspec import NODEFAULT, inspect

from jaxhil.contact.laws import KEYS, LAWS, laws_with
from jaxhil.mechanism.conversion import allowed_of
from jaxhil.mechanism.rules import KEYS_OF_MODELS
from jaxhil.mechanism.structs import Mechanism

__all__ = ["Key", "Table", "tables"]


class Key(NamedTuple):
    """One key of a table."""

    name: str
    meaning: str
    unit: str | None  # None of what is no number, "1" of a number without unit, "" for that of another key
    allowed: str  # the allowed values, in words
    required: bool
    default: Any  # None of a key that has no value unless it is given one
    users: tuple[str, ...]  # contact laws, or models of the motion simulator; () if it is for all


class Table(NamedTuple):
    """One table of the file: its dotted path, '' that of the file's head; what it says; its keys."""

    path: str
    meaning: str
    keys: tuple[Key, ...]


def tables(kind: type[msgspec.Struct] = Mechanism) -> tuple[Table, ...]:
    """The tables of a struct, each before those within it; `"KEY"` stands for the keys of a dictionary.

    Raises ValueError for a key whose type does not say what it means, or of a number the unit.
    """
    return tuple(_tables(inspect.type_info(kind), ""))


def _tables(kind: inspect.Type, path: str) -> Iterator[Table]:
    assert isinstance(kind, inspect.StructType)
    keys, within = [], []
    for field in kind.fields:
        where = f"{path}.{field.encode_name}".lstrip(".")
        inner = _table_of(field.type)
        if inner is None:
            keys.append(_key(field, where))
        elif isinstance(inner, inspect.DictType):
            within.append((inner.value_type, f'{where}."KEY"'))
        else:
            within.append((inner, where))
    yield Table(path, _first_paragraph(kind), tuple(keys))
    for inner, where in within:
        yield from _tables(inner, where)


def _first_paragraph(kind: inspect.StructType) -> str:
    """The first paragraph of a struct's docstring, on one line."""
    return " ".join((kind.cls.__doc__ or "").split("\n\n")[0].split())


def _table_of(kind: inspect.Type) -> inspect.StructType | inspect.DictType | None:
    """The table that a key's type is, possibly an optional one."""
    match kind:
        case inspect.Metadata(type=inner):
            return _table_of(inner)
        case inspect.UnionType(types=members):
            return next((found for member in members if (found := _table_of(member))), None)
        case inspect.StructType() | inspect.DictType():
            return kind
        case _:
            return None


def _key(field: inspect.Field, path: str) -> Key:
    meaning = next(_meanings(field.type), "")
    if not meaning:
        raise ValueError(f"{path}: its type does not say what it means")
    default = None if field.default is NODEFAULT else field.default
    if field.default_factory is not NODEFAULT:
        default = field.default_factory()
    return Key(
        field.encode_name, meaning, _unit(field.type, path), allowed_of(field.type), field.required, default,
        _users(path),
    )  # fmt: skip


def _meanings(kind: inspect.Type) -> Iterator[str]:
    match kind:
        case inspect.Metadata(type=inner, extra_json_schema=said):
            if said and said.get("description"):
                yield said["description"]
            yield from _meanings(inner)
        case inspect.UnionType(types=members):
            for member in members:
                yield from _meanings(member)
        case _:
            return


def _unit(kind: inspect.Type, path: str, extra: Mapping[str, Any] | None = None) -> str | None:
    """The unit of a number, or of a list's entries."""
    match kind:
        case inspect.Metadata(type=inner, extra=said):
            return _unit(inner, path, said)
        case inspect.UnionType(types=members):
            return next((unit for member in members if (unit := _unit(member, path)) is not None), None)
        case inspect.ListType(item_type=item):
            return _unit(item, path)
        case inspect.FloatType() | inspect.IntType():
            if not extra or extra.get("unit") is None:
                raise ValueError(f"{path}: its type does not say the number's unit")
            return extra["unit"]
        case _:
            return None


def _users(path: str) -> tuple[str, ...]:
    table, _, name = path.rpartition(".")
    if table == "contact":
        if name == "damping":
            return tuple(law.name for law in LAWS.values() if not law.dissipates_by)
        return laws_with(KEYS[name]) if name in KEYS else ()
    if table == "rig.simulator":
        return tuple(model for model, keys in KEYS_OF_MODELS.items() if name in keys)
    return ()
