"""Selection of one row per tick from a log that has several rows per control period.

A logger may be faster than the controller. The logged commands are then constant between two ticks, or change
linearly between them. The rows in which the command or its slope changes are those of the ticks.
"""

from __future__ import annotations

import numpy as np

from tuning.identification.logs import clock

MAX_ROWS_PER_PERIOD = 20
MAX_RATIO_ERROR = 0.01  # maximum relative difference of the ratio of rates from a whole number
MIN_CHANGE_SHARE = 0.9  # minimum share of the commands' changes in the rows of the ticks


def find_command_phase(tick: np.ndarray, x: np.ndarray, rows: int) -> int | None:
    """Return which row of each control period has the new command, as an index; None if it is unclear.

    Args:
        tick: Number of each row, counted at the rate of the rows, shape (rows,); lost rows are omitted.
        x: Command in each row, in any unit, shape (rows,).
        rows: Number of rows per control period.

    Returns:
        The remainder of `tick` divided by `rows`; 0 if the command is constant.
    """
    if np.ptp(x) == 0.0:
        return 0
    for order in (1, 2):
        change = np.abs(np.diff(x, order))
        is_successive = tick[order:] - tick[:-order] == order
        changes = np.bincount(
            tick[1 : len(tick) - order + 1] % rows, np.where(is_successive, change, 0.0), minlength=rows
        )
        if np.max(changes) > MIN_CHANGE_SHARE * np.sum(changes):
            return int(np.argmax(changes))
    return None


def select_tick_rows(
    label: str, x: np.ndarray, stamps: np.ndarray | None, period: float, rows: int | None
) -> tuple[np.ndarray | slice, list[str]]:
    """Select one row per control period: that of the tick.

    Args:
        label: Name of the log in messages.
        x: Desired position in each row, in any unit.
        stamps: Time stamps of the rows [s]; None if they are equidistant.
        period: Control period [s].
        rows: Number of rows per control period; None to detect it from stamps and commands.

    Returns:
        The selection of rows, and notes.

    Raises:
        InputError: If the time stamps do not have the specified number of rows per control period.
    """
    every = slice(None)
    is_detected = rows is None
    if rows is None:
        step = None if stamps is None or len(stamps) < 2 else float(np.median(np.diff(stamps)))
        ratio = period / step if step is not None and step > 0.0 else 1.0
        if not 1.5 < ratio <= MAX_ROWS_PER_PERIOD + 0.5:
            return every, []
        rows = round(ratio)
        if abs(ratio / rows - 1.0) > MAX_RATIO_ERROR:
            return every, []
    if rows == 1 or len(x) < 2:
        return every, []
    if stamps is None:
        tick = np.arange(len(x))
    else:
        tick = clock.assign_ticks(stamps, period / rows, label).tick
    phase = find_command_phase(tick, x, rows)
    if phase is None and is_detected:
        return every, []  # A later check of the rates reports the problem.
    note = f"{label}: {rows} rows per control period, of which the row with the new command is used"
    if phase is None:
        note = (
            f"{label}: {rows} rows per control period, of which the first is used, because the commands do "
            f"not show the ticks: delays may be wrong by up to {1e3 * period * (rows - 1) / rows:.3g} ms"
        )
    return np.flatnonzero(tick % rows == (phase or 0)), [note]
