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

from jaxhil.errors import InputError, format_value
from tuning.identification.records import StampClock

PHASE_CHUNK_ROWS = 256  # rows in a chunk, which has one phase
MIN_ROW_DISTANCE = 1e-6  # periods, least distance of rows
MAX_LOG_PERIODS = 1e12  # periods, longest log; beyond it ticks lose digits
MAX_RATE_ROWS = 20_000  # rows that are sufficient for an estimate
MAX_RATE_ERROR = 0.1  # largest relative difference of the rows' rate from the control rate
MAX_MEAN_RATE_ERROR = (
    1.5e-3  # the same over many rows; beyond it the phase of a chunk turns by more than a half
)
MAX_STEP_SCATTER = 0.15  # of the period, largest scatter of the distance of rows that still gives their rate
MAX_STAMP_SCATTER = 0.25  # periods, largest scatter of stamps that still identify ticks


class RowTicks(NamedTuple):
    """Ticks of rows, the first one 0."""

    tick: np.ndarray  # int64
    clock: StampClock


def assign_ticks(stamps: np.ndarray, period: float, label: str, column: str = "time") -> RowTicks:
    """Return the tick of every stamp [s].

    Raises:
        InputError: If the stamps do not increase at the control rate.
    """
    stamps, phase, tick = _round_to_ticks(stamps, period, label, column)
    error = stamps - phase - period * tick
    error -= np.mean(error)
    jitter = float(np.std(error))
    if jitter > MAX_STAMP_SCATTER * period:
        finding = f"stamps that scatter by {1e3 * jitter:.3g} ms about the ticks"
        allowed = f'at most {MAX_STAMP_SCATTER:g} control periods, or timing.clock = "index"'
        raise InputError(f"{label}: {column}: found {finding}, expected {allowed}")
    slope = float(np.polynomial.polynomial.polyfit(tick.astype(float), stamps, 1)[1])
    clock = StampClock(slope, 1e6 * (slope / period - 1.0), jitter, int(tick[-1] - tick[0] + 1 - len(tick)))
    return RowTicks(tick - tick[0], clock)


def remove_stamp_jitter(stamps: np.ndarray, period: float, label: str, column: str) -> np.ndarray:
    """Return the sampling times [s] of rows: stamps without their scatter about a steady rate.

    `period` [s] is used if the stamps scatter too much to estimate the rate.
    """
    _compute_row_distances(stamps, period, label, column)
    first, measured = float(stamps[0]), estimate_row_period(stamps)
    if measured is None and abs(float(np.median(np.diff(stamps))) / period - 1.0) > MAX_RATE_ERROR:
        return stamps
    period = measured or period
    left, phase, tick = _round_to_ticks(stamps, period, label, column)
    times = phase + period * tick
    if np.std(left - times) > MAX_STAMP_SCATTER * period:
        return stamps  # rows that come by events
    return first + times + float(np.mean(left - times))


def estimate_row_period(stamps: np.ndarray) -> float | None:
    """Return the distance of rows [s], robust against lost rows; None if the stamps scatter too much."""
    steps = np.diff(stamps[:MAX_RATE_ROWS])
    period, rows = float(np.median(steps)), 1
    if 1.4826 * float(np.median(np.abs(steps - period))) > MAX_STEP_SCATTER * period:
        return None
    while 4 * rows < len(stamps):
        rows *= 4
        stride = len(stamps) // MAX_RATE_ROWS + 1
        apart = stamps[rows::stride] - stamps[:-rows:stride]
        ticks = np.rint(apart / period)
        # After lost rows there are more ticks than rows.
        period = float(np.median(apart[ticks > 0] / ticks[ticks > 0])) if np.any(ticks > 0) else period
    return period


def _round_to_ticks(
    stamps: np.ndarray, period: float, label: str, column: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stamps from the first one, their phases, and their ticks.

    Raises:
        InputError: If the stamps do not identify ticks.
    """
    steps = _compute_row_distances(stamps, period, label, column)
    _check_rate(stamps, steps, period, label, column)
    stamps = stamps - stamps[0]
    phase = _estimate_phase(stamps, period)
    return stamps, phase, _correct_outliers(np.rint((stamps - phase) / period).astype(np.int64))


def _compute_row_distances(stamps: np.ndarray, period: float, label: str, column: str) -> np.ndarray:
    """Return the distances of rows [s].

    Raises:
        InputError: If they cannot be those of a log.
    """
    steps = np.diff(stamps)
    bad = np.flatnonzero(~(steps > 0))
    if len(bad):
        row, text = int(bad[0]) + 2, f"{stamps[bad[0] + 1]:.9g} s after {stamps[bad[0]]:.9g} s"
        raise InputError(f"{label}: row {row}: {column}: found {text}, expected time that increases")
    if not stamps[-1] - stamps[0] < MAX_LOG_PERIODS * period:
        row = int(np.argmax(steps)) + 2
        text = f"{stamps[row - 1]:.9g} s after {stamps[row - 2]:.9g} s"
        raise InputError(
            f"{label}: row {row}: {column}: found {text}, expected at most {MAX_LOG_PERIODS:g} periods"
        )
    usual = float(np.median(steps[:MAX_RATE_ROWS])) if len(steps) else period
    if not usual > MIN_ROW_DISTANCE * period:
        text = f"rows {usual:.4g} s apart"
        raise InputError(f"{label}: {column}: found {text}, expected the control period, {period:g} s")
    return steps


def number_rows(rows: int, period: float) -> RowTicks:
    """Return one tick per row, none lost."""
    return RowTicks(np.arange(rows, dtype=np.int64), StampClock(period, 0.0, 0.0, 0))


def parse_stamps(stamps: np.ndarray, time_format: str, label: str) -> tuple[np.ndarray, float]:
    """Return seconds from the first stamp, and that stamp [s], from texts in a format of `strptime`."""
    dates = []
    for row, stamp in enumerate(stamps):
        try:
            dates.append(datetime.strptime(str(stamp).strip(), time_format))
        except ValueError:
            allowed = f"a time as time_format says, {format_value(time_format)}"
            raise InputError(
                f"{label}: row {row + 1}: time: found {format_value(stamp)}, expected {allowed}"
            ) from None
    begin = (dates[0].replace(tzinfo=None) - datetime(1970, 1, 1)).total_seconds() if dates else 0.0
    return np.array([(date - dates[0]).total_seconds() for date in dates]), begin


def _check_rate(stamps: np.ndarray, steps: np.ndarray, period: float, label: str, column: str) -> None:
    """Check that the rows come at the control rate throughout."""
    usual = float(np.median(steps))
    if abs(usual / period - 1.0) > MAX_RATE_ERROR:
        finding = f"rows {usual:.4g} s apart"
        allowed = f"the control period, {period:g} s (is the unit of {column} right?)"
        raise InputError(f"{label}: {column}: found {finding}, expected {allowed}")
    measured = estimate_row_period(stamps)
    if measured is not None and abs(measured / period - 1.0) > MAX_MEAN_RATE_ERROR:
        raise InputError(
            f"{label}: {column}: found rows {measured:.6g} s apart, expected the control period, {period:g} s"
        )
    lots = len(steps) // PHASE_CHUNK_ROWS
    medians = (
        np.median(steps[: lots * PHASE_CHUNK_ROWS].reshape(lots, PHASE_CHUNK_ROWS), axis=1)
        if lots
        else np.empty(0)
    )
    bad_chunks = np.flatnonzero(np.abs(medians / period - 1.0) > MAX_RATE_ERROR)
    if len(bad_chunks):
        row, finding = int(bad_chunks[0]) * PHASE_CHUNK_ROWS + 1, f"rows {medians[bad_chunks[0]]:.4g} s apart"
        raise InputError(
            f"{label}: row {row}: {column}: found {finding}, expected one rate, {period:g} s, all along"
        )


def _estimate_phase(stamps: np.ndarray, period: float) -> np.ndarray:
    """Return the slowly changing offset [s] of every stamp from multiples of the period."""
    starts = np.arange(0, len(stamps), PHASE_CHUNK_ROWS)
    if len(stamps) % PHASE_CHUNK_ROWS and len(starts) > 1:
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


def _correct_outliers(tick: np.ndarray) -> np.ndarray:
    """Return ticks in which outliers are corrected: rows are in order and no two share a tick."""
    lost = tick - np.arange(len(tick))
    if np.all(np.diff(lost) >= 0):
        return tick
    from scipy.ndimage import median_filter

    lost = median_filter(lost, size=9, mode="nearest")
    return np.maximum.accumulate(lost) + np.arange(len(tick))
