"""Channels of a log in SI units, at the rows of the desired position, as its mapping names them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaxhil.errors import InputError, one_line, shown
from tuning.identification.logs import checks, clock, joining
from tuning.identification.logs.mapping import Channel, LogMapping, si
from tuning.identification.logs.readers import Columns, Log

NUMBERS = (
    "position_desired",
    "position_measured",
    "force_measured",
    "velocity_desired",
    "force_command",
    "contact_index",
)


def columns_of(
    log: Log, mapping: LogMapping, period: float
) -> tuple[Columns, np.ndarray | None, float, list[str]]:
    """The channels that are there, in SI units, the stamps [s] from the first, that one, and notes."""
    channels = mapping.channels
    wanted: dict[str, str] = {}
    for name in (*NUMBERS, "mode"):
        channel = getattr(channels, name)
        required = name in ("position_desired", "position_measured")
        if channel is not None and (required or channel.column in log.names):
            wanted[name] = channel.column
    stamps = [channels.time.column, *(getattr(channels, name).time for name in wanted if name != "mode")]
    read = log.read(list(dict.fromkeys([*wanted.values(), *(one for one in stamps if one is not None)])))
    columns: Columns = {}
    for name, column in wanted.items():
        values = read[column]
        if name != "mode":
            channel: Channel = getattr(channels, name)
            if values.dtype == object:
                raise InputError(
                    f"{log.label}: column {shown(column)}: found {shown(values[0])}, allowed numbers"
                )
            factor, offset = si(channel, name)
            values = values if (factor, offset) == (1.0, 0.0) else factor * values + offset
        columns[name] = values
    clocks = _clocks(log, mapping, wanted, read)
    if clocks is None:
        time = channels.time.column
        joining.check_lengths(log.label, columns | ({"time": read[time]} if time else {}), wanted)
        return columns, *_stamps(log.label, read, mapping), []
    columns, stamps, notes = joining.join(log.label, columns, clocks, wanted, period)
    first = clocks[joining.MASTER]
    begin = 0.0 if first is None else float(first[0])
    return columns, stamps - begin, begin, notes


def _clocks(
    log: Log, mapping: LogMapping, wanted: Mapping[str, str], read: Columns
) -> dict[str, np.ndarray | None] | None:
    """Stamps of each channel where not all have the same; None where the rows of the log are those of all."""
    named = {name: getattr(getattr(mapping.channels, name), "time", None) for name in wanted}
    if any(named.values()):
        return _named_clocks(log.label, mapping, named, read)
    own = log.clocks(list(wanted.values()))
    clocks = {name: own.get(column) for name, column in wanted.items()}
    master = clocks[joining.MASTER]
    other = [wanted[name] for name, one in clocks.items() if not joining.same_clock(one, master)]
    if not other:
        return None
    time, since = mapping.channels.time, f"{shown(other[0])} has a clock of its own"
    if mapping.timing.clock == "index":
        raise InputError(f'{log.label}: timing.clock: found "index", allowed "stamps", since {since}')
    if time.column is not None and time.column not in log.stamps:
        allowed = ", ".join(sorted(one_line(one, 40) for one in log.stamps)[:4])
        found = f"column {shown(time.column)}"
        raise InputError(f"{log.label}: time: found {found}, allowed one of {allowed}, since {since}")
    return clocks


def _named_clocks(
    label: str, mapping: LogMapping, named: Mapping[str, str | None], read: Columns
) -> dict[str, np.ndarray | None]:
    """Stamps [s] of each channel by the columns that the mapping names, from the first one of them all."""
    time = mapping.channels.time
    if mapping.timing.clock == "index":
        name = next(name for name, column in named.items() if column)
        raise InputError(
            f'{label}: timing.clock: found "index", allowed "stamps", since channels.{name}.time is named'
        )
    columns = {name: column or time.column for name, column in named.items()}
    for column in dict.fromkeys(columns.values()):
        if column is not None and read[column].dtype == object:
            raise InputError(
                f"{label}: column {shown(column)}: found {shown(read[column][0])}, allowed numbers"
            )
    factor = si(Channel(column=time.column or "", unit=time.unit), "time")[0]
    zero = min(float(read[column][0]) for column in columns.values() if column and len(read[column]))
    scaled = {column: factor * (read[column] - zero) for column in columns.values() if column}
    return {name: scaled[column] if column else None for name, column in columns.items()}


def _stamps(label: str, read: Columns, mapping: LogMapping) -> tuple[np.ndarray | None, float]:
    time = mapping.channels.time
    if time.column is None:
        return None, 0.0
    stamps = read[time.column]
    if time.time_format is not None:
        return clock.parsed(stamps, time.time_format, label)
    if stamps.dtype == object:
        allowed = "numbers, or a time_format beside the column"
        raise InputError(f"{label}: column {shown(time.column)}: found {shown(stamps[0])}, allowed {allowed}")
    checks.check_rows(label, "time", stamps)
    # The first stamp may count from an epoch: what is left has digits to spare.
    factor = si(Channel(column=time.column, unit=time.unit), "time")[0]
    return factor * (stamps - stamps[:1]), factor * float(stamps[0]) if len(stamps) else 0.0
