"""Readers of third-party log formats; the library of a format is imported when a log is opened.

Every public function takes a path and returns a `LogReader`. A field of a structure becomes a column whose
name contains a dot (`log.force`). The columns of a matrix are numbered from 1 (`log.signals_2`). Time stamps
relative to an epoch are converted to seconds after the first time stamp of the log.
"""

# The libraries are optional.
# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import format_value

ColumnsByName = dict[str, np.ndarray]


class LogReader(NamedTuple):
    """Opened log: its column names, and functions that read columns and their time stamps."""

    names: list[str]  # names of the columns
    read: Callable[[Sequence[str]], ColumnsByName]
    # Time stamps [s] of columns that were read, with a common origin; None if the format has no such stamps.
    clocks: Callable[[Sequence[str]], dict[str, np.ndarray | None]] | None = None
    stamps: Collection[str] = ()  # names of the columns that contain such time stamps


def mat(path: Path) -> LogReader:
    """Open a MATLAB MAT file, version 5 or 7.3."""
    from pymatreader import read_mat

    def flat(name: str, value: Any) -> ColumnsByName:
        if isinstance(value, Mapping):
            return _join_fields(name, value, flat)
        return _split_columns(name, value)

    content = read_mat(str(path))
    columns = _join_fields(
        "", {name: value for name, value in content.items() if not name.startswith("__")}, flat
    )
    if not columns:
        export = "export signals as arrays, or as a structure with time"
        raise ValueError(f"found no numbers, expected arrays or structures of numbers: {export}")
    return _make_reader(columns)


def hdf5(path: Path) -> LogReader:
    """Open an HDF5 file; the columns are its datasets, named by their paths without the first slash."""
    import h5py

    locations: dict[str, tuple[str, str | None, int | None]] = {}
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset) or item.ndim not in (1, 2):
                return
            if item.dtype.names:
                locations.update({f"{name}.{part}": (name, part, None) for part in item.dtype.names})
            elif item.ndim == 1:
                locations[name] = name, None, None
            else:
                locations.update(
                    {f"{name}_{column + 1}": (name, None, column) for column in range(item.shape[1])}
                )

        file.visititems(visit)

    def read(wanted: Sequence[str]) -> ColumnsByName:
        with h5py.File(path, "r") as file:
            columns = {}
            for column in wanted:
                name, part, index = locations[column]
                data: Any = file[name]
                values = data[:, index] if index is not None else data[part] if part else data[()]
                columns[column] = _convert_to_numbers(column, values)
            return columns

    return LogReader(list(locations), read)


def bag(path: Path) -> LogReader:
    """Open a ROS 2 bag (sqlite3 or MCAP).

    The columns are named `/topic.field`; `/topic.time` is the recording time of the messages.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    rows: dict[str, dict[str, list[float]]] = {}
    folder = path.parent if path.suffix and (path.parent / "metadata.yaml").is_file() else path
    with AnyReader([folder], default_typestore=get_typestore(Stores.LATEST)) as reader:
        for connection, stamp, raw in reader.messages():
            topic = rows.setdefault(connection.topic, {})
            topic.setdefault("time", []).append(stamp)
            for name, value in _flatten_fields(reader.deserialize(raw, connection.msgtype)):
                topic.setdefault(name, []).append(value)
    columns, topics, stamps = {}, {}, {}
    zero = min((fields["time"][0] for fields in rows.values()), default=0)
    for topic, fields in rows.items():
        # Subtract integers: nanoseconds since an epoch have more digits than a float.
        stamps[topic] = 1e-9 * (np.array(fields["time"]) - zero)
        for name, values in fields.items():
            if len(values) == len(fields["time"]):
                column = f"{topic}.{name}"
                columns[column] = stamps[topic] if name == "time" else np.array(values, float)
                topics[column] = topic
    return LogReader(
        list(columns),
        lambda wanted: {name: columns[name] for name in wanted},
        lambda wanted: {name: stamps[topics[name]] for name in wanted},
        {f"{topic}.time" for topic in stamps},
    )


def mdf(path: Path) -> LogReader:
    """Open an ASAM MDF file; the column `time` contains the time stamps of the first requested channel."""
    from asammdf import MDF

    with MDF(path) as file:
        groups = {name: locations[0][0] for name, locations in file.channels_db.items() if name != "time"}
    names = list(groups)
    masters: dict[int, np.ndarray] = {}  # stamps of each group that was read

    def read(wanted: Sequence[str]) -> ColumnsByName:
        columns = {}
        with MDF(path) as file:
            signals = [name for name in wanted if name != "time"]
            for name in signals or names[:1]:
                signal = file.get(name)
                masters.setdefault(groups[name], np.asarray(signal.timestamps, float))
                if name in wanted:
                    columns[name] = _convert_to_numbers(name, signal.samples)
            if "time" in wanted:
                columns["time"] = masters[groups[(signals or names)[0]]]
        return columns

    def clocks(wanted: Sequence[str]) -> dict[str, np.ndarray | None]:
        return {name: masters[groups[name]] for name in wanted if name != "time"}

    return LogReader(["time", *names], read, clocks, {"time"})


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
    return LogReader(
        [*channels, *time_columns],
        read,
        lambda wanted: {
            name: stamps(name.removesuffix(".time") if name in time_columns else name) for name in wanted
        },
        time_columns,
    )


def _to_nanoseconds(stamp: Any) -> int:
    """Return a date in nanoseconds since 1970."""
    stamp = stamp.as_datetime64("ns") if hasattr(stamp, "as_datetime64") else stamp
    return int(np.datetime64(stamp).astype("datetime64[ns]").astype(np.int64))


def _join_fields(
    name: str, parts: Mapping[str, Any], flat: Callable[[str, Any], ColumnsByName]
) -> ColumnsByName:
    columns: ColumnsByName = {}
    for part, value in parts.items():
        columns |= flat(f"{name}.{part}".lstrip("."), value)
    return columns


def _split_columns(name: str, value: Any) -> ColumnsByName:
    """Return the columns of a numeric vector or matrix by name; an empty dictionary for other values."""
    try:
        array = np.asarray(value)
    except ValueError:
        return {}
    if array.dtype.kind not in "biuf" or array.ndim not in (1, 2):
        return {}
    if array.ndim == 1:
        return {name: array.astype(float)}
    return {f"{name}_{index + 1}": column.astype(float) for index, column in enumerate(array.T)}


def _flatten_fields(message: Any, name: str = "") -> list[tuple[str, float]]:
    """Return all numbers in a message, each with the dotted path of its field."""
    fields: list[tuple[str, float]] = []
    for part, value in vars(message).items():
        path = f"{name}.{part}".lstrip(".")
        if part.startswith("__"):
            continue
        if isinstance(value, (bool, int, float, np.number)):
            fields.append((path, float(value)))
        elif hasattr(value, "__dataclass_fields__"):
            fields += _flatten_fields(value, path)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            fields += [(f"{path}_{index + 1}", float(number)) for index, number in enumerate(value.ravel())]
    return fields


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


def _make_reader(columns: ColumnsByName) -> LogReader:
    return LogReader(list(columns), lambda wanted: {name: columns[name] for name in wanted})
