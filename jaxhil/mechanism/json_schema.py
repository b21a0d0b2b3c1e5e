"""JSON Schema of mechanism files, for completion, descriptions and error marks in editors.

The schema contains the allowed values of each key. Rules that involve several keys are checked only when a
file is read.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec

from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.mechanism.conversion import SCALAR_LIST_KEYS
from jaxhil.mechanism.number_ranges import numeric_keys
from jaxhil.mechanism.six_axes import SIX_AXIS_SCHEMA, SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism

__all__ = ["build_json_schema"]

SIX_AXIS_PREFIX = "SixAxes."  # prefix of the names of six-axis tables


def build_json_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) as plain data, with all registered contact laws.

    The key `schema` of a file selects the one-axis or the six-axis tables.
    """
    has_six_axes = {"properties": {"schema": {"const": SIX_AXIS_SCHEMA}}, "required": ["schema"]}
    kinds = {
        "then": {"$ref": f"#/$defs/{SIX_AXIS_PREFIX}SixAxisMechanism"},
        "else": {"$ref": "#/$defs/Mechanism"},
    }
    tables = {**_one_axis(), **_six_axes()}
    draft = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": draft, "if": has_six_axes, **kinds, "$defs": tables}


def _one_axis() -> dict[str, Any]:
    """Return the schemas of the one-axis tables; keys in `SCALAR_LIST_KEYS` may also be one number."""
    tables = _tables(Mechanism)
    for table, name in SCALAR_LIST_KEYS:
        properties = tables[table.capitalize()]["properties"]
        entry = properties[name]["items"]
        number = entry["anyOf"][0] if "anyOf" in entry else entry
        meaning = properties[name].pop("description")
        properties[name] = {"description": meaning, "anyOf": [number, properties[name]]}
    tables["Mechanism"]["properties"]["uncertainty"]["propertyNames"] = {"enum": sorted(numeric_keys())}
    return tables


def _six_axes() -> dict[str, Any]:
    """Return the schemas of the six-axis tables; a prefix makes their names differ from one-axis names."""
    return {
        f"{SIX_AXIS_PREFIX}{name}": _add_prefix(table) for name, table in _tables(SixAxisMechanism).items()
    }


def _tables(kind: type[msgspec.Struct]) -> dict[str, Any]:
    tables = {name: _clean_schema(table) for name, table in msgspec.json.schema(kind)["$defs"].items()}
    tables["Contact"]["properties"]["law"]["enum"] = list(CONTACT_LAWS)
    return tables


def _add_prefix(node: Any) -> Any:
    """Add `SIX_AXIS_PREFIX` to the names of the tables that a schema refers to."""
    if isinstance(node, list):
        return [_add_prefix(entry) for entry in node]
    if not isinstance(node, dict):
        return node
    root = "#/$defs/"
    return {
        key: value.replace(root, root + SIX_AXIS_PREFIX)
        if key == "$ref" and isinstance(value, str)
        else _add_prefix(value)
        for key, value in node.items()
    }


def _clean_schema(node: Any) -> Any:
    """Add units to the descriptions in a schema, and remove null values and infinite defaults.

    TOML has no null, and JSON has no infinite numbers.
    """
    if isinstance(node, list):
        return [_clean_schema(entry) for entry in node]
    if not isinstance(node, dict):
        return node
    if "six" in node or "square" in node:
        return _add_short_forms(node)
    cleaned = {key: _clean_schema(value) for key, value in node.items() if key not in ("unit", "default")}
    if (unit := node.get("unit")) not in (None, "", "1"):
        cleaned["description"] += f" [{unit}]"
    default = node.get("default")
    if default is not None and "$ref" not in node and default != math.inf:
        cleaned["default"] = default
    members = [entry for entry in cleaned.get("anyOf", ()) if entry.get("type") != "null"]
    if len(members) == 1:
        [member] = members
        return {key: value for key, value in cleaned.items() if key != "anyOf"} | member
    return cleaned


def _add_short_forms(node: dict[str, Any]) -> dict[str, Any]:
    """Extend the schema of a list of six numbers, or of a matrix, to accept one number instead.

    The schema of six numbers also accepts a table of two numbers.
    """
    full = _clean_schema(
        {key: value for key, value in node.items() if key not in ("six", "square", "description")}
    )
    number = full["items"]["items"] if "square" in node else full["items"]
    forms = [number]
    if names := node.get("six"):
        numbers = dict.fromkeys(names, number)
        table = {"type": "object", "properties": numbers, "required": names, "additionalProperties": False}
        forms.append(table)
    return {"description": node["description"], "anyOf": [*forms, full]}
