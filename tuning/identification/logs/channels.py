"""Channels of a log according to its mapping, in SI units and at the times of the desired position."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from jaxhil.errors import InputError, format_value, to_one_line
from tuning.identification.logs import checks, clock, resampling, row_rate
from tuning.identification.logs.log_reader import ColumnsByName
from tuning.identification.logs.mapping import Channel, LogMapping, get_si_conversion
from tuning.identification.logs.readers import OpenLog
from tuning.identification.logs.resampling import MASTER_CHANNEL as MASTER
from tuning.identification.logs.units import COUNTS_UNIT, parse_unit

NUMERIC_CHANNELS = (
    "position_desired",
    "position_measured",
    "force_measured",
    "velocity_desired",
    "force_command",
    "contact_index",
)

STAMP_COLUMN_PATTERN = re.compile(r"^t$|^time$|stamp", re.IGNORECASE)  # names of columns with time stamps


def read_channels(
    log: OpenLog, mapping: LogMapping, period: float
) -> tuple[ColumnsByName, np.ndarray | None, float, list[str]]:
    """Read those channels of a log that its mapping names.

    Args:
        log: Open log.
        mapping: Mapping of columns to channels.
        period: Control period [s].

    Returns:
        The available channels in SI units; the time stamps of the rows minus the first one [s], or None if
        there are none; the first time stamp [s]; and notes.
    """
    channels = mapping.channels
    wanted: dict[str, str] = {}
    for name in (*NUMERIC_CHANNELS, "mode"):
        channel = getattr(channels, name)
        required = name in ("position_desired", "position_measured")
        if channel is not None and (required or channel.column in log.names):
            wanted[name] = channel.column
    stamps = [
        channels.time.column,
        channels.time.nanoseconds,
        *(getattr(channels, name).time for name in wanted if name != "mode"),
    ]
    read = log.read(list(dict.fromkeys([*wanted.values(), *(name for name in stamps if name is not None)])))
    columns, notes = _convert_to_si(log, mapping, wanted, read)
    begin, clocks = 0.0, _read_channel_stamps(log, mapping, wanted, read)
    if clocks is None:
        time = channels.time.column
        resampling.check_lengths(log.label, columns | ({"time": read[time]} if time else {}), wanted)
        stamps, begin = read_row_stamps(log, read, mapping)
        clocks = None if stamps is None else resampling.split_sparse_rows(columns, stamps)
        if clocks is None:
            rows, more = _select_tick_rows(log, mapping, columns[MASTER], stamps, period)
            columns = {name: values[rows] for name, values in columns.items()}
            return columns, None if stamps is None else stamps[rows], begin, [*notes, *more]
    master = clocks[MASTER]
    if master is not None:
        resampling.check_clock(log.label, wanted[MASTER], master, len(columns[MASTER]))
        rows, more = _select_tick_rows(log, mapping, columns[MASTER], master, period)
        notes += more
        for name in [name for name, t in clocks.items() if resampling.has_same_stamps(t, master)]:
            columns[name], clocks[name] = columns[name][rows], master[rows]
    columns, stamps, more = resampling.resample_to_rows(log.label, columns, clocks, wanted, period)
    first = 0.0 if (master := clocks[MASTER]) is None else float(master[0])
    return columns, stamps - first, begin + first, [*notes, *more]


def _convert_to_si(
    log: OpenLog, mapping: LogMapping, wanted: Mapping[str, str], read: ColumnsByName
) -> tuple[ColumnsByName, list[str]]:
    """Return the channels in SI units, and notes where the mapping's unit differs from the file's unit."""
    columns, notes = ColumnsByName(), list[str]()
    for name, column in wanted.items():
        columns[name] = values = read[column]
        if name == "mode":
            continue
        channel: Channel = getattr(mapping.channels, name)
        where = f"{log.label}: column {format_value(column)}"
        if values.dtype == object:
            raise InputError(f"{where}: found {format_value(values[0])}, expected numbers")
        stated = log.reader.units.get(column)
        unit = parse_unit(stated or "", name)
        if unit is not None and channel.unit not in (None, COUNTS_UNIT, unit):
            notes.append(f"{where}: read in {channel.unit}, as the mapping states; the file states {unit}")
        factor, offset = get_si_conversion(channel, name, stated)
        if (factor, offset) != (1.0, 0.0):
            columns[name] = factor * values + offset
    return columns, notes


def _select_tick_rows(
    log: OpenLog, mapping: LogMapping, x: np.ndarray, stamps: np.ndarray | None, period: float
) -> tuple[np.ndarray | slice, list[str]]:
    """Select one row per control tick; return the selection and notes.

    Without time stamps, the row rate in the mapping determines the number of rows per control period.
    """
    rows, rate = mapping.timing.rows_per_period, mapping.channels.time.rate
    if mapping.timing.clock == "index":
        stamps, rows = None, rows or 1
    elif stamps is None and rate is not None:
        rows = rows or round(rate * period)
    return row_rate.select_tick_rows(log.label, x, stamps, period, rows)


def _read_channel_stamps(
    log: OpenLog, mapping: LogMapping, wanted: Mapping[str, str], read: ColumnsByName
) -> dict[str, np.ndarray | None] | None:
    """Return the time stamps of each channel [s], or None if all channels have common time stamps."""
    named = {name: getattr(getattr(mapping.channels, name), "time", None) for name in wanted}
    if any(named.values()):
        return _read_mapped_stamps(log.label, mapping, named, read)
    _check_stamps_in_groups(log, mapping, wanted)
    stamps_by_column = log.clocks(list(wanted.values()), mapping.channels.time.column)
    clocks = {name: stamps_by_column.get(column) for name, column in wanted.items()}
    master = clocks[MASTER]
    different = [wanted[name] for name, t in clocks.items() if not resampling.has_same_stamps(t, master)]
    if not different:
        return None
    time, reason = mapping.channels.time, f"because {format_value(different[0])} has separate time stamps"
    if mapping.timing.clock == "index":
        raise InputError(f'{log.label}: timing.clock: found "index", expected "stamps", {reason}')
    if time.column is not None and time.column not in log.reader.stamps:
        expected = ", ".join(sorted(to_one_line(column, 40) for column in log.reader.stamps)[:4])
        finding = f"column {format_value(time.column)}"
        raise InputError(f"{log.label}: time: found {finding}, expected one of {expected}, {reason}")
    return clocks


def _check_stamps_in_groups(log: OpenLog, mapping: LogMapping, wanted: Mapping[str, str]) -> None:
    """Raise `InputError` if a group of columns has time stamps that differ from those of the mapping.

    In HDF5, MAT and TDMS files, the column names contain the group names.
    """
    time = mapping.channels.time
    if time.column is None or log.reader.stamps:
        return
    for name, column in wanted.items():
        for stamps in _find_other_stamps(column, time.column, log.names):
            read = log.read([time.column, stamps])
            rows, times = read[time.column], read[stamps]
            if rows.dtype == object or times.dtype == object or min(len(rows), len(times)) < 2:
                continue
            step, group_step = float(np.median(np.diff(rows))), float(np.median(np.diff(times)))
            if not (step > 0.0 and group_step > 0.0):
                continue
            # The group's time stamps may have another unit.
            power = round(float(np.log10(group_step / step)) / 3.0)
            times = times * 1000.0**-power
            if abs(group_step * 1000.0**-power / step - 1.0) > clock.MAX_RATE_ERROR:
                continue  # The column does not contain times, but for example a counter.
            if (
                len(rows) == len(times)
                and np.max(np.abs(times - rows)) <= resampling.SIMULTANEITY_TOLERANCE * step
            ):
                continue
            raise InputError(
                f"{log.label}: column {format_value(column)}: found separate time stamps in "
                f"{format_value(stamps)} that differ from {format_value(time.column)}, "
                f"expected channels.{name}.time = {format_value(stamps)}"
            )


def _find_other_stamps(column: str, time: str, names: Sequence[str]) -> list[str]:
    """Return the time-stamp columns of the channel groups that contain column `column` but not `time`."""
    result = []
    for candidate in names:
        name = re.split(r"[/.]", candidate)[-1]
        parent = candidate[: len(candidate) - len(name)]
        if (
            parent
            and column.startswith(parent)
            and not time.startswith(parent)
            and STAMP_COLUMN_PATTERN.search(name)
        ):
            result.append(candidate)
    return [name for name in result if name != column]


def _read_mapped_stamps(
    label: str, mapping: LogMapping, named: Mapping[str, str | None], read: ColumnsByName
) -> dict[str, np.ndarray | None]:
    """Read the time stamps [s] of each channel from the columns that the mapping names.

    All time stamps are relative to the earliest stamp.
    """
    time = mapping.channels.time
    if mapping.timing.clock == "index":
        name = next(name for name, column in named.items() if column)
        raise InputError(
            f'{label}: timing.clock: found "index", expected "stamps", because channels.{name}.time is given'
        )
    columns = {name: column or time.column for name, column in named.items()}
    for column in dict.fromkeys(columns.values()):
        if column is not None and read[column].dtype == object:
            raise InputError(
                f"{label}: column {format_value(column)}: found {format_value(read[column][0])}, expected "
                "numbers"
            )
    factor = get_si_conversion(Channel(column=time.column or "", unit=time.unit), "time")[0]
    zero = min(float(read[column][0]) for column in columns.values() if column and len(read[column]))
    scaled = {column: factor * (read[column] - zero) for column in columns.values() if column}
    return {name: scaled[column] if column else None for name, column in columns.items()}


def read_row_stamps(
    log: OpenLog, read: ColumnsByName, mapping: LogMapping
) -> tuple[np.ndarray | None, float]:
    """Return the time stamps of the rows minus the first time stamp [s], and the first time stamp [s].

    The results are None and 0 if the mapping names no column of time stamps.
    """
    time = mapping.channels.time
    if time.column is None:
        return None, 0.0
    stamps = read[time.column]
    if time.time_format is not None or stamps.dtype == object:
        return clock.parse_stamps(stamps, time.time_format, log.label)
    checks.check_values(log.label, "time", stamps)
    # Time stamps may be relative to an epoch: subtract the first one before the conversion to keep precision.
    channel = Channel(column=time.column, unit=time.unit)
    factor = get_si_conversion(channel, "time", log.reader.units.get(time.column))[0]
    relative = factor * (stamps - stamps[:1])
    if time.nanoseconds is not None:
        nanoseconds = read[time.nanoseconds]
        if nanoseconds.dtype == object:
            where = f"{log.label}: column {format_value(time.nanoseconds)}"
            raise InputError(f"{where}: found {format_value(nanoseconds[0])}, expected numbers")
        checks.check_values(log.label, "time", nanoseconds)
        relative = relative + 1e-9 * (nanoseconds - nanoseconds[:1])
    return relative, factor * float(stamps[0]) if len(stamps) else 0.0
