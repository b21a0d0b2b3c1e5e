"""The JSON Schema of mechanism files: editors that have it complete keys, show meanings and mark errors.

It states what each key allows by itself; the rules that join several keys are checked when a file is read.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec

from jaxhil.mechanism.conversion import NUMBER_FOR_LIST
from jaxhil.mechanism.structs import CONTACT_LAWS, Mechanism, numeric_keys

__all__ = ["json_schema"]


def json_schema() -> dict[str, Any]:
    """The schema as plain data (draft 2020-12), with the contact laws that are registered."""
    stated = msgspec.json.schema(Mechanism)
    tables = {name: _tidy(table) for name, table in stated.pop("$defs").items()}
    tables["Contact"]["properties"]["law"]["enum"] = list(CONTACT_LAWS)
    for table, name in NUMBER_FOR_LIST:
        properties = tables[table.capitalize()]["properties"]
        entry = properties[name]["items"]
        number = entry["anyOf"][0] if "anyOf" in entry else entry
        meaning = properties[name].pop("description")
        properties[name] = {"description": meaning, "anyOf": [number, properties[name]]}
    tables["Mechanism"]["properties"]["uncertainty"]["propertyNames"] = {"enum": sorted(numeric_keys())}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **stated, "$defs": tables}


def _tidy(node: Any) -> Any:
    """Units in the descriptions; without null, which TOML has not, and without defaults that JSON has not."""
    if isinstance(node, list):
        return [_tidy(entry) for entry in node]
    if not isinstance(node, dict):
        return node
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
