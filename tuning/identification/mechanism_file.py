"""Text of a mechanism file: values, uncertainty and correlation of identified parameters."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

# minimum eigenvalue of the correlation matrix in the file; it prevents a singular matrix after rounding
MIN_CORRELATION_EIGENVALUE = 1e-6
FILE_DIGITS = 12  # number of significant digits in the file


def make_uncertainty_tables(
    keys: list[str], draws: np.ndarray, floors: np.ndarray, off: np.ndarray | None = None
) -> dict[str, Any]:
    """Return the tables `[uncertainty]` and `[correlation]` of a mechanism file from posterior draws.

    All entries of a list parameter have one standard deviation and one common row in the correlation matrix.

    Args:
        keys: Dotted keys of the parameters; the key of a list entry ends in its index.
        draws: Draws of the parameters, shape (draws, keys).
        floors: Minimum standard deviation of each parameter.
        off: For each key, the value in the file minus the mean of the draws. Its square is added to the
            variance.
    """
    covariance = np.atleast_2d(np.cov(draws.T))
    covariance = covariance if off is None else covariance + np.outer(off, off)
    short = np.maximum(floors**2 - np.diag(covariance), 0.0)
    covariance = covariance + np.diag(short)
    names = list(dict.fromkeys(_strip_index(key) for key in keys))
    groups = [[i for i, key in enumerate(keys) if _strip_index(key) == name] for name in names]
    std = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(std, std)
    # The correlation of a list parameter is the mean of the correlations of its entries.
    joined = np.array(
        [[np.mean(correlation[np.ix_(first, second)]) for second in groups] for first in groups]
    )
    np.fill_diagonal(joined, 1.0)
    values, vectors = np.linalg.eigh(joined)
    if values.min() < MIN_CORRELATION_EIGENVALUE:
        joined = vectors @ np.diag(np.maximum(values, MIN_CORRELATION_EIGENVALUE)) @ vectors.T
        scale = np.sqrt(np.diag(joined))
        joined = joined / np.outer(scale, scale)
    uncertainty = {}
    for name, group in zip(names, groups, strict=True):
        entry: dict[str, Any] = {"distribution": "normal", "std": float(np.sqrt(np.mean(std[group] ** 2)))}
        if len(group) > 1:
            entry["independent"] = True
        uncertainty[name] = entry
    tables: dict[str, Any] = {"uncertainty": uncertainty}
    if len(names) > 1:
        rows = [[round(float(joined[i, j]), 9) for j in range(i)] + [1.0] for i in range(len(names))]
        tables["correlation"] = {"keys": names, "matrix": rows}
    return tables


def _strip_index(key: str) -> str:
    """Return the key of a list entry without its index."""
    parts = key.split(".")
    while parts[-1].isdigit():
        parts.pop()
    return ".".join(parts)


def set_value(document: dict[str, Any], key: str, value: float) -> None:
    """Set the value at a dotted key in nested tables; the key of a list entry ends in its index."""
    *path, last = [int(part) if part.isdigit() else part for part in key.split(".")]
    table: Any = document
    for part in path:
        table = table[part]
    table[last] = value


def to_toml(document: dict[str, Any], comment: str = "") -> str:
    """Convert nested tables of a mechanism (`to_plain_data`) to TOML text, after an optional comment."""
    lines = [f"# {line}" for line in comment.splitlines()]
    tables: list[tuple[str, dict[str, Any]]] = []

    def collect(path: str, table: dict[str, Any]) -> None:
        plain = {key: value for key, value in table.items() if not isinstance(value, dict)}
        if plain and path:
            tables.append((path, plain))
        for key, value in table.items():
            if isinstance(value, dict):
                collect(f"{path}.{key}".lstrip("."), value)

    inline = {name: document[name] for name in ("uncertainty",) if document.get(name)}
    rest = {key: value for key, value in document.items() if key not in ("uncertainty",)}
    lines += [f"{key} = {_format_value(value)}" for key, value in rest.items() if not isinstance(value, dict)]
    collect("", rest)
    for path, table in tables:
        lines += ["", f"[{path}]"]
        lines += [f"{key} = {_format_value(value)}" for key, value in table.items() if value is not None]
    for path, table in inline.items():
        lines += ["", f"[{path}]"]
        for key, entry in table.items():
            parts = ", ".join(
                f"{name} = {_format_value(value)}" for name, value in entry.items() if value is not None
            )
            lines.append(f"{json.dumps(key)} = {{ {parts} }}")
    return "\n".join(lines) + "\n"


def _format_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_format_value(item) for item in value) + "]"
    if isinstance(value, int):
        return str(value)
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    text = f"{value:.{FILE_DIGITS}g}"
    return text if any(mark in text for mark in ".en") else text + ".0"
