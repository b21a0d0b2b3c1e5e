"""Reader of MATLAB's MAT files, as Simulink, ControlDesk and scripts write them.

A field of a structure becomes a column whose name contains a dot (`log.force`). Signals of a structure
array are named by their labels (Simulink's "Structure With Time": `log.signals.x_cmd`; dSPACE ControlDesk:
`run.Y.Model/x_cmd`), or numbered from 1 if they have none. The columns of a matrix are numbered
(`log.position_2`), and so are its rows if it has more columns than rows (Simulink's "To File": `ans_2`).
"""

# The optional library may not be installed.
# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tuning.identification.logs.log_reader import ColumnsByName, LogReader, make_reader

# For each field with the values of several signals, the field with their names.
NAME_FIELDS = {"values": "label", "Data": "Name"}


def mat(path: Path) -> LogReader:
    """Open a MATLAB MAT file, version 5 or 7.3."""
    from pymatreader import read_mat

    content = read_mat(str(path))
    units: dict[str, str] = {}
    columns = _flatten(
        "", {name: value for name, value in content.items() if not name.startswith("__")}, units
    )
    if not columns:
        export = "export signals as arrays, or as a structure with time"
        raise ValueError(f"found no numbers, expected arrays or structures of numbers: {export}")
    return make_reader(columns, units)


def _flatten(name: str, value: Any, units: dict[str, str]) -> ColumnsByName:
    """Return the numeric columns in a nested value, by name; add units stored by ControlDesk to `units`."""
    if not isinstance(value, Mapping):
        return split_columns(name, value)
    columns: ColumnsByName = {}
    for part, content in value.items():
        path = f"{name}.{part}".lstrip(".")
        names = value.get(NAME_FIELDS.get(part, ""))
        if isinstance(content, list) or (part == "Data" and isinstance(names, str)):
            signals = content if isinstance(content, list) else [content]
            names = (
                names if isinstance(names, list) and len(names) == len(signals) else [names] * len(signals)
            )
            stated = value.get("Unit")
            stated = stated if isinstance(stated, list) and len(stated) == len(signals) else [stated]
            for index, (signal, label) in enumerate(zip(signals, names, strict=True)):
                is_unique = isinstance(label, str) and bool(label) and names.count(label) == 1
                title = f"{name}.{label}" if is_unique else f"{path}_{index + 1}"
                columns |= split_columns(title, signal)
                if isinstance(unit := stated[index % len(stated)], str) and unit:
                    units[title] = unit
        else:
            columns |= _flatten(path, content, units)
    return columns


def split_columns(name: str, value: Any) -> ColumnsByName:
    """Return the columns of a numeric vector or matrix by name; an empty dictionary for other values.

    A matrix has a signal in each row if it has more columns than rows.
    """
    try:
        array = np.asarray(value)
    except ValueError:
        return {}
    if array.dtype.kind not in "biuf" or array.ndim not in (1, 2):
        return {}
    if array.ndim == 1:
        return {name: array.astype(float)}
    signals = array if array.shape[0] < array.shape[1] else array.T
    return {f"{name}_{index + 1}": signal.astype(float) for index, signal in enumerate(signals)}
