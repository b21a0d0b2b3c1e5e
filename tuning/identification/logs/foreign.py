"""Logs in formats of other tools, each read by that format's own library; imported when one is met.

Every function takes a path and returns the names of the columns and a function that reads some of them.
Fields of structures are joined by a dot (`log.force`); the columns of a matrix are counted from 1
(`log.signals_2`). Stamps that count from an epoch are in s from the first one.
"""

# Whoever has no such log need not have the library.
# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxhil.errors import shown

Columns = dict[str, np.ndarray]
Reader = tuple[list[str], Callable[[Sequence[str]], Columns]]


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

    return list(places), read


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
    columns = {}
    for topic, fields in rows.items():
        for name, values in fields.items():
            if len(values) == len(fields["time"]):
                whole = np.array(values)
                columns[f"{topic}.{name}"] = (
                    1e-9 * (whole - whole[0]) if name == "time" else whole.astype(float)
                )
    return _kept(columns)


def mdf(path: Path) -> Reader:
    """ASAM MDF: channels by their names, and `time`, the master of the first one that is read."""
    from asammdf import MDF

    with MDF(path) as file:
        names = [name for name in file.channels_db if name != "time"]

    def read(wanted: Sequence[str]) -> Columns:
        found = {}
        with MDF(path) as file:
            signals = {name: file.get(name) for name in wanted if name != "time"}
            for name, signal in signals.items():
                found[name] = _numbers(name, signal.samples)
            if "time" in wanted:
                first = next(iter(signals.values())) if signals else file.get(names[0])
                found["time"] = np.asarray(first.timestamps, float)
        return found

    return ["time", *names], read


def tdms(path: Path) -> Reader:
    """NI TDMS: `group/channel`, and `group/channel.time` where the channel has a rate of its own."""
    from nptdms import TdmsFile

    channels = {}
    file = TdmsFile.read(path)
    for group in file.groups():
        for channel in group.channels():
            channels[f"{group.name}/{channel.name}"] = channel
    timed = [f"{name}.time" for name, one in channels.items() if "wf_increment" in one.properties]

    def read(wanted: Sequence[str]) -> Columns:
        return {
            name: channels[name.removesuffix(".time")].time_track()
            if name in timed
            else _numbers(name, channels[name][:])
            for name in wanted
        }

    return [*channels, *timed], read


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
    return list(columns), lambda wanted: {name: columns[name] for name in wanted}
