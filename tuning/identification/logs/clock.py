"""Which control period each row belongs to, from stamps that are not exact.

The samples were taken at ticks; what scatters is when each was stamped. A stamp t is taken to be

    t = t_0 + phase(t) + n T + error,

with the tick n wanted, T the control period as told, and a phase that drifts slowly, where the clock of the
stamps runs faster or slower. The phase is the angle of the mean of e^(2 pi i t / T) over some rows, unwrapped
from one lot of rows to the next; a stamp less its phase, in periods, is rounded.
"""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import numpy as np

from jaxhil.errors import InputError, shown
from tuning.identification.records import Clock

LOT = 256  # rows that share a phase
SHORTEST = 1e-6  # periods between rows
LONGEST = 1e12  # periods of a log, beyond which ticks lose digits
MANY = 20_000  # rows that say as much as all
RATE = 0.1  # share by which the rows' rate may differ from the control rate
DRIFT = 1.5e-3  # the same over many rows: beyond it a lot of rows is half a turn of the phase
STEADY = 0.15  # of the period, by which the distance of rows may scatter where it tells their rate
SCATTER = 0.25  # of the stamps, in periods, beyond which ticks cannot be told from them


class Ticks(NamedTuple):
    """The ticks of rows, the first one 0."""

    tick: np.ndarray  # int64
    clock: Clock


def ticks_of(stamps: np.ndarray, period: float, label: str, column: str = "time") -> Ticks:
    """The tick of every stamp [s]. Raises `InputError` unless they increase, at the control rate."""
    stamps, phase, tick = _rounded(stamps, period, label, column)
    error = stamps - phase - period * tick
    error -= np.mean(error)
    jitter = float(np.std(error))
    if jitter > SCATTER * period:
        found = f"stamps that scatter by {1e3 * jitter:.3g} ms about the ticks"
        allowed = f'at most {SCATTER:g} control periods, or timing.clock = "index"'
        raise InputError(f"{label}: {column}: found {found}, allowed {allowed}")
    slope = float(np.polynomial.polynomial.polyfit(tick.astype(float), stamps, 1)[1])
    clock = Clock(slope, 1e6 * (slope / period - 1.0), jitter, int(tick[-1] - tick[0] + 1 - len(tick)))
    return Ticks(tick - tick[0], clock)


def regular(stamps: np.ndarray, period: float, label: str, column: str) -> np.ndarray:
    """Return the times [s] at which rows were sampled: stamps without what scatters about a steady rate.

    `period` is the rate's where stamps scatter too much to tell another one."""
    _steps(stamps, period, label, column)
    first, own = float(stamps[0]), own_period(stamps)
    if own is None and abs(float(np.median(np.diff(stamps))) / period - 1.0) > RATE:
        return stamps
    period = own or period
    left, phase, tick = _rounded(stamps, period, label, column)
    times = phase + period * tick
    if np.std(left - times) > SCATTER * period:
        return stamps  # rows that come by events
    return first + times + float(np.mean(left - times))


def own_period(stamps: np.ndarray) -> float | None:
    """Return the distance of rows [s], over ever more of them, some being lost; None if stamps scatter."""
    steps = np.diff(stamps[:MANY])
    period, rows = float(np.median(steps)), 1
    if 1.4826 * float(np.median(np.abs(steps - period))) > STEADY * period:
        return None
    while 4 * rows < len(stamps):
        rows *= 4
        every = len(stamps) // MANY + 1
        apart = stamps[rows::every] - stamps[:-rows:every]
        ticks = np.rint(apart / period)
        # Where rows were lost, the ticks are more than the rows.
        period = float(np.median(apart[ticks > 0] / ticks[ticks > 0])) if np.any(ticks > 0) else period
    return period


def _rounded(
    stamps: np.ndarray, period: float, label: str, column: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stamps from the first one, their phases, and their ticks; raise `InputError` where none show."""
    steps = _steps(stamps, period, label, column)
    _check_rate(stamps, steps, period, label, column)
    stamps = stamps - stamps[0]
    phase = _phase(stamps, period)
    return stamps, phase, _increasing(np.rint((stamps - phase) / period).astype(np.int64))


def _steps(stamps: np.ndarray, period: float, label: str, column: str) -> np.ndarray:
    """Return the distances of rows [s]; raise `InputError` unless they can be those of a log."""
    steps = np.diff(stamps)
    bad = np.flatnonzero(~(steps > 0))
    if len(bad):
        row, found = int(bad[0]) + 2, f"{stamps[bad[0] + 1]:.9g} s after {stamps[bad[0]]:.9g} s"
        raise InputError(f"{label}: row {row}: {column}: found {found}, allowed time that increases")
    if not stamps[-1] - stamps[0] < LONGEST * period:
        row = int(np.argmax(steps)) + 2
        found = f"{stamps[row - 1]:.9g} s after {stamps[row - 2]:.9g} s"
        raise InputError(f"{label}: row {row}: {column}: found {found}, allowed at most {LONGEST:g} periods")
    usual = float(np.median(steps[:MANY])) if len(steps) else period
    if not usual > SHORTEST * period:
        found = f"rows {usual:.4g} s apart"
        raise InputError(f"{label}: {column}: found {found}, allowed the control period, {period:g} s")
    return steps


def counted(rows: int, period: float) -> Ticks:
    """One row a tick, none lost."""
    return Ticks(np.arange(rows, dtype=np.int64), Clock(period, 0.0, 0.0, 0))


def parsed(stamps: np.ndarray, time_format: str, label: str) -> tuple[np.ndarray, float]:
    """Seconds from the first stamp, and of that one, of texts as `datetime.strptime` reads them."""
    found = []
    for row, stamp in enumerate(stamps):
        try:
            found.append(datetime.strptime(str(stamp).strip(), time_format))
        except ValueError:
            allowed = f"a time as time_format says, {shown(time_format)}"
            raise InputError(
                f"{label}: row {row + 1}: time: found {shown(stamp)}, allowed {allowed}"
            ) from None
    begin = (found[0].replace(tzinfo=None) - datetime(1970, 1, 1)).total_seconds() if found else 0.0
    return np.array([(one - found[0]).total_seconds() for one in found]), begin


def _check_rate(stamps: np.ndarray, steps: np.ndarray, period: float, label: str, column: str) -> None:
    """The rows come at the control rate, all along."""
    usual = float(np.median(steps))
    if abs(usual / period - 1.0) > RATE:
        found = f"rows {usual:.4g} s apart"
        allowed = f"the control period, {period:g} s (is the unit of {column} right?)"
        raise InputError(f"{label}: {column}: found {found}, allowed {allowed}")
    own = own_period(stamps)
    if own is not None and abs(own / period - 1.0) > DRIFT:
        raise InputError(
            f"{label}: {column}: found rows {own:.6g} s apart, allowed the control period, {period:g} s"
        )
    lots = len(steps) // LOT
    medians = np.median(steps[: lots * LOT].reshape(lots, LOT), axis=1) if lots else np.empty(0)
    other = np.flatnonzero(np.abs(medians / period - 1.0) > RATE)
    if len(other):
        row, found = int(other[0]) * LOT + 1, f"rows {medians[other[0]]:.4g} s apart"
        raise InputError(
            f"{label}: row {row}: {column}: found {found}, allowed one rate, {period:g} s, all along"
        )


def _phase(stamps: np.ndarray, period: float) -> np.ndarray:
    """Of every stamp [s]: the slowly changing part by which stamps are off multiples of the period."""
    starts = np.arange(0, len(stamps), LOT)
    if len(stamps) % LOT and len(starts) > 1:
        starts = starts[:-1]  # the last lot has the rest as well
    turns = stamps / period
    # The whole turns say nothing, and would cost digits.
    turns -= np.rint(turns)
    turns *= 2.0 * np.pi
    sizes = np.diff(np.append(starts, len(stamps)))
    angle = np.unwrap(np.arctan2(*(np.add.reduceat(one(turns), starts) for one in (np.sin, np.cos))))
    middle = np.add.reduceat(stamps, starts) / sizes
    if len(middle) > 1:
        # On to the outer rows of the outer lots.
        middle, angle = (np.array([2 * c[0] - c[1], *c, 2 * c[-1] - c[-2]]) for c in (middle, angle))
    return np.interp(stamps, middle, period * angle / (2 * np.pi))


def _increasing(tick: np.ndarray) -> np.ndarray:
    """With rows that scatter put a tick aside put back: rows are in order, no two of one tick."""
    lost = tick - np.arange(len(tick))
    if np.all(np.diff(lost) >= 0):
        return tick
    from scipy.ndimage import median_filter

    lost = median_filter(lost, size=9, mode="nearest")
    return np.maximum.accumulate(lost) + np.arange(len(tick))
