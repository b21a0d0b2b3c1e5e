"""Guess of the column of time stamps, its unit or format, and the time between the rows."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from tuning.identification.logs import clock
from tuning.identification.logs.log_sample import MAX_SAMPLED_ROWS, ChannelGuess, LogSample
from tuning.identification.logs.units import UNITS_OF_CHANNEL, parse_unit

MAX_ROW_DISTANCE = 0.02  # longest plausible time between rows [s]
NANOSECOND_NAME = re.compile(r"nano(sec(ond)?s?)?$|nsecs?$", re.IGNORECASE)
TIME_FORMATS = (
    "%m/%d/%Y %I:%M:%S.%f %p",
    "%m/%d/%Y %H:%M:%S.%f",
    "%d/%m/%Y %H:%M:%S.%f",
    "%d.%m.%Y %H:%M:%S.%f",
    "%H:%M:%S.%f",
)


def guess_time(sample: LogSample, names: Sequence[str], position: str) -> ChannelGuess | None:
    """Guess which column contains the time stamps; return None if no column is a candidate."""
    for seconds in names:
        for nanoseconds in names:
            if (
                NANOSECOND_NAME.search(nanoseconds)
                and not NANOSECOND_NAME.search(seconds)
                and len(nanoseconds) > len(seconds)
                and len(x := sample.numbers(seconds)) == len(y := sample.numbers(nanoseconds)) > 1
                and np.all(x == np.rint(x))
                and nanoseconds.startswith(re.split(r"s(ec(ond)?s?)?$", seconds)[0])
                and np.all(np.diff(x - x[0] + 1e-9 * y) > 0.0)
            ):
                return ChannelGuess(seconds, None, 1, "seconds and nanoseconds", nanoseconds)
    increasing = [name for name in names if _increases(sample.numbers(name))]
    if sample.stamps:
        mine = [name for name in increasing if name in sample.stamps and _owns(name, position)]
        increasing = sorted(mine or increasing, key=lambda name: not name.endswith("header.stamp"))[:1]
    if not increasing:
        for name in names:
            if (time_format := _find_time_format(sample.values.get(name))) is not None:
                return ChannelGuess(name, None, 1, "by its name", None, time_format or None)
        steady = [name for name in sample.values if name != position and _is_steady(sample.numbers(name))]
        if len(steady) != 1:
            return ChannelGuess(None, candidates=names) if len(names) > 1 else None
        increasing = steady
    if len(increasing) > 1:
        shared = [_count_shared(name, position) for name in increasing]
        nearest = [name for name, count in zip(increasing, shared, strict=True) if count == max(shared)]
        increasing = nearest if len(nearest) == 1 else increasing
    if len(increasing) > 1:
        return ChannelGuess(None, candidates=increasing)
    name = increasing[0]
    stated = sample.units.get(name)
    unit, why = (parse_unit(stated, "time") if stated else None), "by its name and unit"
    if unit is None:
        step = float(np.median(np.diff(sample.numbers(name))))
        units = (("s", 1.0), ("ms", 1e-3), ("us", 1e-6))
        unit = next((unit for unit, size in units if step * size <= MAX_ROW_DISTANCE), "ns")
        why = f"by its {'name' if name in names else 'values'}; rows are {step:.4g} {unit} apart"
    return ChannelGuess(name, unit, 1, why)


def find_step(sample: LogSample, time: ChannelGuess, column: str | None) -> float | None:
    """Return the median time between rows with a number in `column` [s]; None if this time is unknown."""
    if time.column is None:
        return None
    values = sample.values[time.column]
    if time.nanoseconds is not None:
        values = values - values[0] + 1e-9 * sample.values[time.nanoseconds]
    elif values.dtype == object:
        values = clock.parse_stamps(values[:MAX_SAMPLED_ROWS], time.time_format, "time")[0]
    present = sample.present.get(column or "")
    steps = np.diff(values if present is None else values[present])
    steps = steps[steps > 0.0]
    return float(np.median(steps)) * UNITS_OF_CHANNEL["time"][time.unit or "s"] if len(steps) else None


def _increases(values: np.ndarray) -> bool:
    return len(values) > 1 and bool(np.all(np.diff(values) > 0.0))


def _is_steady(values: np.ndarray) -> bool:
    """Return whether the values increase by equal steps, as time stamps do."""
    return _increases(values) and bool(np.ptp(np.diff(values)) < 0.1 * np.median(np.diff(values)))


def _owns(stamps: str, column: str) -> bool:
    """Return whether the column `stamps` contains the time stamps of `column`, according to their names."""
    return column.startswith(re.sub(r"\.(time|header\.stamp)$", "", stamps)) or "." not in stamps


def _count_shared(name: str, other: str) -> int:
    """Return the number of equal characters at the beginning of two names."""
    return next((i for i, (a, b) in enumerate(zip(name, other, strict=False)) if a != b), len(name))


def _find_time_format(values: np.ndarray | None) -> str | None:
    """Return the `strptime` format of time stamps in text; it is "" for ISO 8601 and None if unknown."""
    if values is None or values.dtype != object or not len(values):
        return None
    for time_format in (None, *TIME_FORMATS):
        try:
            clock.parse_stamps(values[:100], time_format, "")
        except ValueError:
            continue
        return time_format or ""
    return None
