"""Channels with clocks of their own, brought to the rows of the desired position.

Some formats stamp every channel, or every group of channels, by itself: such a channel may begin later, be
sampled faster, or lose rows of its own. Rows are those of the desired position. A reading that was taken at
a row's time is that row's; between two readings it is the line through them. Forces jump at the begin of a
contact, which such a line would smear: of forces read as often as rows, a row has the nearest one, and by how
much that is later than the row. A row for which a channel has no reading, since it begins later, ends earlier
or lost rows, counts as lost.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaxhil.errors import InputError, shown
from tuning.identification.logs import clock

MASTER = "position_desired"
SLOWEST = 1.5  # control periods between readings, beyond which rows would have to be made up
GAP = 1.5  # times the usual distance of readings, beyond which some were lost
AT_A_ROW = 0.02  # periods: readings nearer to a row than this are taken at it
STEPS = "contact_index", "mode"  # channels that hold their value between readings
JUMPS, LATE = "force_measured", "force_late"  # the channel that jumps, and that of its delay behind rows [s]
AS_OFTEN = 0.01  # relative difference of a channel's rate from that of the rows, up to which it is the same


def same_clock(one: np.ndarray | None, other: np.ndarray | None) -> bool:
    """Return whether two clocks have the same stamps."""
    if one is None or other is None:
        return one is other
    return one is other or np.array_equal(one, other)


def check_lengths(label: str, columns: Mapping[str, np.ndarray], named: Mapping[str, str]) -> None:
    """Raise `InputError` unless columns without clocks of their own are of one length."""
    if len({len(one) for one in columns.values()}) > 1:
        found = ", ".join(f"{len(one)} in {shown(named.get(name, name))}" for name, one in columns.items())
        raise InputError(f"{label}: found columns of unlike length ({found}), allowed one row a tick")


def join(
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
        clocks: Stamps of each channel [s], from a zero that all share.
        named: Column of each channel, for messages.
        period: Control period [s].

    Returns:
        Values of each channel at the rows, `LATE` among them where forces are those nearest to the rows; the
        rows' stamps [s]; and notes.

    Raises:
        InputError: If a channel has no clock, or one that the rows cannot be found in.
    """
    for name, stamps in clocks.items():
        _check_clock(label, named[name], stamps, len(columns[name]))
    master = clocks[MASTER]
    assert master is not None
    times = clock.regular(master, period, label, _stamps_of(named[MASTER]))
    joined, notes, kept = {}, [], np.ones(len(times), bool)
    places: list[tuple[np.ndarray, _Places]] = []
    for name, values in columns.items():
        stamps = clocks[name]
        assert stamps is not None
        if same_clock(stamps, master):
            joined[name] = values
            continue
        found = next((found for other, found in places if same_clock(other, stamps)), None)
        if found is None:
            found = _Places(label, named[name], stamps, times, period)
            places.append((stamps, found))
            notes.append(f"{label}: {found.note(named[MASTER])}")
        if name == JUMPS and found.as_often:
            joined[name], joined[LATE] = found.nearest(values)
        else:
            joined[name] = found.of(values, name in STEPS or values.dtype == object)
        kept &= found.there
    if not kept.any():
        spans = [f"{shown(named[name])} {one[0]:.6g} to {one[-1]:.6g} s" for name, one in clocks.items()
                 if one is not None]  # fmt: skip
        raise InputError(f"{label}: found no time at which all channels were read ({', '.join(spans)})")
    if not kept.all():
        notes.append(f"{label}: {np.count_nonzero(~kept)} rows at which a channel was not read are left out")
    return {name: values[kept] for name, values in joined.items()}, master[kept], notes


def _stamps_of(column: str) -> str:
    return f"stamps of {shown(column)}"


def _check_clock(label: str, column: str, stamps: np.ndarray | None, rows: int) -> None:
    """Raise `InputError` unless there are as many stamps as rows, and they increase."""
    if stamps is None:
        allowed = "some, since other columns have their own"
        raise InputError(f"{label}: column {shown(column)}: found no stamps, allowed {allowed}")
    if len(stamps) != rows:
        raise InputError(f"{label}: {_stamps_of(column)}: found {len(stamps)}, allowed {rows}, one a row")
    if rows < 2:
        raise InputError(f"{label}: column {shown(column)}: found {rows} rows, allowed at least 2")
    bad = np.flatnonzero(~(np.diff(stamps) > 0.0) | ~np.isfinite(stamps[1:]))
    if len(bad):
        row = int(bad[0]) + 2
        found = f"{stamps[row - 1]:.9g} s after {stamps[row - 2]:.9g} s"
        raise InputError(
            f"{label}: row {row}: {_stamps_of(column)}: found {found}, allowed time that increases"
        )


class _Places:
    """Places of the rows among the readings of another clock."""

    def __init__(self, label: str, column: str, stamps: np.ndarray, times: np.ndarray, period: float):
        self._column = column
        usual = float(np.median(np.diff(stamps)))
        if usual > SLOWEST * period:
            raise InputError(
                f"{label}: {_stamps_of(column)}: found readings {usual:.4g} s apart, "
                f"allowed the control period, {period:g} s, or less"
            )
        self._rate, self._period = usual, period
        # Where stamps scatter the samples do not.
        stamps = clock.regular(stamps, period, label, _stamps_of(column))
        self._begins = float(stamps[0] - times[0])
        place = np.interp(times, stamps, np.arange(len(stamps), dtype=float))
        slack = AT_A_ROW * usual
        self.there = (times >= stamps[0] - slack) & (times <= stamps[-1] + slack)
        nearest = np.rint(place)
        off = np.abs(times - stamps[nearest.astype(np.int64)])
        self._exact = bool(np.all((off <= AT_A_ROW * period) | (off > 0.5 * usual) | ~self.there))
        if self._exact:
            self.there &= off <= AT_A_ROW * period
            self._before = nearest.astype(np.int64)
            self._share = np.zeros(0)
            return
        self._nearest, self._late = nearest.astype(np.int64), stamps[nearest.astype(np.int64)] - times
        before = np.minimum(place.astype(np.int64), len(stamps) - 2)
        self.there &= stamps[before + 1] - stamps[before] <= GAP * usual
        self._before, self._share = before, place - before

    @property
    def as_often(self) -> bool:
        """Tell whether readings are as far apart as rows, at other times."""
        return not self._exact and abs(self._rate / self._period - 1.0) < AS_OFTEN

    def nearest(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values nearest to the rows, and by how much later they were read [s]."""
        return values[self._nearest], self._late

    def of(self, values: np.ndarray, steps: bool) -> np.ndarray:
        """Values at the rows; `steps`: they hold until the next reading."""
        if self._exact:
            return values[self._before]
        if steps:
            return values[self._before + (self._share >= 1.0)]
        return values[self._before] * (1.0 - self._share) + values[self._before + 1] * self._share

    def note(self, master: str) -> str:
        """Say what was done."""
        how = "taken at their own times" if self._exact else "interpolated between their own times"
        how += ", forces taken at the nearest" if self.as_often else ""
        begins = f"{abs(1e3 * self._begins):.4g} ms {'after' if self._begins >= 0 else 'before'} that"
        return (
            f"column {shown(self._column)} has a clock of its own, which begins {begins} of {shown(master)}: "
            f"readings {1e3 * self._rate:.4g} ms apart are {how}"
        )
