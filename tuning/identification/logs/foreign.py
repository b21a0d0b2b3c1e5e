"""Logs in formats of other tools, each read by that format's own library; imported when one is met.

Every function takes a path and returns the names of the columns, a function that reads some of them and,
where the format has stamps for each of them, one that returns these. Fields of structures are joined by a dot
(`log.force`); the columns of a matrix are counted from 1 (`log.signals_2`). Stamps that count from an epoch
are in s from the first one of the log.
"""

# Whoever has no such log need not have the library.
# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import shown

Columns = dict[str, np.ndarray]


class Reader(NamedTuple):
    """A log that was opened."""

    names: list[str]  # of its columns
    read: Callable[[Sequence[str]], Columns]
    # Stamps [s] of columns that were read, from one zero; None where the format knows no clocks of columns.
    clocks: Callable[[Sequence[str]], dict[str, np.ndarray | None]] | None = None
    stamps: Collection[str] = ()  # columns that are such stamps


def mat(path: Path) -> Reader:
    """MATLAB's MAT files, of version 5 and 7.3."""
    from pymatreader import read_mat

    def flat(name: str, value: Any) -> Columns:
        if isinstance(value, Mapping):
            return _joined(name, value, flat)
        return _columns(name, value)

    found = read_mat(str(path))
    columns = _joined("", {name: one for name, one in found.items() if not name.startswith("__")}, flat)
    if not columns:
        export = "export signals as arrays, or as a structure with time"
        raise ValueError(f"found no numbers, allowed arrays or structures of them: {export}")
    return _kept(columns)


def hdf5(path: Path) -> Reader:
    """HDF5: every dataset of numbers, by its path without the first slash."""
    import h5py

    places: dict[str, tuple[str, str | None, int | None]] = {}
    with h5py.File(path, "r") as file:

        def visit(name: str, one: Any) -> None:
            if not isinstance(one, h5py.Dataset) or one.ndim not in (1, 2):
                return
            if one.dtype.names:
                places.update({f"{name}.{part}": (name, part, None) for part in one.dtype.names})
            elif one.ndim == 1:
                places[name] = name, None, None
            else:
                places.update({f"{name}_{place + 1}": (name, None, place) for place in range(one.shape[1])})

        file.visititems(visit)

    def read(wanted: Sequence[str]) -> Columns:
        with h5py.File(path, "r") as file:
            found = {}
            for column in wanted:
                name, part, place = places[column]
                data: Any = file[name]
                values = data[:, place] if place is not None else data[part] if part else data[()]
                found[column] = _numbers(column, values)
            return found

    return Reader(list(places), read)


def bag(path: Path) -> Reader:
    """ROS 2 bags, sqlite3 or MCAP: `/topic.field`, and `/topic.time`, when the message was recorded."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    rows: dict[str, dict[str, list[float]]] = {}
    folder = path.parent if path.suffix and (path.parent / "metadata.yaml").is_file() else path
    with AnyReader([folder], default_typestore=get_typestore(Stores.LATEST)) as reader:
        for connection, stamp, raw in reader.messages():
            topic = rows.setdefault(connection.topic, {})
            topic.setdefault("time", []).append(stamp)
            for name, value in _fields(reader.deserialize(raw, connection.msgtype)):
                topic.setdefault(name, []).append(value)
    columns, topics, stamps = {}, {}, {}
    zero = min((fields["time"][0] for fields in rows.values()), default=0)
    for topic, fields in rows.items():
        # Nanoseconds since an epoch have more digits than a float.
        stamps[topic] = 1e-9 * (np.array(fields["time"]) - zero)
        for name, values in fields.items():
            if len(values) == len(fields["time"]):
                column = f"{topic}.{name}"
                columns[column] = stamps[topic] if name == "time" else np.array(values, float)
                topics[column] = topic
    return Reader(
        list(columns),
        lambda wanted: {name: columns[name] for name in wanted},
        lambda wanted: {name: stamps[topics[name]] for name in wanted},
        {f"{topic}.time" for topic in stamps},
    )


def mdf(path: Path) -> Reader:
    """ASAM MDF: channels by their names, and `time`, the master of the first one that is read."""
    from asammdf import MDF

    with MDF(path) as file:
        groups = {name: places[0][0] for name, places in file.channels_db.items() if name != "time"}
    names = list(groups)
    masters: dict[int, np.ndarray] = {}  # of each group, once it was read

    def read(wanted: Sequence[str]) -> Columns:
        found = {}
        with MDF(path) as file:
            signals = [name for name in wanted if name != "time"]
            for name in signals or names[:1]:
                signal = file.get(name)
                masters.setdefault(groups[name], np.asarray(signal.timestamps, float))
                if name in wanted:
                    found[name] = _numbers(name, signal.samples)
            if "time" in wanted:
                found["time"] = masters[groups[(signals or names)[0]]]
        return found

    def clocks(wanted: Sequence[str]) -> dict[str, np.ndarray | None]:
        return {name: masters[groups[name]] for name in wanted if name != "time"}

    return Reader(["time", *names], read, clocks, {"time"})


def tdms(path: Path) -> Reader:
    """NI TDMS: `group/channel`, and `group/channel.time` where the channel has a rate of its own."""
    from nptdms import TdmsFile

    channels, group_of = {}, {}
    file = TdmsFile.read(path)
    for group in file.groups():
        for channel in group.channels():
            channels[f"{group.name}/{channel.name}"] = channel
            group_of[f"{group.name}/{channel.name}"] = group.name
    waves = {name: one for name, one in channels.items() if one.properties.get("wf_increment")}
    begins = {name: one.properties.get("wf_start_time") for name, one in waves.items()}
    begins = {name: _nanoseconds(one) for name, one in begins.items() if one is not None}
    zero = min(begins.values(), default=0)

    def wave(name: str) -> tuple[float, float, int]:
        """When a channel's first reading is [s], the distance of the others, and how many there are."""
        if begins and name not in begins:
            raise ValueError(f"column {shown(name)}: found no wf_start_time, allowed one, as others have")
        properties = waves[name].properties
        begin = 1e-9 * (begins.get(name, 0) - zero) + float(properties.get("wf_start_offset", 0.0))
        return begin, float(properties["wf_increment"]), len(waves[name])

    def stamps(name: str) -> np.ndarray | None:
        if name not in waves:
            # A channel that says nothing goes by the others of its group, where these agree.
            group = [one for one in waves if group_of[one] == group_of[name]]
            if len({wave(one) for one in group}) != 1 or len(waves[group[0]]) != len(channels[name]):
                return None
            name = group[0]
        begin, step, rows = wave(name)
        return begin + step * np.arange(rows)

    def read(wanted: Sequence[str]) -> Columns:
        found = {}
        for name in wanted:
            own = stamps(name.removesuffix(".time")) if name in timed else None
            found[name] = own if own is not None else _numbers(name, channels[name][:])
        return found

    timed = [f"{name}.time" for name in waves]
    return Reader(
        [*channels, *timed],
        read,
        lambda wanted: {
            name: stamps(name.removesuffix(".time") if name in timed else name) for name in wanted
        },
        timed,
    )


def _nanoseconds(stamp: Any) -> int:
    """Return a date as nanoseconds since 1970."""
    stamp = stamp.as_datetime64("ns") if hasattr(stamp, "as_datetime64") else stamp
    return int(np.datetime64(stamp).astype("datetime64[ns]").astype(np.int64))


def _joined(name: str, parts: Mapping[str, Any], flat: Callable[[str, Any], Columns]) -> Columns:
    columns: Columns = {}
    for part, value in parts.items():
        columns |= flat(f"{name}.{part}".lstrip("."), value)
    return columns


def _columns(name: str, value: Any) -> Columns:
    """Those of a vector or a matrix of numbers; none of anything else."""
    try:
        array = np.asarray(value)
    except ValueError:
        return {}
    if array.dtype.kind not in "biuf" or array.ndim not in (1, 2):
        return {}
    if array.ndim == 1:
        return {name: array.astype(float)}
    return {f"{name}_{place + 1}": column.astype(float) for place, column in enumerate(array.T)}


def _fields(message: Any, name: str = "") -> list[tuple[str, float]]:
    """The numbers of a message, by their paths."""
    found: list[tuple[str, float]] = []
    for part, value in vars(message).items():
        path = f"{name}.{part}".lstrip(".")
        if part.startswith("__"):
            continue
        if isinstance(value, (bool, int, float, np.number)):
            found.append((path, float(value)))
        elif hasattr(value, "__dataclass_fields__"):
            found += _fields(value, path)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            found += [(f"{path}_{place + 1}", float(one)) for place, one in enumerate(value.ravel())]
    return found


def _numbers(name: str, values: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind == "M":
        whole = array.astype("datetime64[ns]").astype(np.int64)
        return 1e-9 * (whole - whole[:1])
    if array.dtype.kind not in "biuf" or array.ndim != 1:
        raise ValueError(
            f"column {shown(name)}: found {array.dtype} of {array.ndim} axes, allowed numbers, one a row"
        )
    return array.astype(float)


def _kept(columns: Columns) -> Reader:
    return Reader(list(columns), lambda wanted: {name: columns[name] for name in wanted})
