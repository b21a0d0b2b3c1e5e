"""The JSON Schema of mechanism files: editors that have it complete keys, show meanings and mark errors.

It states what each key allows by itself; the rules that join several keys are checked when a file is read.
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

SIX = "SixAxes."  # begins the names of tables of six axes


def json_schema() -> dict[str, Any]:
    """The schema as plain data (draft 2020-12), with the contact laws that are registered: that of one axis
    or of six, as a file's own `schema` says."""
    of_six_axes = {"properties": {"schema": {"const": SCHEMA_SIX}}, "required": ["schema"]}
    kinds = {"then": {"$ref": f"#/$defs/{SIX}SixAxisMechanism"}, "else": {"$ref": "#/$defs/Mechanism"}}
    tables = {**_one_axis(), **_six_axes()}
    draft = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": draft, "if": of_six_axes, **kinds, "$defs": tables}


def _one_axis() -> dict[str, Any]:
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
    """Under names of their own: tables of one axis have the same."""
    return {f"{SIX}{name}": _renamed(table) for name, table in _tables(SixAxisMechanism).items()}


def _tables(kind: type[msgspec.Struct]) -> dict[str, Any]:
    tables = {name: _tidy(table) for name, table in msgspec.json.schema(kind)["$defs"].items()}
    tables["Contact"]["properties"]["law"]["enum"] = list(LAWS)
    return tables


def _renamed(node: Any) -> Any:
    if isinstance(node, list):
        return [_renamed(entry) for entry in node]
    if not isinstance(node, dict):
        return node
    place = "#/$defs/"
    return {
        key: value.replace(place, place + SIX)
        if key == "$ref" and isinstance(value, str)
        else _renamed(value)
        for key, value in node.items()
    }


def _tidy(node: Any) -> Any:
    """Units in the descriptions; without null, which TOML has not, and without defaults that JSON has not."""
    if isinstance(node, list):
        return [_tidy(entry) for entry in node]
    if not isinstance(node, dict):
        return node
    if "six" in node or "square" in node:
        return _shorter(node)
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


def _shorter(node: dict[str, Any]) -> dict[str, Any]:
    """Six numbers that may be said as one or two, or a matrix that may be said as one."""
    whole = _tidy({key: value for key, value in node.items() if key not in ("six", "square", "description")})
    number = whole["items"]["items"] if "square" in node else whole["items"]
    several = [number]
    if names := node.get("six"):
        each = dict.fromkeys(names, number)
        table = {"type": "object", "properties": each, "required": names, "additionalProperties": False}
        several.append(table)
    return {"description": node["description"], "anyOf": [*several, whole]}
