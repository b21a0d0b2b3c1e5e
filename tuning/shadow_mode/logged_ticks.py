"""Readings and commands of a rig's log, tick by tick, for one axis or six axes.

The readers, the mapping and the assignment of rows to ticks are those of `jaxhil identify`. The checks of
`identify` are left out, because shadow mode shows what a controller does with wrong readings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxhil.errors import InputError, format_value
from jaxhil.mechanism.structs import Mechanism
from tuning.identification.logs import clock
from tuning.identification.logs.campaign import (
    check_names,
    classify_rows,
    find_restarts,
    make_timing,
    select_rows,
)
from tuning.identification.logs.channels import read_channels, read_row_stamps
from tuning.identification.logs.contact_detection import detect_contacts
from tuning.identification.logs.mapping import KINDS, LogMapping, RunFiles, get_si_conversion
from tuning.identification.logs.readers import OpenLog, open_log
from tuning.identification.logs.six_axis_mapping import VECTOR_UNITS, SixAxisLogMapping, get_factors
from tuning.identification.records import CampaignTiming

MIN_ROWS = 3  # minimum number of rows of a log
PERIOD_TOLERANCE = 1e-9  # relative difference of the mapping's control period from that of the gains


@dataclass(frozen=True)
class LoggedTicks:
    """Readings, commands and time stamps of one log; arrays have one row per logged tick.

    Vectors have one column on one axis, and six on six axes.
    """

    label: str  # name of the log
    period: float  # control period [s]
    tick: np.ndarray  # int64, (rows,), number of the control period, counted from the first row
    time: np.ndarray | None  # time stamps from the first row [s], (rows,); None without a clock
    force: np.ndarray  # force reading [N], wrench on six axes [N, N m]
    position_desired: np.ndarray  # position of the numerical model before the tick [m, rad]
    velocity_desired: np.ndarray  # velocity of the numerical model before the tick [m/s, rad/s]
    position_measured: np.ndarray  # position reading [m, rad]
    command: np.ndarray  # logged command that answers these readings [N, N m]; NaN if it is not in the log
    starts: np.ndarray  # int, rows at which a run begins; the first is 0
    contact: np.ndarray | None = None  # int64, (rows,), index of the contact, if the log states it
    notes: tuple[str, ...] = ()

    @property
    def axes(self) -> int:
        """Return the number of axes."""
        return self.force.shape[1]

    @property
    def instant(self) -> np.ndarray:
        """Return the time of each row since the first row [s]; without time stamps, from the tick numbers."""
        return self.period * self.tick if self.time is None else self.time

    @property
    def gaps(self) -> np.ndarray:
        """Return the indices of the rows that directly follow lost rows of the same run."""
        after = np.flatnonzero(np.diff(self.tick) > 1) + 1
        return after[~np.isin(after, self.starts)]

    @property
    def lost(self) -> int:
        """Return the number of lost rows within the runs."""
        return int(np.sum(self.tick[self.gaps] - self.tick[self.gaps - 1] - 1))


def read_logged_ticks(
    logs: Sequence[Path], mapping: LogMapping | SixAxisLogMapping, mechanism: Any
) -> list[LoggedTicks]:
    """Read the contact runs of log files.

    Args:
        logs: Paths of the log files.
        mapping: Mapping of columns to channels.
        mechanism: Mechanism of the gain file; it supplies the values that `[timing]` in the mapping omits.

    Raises:
        InputError: If a log cannot be read, or its control period differs from that of the gains.
    """
    check_names(logs, mapping.runs)
    timing: CampaignTiming = make_timing(mapping, mechanism)  # pyright: ignore[reportArgumentType]
    period = mechanism.rig.control_period
    if abs(timing.control_period / period - 1.0) > PERIOD_TOLERANCE:
        raise InputError(
            f"timing.control_period: found {timing.control_period:g} s, expected {period:g} s as in the gains"
        )
    read = [
        _read_log(path, entry, mapping, replace(timing, control_period=period), _is_two_sided(mechanism))
        for entry in mapping.runs
        for path in logs
        if entry.names(path) and (entry.kind == "contact" or getattr(mapping.channels, "mode", None))
    ]
    if not read:
        kinds = ", ".join(dict.fromkeys(entry.kind for entry in mapping.runs))
        raise InputError(f"logs: found runs of kind {kinds}, expected runs of kind contact")
    return read


def _read_log(
    path: Path,
    entry: RunFiles,
    mapping: LogMapping | SixAxisLogMapping,
    timing: CampaignTiming,
    is_two_sided: bool,
) -> LoggedTicks:
    """Read one log's contact rows; with two surfaces (`is_two_sided`), a run may have several contacts."""
    log = open_log(path, mapping.text)
    period = timing.control_period
    if isinstance(mapping, LogMapping):
        vectors, more, stamps, notes = _read_one_axis(log, mapping, period)
    else:
        vectors, more, stamps, notes = _read_six_axes(log, mapping)
    rows = len(vectors["command"])
    used = np.zeros(rows, bool)
    used[select_rows(stamps, entry, period)] = True
    if (modes := more.get("mode")) is not None and isinstance(mapping, LogMapping):
        used &= classify_rows(modes, mapping, entry.kind, log.label) == KINDS.index("contact")
    if np.count_nonzero(used) < MIN_ROWS:
        rows_found = f"found {np.count_nonzero(used)} rows of contact runs"
        raise InputError(f"{log.label}: {rows_found}, expected {MIN_ROWS} or more")
    if stamps is None or mapping.timing.clock == "index":
        stamps, tick = None, np.arange(rows, dtype=np.int64)
    else:
        tick = clock.assign_ticks(stamps, period, log.label).tick
    index, chosen = more.get("contact_index"), np.flatnonzero(used)
    if index is not None:
        index = index.astype(np.int64)[chosen]
    if index is not None and is_two_sided:
        runs = find_restarts(vectors["position_desired"][chosen, 0], index)
    else:
        runs = _find_starts(vectors["force"][chosen], index, period)
    starts = [np.flatnonzero(np.diff(chosen) > 1) + 1, runs]
    ticks = LoggedTicks(
        label=log.label,
        period=period,
        tick=tick[chosen] - tick[chosen[0]],
        time=None if stamps is None else stamps[chosen] - stamps[chosen[0]],
        **{name: values[chosen] for name, values in vectors.items()},
        starts=np.unique(np.concatenate([[0], *starts])).astype(int),
        contact=index,
        notes=tuple(notes),
    )
    return _align(ticks, timing)


def _is_two_sided(mechanism: Any) -> bool:
    """Return whether the mechanism of one axis has two surfaces."""
    return isinstance(mechanism, Mechanism) and math.isfinite(mechanism.contact.clearance)


def _read_one_axis(log: OpenLog, mapping: LogMapping, period: float):
    """Return arrays (rows, 1) by field name of `LoggedTicks`, optional channels, time stamps [s], notes."""
    columns, stamps, _, notes = read_channels(log, mapping, period)
    for name in ("force_measured", "force_command"):
        if name not in columns:
            raise InputError(f"{log.label}: {name}: found no such channel, expected one for shadow mode")
    if "velocity_desired" not in columns:
        x = columns["position_desired"]
        columns["velocity_desired"] = np.diff(x, prepend=2 * x[:1] - x[1:2]) / period
        notes.append(f"{log.label}: velocity_desired: found no such channel: computed from position_desired")
    names = {
        "force": "force_measured",
        "position_desired": "position_desired",
        "velocity_desired": "velocity_desired",
        "position_measured": "position_measured",
        "command": "force_command",
    }
    more = {name: columns[name] for name in ("mode", "contact_index") if name in columns}
    return {field: columns[name][:, None] for field, name in names.items()}, more, stamps, notes


def _read_six_axes(log: OpenLog, mapping: SixAxisLogMapping):
    """Return arrays (rows, 6) by field name of `LoggedTicks`, optional channels, time stamps [s], notes."""
    channels, index = mapping.channels, mapping.channels.contact_index
    names = [column for name in VECTOR_UNITS for column in getattr(channels, name).columns]
    if index is not None:
        names.append(index.column)
    stamps = [name for name in (channels.time.column, channels.time.nanoseconds) if name is not None]
    read = log.read(list(dict.fromkeys([*names, *stamps])))
    for name in names:
        if read[name].dtype == object or len(read[name]) != len(read[names[0]]):
            where = f"{log.label}: column {format_value(name)}"
            raise InputError(f"{where}: found missing values or texts, expected a number in each row")
    if any(value is not None for value in log.clocks(names, channels.time.column).values()):
        raise InputError(f"{log.label}: found separate time stamps of channels, expected those of the rows")
    vectors = {
        field: np.stack([read[column] for column in channel.columns], axis=1) * get_factors(channel, name)
        for field, name in (
            ("force", "wrench_measured"),
            ("position_desired", "pose_desired"),
            ("velocity_desired", "twist_desired"),
            ("position_measured", "pose_measured"),
            ("command", "wrench_command"),
        )
        for channel in [getattr(channels, name)]
    }
    more = {}
    if index is not None:
        factor, offset = get_si_conversion(index, "contact_index")
        more["contact_index"] = factor * read[index.column] + offset
        if not np.all(np.isfinite(more["contact_index"])):
            where = f"{log.label}: column {format_value(index.column)}"
            raise InputError(f"{where}: found missing values, expected the index of a contact in each row")
    return vectors, more, read_row_stamps(log, read, mapping)[0], []  # pyright: ignore[reportArgumentType]


def _find_starts(force: np.ndarray, index: np.ndarray | None, period: float) -> np.ndarray:
    """Return the rows at which a run (the rows of one contact) begins, except the first row of the log.

    A run begins where the contact index changes. If `index` is None, a run of a one-axis log begins midway
    between two contacts, which the force shows.
    """
    if index is not None:
        return np.flatnonzero(np.diff(index)) + 1
    if force.shape[1] > 1 or not np.any(np.isfinite(force)):
        return np.empty(0, int)
    contacts = np.array(detect_contacts(force[:, 0], period)).reshape(-1, 2)
    return (contacts[:-1, 1] + contacts[1:, 0]) // 2


def _align(ticks: LoggedTicks, timing: CampaignTiming) -> LoggedTicks:
    """Return one row per tick with the readings of this tick and the command that answers them.

    In the mapping, `timing.row` and `timing.computing_delay` determine the rows of the log from which
    readings and command come.
    """
    motion, readings, command = {"tick": (0, 0, 0), "sent": (-1, 0, 0), "after": (0, -1, 0)}[timing.row]
    command += timing.computing_delay
    if motion == readings == command == 0:
        return ticks
    tick, shifted, complete = ticks.tick, {}, np.ones(len(ticks.tick), bool)
    for names, shift in (
        (("position_desired", "velocity_desired"), motion),
        (("force", "position_measured"), readings),
        (("command",), command),
    ):
        row = np.minimum(np.searchsorted(tick, tick + shift), len(tick) - 1)
        has_row = tick[row] == tick + shift
        for name in names:
            shifted[name] = np.where(has_row[:, None], getattr(ticks, name)[row], np.nan)
        complete &= has_row | (names == ("command",))
    rows = np.flatnonzero(complete)
    starts = np.unique(np.searchsorted(rows, ticks.starts))
    shifted = {name: values[rows] for name, values in shifted.items()}
    return replace(
        ticks,
        **shifted,
        tick=tick[rows] - tick[rows[0]],
        time=None if ticks.time is None else ticks.time[rows] - ticks.time[rows[0]],
        contact=None if ticks.contact is None else ticks.contact[rows],
        starts=starts[starts < len(rows)],
    )
