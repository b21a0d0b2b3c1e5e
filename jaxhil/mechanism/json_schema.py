"""JSON Schema of mechanism files, with which editors complete keys, show descriptions and mark errors.

It contains the allowed values of each key; rules for several keys together are checked when a file is read.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec

from jaxhil.contact.laws import LAWS
from jaxhil.mechanism.conversion import NUMBER_FOR_LIST
from jaxhil.mechanism.six_axes import SCHEMA_SIX, SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism, numeric_keys

__all__ = ["json_schema"]

SIX = "SixAxes."  # prefix of the names of six-axis tables


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) as plain data, with the registered contact laws.

    A file's key `schema` selects the one-axis or the six-axis tables.
    """
    has_six_axes = {"properties": {"schema": {"const": SCHEMA_SIX}}, "required": ["schema"]}
    kinds = {"then": {"$ref": f"#/$defs/{SIX}SixAxisMechanism"}, "else": {"$ref": "#/$defs/Mechanism"}}
    tables = {**_one_axis(), **_six_axes()}
    draft = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": draft, "if": has_six_axes, **kinds, "$defs": tables}


def _one_axis() -> dict[str, Any]:
    """Return the one-axis tables; some lists may also be a single number."""
    tables = _tables(Mechanism)
    for table, name in NUMBER_FOR_LIST:
        properties = tables[table.capitalize()]["properties"]
        entry = properties[name]["items"]
        number = entry["anyOf"][0] if "anyOf" in entry else entry
        meaning = properties[name].pop("description")
        properties[name] = {"description": meaning, "anyOf": [number, properties[name]]}
    tables["Mechanism"]["properties"]["uncertainty"]["propertyNames"] = {"enum": sorted(numeric_keys())}
    return tables


def _six_axes() -> dict[str, Any]:
    """Return the six-axis tables, with a prefix because one-axis tables have the same names."""
    return {f"{SIX}{name}": _renamed(table) for name, table in _tables(SixAxisMechanism).items()}


def _tables(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the schema of each table of a struct type, by name."""
    tables = {name: _tidy(table) for name, table in msgspec.json.schema(kind)["$defs"].items()}
    tables["Contact"]["properties"]["law"]["enum"] = list(LAWS)
    return tables


def _renamed(node: Any) -> Any:
    """Return a schema whose references to tables have the six-axis prefix."""
    if isinstance(node, list):
        return [_renamed(entry) for entry in node]
    if not isinstance(node, dict):
        return node
    root = "#/$defs/"
    return {
        key: value.replace(root, root + SIX) if key == "$ref" and isinstance(value, str) else _renamed(value)
        for key, value in node.items()
    }


def _tidy(node: Any) -> Any:
    """Return a schema with units in the descriptions, without null values and infinite defaults.

    TOML has no null, and JSON has no infinite numbers.
    """
    if isinstance(node, list):
        return [_tidy(entry) for entry in node]
    if not isinstance(node, dict):
        return node
    if "six" in node or "square" in node:
        return _with_short_forms(node)
    tidied = {key: _tidy(value) for key, value in node.items() if key not in ("unit", "default")}
    if (unit := node.get("unit")) not in (None, "", "1"):
        tidied["description"] += f" [{unit}]"
    default = node.get("default")
    if default is not None and "$ref" not in node and default != math.inf:
        tidied["default"] = default
    members = [entry for entry in tidied.get("anyOf", ()) if entry.get("type") != "null"]
    if len(members) == 1:
        [member] = members
        return {key: value for key, value in tidied.items() if key != "anyOf"} | member
    return tidied


def _with_short_forms(node: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of six numbers or of a matrix, extended by the forms with one or two numbers."""
    full = _tidy({key: value for key, value in node.items() if key not in ("six", "square", "description")})
    number = full["items"]["items"] if "square" in node else full["items"]
    forms = [number]
    if names := node.get("six"):
        numbers = dict.fromkeys(names, number)
        table = {"type": "object", "properties": numbers, "required": names, "additionalProperties": False}
        forms.append(table)
    return {"description": node["description"], "anyOf": [*forms, full]}
