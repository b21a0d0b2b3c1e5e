"""Mapping file `jaxhil/log/1`, which describes logs: channels, units and kinds of experiments.

    schema = "jaxhil/log/1"
    [channels]                  # a column's name, or a table: column, unit, scale, sign, offset
    [timing]                    # control_period, command_hold, command_latency, row, clock, rows_per_period
    [bodies]                    # masses of the numerical model
    [text]                      # skip_rows, units_row, delimiter, decimal, of text files
    [[runs]]                    # files (patterns), kind

A prior mechanism file provides the values that `[timing]` and `[bodies]` omit. The value of a channel, in its
unit, is sign * (scale * number + offset), where number is the entry of the column.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, field

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.mechanism.conversion import KeyProblem, suggest_names, to_struct
from jaxhil.mechanism.structs import Bodies, CommandHold, Mechanism, key_metadata
from jaxhil.mechanism.toml_table import parse_toml, read_bytes
from tuning.identification.logs.units import COUNTS_UNIT, UNITS_OF_CHANNEL, parse_unit
from tuning.identification.records import RowConvention, RunKind

SCHEMA = "jaxhil/log/1"
KINDS: tuple[RunKind, ...] = ("free", "press", "tap", "contact", "rest")

ColumnName = Annotated[str, Meta(min_length=1, max_length=200)]
FilePattern = Annotated[str, Meta(min_length=1, max_length=1000)]


class Channel(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Numeric column of a log and its conversion to SI units."""

    column: ColumnName  # name of the column
    # Unit of the column; by default the unit that the file states or, if it states none, the SI unit.
    unit: Annotated[str, Meta(min_length=1, max_length=20)] | None = None
    # Factor; if the unit is "counts", the value of one count in SI units.
    scale: Annotated[float, key_metadata("of the column's number", "")] = 1.0
    sign: Annotated[int, key_metadata("of the whole", "", ge=-1, le=1)] = 1
    offset: Annotated[float, key_metadata("added to the scaled number", "")] = 0.0  # in the given unit
    time: ColumnName | None = None  # column of separate time stamps, in the unit of `channels.time`


class TimeChannel(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Column of the rows' time stamps, or the rate of the rows if there are no time stamps."""

    column: ColumnName | None = None  # name of the column
    unit: Annotated[str, Meta(min_length=1, max_length=20)] | None = None  # s if not specified
    rate: Annotated[float, key_metadata("of rows without stamps", "Hz", gt=0.0)] | None = None
    # Format of `strptime`; texts in the format of ISO 8601 need none.
    time_format: Annotated[str, Meta(min_length=1, max_length=100)] | None = None
    nanoseconds: ColumnName | None = None  # column of nanoseconds that are added to a column of whole seconds


class ModeChannel(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Column that states the kind of experiment in each row."""

    column: ColumnName  # name of the column
    values: dict[str, RunKind] = field(default_factory=dict)  # kind of each entry that does not name a kind


class ChannelTable(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Table `[channels]`: the column of each channel."""

    time: TimeChannel
    position_desired: Channel
    position_measured: Channel
    force_measured: Channel | None = None
    velocity_desired: Channel | None = None
    force_command: Channel | None = None
    mode: ModeChannel | None = None
    contact_index: Channel | None = None


class TimingSection(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Table `[timing]`: timing of commands and readings in the logs."""

    control_period: Annotated[float, key_metadata("time from tick to tick", "s", gt=0.0, le=0.1)] | None = (
        None
    )
    command_hold: CommandHold | None = None
    command_latency: (
        Annotated[int, key_metadata("periods until a command reaches the drives", ge=0, le=1)] | None
    ) = None
    row: RowConvention = "tick"
    computing_delay: Annotated[
        int, key_metadata("periods from a reading to the command that answers it", ge=0, le=4)
    ] = 0
    clock: Literal["stamps", "index", "separate"] = "stamps"  # "separate": the forces have another clock
    # Number of log rows per control period; if it is not specified, stamps and commands determine it.
    rows_per_period: (
        Annotated[int, key_metadata("rows of the log per control period", ge=1, le=20)] | None
    ) = None


class TextFormat(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Table `[text]`: format of text files; what is not specified is detected in each file."""

    skip_rows: (
        Annotated[int, key_metadata("lines above that of the columns' names", ge=0, le=10_000)] | None
    ) = None
    units_row: bool | None = None  # whether a line of units follows that of the columns' names
    delimiter: Annotated[str, Meta(min_length=1, max_length=1)] | None = None  # " ": one or more blanks
    decimal: Literal[".", ","] | None = None


class _TextTable(Struct, frozen=True):
    text: TextFormat = TextFormat()


class RunFiles(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Entry of `[[runs]]`: log files of one kind of experiment."""

    files: Annotated[list[FilePattern], Meta(min_length=1, max_length=1000)]  # patterns of file names
    kind: RunKind
    begin: Annotated[float, key_metadata("of the run, from the first row", "s", ge=0.0)] = 0.0
    end: Annotated[float, key_metadata("of the run, from the first row", "s", gt=0.0)] | None = None

    def names(self, path: Path) -> bool:
        """Return whether the entry names a file: whether one of its patterns matches the path."""
        return any(PurePath(path).match(pattern) for pattern in self.files)


class LogMapping(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Content of a mapping file: channels, timing, masses, text format and runs."""

    schema: Literal["jaxhil/log/1"]
    channels: ChannelTable
    timing: TimingSection = TimingSection()
    bodies: Bodies | None = None
    text: TextFormat = TextFormat()
    runs: Annotated[list[RunFiles], Meta(min_length=1, max_length=1000)]


def load_mapping(path: str | os.PathLike[str]) -> LogMapping:
    """Load a mapping from a TOML file.

    Raises:
        InputError: If the file is missing or invalid.
    """
    label = to_one_line(os.fspath(path)) or "''"
    return parse_mapping(read_mapping_file(path, label), label)


def load_text_format(path: str | os.PathLike[str]) -> TextFormat:
    """Load the table `[text]` of a mapping file that may lack all other tables.

    Raises:
        InputError: If the file is missing, or if the table is invalid.
    """
    label = to_one_line(os.fspath(path)) or "''"
    raw = {"text": {}} | read_mapping_file(path, label)
    try:
        return to_struct(_TextTable, {"text": raw["text"]}).text
    except KeyProblem as problem:
        raise InputError(f"{label}: {problem}") from None


def parse_mapping(raw: Mapping[str, Any], label: str) -> LogMapping:
    """Convert parsed TOML tables to a mapping; `label` is the name of the mapping in messages.

    Raises:
        InputError: If the tables are invalid.
    """
    try:
        mapping = to_struct(LogMapping, expand_shorthand(raw))
        _check_mapping(mapping)
    except KeyProblem as problem:
        raise InputError(f"{label}: {problem}") from None
    return mapping


def make_simulation_mapping() -> LogMapping:
    """Return the mapping for the logs that `jaxhil simulate --log` writes."""
    names = ("position_desired", "position_measured", "force_measured", "velocity_desired", "force_command")
    channels = {"time": "time", **{name: name for name in names}, "contact_index": "contact"}
    runs = [{"files": "*", "kind": "contact"}]
    return parse_mapping({"schema": SCHEMA, "channels": channels, "runs": runs}, "own logs")


def get_si_conversion(channel: Channel, name: str, stated: str | None = None) -> tuple[float, float]:
    """Return the factor and the offset that convert a column to SI units: factor * number + offset.

    Args:
        channel: Column with its conversion.
        name: Name of the channel.
        stated: Unit that the file states, as it is spelled there; used if the mapping specifies none.
    """
    if channel.unit == COUNTS_UNIT or name not in UNITS_OF_CHANNEL:
        unit = 1.0
    else:
        units = UNITS_OF_CHANNEL[name]
        unit = units[channel.unit or parse_unit(stated or "", name) or next(iter(units))]
    return channel.sign * unit * channel.scale, channel.sign * unit * channel.offset


def read_mapping_file(path: str | os.PathLike[str], label: str) -> dict[str, Any]:
    try:
        data = read_bytes(Path(path), label, "a mapping")
    except FileNotFoundError:
        raise InputError(f"{label}: found no such file, expected a mapping file ({SCHEMA})") from None
    return parse_toml(data, label, "a mapping")


def expand_shorthand(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Expand shorthand in a mapping: replace a column's name by a table, and a file pattern by a list."""
    tables = dict(raw)
    if isinstance(channels := tables.get("channels"), Mapping):
        named = {
            key: {"column": entry} if isinstance(entry, str) else entry for key, entry in channels.items()
        }
        if "time" not in named and "rate" in named:
            named["time"] = {"rate": named.pop("rate")}
        tables["channels"] = named
    if isinstance(runs := tables.get("runs"), Sequence) and not isinstance(runs, str):
        tables["runs"] = [
            {**run, "files": [run["files"]]} if isinstance(run, Mapping) and isinstance(run.get("files"), str)
            else run
            for run in runs
        ]  # fmt: skip
    return tables


def _check_mapping(mapping: LogMapping) -> None:
    channels = mapping.channels
    for name, units in UNITS_OF_CHANNEL.items():
        channel = getattr(channels, name)
        if channel is None or channel.unit is None:
            continue
        allowed = [*units, *([COUNTS_UNIT] if name != "time" else [])]
        if channel.unit not in allowed:
            expected = f"one of {', '.join(allowed)}{suggest_names(channel.unit, allowed)}"
            raise KeyProblem(("channels", name, "unit"), format_value(channel.unit), expected)
        if channel.unit == COUNTS_UNIT and channel.scale == 1.0:
            raise KeyProblem(("channels", name, "scale"), "none", "the value of one count in SI units")
    for name in channels.__struct_fields__:
        channel = getattr(channels, name)
        if isinstance(channel, Channel) and channel.sign == 0:
            raise KeyProblem(("channels", name, "sign"), "0", "1 or -1")
        if isinstance(channel, Channel) and channel.scale == 0.0:
            raise KeyProblem(("channels", name, "scale"), "0.0", "a number other than 0")
    time = channels.time
    if (time.column is None) == (time.rate is None):
        finding = "neither" if time.rate is None else "both"
        raise KeyProblem(("channels", "time"), finding, "either a column of stamps or a rate of rows")
    if time.nanoseconds is not None and (time.time_format is not None or time.unit not in (None, "s")):
        expected = "none, because channels.time is not a column of seconds"
        raise KeyProblem(("channels", "time", "nanoseconds"), format_value(time.nanoseconds), expected)
    if time.column is None or time.time_format is not None:
        for name in channels.__struct_fields__:
            stamps_column = getattr(getattr(channels, name), "time", None)
            if stamps_column is not None:
                expected = "none, because channels.time is not a column of numbers"
                raise KeyProblem(("channels", name, "time"), format_value(stamps_column), expected)
    _check_rest(mapping)


def _check_rest(mapping: LogMapping) -> None:
    for index, run in enumerate(mapping.runs):
        if run.end is not None and run.end <= run.begin:
            raise KeyProblem(
                ("runs", index, "end"), format_value(run.end), f"a number > begin, {run.begin:g} s"
            )
    bodies = mapping.bodies
    if bodies is not None:
        specified = {key for key in bodies.__struct_fields__ if getattr(bodies, key) is not None}
        if specified not in ({"equivalent_mass"}, {"chaser_mass", "target_mass"}):
            either = "either equivalent_mass, or both chaser_mass and target_mass"
            raise KeyProblem(("bodies",), " and ".join(sorted(specified)) or "neither", either)


def find_equivalent_mass(mapping: LogMapping, prior: Mechanism | None) -> float | None:
    """Return the equivalent mass of the numerical model [kg] from the mapping; if omitted, from the prior."""
    if mapping.bodies is not None:
        return mapping.bodies.mass
    return None if prior is None else prior.bodies.mass
