"""Channels of a log in SI units, at the rows of the desired position, as its mapping names them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

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

STAMPS = re.compile(r"^t$|^time$|stamp", re.IGNORECASE)  # names of columns of stamps in a group


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
    _check_stamps_beside(log, mapping, wanted)
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


def _check_stamps_beside(log: Log, mapping: LogMapping, wanted: Mapping[str, str]) -> None:
    """Raise `InputError` if a group of columns has stamps of its own that are not those of the rows.

    Groups are those of HDF5, MAT and TDMS, by the names of columns."""
    time = mapping.channels.time
    if time.column is None or log.stamps:
        return
    for name, column in wanted.items():
        for stamps in _stamps_beside(column, time.column, log.names):
            read = log.read([time.column, stamps])
            rows, own = read[time.column], read[stamps]
            if rows.dtype == object or own.dtype == object or min(len(rows), len(own)) < 2:
                continue
            step, other = float(np.median(np.diff(rows))), float(np.median(np.diff(own)))
            if not (step > 0.0 and other > 0.0):
                continue
            # Stamps may be in another unit of time.
            power = round(float(np.log10(other / step)) / 3.0)
            own = own * 1000.0**-power
            if abs(other * 1000.0**-power / step - 1.0) > clock.RATE:
                continue  # of another kind, such as a count
            if len(rows) == len(own) and np.max(np.abs(own - rows)) <= joining.AT_A_ROW * step:
                continue
            raise InputError(
                f"{log.label}: column {shown(column)}: found stamps of its own in {shown(stamps)} that are "
                f"not those in {shown(time.column)}, expected channels.{name}.time = {shown(stamps)}"
            )


def _stamps_beside(column: str, time: str, names: Sequence[str]) -> list[str]:
    """Return columns named like stamps in the groups of a column that do not hold those of the rows."""
    found = []
    for other in names:
        name = re.split(r"[/.]", other)[-1]
        parent = other[: len(other) - len(name)]
        if parent and column.startswith(parent) and not time.startswith(parent) and STAMPS.search(name):
            found.append(other)
    return [one for one in found if one != column]


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
