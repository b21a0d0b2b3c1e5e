"""Explanations of a difference between a controller's commands and the logged ones: sign, lost rows, delay.

Each function returns one line for the log that it describes, or None if the log shows no such cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from jaxhil.laws.shared.nominal_values import force_delay
from tuning.shadow_mode.logged_ticks import LoggedTicks
from tuning.shadow_mode.replay import ReplayedRun, compare_commands, relative_difference

SPEED_SPAN_ROWS = 8  # rows before and after a row, between which the model's velocity changes are computed
MIN_FORCE_SHARE = 0.05  # minimum size of a force that is used, as a share of the largest one
MAX_SIGN_AGREEMENT = -0.5  # below this agreement of force and motion (-1 to 1), the sign is flipped
MIN_DIFFERENCE = 1e-3  # a smaller difference of commands, divided by their range, is not explained
MAX_SHIFT = 20  # largest shift of the commands in the search [periods]
SHIFT_STEP = 0.05  # resolution of the search [periods]
MIN_SHIFT = 0.1  # smallest shift that is reported [periods]
MAX_REMAINING_SHARE = 0.25  # maximum rms difference after the shift, as a share of that before it
MAX_UNEXPLAINED_SHARE = 0.2  # maximum rms difference after the shift, as a share of the rms command
MIN_FIT_ROWS = 20  # minimum number of rows in contact for a fit
MIN_DELAY_CHANGE = 5e-4  # smallest change of the force delay that is reported [s]
MIN_DELAY_SIGMAS = 5.0  # smallest change of the force delay that is reported, in standard errors
MIN_DEPTH_SHARE = 0.1  # minimum depth of a row that is used, as a share of the run's largest depth


def explain(ticks: LoggedTicks, runs: Sequence[ReplayedRun], mechanism: Any) -> list[str]:
    """Return one line for each reason, found in the log, why its commands differ from the controller's."""
    lines = [
        describe_lost_rows(ticks),
        *describe_signs(ticks),
        describe_shift(ticks, runs),
        describe_force_delay(ticks, mechanism),
    ]
    return [f"{ticks.label}: {line}" for line in lines if line is not None]


def describe_lost_rows(ticks: LoggedTicks) -> str | None:
    """Return a line that states how many rows are lost, and where."""
    gaps = ticks.gaps
    if not len(gaps):
        return None
    longest = int(np.max(np.diff(ticks.tick)[gaps - 1])) - 1
    return (
        f"{ticks.lost} row{'s are' if ticks.lost > 1 else ' is'} lost (gaps: {len(gaps)}, the longest with "
        f"{longest}, the first at {ticks.instant[gaps[0]]:.4f} s): the controller misses these ticks"
    )


def describe_signs(ticks: LoggedTicks) -> list[str]:
    """Return one line for each channel, force reading or command, whose sign is flipped.

    A force must change the velocity of the numerical model in its own direction: the product of the force on
    the model and the model's change of velocity is positive.
    """
    names = ("force_measured", "force_command") if ticks.axes == 1 else ("wrench_measured", "wrench_command")
    lines = []
    for name, values in zip(names, (ticks.force, ticks.command), strict=True):
        agreement = _agreement(ticks, values)
        if agreement is not None and agreement < MAX_SIGN_AGREEMENT:
            lines.append(
                f"{name}: the sign is flipped: the numerical model accelerates against this force (if the "
                "log is wrong, correct the sign of this channel in the mapping)"
            )
    return lines


def _agreement(ticks: LoggedTicks, force: np.ndarray) -> float | None:
    """Return the agreement of a force's direction with the model's acceleration, -1 to 1; None if unknown."""
    span, rows = SPEED_SPAN_ROWS, len(ticks.tick)
    middle = np.arange(span, rows - span)
    first, last = middle - span, middle + span
    run = np.searchsorted(ticks.starts, np.arange(rows), side="right")
    # Rows whose span contains lost rows or the start of a run say nothing about the force.
    complete = (run[first] == run[last]) & (ticks.tick[last] - ticks.tick[first] == 2 * span)
    size = np.linalg.norm(force, axis=1)
    complete &= size[middle] > MIN_FORCE_SHARE * np.nanmax(size, initial=0.0)
    middle = middle[complete]
    if not len(middle):
        return None
    change = ticks.velocity_desired[middle + span] - ticks.velocity_desired[middle - span]
    values = force[middle]
    if ticks.axes == 1:
        power = -values[:, 0] * change[:, 0]
    else:
        # The twist is that of frame C, so that the moment must be about its origin.
        moment = values[:, 3:] - np.cross(ticks.position_desired[middle, :3], values[:, :3])
        power = np.sum(values[:, :3] * change[:, :3] + moment * change[:, 3:], axis=1)
    total = float(np.nansum(np.abs(power)))
    return float(np.nansum(power)) / total if total > 0.0 else None


def describe_shift(ticks: LoggedTicks, runs: Sequence[ReplayedRun]) -> str | None:
    """Return a line if the logged commands are the controller's commands, shifted in time.

    The shift minimises the rms difference in the rows with a force. Return None if the shift explains less
    than three quarters of the difference, or if more than a fifth of the commands remains unexplained.
    """
    if (
        max((relative_difference(*compare_commands(ticks, run)) for run in runs), default=0.0)
        < MIN_DIFFERENCE
    ):
        return None
    fits = [fit for run in runs for fit in [_get_fit_rows(ticks, run)] if fit is not None]
    if not fits:
        return None
    shifts = np.arange(-MAX_SHIFT, MAX_SHIFT + SHIFT_STEP / 2, SHIFT_STEP)
    squares = np.zeros(len(shifts))
    for spline, rows, logged in fits:
        for index, shift in enumerate(shifts):
            squares[index] += float(np.sum((logged - spline(rows - shift)) ** 2))
    best = int(np.argmin(squares))
    unshifted = float(np.interp(0.0, shifts, squares))
    power = sum(float(np.sum(logged**2)) for *_, logged in fits)
    if (
        abs(shifts[best]) < MIN_SHIFT
        or squares[best] > MAX_REMAINING_SHARE**2 * unshifted
        or squares[best] > MAX_UNEXPLAINED_SHARE**2 * power
    ):
        return None
    late = "later" if shifts[best] > 0 else "earlier"
    word = "longer" if shifts[best] > 0 else "shorter"
    time = 1e3 * ticks.period * abs(shifts[best])
    return (
        f"the logged commands are the controller's, {time:.2f} ms {late}: they are those of a controller "
        f"whose delay is {time:.2f} ms {word} (the shift reduces the rms difference to "
        f"{100 * np.sqrt(squares[best] / unshifted):.2g} %)"
    )


def _get_fit_rows(ticks: LoggedTicks, run: ReplayedRun) -> tuple[CubicSpline, np.ndarray, np.ndarray] | None:
    """Return a spline of the controller's commands over the ticks of a run, and the logged rows to compare.

    These rows are an array of ticks and an array of logged commands. Return None if there are too few rows.
    """
    logged, tick = ticks.command[run.rows], ticks.tick[run.rows]
    finite = np.all(np.isfinite(run.commands), axis=1)
    if np.count_nonzero(finite) < 2 * MAX_SHIFT + MIN_FIT_ROWS:
        return None
    spline = CubicSpline(tick[finite], run.commands[finite], axis=0)
    inside = (tick >= tick[finite][0] + MAX_SHIFT) & (tick <= tick[finite][-1] - MAX_SHIFT)
    size = np.linalg.norm(logged, axis=1)
    inside &= np.isfinite(size) & (size > MIN_FORCE_SHARE * np.nanmax(size, initial=0.0))
    if np.count_nonzero(inside) < MIN_FIT_ROWS:
        return None
    return spline, tick[inside].astype(float), logged[inside]


def describe_force_delay(ticks: LoggedTicks, mechanism: Any) -> str | None:
    """Return a message if the log's force delay differs from that of `mechanism`, for which gains were tuned.

    For a penetration d, the force is F = k d + b d'. In slow contacts, its reading with the delay tau is
    k d + (b - k tau) d'. To find tau, the function assumes the damping b of `mechanism`. Return None on six
    axes and for a contact law other than this one.
    """
    if ticks.axes > 1 or mechanism.contact.law not in ("linear", "kelvin_voigt"):
        return None
    runs = range(len(ticks.starts))
    fits = [fit for number in runs for fit in [_fit_delay(ticks, number, mechanism)] if fit]
    if not fits:
        return None
    delays, errors = np.array(fits).T
    weights = 1.0 / np.maximum(errors, 1e-9) ** 2
    delay, error = float(np.average(delays, weights=weights)), float(np.sum(weights) ** -0.5)
    expected = force_delay(mechanism) - mechanism.rig.position_sensor.delay
    change = delay - expected
    if abs(change) < max(MIN_DELAY_CHANGE, MIN_DELAY_SIGMAS * error):
        return None
    word = "longer" if change > 0.0 else "shorter"
    return (
        f"the delay of the force reading is {1e3 * abs(change):.2f} ms {word} than in the mechanism of the "
        f"gains ({1e3 * delay:.2f} ms behind the position reading instead of {1e3 * expected:.2f} ms, if the "
        "contact's damping is that of the mechanism)"
    )


def _fit_delay(ticks: LoggedTicks, number: int, mechanism: Any) -> tuple[float, float] | None:
    """Fit the delay from position to force reading in a run; return (delay, standard error) [s], or None."""
    rows = slice(ticks.starts[number], [*ticks.starts[1:], len(ticks.tick)][number])
    depth = ticks.position_measured[rows, 0] - mechanism.rig.contact_plane
    force, tick = ticks.force[rows, 0], ticks.tick[rows]
    if len(depth) < 3 or not np.nanmax(depth) > 0.0:
        return None
    rate = np.gradient(depth, ticks.period)
    used = depth > MIN_DEPTH_SHARE * np.nanmax(depth)
    used[1:-1] &= tick[2:] - tick[:-2] == 2
    used &= np.isfinite(force) & np.isfinite(rate)
    if np.count_nonzero(used) < MIN_FIT_ROWS:
        return None
    columns = np.stack([depth[used], rate[used], np.ones(np.count_nonzero(used))], axis=1)
    solution, _, rank, _ = np.linalg.lstsq(columns, force[used], rcond=None)
    stiffness, damping, _ = solution.tolist()
    if rank < columns.shape[1] or not stiffness > 0.0:
        return None
    residual = force[used] - columns @ solution
    variance = float(residual @ residual) / len(residual) * np.linalg.inv(columns.T @ columns)[1, 1]
    values = mechanism.contact.damping
    index = number if ticks.contact is None else int(ticks.contact[rows.start])
    nominal = values[min(max(index, 0), len(values) - 1)]
    return (nominal - damping) / stiffness, float(np.sqrt(variance)) / stiffness
