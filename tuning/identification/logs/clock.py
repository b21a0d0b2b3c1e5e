"""Assignment of log rows to control periods (ticks) from time stamps with jitter.

Samples are assumed to be taken exactly at the ticks, but the time stamps scatter. A stamp t is modelled as

    t = t_0 + phase(t) + n T + error,

with the unknown tick n and the specified control period T. The phase [s] is a slow change of the offset,
which occurs if the clock of the stamps is faster or slower than the control loop. It is estimated for chunks
of rows, from the angle of the mean of e^(2 pi i t / T). The tick n is (t - t_0 - phase) / T, rounded.
"""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from jaxhil.errors import InputError, format_value
from tuning.identification.records import StampClock

PHASE_CHUNK_ROWS = 256  # number of rows for one estimate of the phase
MIN_ROW_DISTANCE = 1e-6  # minimum valid time between rows [periods]
MAX_LOG_PERIODS = 1e12  # maximum length of a log [periods]; the ticks of a longer log would lose digits
MAX_RATE_ROWS = 20_000  # maximum number of rows for an estimate of the row rate; more are not needed
MAX_RATE_ERROR = 0.1  # maximum relative difference between row rate and control rate
# Maximum relative difference between mean row rate and control rate; above it, the phase changes too much per
# chunk.
MAX_MEAN_RATE_ERROR = 1.5e-3
# The row rate is estimated only if the time between rows scatters by less than this [periods].
MAX_STEP_SCATTER = 0.15
MAX_STAMP_SCATTER = 0.25  # maximum scatter of time stamps for an identification of ticks [periods]


class RowTicks(NamedTuple):
    """Ticks of the rows of a log, counted from the first row, and the accuracy of the time stamps."""

    tick: np.ndarray  # int64, (rows,)
    clock: StampClock


def assign_ticks(stamps: np.ndarray, period: float, label: str) -> RowTicks:
    """Return the tick of each row from its time stamp.

    Args:
        stamps: Time stamps [s].
        period: Control period [s].
        label: Name of the log in messages.

    Raises:
        InputError: If the time stamps do not increase at the control rate.
    """
    stamps, phase, tick = _round_to_ticks(stamps, period, label, "time")
    error = stamps - phase - period * tick
    error -= np.mean(error)
    jitter = float(np.std(error))
    if jitter > MAX_STAMP_SCATTER * period:
        finding = f"stamps that scatter by {1e3 * jitter:.3g} ms about the ticks"
        expected = f'at most {MAX_STAMP_SCATTER:g} control periods, or timing.clock = "index"'
        raise InputError(f"{label}: time: found {finding}, expected {expected}")
    slope = float(np.polynomial.polynomial.polyfit(tick.astype(float), stamps, 1)[1])
    clock = StampClock(slope, 1e6 * (slope / period - 1.0), jitter, int(tick[-1] - tick[0] + 1 - len(tick)))
    return RowTicks(tick - tick[0], clock)


def remove_stamp_jitter(stamps: np.ndarray, period: float, label: str, column: str) -> np.ndarray:
    """Return the sampling times [s] of rows: their time stamps without jitter.

    The rows are assumed to have a constant rate, which is estimated from the stamps. If the stamps scatter
    too much, `period` [s] is assumed. If the rate is not constant, the stamps are not changed.
    """
    _compute_row_distances(stamps, period, label, column)
    first, measured = float(stamps[0]), estimate_row_period(stamps)
    if measured is None and abs(float(np.median(np.diff(stamps))) / period - 1.0) > MAX_RATE_ERROR:
        return stamps
    period = measured or period
    relative, phase, tick = _round_to_ticks(stamps, period, label, column)
    times = phase + period * tick
    if np.std(relative - times) > MAX_STAMP_SCATTER * period:
        return stamps  # The rows are logged at events, not at a constant rate.
    return first + times + float(np.mean(relative - times))


def estimate_row_period(stamps: np.ndarray) -> float | None:
    """Estimate the time between successive rows [s]; lost rows do not affect the estimate.

    Returns None if the time stamps scatter too much for an estimate.
    """
    steps = np.diff(stamps[:MAX_RATE_ROWS])
    period, rows = float(np.median(steps)), 1
    if 1.4826 * float(np.median(np.abs(steps - period))) > MAX_STEP_SCATTER * period:
        return None
    while 4 * rows < len(stamps):
        rows *= 4
        stride = len(stamps) // MAX_RATE_ROWS + 1
        apart = stamps[rows::stride] - stamps[:-rows:stride]
        ticks = np.rint(apart / period)
        # If rows are lost, the number of ticks exceeds the number of rows.
        period = float(np.median(apart[ticks > 0] / ticks[ticks > 0])) if np.any(ticks > 0) else period
    return period


def _round_to_ticks(
    stamps: np.ndarray, period: float, label: str, column: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, for each row, the time since the first row [s], the phase [s] and the tick.

    Raises:
        InputError: If the time stamps do not identify ticks.
    """
    steps = _compute_row_distances(stamps, period, label, column)
    _check_rate(stamps, steps, period, label, column)
    stamps = stamps - stamps[0]
    phase = _estimate_phase(stamps, period)
    return stamps, phase, _correct_outliers(np.rint((stamps - phase) / period).astype(np.int64))


def _compute_row_distances(stamps: np.ndarray, period: float, label: str, column: str) -> np.ndarray:
    """Return the times between successive rows [s].

    Raises:
        InputError: If the time stamps do not increase, or if the rows are too close or the log is too long.
    """
    steps = np.diff(stamps)
    bad = np.flatnonzero(~(steps > 0))
    if len(bad):
        row, text = int(bad[0]) + 2, f"{stamps[bad[0] + 1]:.9g} s after {stamps[bad[0]]:.9g} s"
        raise InputError(f"{label}: row {row}: {column}: found {text}, expected an increasing time")
    if not stamps[-1] - stamps[0] < MAX_LOG_PERIODS * period:
        row = int(np.argmax(steps)) + 2
        text = f"{stamps[row - 1]:.9g} s after {stamps[row - 2]:.9g} s"
        raise InputError(
            f"{label}: row {row}: {column}: found {text}, expected at most {MAX_LOG_PERIODS:g} periods in all"
        )
    usual = float(np.median(steps[:MAX_RATE_ROWS])) if len(steps) else period
    if not usual > MIN_ROW_DISTANCE * period:
        text = f"rows {usual:.4g} s apart"
        raise InputError(f"{label}: {column}: found {text}, expected the control period, {period:g} s")
    return steps


def number_rows(rows: int, period: float) -> RowTicks:
    """Return successive ticks for a log without time stamps, assuming that no row was lost."""
    return RowTicks(np.arange(rows, dtype=np.int64), StampClock(period, 0.0, 0.0, 0))


def parse_stamps(stamps: np.ndarray, time_format: str | None, label: str) -> tuple[np.ndarray, float]:
    """Convert time stamps from text to seconds.

    Args:
        stamps: Texts of the time stamps.
        time_format: Format of the texts (`strptime`); None for ISO 8601, as Python and .NET write it.
        label: Name of the log in messages.

    Returns:
        Time stamps relative to the first one [s], and the first time stamp in seconds since 1970.

    Raises:
        InputError: If a text has another format.
    """
    if time_format is None:
        return _parse_iso_stamps(stamps, label)
    dates = []
    for row, stamp in enumerate(stamps):
        try:
            dates.append(datetime.strptime(str(stamp).strip(), time_format))
        except ValueError:
            expected = f"a time in the time_format {format_value(time_format)}"
            raise InputError(
                f"{label}: row {row + 1}: time: found {format_value(stamp)}, expected {expected}"
            ) from None
    begin = (dates[0].replace(tzinfo=None) - datetime(1970, 1, 1)).total_seconds() if dates else 0.0
    return np.array([(date - dates[0]).total_seconds() for date in dates]), begin


def _parse_iso_stamps(stamps: np.ndarray, label: str) -> tuple[np.ndarray, float]:
    """Convert time stamps from ISO 8601, with or without zone and fraction, to seconds."""
    texts = [str(stamp).strip().replace(",", ".") for stamp in stamps]
    for kind in (pa.timestamp("ns"), pa.timestamp("ns", "UTC")):
        try:
            # Integers of nanoseconds: a float has too few digits for times since 1970.
            times = pa.array(texts, pa.string()).cast(kind).cast(pa.int64()).to_numpy(zero_copy_only=False)
        except pa.ArrowInvalid:
            continue
        return 1e-9 * (times - times[:1]), 1e-9 * float(times[0]) if len(times) else 0.0

    def is_valid(text: str) -> bool:
        try:
            datetime.fromisoformat(text)
        except ValueError:
            return False
        return True

    row = next((row for row, text in enumerate(texts) if not is_valid(text)), 0)
    expected = (
        "numbers, texts in ISO 8601 (2026-03-01T10:00:00.001), or channels.time.time_format for other texts"
    )
    raise InputError(f"{label}: row {row + 1}: time: found {format_value(stamps[row])}, expected {expected}")


def _check_rate(stamps: np.ndarray, steps: np.ndarray, period: float, label: str, column: str) -> None:
    """Raise `InputError` if the row rate differs from the control rate in any part of the log."""
    usual = float(np.median(steps))
    if abs(usual / period - 1.0) > MAX_RATE_ERROR:
        finding = f"rows {usual:.4g} s apart"
        expected = f"the control period, {period:g} s (is the unit of {column} right?)"
        raise InputError(f"{label}: {column}: found {finding}, expected {expected}")
    measured = estimate_row_period(stamps)
    if measured is not None and abs(measured / period - 1.0) > MAX_MEAN_RATE_ERROR:
        raise InputError(
            f"{label}: {column}: found rows {measured:.6g} s apart, expected the control period, {period:g} s"
        )
    chunk_count = len(steps) // PHASE_CHUNK_ROWS
    medians = (
        np.median(steps[: chunk_count * PHASE_CHUNK_ROWS].reshape(chunk_count, PHASE_CHUNK_ROWS), axis=1)
        if chunk_count
        else np.empty(0)
    )
    bad_chunks = np.flatnonzero(np.abs(medians / period - 1.0) > MAX_RATE_ERROR)
    if len(bad_chunks):
        row, finding = int(bad_chunks[0]) * PHASE_CHUNK_ROWS + 1, f"rows {medians[bad_chunks[0]]:.4g} s apart"
        raise InputError(
            f"{label}: row {row}: {column}: found {finding}, expected {period:g} s throughout the log"
        )


def _estimate_phase(stamps: np.ndarray, period: float) -> np.ndarray:
    """Return the phase of each time stamp: its slowly changing offset [s] from multiples of the period."""
    starts = np.arange(0, len(stamps), PHASE_CHUNK_ROWS)
    if len(stamps) % PHASE_CHUNK_ROWS and len(starts) > 1:
        starts = starts[:-1]  # The last chunk includes the remaining rows.
    phase_angles = stamps / period
    # Subtract whole turns, which do not change the angle but reduce the precision.
    phase_angles -= np.rint(phase_angles)
    phase_angles *= 2.0 * np.pi
    sizes = np.diff(np.append(starts, len(stamps)))
    angle = np.unwrap(np.arctan2(*(np.add.reduceat(part(phase_angles), starts) for part in (np.sin, np.cos))))
    middle = np.add.reduceat(stamps, starts) / sizes
    if len(middle) > 1:
        # Extrapolate to the outer rows of the first and the last chunk.
        middle, angle = (np.array([2 * c[0] - c[1], *c, 2 * c[-1] - c[-2]]) for c in (middle, angle))
    return np.interp(stamps, middle, period * angle / (2 * np.pi))


def _correct_outliers(tick: np.ndarray) -> np.ndarray:
    """Return the ticks of all rows; if they do not increase strictly, a median filter corrects outliers."""
    lost = tick - np.arange(len(tick))
    if np.all(np.diff(lost) >= 0):
        return tick
    from scipy.ndimage import median_filter

    lost = median_filter(lost, size=9, mode="nearest")
    return np.maximum.accumulate(lost) + np.arange(len(tick))
