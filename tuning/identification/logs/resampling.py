"""Resampling of channels with separate time stamps to the rows (times) of the desired position.

In some log formats, each channel or group of channels has its own time stamps. Such a channel may begin
later, have a higher rate, or lose other rows than the desired position. All channels are resampled to the
times of the desired position. Readings are interpolated linearly. Forces at the rate of the desired position
are an exception, because interpolation would smooth the jump of the force at the onset of contact: the
nearest reading is used, and its time offset is returned. Rows in which any channel has no reading are
removed.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaxhil.errors import InputError, format_value
from tuning.identification.logs import clock

MASTER_CHANNEL = "position_desired"  # channel whose times define the rows
MAX_READING_PERIOD = 1.5  # maximum time between readings [control periods]; a slower channel is rejected
MIN_GAP_RATIO = 1.5  # minimum ratio of the time between two readings to its median if a reading was lost
SIMULTANEITY_TOLERANCE = 0.02  # maximum time between a row and a reading that count as simultaneous [periods]
MIN_EMPTY_SHARE = 0.1  # minimum share of empty cells in a column if its log has rows of other topics
HELD_CHANNELS = "contact_index", "mode"  # channels whose values are valid until the next reading
NEAREST_READING_CHANNEL = "force_measured"  # channel with jumps, which is not interpolated
FORCE_LATE_CHANNEL = "force_late"  # time from a row to the force reading that is used for it [s]
EQUAL_RATE_TOLERANCE = 0.01  # maximum relative difference of two rates that count as equal


def has_same_stamps(first: np.ndarray | None, other: np.ndarray | None) -> bool:
    """Return whether two channels have the same time stamps; None stands for no time stamps."""
    if first is None or other is None:
        return first is other
    return first is other or np.array_equal(first, other)


def check_lengths(label: str, columns: Mapping[str, np.ndarray], named: Mapping[str, str]) -> None:
    """Raise `InputError` if columns without separate time stamps have different lengths."""
    if len({len(values) for values in columns.values()}) > 1:
        lengths = ", ".join(
            f"{len(x)} in {format_value(named.get(name, name))}" for name, x in columns.items()
        )
        raise InputError(f"{label}: found columns of different lengths ({lengths}), expected equal lengths")


def split_sparse_rows(
    columns: dict[str, np.ndarray], stamps: np.ndarray
) -> dict[str, np.ndarray | None] | None:
    """Remove empty cells from each column; return the time stamps of each column's readings [s].

    Many cells are empty if a log has one row per message, because a message contains only the channels of one
    topic. Returns None, and changes nothing, if the share of empty cells is below `MIN_EMPTY_SHARE` in every
    column, or if all cells of a column are empty.

    Args:
        columns: Values of each channel, changed in place.
        stamps: Time stamps of the rows [s].
    """
    is_reading = {
        name: values != "" if values.dtype == object else np.isfinite(values)
        for name, values in columns.items()
    }
    shares = [np.mean(there) if len(there) else 1.0 for there in is_reading.values()]
    if min(shares) > 1.0 - MIN_EMPTY_SHARE or min(shares) == 0.0:
        return None
    for name, there in is_reading.items():
        columns[name] = columns[name][there]
    return {name: stamps[there] for name, there in is_reading.items()}


def resample_to_rows(
    label: str,
    columns: Mapping[str, np.ndarray],
    clocks: Mapping[str, np.ndarray | None],
    named: Mapping[str, str],
    period: float,
) -> tuple[dict[str, np.ndarray], np.ndarray, list[str]]:
    """Resample all channels to the rows of the desired position.

    Args:
        label: Name of the log in messages.
        columns: Values of each channel.
        clocks: Time stamps of each channel [s], with a common origin.
        named: Name of each channel's column in messages.
        period: Control period [s].

    Returns:
        The values of each channel; the time stamps of the rows [s]; and notes. If each row gets the nearest
        force reading, a further channel `FORCE_LATE_CHANNEL` contains the time from row to reading [s].

    Raises:
        InputError: If a channel has no valid time stamps, or no row has readings of all channels.
    """
    for name, stamps in clocks.items():
        check_clock(label, named[name], stamps, len(columns[name]))
    master = clocks[MASTER_CHANNEL]
    assert master is not None
    times = clock.remove_stamp_jitter(master, period, label, _label_stamps(named[MASTER_CHANNEL]))
    resampled, notes, is_complete = {}, [], np.ones(len(times), bool)
    assignments: list[tuple[np.ndarray, _RowsAmongReadings]] = []
    for name, values in columns.items():
        stamps = clocks[name]
        assert stamps is not None
        if has_same_stamps(stamps, master):
            resampled[name] = values
            continue
        assignment = next(
            (item for assigned_stamps, item in assignments if has_same_stamps(assigned_stamps, stamps)), None
        )
        if assignment is None:
            assignment = _RowsAmongReadings(label, named[name], stamps, times, period)
            assignments.append((stamps, assignment))
            notes.append(f"{label}: {assignment.note(named[MASTER_CHANNEL])}")
        if name == NEAREST_READING_CHANNEL and assignment.has_row_rate:
            resampled[name], resampled[FORCE_LATE_CHANNEL] = assignment.nearest(values)
        else:
            resampled[name] = assignment.of(values, name in HELD_CHANNELS or values.dtype == object)
        is_complete &= assignment.has_reading
    if not is_complete.any():
        spans = [f"{format_value(named[name])} {t[0]:.6g} to {t[-1]:.6g} s" for name, t in clocks.items()
                 if t is not None]  # fmt: skip
        raise InputError(f"{label}: found no time with readings of all channels ({', '.join(spans)})")
    if not is_complete.all():
        notes.append(
            f"{label}: {np.count_nonzero(~is_complete)} rows without readings of all channels are omitted"
        )
    return {name: values[is_complete] for name, values in resampled.items()}, master[is_complete], notes


def _label_stamps(column: str) -> str:
    return f"stamps of {format_value(column)}"


def check_clock(label: str, column: str, stamps: np.ndarray | None, rows: int) -> None:
    """Raise `InputError` if a column does not have one increasing time stamp per row."""
    if stamps is None:
        expected = "stamps, because other columns have separate stamps"
        raise InputError(f"{label}: column {format_value(column)}: found no stamps, expected {expected}")
    if len(stamps) != rows:
        raise InputError(
            f"{label}: {_label_stamps(column)}: found {len(stamps)}, expected {rows}: one per row"
        )
    if rows < 2:
        raise InputError(f"{label}: column {format_value(column)}: found {rows} rows, expected at least 2")
    bad = np.flatnonzero(~(np.diff(stamps) > 0.0) | ~np.isfinite(stamps[1:]))
    if len(bad):
        row = int(bad[0]) + 2
        finding = f"{stamps[row - 1]:.9g} s after {stamps[row - 2]:.9g} s"
        raise InputError(
            f"{label}: row {row}: {_label_stamps(column)}: found {finding}, expected an increasing time"
        )


class _RowsAmongReadings:
    """Resampling of a channel with its own time stamps, at the rows of the desired position."""

    def __init__(self, label: str, column: str, stamps: np.ndarray, times: np.ndarray, period: float):
        self._column = column
        usual = float(np.median(np.diff(stamps)))
        if usual > MAX_READING_PERIOD * period:
            raise InputError(
                f"{label}: {_label_stamps(column)}: found readings {usual:.4g} s apart, "
                f"expected the control period, {period:g} s, or less"
            )
        self._rate, self._period = usual, period
        # The samples are assumed to be equidistant; only their time stamps scatter.
        stamps = clock.remove_stamp_jitter(stamps, period, label, _label_stamps(column))
        self._begins = float(stamps[0] - times[0])
        index = np.interp(times, stamps, np.arange(len(stamps), dtype=float))
        slack = SIMULTANEITY_TOLERANCE * usual
        self.has_reading = (times >= stamps[0] - slack) & (times <= stamps[-1] + slack)
        nearest = np.rint(index)
        distance = np.abs(times - stamps[nearest.astype(np.int64)])
        self._exact = bool(
            np.all(
                (distance <= SIMULTANEITY_TOLERANCE * period) | (distance > 0.5 * usual) | ~self.has_reading
            )
        )
        if self._exact:
            self.has_reading &= distance <= SIMULTANEITY_TOLERANCE * period
            self._before = nearest.astype(np.int64)
            self._share = np.zeros(0)
            return
        self._nearest, self._late = nearest.astype(np.int64), stamps[nearest.astype(np.int64)] - times
        before = np.minimum(index.astype(np.int64), len(stamps) - 2)
        self.has_reading &= stamps[before + 1] - stamps[before] <= MIN_GAP_RATIO * usual
        self._before, self._share = before, index - before

    @property
    def has_row_rate(self) -> bool:
        """Return whether the readings have the rate of the rows, but are taken between the rows."""
        return not self._exact and abs(self._rate / self._period - 1.0) < EQUAL_RATE_TOLERANCE

    def nearest(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the reading nearest to each row in time, and its time minus that of the row [s]."""
        return values[self._nearest], self._late

    def of(self, values: np.ndarray, steps: bool) -> np.ndarray:
        """Return the values at the times of the rows: held if `steps` is true, else interpolated linearly."""
        if self._exact:
            return values[self._before]
        if steps:
            return values[self._before + (self._share >= 1.0)]
        return values[self._before] * (1.0 - self._share) + values[self._before + 1] * self._share

    def note(self, master: str) -> str:
        """Return a note on the resampling; `master` is the column that defines the rows."""
        how = "used unchanged" if self._exact else "interpolated"
        how += ", but the nearest forces are used" if self.has_row_rate else ""
        begins = f"{abs(1e3 * self._begins):.4g} ms {'after' if self._begins >= 0 else 'before'} those"
        return (
            f"column {format_value(self._column)} has separate stamps, which begin {begins} of "
            f"{format_value(master)}: "
            f"readings {1e3 * self._rate:.4g} ms apart are {how}"
        )
