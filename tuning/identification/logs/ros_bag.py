"""Reader of ROS 2 bags (sqlite3 or MCAP).

The columns are named `/topic.field`. Entries of an array are numbered from 1, and also have the names that
the message gives them (JointState: `/topic.position.joint`). `/topic.time` is the recording time of the
messages; `/topic.header.stamp` is the time in their headers, as one number computed from `sec` and `nanosec`.
"""

# The optional library may not be installed.
# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxhil.errors import format_value
from tuning.identification.logs.log_reader import ColumnsByName, LogReader

TIME, HEADER_STAMP = "time", "header.stamp"  # columns of time stamps of each topic


def bag(path: Path) -> LogReader:
    """Open a ROS 2 bag (sqlite3 or MCAP)."""
    topics = _read_topics(path)
    columns: ColumnsByName = {}
    topic_of, stamps_of = {}, {}
    for kind in (TIME, HEADER_STAMP):
        stamps = {topic: fields.pop(kind) for topic, fields in topics.items() if kind in fields}
        zero = min((times[0] for times in stamps.values()), default=0)
        for topic, times in stamps.items():
            # Subtract integers: nanoseconds since an epoch have more digits than a float.
            name = f"{topic}.{kind}"
            stamps_of[name] = columns[name] = 1e-9 * np.array([time - zero for time in times], float)
            topic_of[name] = topic
    for topic, fields in topics.items():
        rows = len(columns[f"{topic}.{TIME}"])
        for name, values in fields.items():
            if len(values) == rows:
                columns[f"{topic}.{name}"] = np.array(values, float)
                topic_of[f"{topic}.{name}"] = topic

    def clocks(wanted: Sequence[str], time: str | None) -> dict[str, np.ndarray | None]:
        kind = HEADER_STAMP if time is not None and time.endswith(f".{HEADER_STAMP}") else TIME
        result: dict[str, np.ndarray | None] = {}
        for name in wanted:
            stamps = stamps_of.get(f"{topic_of[name]}.{kind}")
            if stamps is None:
                raise ValueError(
                    f"column {format_value(name)}: found no {kind}, expected one as in {format_value(time)}"
                )
            result[name] = stamps
        return result

    return LogReader(
        list(columns), lambda wanted: {name: columns[name] for name in wanted}, clocks, list(stamps_of)
    )


def _read_topics(path: Path) -> dict[str, dict[str, list[Any]]]:
    """Return, for each topic, the values of each field in all messages; the field `TIME` has stamps [ns]."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    topics: dict[str, dict[str, list[Any]]] = {}
    folder = path.parent if path.suffix and (path.parent / "metadata.yaml").is_file() else path
    with AnyReader([folder], default_typestore=get_typestore(Stores.LATEST)) as reader:
        for connection, stamp, raw in reader.messages():
            topic = topics.setdefault(connection.topic, {})
            message: Any = reader.deserialize(raw, connection.msgtype)
            topic.setdefault(TIME, []).append(stamp)
            for name, value in _flatten_fields(message):
                topic.setdefault(name, []).append(value)
            header: Any = getattr(getattr(message, "header", None), "stamp", None)
            if hasattr(header, "nanosec"):
                topic.setdefault(HEADER_STAMP, []).append(10**9 * header.sec + header.nanosec)
    return topics


def _flatten_fields(message: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield all numbers in a message, each with the dotted path of its field."""
    labels = getattr(message, "name", None)
    for part, value in vars(message).items():
        path = f"{name}.{part}".lstrip(".")
        if part.startswith("__"):
            continue
        if isinstance(value, (bool, int, float, np.number)):
            yield path, float(value)
        elif hasattr(value, "__dataclass_fields__"):
            yield from _flatten_fields(value, path)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            numbers = value.ravel().tolist()
            if isinstance(labels, list) and len(labels) == len(numbers):
                yield from (
                    (f"{path}.{label}", float(number)) for label, number in zip(labels, numbers, strict=True)
                )
            yield from ((f"{path}_{index + 1}", float(number)) for index, number in enumerate(numbers))
