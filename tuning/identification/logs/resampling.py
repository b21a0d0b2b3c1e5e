"""Resampling of channels with separate clocks to the rows of the desired position.

In some formats every channel, or every group of channels, has its own time stamps. Such a channel may begin
later, have a higher rate, or lose other rows. The rows are those of the desired position. A reading at the
time of a row is used unchanged; otherwise readings are interpolated linearly. The force jumps at the onset of
contact, and interpolation would smear the jump: if forces have the rate of the rows, the nearest reading is
used, together with its delay behind the row. A row without a reading of some channel counts as lost.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaxhil.errors import InputError, format_value
from tuning.identification.logs import clock

MASTER_CHANNEL = "position_desired"
MAX_READING_PERIOD = 1.5  # control periods between readings, above which rows would lack data
MIN_GAP_RATIO = 1.5  # times the median distance of readings, above which readings are missing
SIMULTANEITY_TOLERANCE = 0.02  # periods, distance to a row within which a reading counts as simultaneous
HELD_CHANNELS = "contact_index", "mode"  # channels that hold their value between readings
NEAREST_READING_CHANNEL, FORCE_LATE_CHANNEL = (
    "force_measured",
    "force_late",
)  # channel that jumps; its delay behind the rows [s]
EQUAL_RATE_TOLERANCE = 0.01  # relative difference of two rates that count as equal


def has_same_stamps(one: np.ndarray | None, other: np.ndarray | None) -> bool:
    """Return whether two clocks have the same stamps."""
    if one is None or other is None:
        return one is other
    return one is other or np.array_equal(one, other)


def check_lengths(label: str, columns: Mapping[str, np.ndarray], named: Mapping[str, str]) -> None:
    """Raise `InputError` if columns that share a clock have different lengths."""
    if len({len(values) for values in columns.values()}) > 1:
        lengths = ", ".join(
            f"{len(x)} in {format_value(named.get(name, name))}" for name, x in columns.items()
        )
        raise InputError(f"{label}: found columns of unlike length ({lengths}), expected one row a tick")


def resample_to_rows(
    label: str,
    columns: Mapping[str, np.ndarray],
    clocks: Mapping[str, np.ndarray | None],
    named: Mapping[str, str],
    period: float,
) -> tuple[dict[str, np.ndarray], np.ndarray, list[str]]:
    """Bring all channels to the rows of the desired position.

    Args:
        label: Name of the log in messages.
        columns: Values of each channel.
        clocks: Stamps of each channel [s], with a common zero.
        named: Column of each channel, for messages.
        period: Control period [s].

    Returns:
        Values of each channel at the rows, with `FORCE_LATE_CHANNEL` if the nearest forces are used; the
        stamps of the rows [s]; and notes.

    Raises:
        InputError: If a channel has no clock, or its clock does not cover any row.
    """
    for name, stamps in clocks.items():
        _check_clock(label, named[name], stamps, len(columns[name]))
    master = clocks[MASTER_CHANNEL]
    assert master is not None
    times = clock.remove_stamp_jitter(master, period, label, _label_stamps(named[MASTER_CHANNEL]))
    joined, notes, full = {}, [], np.ones(len(times), bool)
    places: list[tuple[np.ndarray, _RowsAmongReadings]] = []
    for name, values in columns.items():
        stamps = clocks[name]
        assert stamps is not None
        if has_same_stamps(stamps, master):
            joined[name] = values
            continue
        places_of = next((item for times_of, item in places if has_same_stamps(times_of, stamps)), None)
        if places_of is None:
            places_of = _RowsAmongReadings(label, named[name], stamps, times, period)
            places.append((stamps, places_of))
            notes.append(f"{label}: {places_of.note(named[MASTER_CHANNEL])}")
        if name == NEAREST_READING_CHANNEL and places_of.has_row_rate:
            joined[name], joined[FORCE_LATE_CHANNEL] = places_of.nearest(values)
        else:
            joined[name] = places_of.of(values, name in HELD_CHANNELS or values.dtype == object)
        full &= places_of.there
    if not full.any():
        spans = [f"{format_value(named[name])} {t[0]:.6g} to {t[-1]:.6g} s" for name, t in clocks.items()
                 if t is not None]  # fmt: skip
        raise InputError(f"{label}: found no time at which all channels were read ({', '.join(spans)})")
    if not full.all():
        notes.append(f"{label}: {np.count_nonzero(~full)} rows at which a channel was not read are left out")
    return {name: values[full] for name, values in joined.items()}, master[full], notes


def _label_stamps(column: str) -> str:
    return f"stamps of {format_value(column)}"


def _check_clock(label: str, column: str, stamps: np.ndarray | None, rows: int) -> None:
    """Raise `InputError` if there is not one stamp per row, or the stamps do not increase."""
    if stamps is None:
        allowed = "some, since other columns have their own"
        raise InputError(f"{label}: column {format_value(column)}: found no stamps, expected {allowed}")
    if len(stamps) != rows:
        raise InputError(f"{label}: {_label_stamps(column)}: found {len(stamps)}, expected {rows}, one a row")
    if rows < 2:
        raise InputError(f"{label}: column {format_value(column)}: found {rows} rows, expected at least 2")
    bad = np.flatnonzero(~(np.diff(stamps) > 0.0) | ~np.isfinite(stamps[1:]))
    if len(bad):
        row = int(bad[0]) + 2
        finding = f"{stamps[row - 1]:.9g} s after {stamps[row - 2]:.9g} s"
        raise InputError(
            f"{label}: row {row}: {_label_stamps(column)}: found {finding}, expected time that increases"
        )


class _RowsAmongReadings:
    """Positions of the rows among the readings of another clock."""

    def __init__(self, label: str, column: str, stamps: np.ndarray, times: np.ndarray, period: float):
        self._column = column
        usual = float(np.median(np.diff(stamps)))
        if usual > MAX_READING_PERIOD * period:
            raise InputError(
                f"{label}: {_label_stamps(column)}: found readings {usual:.4g} s apart, "
                f"expected the control period, {period:g} s, or less"
            )
        self._rate, self._period = usual, period
        # The stamps scatter, but the samples are regular.
        stamps = clock.remove_stamp_jitter(stamps, period, label, _label_stamps(column))
        self._begins = float(stamps[0] - times[0])
        index = np.interp(times, stamps, np.arange(len(stamps), dtype=float))
        slack = SIMULTANEITY_TOLERANCE * usual
        self.there = (times >= stamps[0] - slack) & (times <= stamps[-1] + slack)
        nearest = np.rint(index)
        distance = np.abs(times - stamps[nearest.astype(np.int64)])
        self._exact = bool(
            np.all((distance <= SIMULTANEITY_TOLERANCE * period) | (distance > 0.5 * usual) | ~self.there)
        )
        if self._exact:
            self.there &= distance <= SIMULTANEITY_TOLERANCE * period
            self._before = nearest.astype(np.int64)
            self._share = np.zeros(0)
            return
        self._nearest, self._late = nearest.astype(np.int64), stamps[nearest.astype(np.int64)] - times
        before = np.minimum(index.astype(np.int64), len(stamps) - 2)
        self.there &= stamps[before + 1] - stamps[before] <= MIN_GAP_RATIO * usual
        self._before, self._share = before, index - before

    @property
    def has_row_rate(self) -> bool:
        """Return whether the readings have the rate of the rows, but other times."""
        return not self._exact and abs(self._rate / self._period - 1.0) < EQUAL_RATE_TOLERANCE

    def nearest(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the readings nearest to the rows, and their delay behind the rows [s]."""
        return values[self._nearest], self._late

    def of(self, values: np.ndarray, steps: bool) -> np.ndarray:
        """Return the values at the rows; with `steps`, a value holds until the next reading."""
        if self._exact:
            return values[self._before]
        if steps:
            return values[self._before + (self._share >= 1.0)]
        return values[self._before] * (1.0 - self._share) + values[self._before + 1] * self._share

    def note(self, master: str) -> str:
        """Return a note on the resampling."""
        how = "taken at their own times" if self._exact else "interpolated between their own times"
        how += ", forces taken at the nearest" if self.has_row_rate else ""
        begins = f"{abs(1e3 * self._begins):.4g} ms {'after' if self._begins >= 0 else 'before'} that"
        return (
            f"column {format_value(self._column)} has a clock of its own, which begins {begins} of "
            f"{format_value(master)}: "
            f"readings {1e3 * self._rate:.4g} ms apart are {how}"
        )
