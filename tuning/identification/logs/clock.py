"""Assignment of rows to control periods, from time stamps with jitter.

The samples are taken at ticks; only their stamps scatter. A stamp t is modelled as

    t = t_0 + phase(t) + n T + error,

with the unknown tick n, the specified control period T, and a phase that drifts slowly if the clock of the
stamps runs faster or slower. The phase is the angle of the mean of e^(2 pi i t / T) over a chunk of rows,
unwrapped from chunk to chunk. The tick is the stamp minus its phase, in periods, rounded.
"""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import numpy as np

from jaxhil.errors import InputError, shown
from tuning.identification.records import Clock

LOT = 256  # rows in a chunk, which has one phase
SHORTEST = 1e-6  # periods, least distance of rows
LONGEST = 1e12  # periods, longest log; beyond it ticks lose digits
MANY = 20_000  # rows that are sufficient for an estimate
RATE = 0.1  # largest relative difference of the rows' rate from the control rate
DRIFT = 1.5e-3  # the same over many rows; beyond it the phase of a chunk turns by more than a half
STEADY = 0.15  # of the period, largest scatter of the distance of rows that still gives their rate
SCATTER = 0.25  # periods, largest scatter of stamps that still identify ticks


class Ticks(NamedTuple):
    """Ticks of rows, the first one 0."""

    tick: np.ndarray  # int64
    clock: Clock


def ticks_of(stamps: np.ndarray, period: float, label: str, column: str = "time") -> Ticks:
    """Return the tick of every stamp [s].

    Raises:
        InputError: If the stamps do not increase at the control rate.
    """
    stamps, phase, tick = _rounded(stamps, period, label, column)
    error = stamps - phase - period * tick
    error -= np.mean(error)
    jitter = float(np.std(error))
    if jitter > SCATTER * period:
        finding = f"stamps that scatter by {1e3 * jitter:.3g} ms about the ticks"
        allowed = f'at most {SCATTER:g} control periods, or timing.clock = "index"'
        raise InputError(f"{label}: {column}: found {finding}, allowed {allowed}")
    slope = float(np.polynomial.polynomial.polyfit(tick.astype(float), stamps, 1)[1])
    clock = Clock(slope, 1e6 * (slope / period - 1.0), jitter, int(tick[-1] - tick[0] + 1 - len(tick)))
    return Ticks(tick - tick[0], clock)


def regular(stamps: np.ndarray, period: float, label: str, column: str) -> np.ndarray:
    """Return the sampling times [s] of rows: stamps without their scatter about a steady rate.

    `period` [s] is used if the stamps scatter too much to estimate the rate.
    """
    _steps(stamps, period, label, column)
    first, measured = float(stamps[0]), own_period(stamps)
    if measured is None and abs(float(np.median(np.diff(stamps))) / period - 1.0) > RATE:
        return stamps
    period = measured or period
    left, phase, tick = _rounded(stamps, period, label, column)
    times = phase + period * tick
    if np.std(left - times) > SCATTER * period:
        return stamps  # rows that come by events
    return first + times + float(np.mean(left - times))


def own_period(stamps: np.ndarray) -> float | None:
    """Return the distance of rows [s], robust against lost rows; None if the stamps scatter too much."""
    steps = np.diff(stamps[:MANY])
    period, rows = float(np.median(steps)), 1
    if 1.4826 * float(np.median(np.abs(steps - period))) > STEADY * period:
        return None
    while 4 * rows < len(stamps):
        rows *= 4
        stride = len(stamps) // MANY + 1
        apart = stamps[rows::stride] - stamps[:-rows:stride]
        ticks = np.rint(apart / period)
        # After lost rows there are more ticks than rows.
        period = float(np.median(apart[ticks > 0] / ticks[ticks > 0])) if np.any(ticks > 0) else period
    return period


def _rounded(
    stamps: np.ndarray, period: float, label: str, column: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stamps from the first one, their phases, and their ticks.

    Raises:
        InputError: If the stamps do not identify ticks.
    """
    steps = _steps(stamps, period, label, column)
    _check_rate(stamps, steps, period, label, column)
    stamps = stamps - stamps[0]
    phase = _phase(stamps, period)
    return stamps, phase, _increasing(np.rint((stamps - phase) / period).astype(np.int64))


def _steps(stamps: np.ndarray, period: float, label: str, column: str) -> np.ndarray:
    """Return the distances of rows [s].

    Raises:
        InputError: If they cannot be those of a log.
    """
    steps = np.diff(stamps)
    bad = np.flatnonzero(~(steps > 0))
    if len(bad):
        row, text = int(bad[0]) + 2, f"{stamps[bad[0] + 1]:.9g} s after {stamps[bad[0]]:.9g} s"
        raise InputError(f"{label}: row {row}: {column}: found {text}, allowed time that increases")
    if not stamps[-1] - stamps[0] < LONGEST * period:
        row = int(np.argmax(steps)) + 2
        text = f"{stamps[row - 1]:.9g} s after {stamps[row - 2]:.9g} s"
        raise InputError(f"{label}: row {row}: {column}: found {text}, allowed at most {LONGEST:g} periods")
    usual = float(np.median(steps[:MANY])) if len(steps) else period
    if not usual > SHORTEST * period:
        text = f"rows {usual:.4g} s apart"
        raise InputError(f"{label}: {column}: found {text}, allowed the control period, {period:g} s")
    return steps


def counted(rows: int, period: float) -> Ticks:
    """Return one tick per row, none lost."""
    return Ticks(np.arange(rows, dtype=np.int64), Clock(period, 0.0, 0.0, 0))


def parsed(stamps: np.ndarray, time_format: str, label: str) -> tuple[np.ndarray, float]:
    """Return seconds from the first stamp, and that stamp [s], from texts in a format of `strptime`."""
    dates = []
    for row, stamp in enumerate(stamps):
        try:
            dates.append(datetime.strptime(str(stamp).strip(), time_format))
        except ValueError:
            allowed = f"a time as time_format says, {shown(time_format)}"
            raise InputError(
                f"{label}: row {row + 1}: time: found {shown(stamp)}, allowed {allowed}"
            ) from None
    begin = (dates[0].replace(tzinfo=None) - datetime(1970, 1, 1)).total_seconds() if dates else 0.0
    return np.array([(date - dates[0]).total_seconds() for date in dates]), begin


def _check_rate(stamps: np.ndarray, steps: np.ndarray, period: float, label: str, column: str) -> None:
    """Check that the rows come at the control rate throughout."""
    usual = float(np.median(steps))
    if abs(usual / period - 1.0) > RATE:
        finding = f"rows {usual:.4g} s apart"
        allowed = f"the control period, {period:g} s (is the unit of {column} right?)"
        raise InputError(f"{label}: {column}: found {finding}, allowed {allowed}")
    measured = own_period(stamps)
    if measured is not None and abs(measured / period - 1.0) > DRIFT:
        raise InputError(
            f"{label}: {column}: found rows {measured:.6g} s apart, allowed the control period, {period:g} s"
        )
    lots = len(steps) // LOT
    medians = np.median(steps[: lots * LOT].reshape(lots, LOT), axis=1) if lots else np.empty(0)
    bad_chunks = np.flatnonzero(np.abs(medians / period - 1.0) > RATE)
    if len(bad_chunks):
        row, finding = int(bad_chunks[0]) * LOT + 1, f"rows {medians[bad_chunks[0]]:.4g} s apart"
        raise InputError(
            f"{label}: row {row}: {column}: found {finding}, allowed one rate, {period:g} s, all along"
        )


def _phase(stamps: np.ndarray, period: float) -> np.ndarray:
    """Return the slowly changing offset [s] of every stamp from multiples of the period."""
    starts = np.arange(0, len(stamps), LOT)
    if len(stamps) % LOT and len(starts) > 1:
        starts = starts[:-1]  # the last chunk includes the remaining rows
    turns = stamps / period
    # Whole turns carry no information and would cost digits.
    turns -= np.rint(turns)
    turns *= 2.0 * np.pi
    sizes = np.diff(np.append(starts, len(stamps)))
    angle = np.unwrap(np.arctan2(*(np.add.reduceat(part(turns), starts) for part in (np.sin, np.cos))))
    middle = np.add.reduceat(stamps, starts) / sizes
    if len(middle) > 1:
        # Extrapolate to the outer rows of the first and the last chunk.
        middle, angle = (np.array([2 * c[0] - c[1], *c, 2 * c[-1] - c[-2]]) for c in (middle, angle))
    return np.interp(stamps, middle, period * angle / (2 * np.pi))


def _increasing(tick: np.ndarray) -> np.ndarray:
    """Return ticks in which outliers are corrected: rows are in order and no two share a tick."""
    lost = tick - np.arange(len(tick))
    if np.all(np.diff(lost) >= 0):
        return tick
    from scipy.ndimage import median_filter

    lost = median_filter(lost, size=9, mode="nearest")
    return np.maximum.accumulate(lost) + np.arange(len(tick))
