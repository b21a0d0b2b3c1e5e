"""Mapping file `jaxhil/log/1` of six-axis logs: six columns for each wrench, pose and twist.

    schema = "jaxhil/log/1"
    [channels]
    time = "t"
    wrench_measured = ["fx", "fy", "fz", "mx", "my", "mz"]      # or a table: columns, units, sign
    pose_measured = { columns = ["x", "y", "z", "rx", "ry", "rz"], units = ["mm", "deg"] }
    ...

The tables `[timing]`, `[text]` and `[[runs]]` are those of one axis (`mapping`). All columns have the time
stamps of the rows, and each control period has one row. Wrenches are about the origin of target frame T.
Poses and twists are those of chaser frame C relative to T. Wrenches, poses and twists are in T axes, as in
the files of `jaxhil simulate --log`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.mechanism.conversion import KeyProblem, suggest_names, to_struct
from jaxhil.mechanism.structs import key_metadata
from jaxhil.rig.flight_recorder import CHANNELS
from tuning.identification.logs.mapping import (
    SCHEMA,
    Channel,
    ColumnName,
    RunFiles,
    TextFormat,
    TimeChannel,
    TimingSection,
    expand_shorthand,
    parse_mapping,
    read_mapping_file,
)
from tuning.identification.logs.units import FORCE_UNITS, LENGTH_UNITS, SPEED_UNITS

ANGLE_UNITS = {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295}
ANGULAR_SPEED_UNITS = {f"{unit}/s": factor for unit, factor in ANGLE_UNITS.items()}
TORQUE_UNITS = {"N m": 1.0, "N mm": 1e-3, "kN m": 1e3}
# Allowed units of the first three columns of a channel and of its last three; SI units come first.
VECTOR_UNITS = {
    "wrench_measured": (FORCE_UNITS, TORQUE_UNITS),
    "wrench_command": (FORCE_UNITS, TORQUE_UNITS),
    "pose_desired": (LENGTH_UNITS, ANGLE_UNITS),
    "pose_measured": (LENGTH_UNITS, ANGLE_UNITS),
    "twist_desired": (SPEED_UNITS, ANGULAR_SPEED_UNITS),
}


class VectorChannel(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Six columns of a log, and their conversion to SI units."""

    columns: Annotated[
        list[ColumnName], Meta(min_length=6, max_length=6)
    ]  # three components of translation, then three of rotation
    units: Annotated[list[str], Meta(min_length=2, max_length=2)] | None = (
        None  # units of the translations and of the rotations; None: SI units
    )
    sign: Annotated[int, key_metadata("of all six columns", "", ge=-1, le=1)] = 1


class SixAxisChannels(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Table `[channels]` of a mapping for six-axis logs: the columns of each channel."""

    time: TimeChannel
    wrench_measured: VectorChannel
    pose_desired: VectorChannel
    pose_measured: VectorChannel
    twist_desired: VectorChannel
    wrench_command: VectorChannel
    contact_index: Channel | None = None


class SixAxisLogMapping(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Content of a mapping file for six-axis logs."""

    schema: Literal["jaxhil/log/1"]
    channels: SixAxisChannels
    timing: TimingSection = TimingSection()
    text: TextFormat = TextFormat()
    runs: Annotated[list[RunFiles], Meta(min_length=1, max_length=1000)]


def load_six_axis_mapping(path: str | os.PathLike[str]) -> SixAxisLogMapping:
    """Load a mapping of six-axis logs from a TOML file.

    Raises:
        InputError: If the file is missing or invalid.
    """
    label = to_one_line(os.fspath(path)) or "''"
    return parse_six_axis_mapping(read_mapping_file(path, label), label)


def parse_six_axis_mapping(raw: Mapping[str, Any], label: str) -> SixAxisLogMapping:
    """Convert parsed TOML tables to a mapping; `label` is the name of the mapping in messages.

    Raises:
        InputError: If the tables are invalid.
    """
    tables = expand_shorthand(raw)
    if isinstance(channels := tables.get("channels"), Mapping):
        tables["channels"] = {
            name: {"columns": list(entry)} if _is_list(entry) else entry for name, entry in channels.items()
        }
    try:
        mapping = to_struct(SixAxisLogMapping, tables)
        _check_units(mapping.channels)
        _check_rows(mapping)
    except KeyProblem as problem:
        raise InputError(f"{label}: {problem}") from None
    # The checks of the time stamps, of the contact's index and of the runs are those of one axis.
    checked = dict.fromkeys(("position_desired", "position_measured"), "x") | {
        name: tables["channels"][name] for name in ("time", "contact_index") if name in tables["channels"]
    }
    parse_mapping({"schema": SCHEMA, "channels": checked, "runs": tables["runs"]}, label)
    return mapping


def make_six_axis_simulation_mapping() -> SixAxisLogMapping:
    """Return the mapping for the six-axis logs that `jaxhil simulate --log` writes."""
    channels = {name: [prefix + suffix for suffix in suffixes] for name, prefix, suffixes in CHANNELS[6]}
    runs = [{"files": "*", "kind": "contact"}]
    return parse_six_axis_mapping(
        {"schema": SCHEMA, "channels": {"time": "time", **channels}, "runs": runs}, "own logs"
    )


def get_factors(channel: VectorChannel, name: str) -> list[float]:
    """Return the factors that convert the six columns of the channel `name` to SI units."""
    tables = VECTOR_UNITS[name]
    units = channel.units or [next(iter(table)) for table in tables]
    return [channel.sign * table[unit] for table, unit in zip(tables, units, strict=True) for _ in range(3)]


def _check_rows(mapping: SixAxisLogMapping) -> None:
    """Raise `KeyProblem` if a key on time stamps or rows has a value that six-axis logs do not allow."""
    index, timing = mapping.channels.contact_index, mapping.timing
    if index is not None and index.time is not None:
        expected = "none, because six-axis logs have the time stamps of the rows"
        raise KeyProblem(("channels", "contact_index", "time"), format_value(index.time), expected)
    if timing.clock == "separate":
        raise KeyProblem(("timing", "clock"), "separate", "stamps or index, in six-axis logs")
    if timing.rows_per_period not in (None, 1):
        raise KeyProblem(("timing", "rows_per_period"), str(timing.rows_per_period), "1, in six-axis logs")


def _is_list(entry: Any) -> bool:
    return isinstance(entry, Sequence) and not isinstance(entry, str)


def _check_units(channels: SixAxisChannels) -> None:
    for name, tables in VECTOR_UNITS.items():
        channel: VectorChannel = getattr(channels, name)
        if channel.sign == 0:
            raise KeyProblem(("channels", name, "sign"), "0", "1 or -1")
        for index, (unit, table) in enumerate(zip(channel.units or (), tables, strict=False)):
            if unit not in table:
                expected = f"one of {', '.join(table)}{suggest_names(unit, table)}"
                raise KeyProblem(("channels", name, "units", index), format_value(unit), expected)
