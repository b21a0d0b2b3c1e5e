"""Reconstruction of lost rows, and division of a log at longer gaps.

The command of a lost row is lost, too. Up to `MAX_RECONSTRUCTED_ROWS` successive commands are reconstructed.
The numerical model

    x(n+1) = x(n) + T v(n+1),   v(n+1) = v(n) - T F_c(n) / M        (semi-implicit Euler)

gives the first and the last lost command from the adjacent rows, with the precision of the log. A cubic
polynomial gives the commands between them; if the velocity or the force command is not logged, it gives all
lost commands. Sensor readings are not reconstructed: they are NaN, and the row is marked as not valid. The
log is divided at longer gaps.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tuning.identification.logs.scale_fit import fit_scale

MAX_RECONSTRUCTED_ROWS = 3  # maximum number of rows in a gap whose commands are reconstructed
INTEGRATOR_SPAN_ROWS = 32  # number of rows in which the motion shows the integrator despite rounding
# half periods, maximum distance of the estimate from an integrator's value
MAX_INTEGRATOR_DISTANCE = 0.2
MIN_INTEGRATOR_SIGMAS = 4.0  # minimum distance from the other integrators' values, in standard errors
# minimum change of velocity in a used row, as a share of the largest change
MIN_VELOCITY_CHANGE_SHARE = 0.1

ChannelValues = Mapping[str, np.ndarray | None]


class LogSegment(NamedTuple):
    """Part of a log without long gaps, with one row per tick."""

    tick: np.ndarray  # int64
    channels: dict[str, np.ndarray | None]  # SI values of each channel; NaN (integers: -1) in lost rows
    valid: np.ndarray  # bool, False in lost rows


def split_at_gaps(
    tick: np.ndarray, channels: ChannelValues, cuts: np.ndarray, period: float, mass: float
) -> list[LogSegment]:
    """Divide a log at long gaps and before the rows `cuts`; fill shorter gaps.

    Args:
        tick: Tick of each row.
        channels: Values of each channel.
        cuts: Rows at which a new segment begins.
        period: Control period [s].
        mass: Equivalent mass of the numerical model [kg].
    """
    before = np.flatnonzero(np.diff(tick) > MAX_RECONSTRUCTED_ROWS + 1) + 1
    edges = [0, *np.union1d(before, cuts).astype(int).tolist(), len(tick)]
    return [
        _fill_lost_ticks(
            tick[a:b], {n: None if c is None else c[a:b] for n, c in channels.items()}, period, mass
        )
        for a, b in itertools.pairwise(edges)
        if b > a
    ]


def detect_integrator(x: np.ndarray, v: np.ndarray | None, period: float) -> str | None:
    """Detect the integrator of the numerical model from logged positions and velocities.

    Args:
        x: Desired position [m].
        v: Desired velocity [m/s], or None.
        period: Control period [s].

    Returns:
        The name of the integrator, or None if the log does not determine it.
    """
    if v is None:
        return None
    step = np.diff(x)
    by = {"semi_implicit_euler": v[1:], "explicit_euler": v[:-1], "zoh": (v[1:] + v[:-1]) / 2}
    errors = {name: np.abs(step - period * velocity) for name, velocity in by.items()}
    # Omit rows without force (all integrators agree) and velocity jumps that a reset of the rig causes.
    pulled = np.abs(np.diff(v))
    usable = np.isfinite(step) & (pulled > 0)
    usable &= pulled <= 10 * np.nanmedian(pulled[usable]) if np.any(usable) else False
    sums = {name: float(np.nansum(error[usable])) for name, error in errors.items()}
    best, second, _ = sorted(sums, key=sums.__getitem__)
    return best if sums[best] < 0.5 * sums[second] else _detect_integrator_over_span(x, v, period)


def _detect_integrator_over_span(x: np.ndarray, v: np.ndarray, period: float) -> str | None:
    """Detect the integrator from the motion in `INTEGRATOR_SPAN_ROWS` rows, despite rounding or jitter.

    In each period, an integrator uses the velocity at the start, the velocity at the end, or their mean.
    """
    if len(v) <= INTEGRATOR_SPAN_ROWS:
        return None
    finite = np.isfinite(v)
    summed = np.cumsum(np.where(finite, v, 0.0))
    complete = np.convolve(~finite, np.ones(INTEGRATOR_SPAN_ROWS + 1, int), "valid") == 0
    changed = np.where(complete, v[INTEGRATOR_SPAN_ROWS:] - v[:-INTEGRATOR_SPAN_ROWS], 0.0)
    pulled = np.abs(changed) > MIN_VELOCITY_CHANGE_SHARE * np.max(np.abs(changed), initial=0.0)
    middle = summed[INTEGRATOR_SPAN_ROWS:] - summed[:-INTEGRATOR_SPAN_ROWS] - changed / 2
    left = (x[INTEGRATOR_SPAN_ROWS:] - x[:-INTEGRATOR_SPAN_ROWS] - period * middle)[pulled]
    fit = fit_scale(left, period / 2 * changed[pulled], INTEGRATOR_SPAN_ROWS) if np.any(pulled) else None
    if fit is None:
        return None
    expected_slopes = {"semi_implicit_euler": 1.0, "explicit_euler": -1.0, "zoh": 0.0}
    best = min(expected_slopes, key=lambda name: abs(fit.slope - expected_slopes[name]))
    return (
        best
        if abs(fit.slope - expected_slopes[best]) < MAX_INTEGRATOR_DISTANCE
        and MIN_INTEGRATOR_SIGMAS * fit.error < 0.5 - MAX_INTEGRATOR_DISTANCE
        else None
    )


def _fill_lost_ticks(tick: np.ndarray, channels: ChannelValues, period: float, mass: float) -> LogSegment:
    """Insert the lost rows and reconstruct their commands; return a segment with one row per tick."""
    index = tick - tick[0]
    rows = int(index[-1]) + 1
    valid = np.zeros(rows, bool)
    valid[index] = True
    filled_channels: dict[str, np.ndarray | None] = {}
    for name, values in channels.items():
        if values is None or rows == len(tick):
            filled_channels[name] = values
            continue
        filled_channels[name] = filled = np.full(
            rows, -1 if values.dtype.kind == "i" else np.nan, values.dtype
        )
        filled[index] = values
    if rows > len(tick):
        _reconstruct_commands(filled_channels, valid, period, mass)
    return LogSegment(np.arange(rows, dtype=np.int64) + tick[0], filled_channels, valid)


def _reconstruct_commands(
    channels: dict[str, np.ndarray | None], valid: np.ndarray, period: float, mass: float
) -> None:
    """Reconstruct the position commands and contact indices of lost rows, in place."""
    x, v, force = (channels[name] for name in ("position_desired", "velocity_desired", "force_command"))
    assert x is not None
    index, valid_rows = channels["contact_index"], np.flatnonzero(valid)
    if index is not None:
        index[~valid] = index[valid_rows[np.searchsorted(valid_rows, np.flatnonzero(~valid)) - 1]]
    after = np.flatnonzero(valid[:-1] & ~valid[1:])
    until = np.flatnonzero(~valid[:-1] & valid[1:]) + 1
    is_known = valid.copy()
    if v is not None and force is not None and detect_integrator(x, v, period) == "semi_implicit_euler":
        x[after + 1] = x[after] + period * (v[after] - period * force[after] / mass)
        several = until - after > 2
        x[until[several] - 1] = x[until[several]] - period * v[until[several]]
        is_known[after + 1] = is_known[until - 1] = True
    for a, b in zip(after, until, strict=True):
        gap = np.flatnonzero(~is_known[a:b]) + a
        neighbours = np.flatnonzero(is_known[max(0, a - 3) : b + 4]) + max(0, a - 3)
        if len(gap):
            neighbours = neighbours[np.argsort(np.abs(neighbours - (a + b) / 2), kind="stable")[:4]]
            x[gap] = np.polynomial.Polynomial.fit(neighbours, x[neighbours], len(neighbours) - 1)(gap)
