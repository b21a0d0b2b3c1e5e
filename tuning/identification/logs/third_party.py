"""Readers of HDF5, MDF and TDMS files; the library of a format is imported when a log is opened.

Every public function takes a path and returns a `LogReader`. Time stamps relative to an epoch are converted
to seconds after the first time stamp of the log.
"""

# The optional libraries may not be installed.
# pyright: reportMissingImports=false

from __future__ import annotations

import gc
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxhil.errors import format_value
from tuning.identification.logs.log_reader import ColumnsByName, LogReader


def hdf5(path: Path) -> LogReader:
    """Open an HDF5 file; the columns are its datasets, named by their paths without the first slash."""
    import h5py

    locations: dict[str, tuple[str, Any]] = {}  # path of each column's dataset, and the part of the dataset
    units: dict[str, str] = {}
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset) or item.ndim not in (1, 2):
                return
            if item.dtype.names:
                parts = {f"{name}.{part}": part for part in item.dtype.names}
            elif item.ndim == 1 or item.shape[0] == 1:
                parts = {name: () if item.ndim == 1 else 0}
            else:
                # A matrix has a signal in each row if it has more columns than rows.
                is_in_rows = item.shape[0] < item.shape[1]
                parts = {
                    f"{name}_{index + 1}": index if is_in_rows else (slice(None), index)
                    for index in range(min(item.shape) if is_in_rows else item.shape[1])
                }
            locations.update({column: (name, part) for column, part in parts.items()})
            unit = item.attrs.get("units", item.attrs.get("unit", ""))
            unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else unit
            if isinstance(unit, str) and unit:
                units.update(dict.fromkeys(parts, unit))

        file.visititems(visit)

    def read(wanted: Sequence[str]) -> ColumnsByName:
        with h5py.File(path, "r") as file:
            columns = {}
            for column in wanted:
                name, part = locations[column]
                data: Any = file[name]
                columns[column] = _convert_to_numbers(column, data[part])
            return columns

    return LogReader(list(locations), read, units=units)


def mdf(path: Path) -> LogReader:
    """Open an ASAM MDF file; the column `time` contains the time stamps of the first requested channel.

    A channel whose name occurs in several groups is named `group/channel`.
    """
    places: dict[str, tuple[int, int]] = {}  # group and index of each channel
    units: dict[str, str] = {}
    with _open_mdf(path) as file:
        titles = [
            getattr(group.channel_group, "acq_name", "") or f"group {index + 1}"
            for index, group in enumerate(file.groups)
        ]
        for name, locations in file.channels_db.items():
            if name == "time":
                continue
            is_unique = len({group for group, _ in locations}) == 1
            for group, index in locations:
                title = titles[group] if titles.count(titles[group]) == 1 else f"{titles[group]} {group + 1}"
                column = name if is_unique else f"{title}/{name}"
                places.setdefault(column, (group, index))
                if unit := file.get_channel_unit(group=group, index=index):
                    units[column] = unit
    names = list(places)
    masters: dict[int, np.ndarray] = {}  # stamps of each group that was read

    def read(wanted: Sequence[str]) -> ColumnsByName:
        columns = {}
        with _open_mdf(path) as file:
            signals = [name for name in wanted if name != "time"]
            for name in signals or names[:1]:
                group, index = places[name]
                signal = file.get(group=group, index=index)
                masters.setdefault(group, np.asarray(signal.timestamps, float))
                if name in wanted:
                    columns[name] = _convert_to_numbers(name, signal.samples)
            if "time" in wanted:
                columns["time"] = masters[places[(signals or names)[0]][0]]
        return columns

    def clocks(wanted: Sequence[str], time: str | None) -> dict[str, np.ndarray | None]:
        return {name: masters[places[name][0]] for name in wanted if name != "time"}

    return LogReader(["time", *names], read, clocks, {"time"}, units)


def _open_mdf(path: Path) -> Any:
    """Open an MDF file; if this fails, prevent the library from printing tracebacks later."""
    from asammdf import MDF

    try:
        return MDF(path)
    except Exception as error:
        message = str(error) or type(error).__name__
        hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        gc.collect()
    finally:
        sys.unraisablehook = hook
    raise ValueError(message)


def tdms(path: Path) -> LogReader:
    """Open an NI TDMS file.

    The columns are named `group/channel`; channels with a sampling rate also have `group/channel.time`.
    """
    from nptdms import TdmsFile

    channels, group_of = {}, {}
    file = TdmsFile.read(path)
    for group in file.groups():
        for channel in group.channels():
            channels[f"{group.name}/{channel.name}"] = channel
            group_of[f"{group.name}/{channel.name}"] = group.name
    waves = {name: channel for name, channel in channels.items() if channel.properties.get("wf_increment")}
    begins = {name: channel.properties.get("wf_start_time") for name, channel in waves.items()}
    begins = {name: _to_nanoseconds(stamp) for name, stamp in begins.items() if stamp is not None}
    zero = min(begins.values(), default=0)

    def wave(name: str) -> tuple[float, float, int]:
        """Return a channel's first time stamp [s], sampling period [s] and number of readings."""
        if begins and name not in begins:
            raise ValueError(
                f"column {format_value(name)}: found no wf_start_time, expected one as in other channels"
            )
        properties = waves[name].properties
        begin = 1e-9 * (begins.get(name, 0) - zero) + float(properties.get("wf_start_offset", 0.0))
        return begin, float(properties["wf_increment"]), len(waves[name])

    def stamps(name: str) -> np.ndarray | None:
        if name not in waves:
            # A channel without a rate gets the time stamps of its group if all other channels of the group
            # agree.
            group = [member for member in waves if group_of[member] == group_of[name]]
            if len({wave(member) for member in group}) != 1 or len(waves[group[0]]) != len(channels[name]):
                return None
            name = group[0]
        begin, step, rows = wave(name)
        return begin + step * np.arange(rows)

    def read(wanted: Sequence[str]) -> ColumnsByName:
        columns = {}
        for name in wanted:
            own_stamps = stamps(name.removesuffix(".time")) if name in time_columns else None
            columns[name] = (
                own_stamps if own_stamps is not None else _convert_to_numbers(name, channels[name][:])
            )
        return columns

    time_columns = [f"{name}.time" for name in waves]
    units = {name: str(channel.properties.get("unit_string", "")) for name, channel in channels.items()}
    return LogReader(
        [*channels, *time_columns],
        read,
        lambda wanted, time: {
            name: stamps(name.removesuffix(".time") if name in time_columns else name) for name in wanted
        },
        time_columns,
        {name: unit for name, unit in units.items() if unit},
    )


def _to_nanoseconds(stamp: Any) -> int:
    """Return a date in nanoseconds since 1970."""
    stamp = stamp.as_datetime64("ns") if hasattr(stamp, "as_datetime64") else stamp
    return int(np.datetime64(stamp).astype("datetime64[ns]").astype(np.int64))


def _convert_to_numbers(name: str, values: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind == "M":
        nanoseconds = array.astype("datetime64[ns]").astype(np.int64)
        return 1e-9 * (nanoseconds - nanoseconds[:1])
    if array.dtype.kind not in "biuf" or array.ndim != 1:
        raise ValueError(
            f"column {format_value(name)}: found {array.dtype} with {array.ndim} axes, expected one number "
            "per row"
        )
    return array.astype(float)
