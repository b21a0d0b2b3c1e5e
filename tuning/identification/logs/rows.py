"""Rows that were lost, commands put back where that is exact, and where a log is cut.

A row that was lost took the command with it. Up to `SHORT` of them in a row are put back: the numerical model

    x(n+1) = x(n) + T v(n+1),   v(n+1) = v(n) - T F_c(n) / M        (semi-implicit Euler)

tells the first and the last of them from the rows beside, to the last digits of the log; a cubic tells what
is between, and all of them where velocity or force command are not logged. What a sensor read is never made
up: it is NaN there, and the row is not valid. A longer gap cuts the log in two.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tuning.identification.logs.scale_fit import scale

SHORT = 3  # rows
WIDE = 32  # rows, over which the integrator shows under rounding and jitter
CLEAR = 0.2  # of half a period, by which it may seem to be between two integrators
SURE = 4.0  # standard deviations
PULLED = 0.1  # of the largest change of the velocity, from which a row tells the integrator

Channels = Mapping[str, np.ndarray | None]


class Stretch(NamedTuple):
    """Rows without a longer gap; a row for every tick."""

    tick: np.ndarray  # int64
    channels: dict[str, np.ndarray | None]
    valid: np.ndarray  # bool


def stretches(
    tick: np.ndarray, channels: Channels, cuts: np.ndarray, period: float, mass: float
) -> list[Stretch]:
    """The stretches between longer gaps and `cuts`, rows before which the log is cut as well."""
    before = np.flatnonzero(np.diff(tick) > SHORT + 1) + 1
    edges = [0, *np.union1d(before, cuts).astype(int).tolist(), len(tick)]
    return [
        _whole(tick[a:b], {n: None if c is None else c[a:b] for n, c in channels.items()}, period, mass)
        for a, b in itertools.pairwise(edges)
        if b > a
    ]


def integrator_of(x: np.ndarray, v: np.ndarray | None, period: float) -> str | None:
    """How the numerical model of a log moves by its velocity; None where the log does not tell."""
    if v is None:
        return None
    step = np.diff(x)
    by = {"semi_implicit_euler": v[1:], "explicit_euler": v[:-1], "zoh": (v[1:] + v[:-1]) / 2}
    off = {name: np.abs(step - period * one) for name, one in by.items()}
    # Where nothing pulls all are alike, and of jumps, where a rig is driven back, nothing follows.
    pulled = np.abs(np.diff(v))
    known = np.isfinite(step) & (pulled > 0)
    known &= pulled <= 10 * np.nanmedian(pulled[known]) if np.any(known) else False
    sums = {name: float(np.nansum(one[known])) for name, one in off.items()}
    best, second, _ = sorted(sums, key=sums.__getitem__)
    return best if sums[best] < 0.5 * sums[second] else _over_rows(x, v, period)


def _over_rows(x: np.ndarray, v: np.ndarray, period: float) -> str | None:
    """Return the integrator by motion over `WIDE` rows, where rounding or jitter hide that over one row.

    Integrators differ by which of the velocities at both ends counts."""
    finite = np.isfinite(v)
    summed = np.cumsum(np.where(finite, v, 0.0))
    whole = np.convolve(~finite, np.ones(WIDE + 1, int), "valid") == 0
    changed = np.where(whole, v[WIDE:] - v[:-WIDE], 0.0)
    pulled = np.abs(changed) > PULLED * np.max(np.abs(changed), initial=0.0)
    middle = summed[WIDE:] - summed[:-WIDE] - changed / 2
    left = (x[WIDE:] - x[:-WIDE] - period * middle)[pulled]
    fit = scale(left, period / 2 * changed[pulled], WIDE) if np.any(pulled) else None
    if fit is None:
        return None
    places = {"semi_implicit_euler": 1.0, "explicit_euler": -1.0, "zoh": 0.0}
    best = min(places, key=lambda one: abs(fit.slope - places[one]))
    return best if abs(fit.slope - places[best]) < CLEAR and SURE * fit.error < 0.5 - CLEAR else None


def _whole(tick: np.ndarray, channels: Channels, period: float, mass: float) -> Stretch:
    """With a row for every tick."""
    place = tick - tick[0]
    rows = int(place[-1]) + 1
    valid = np.zeros(rows, bool)
    valid[place] = True
    spread: dict[str, np.ndarray | None] = {}
    for name, values in channels.items():
        if values is None or rows == len(tick):
            spread[name] = values
            continue
        spread[name] = whole = np.full(rows, -1 if values.dtype.kind == "i" else np.nan, values.dtype)
        whole[place] = values
    if rows > len(tick):
        _put_back(spread, valid, period, mass)
    return Stretch(np.arange(rows, dtype=np.int64) + tick[0], spread, valid)


def _put_back(channels: dict[str, np.ndarray | None], valid: np.ndarray, period: float, mass: float) -> None:
    """Fill in the commands of the lost rows."""
    x, v, force = (channels[name] for name in ("position_desired", "velocity_desired", "force_command"))
    assert x is not None
    index, known = channels["contact_index"], np.flatnonzero(valid)
    if index is not None:
        index[~valid] = index[known[np.searchsorted(known, np.flatnonzero(~valid)) - 1]]
    after = np.flatnonzero(valid[:-1] & ~valid[1:])
    until = np.flatnonzero(~valid[:-1] & valid[1:]) + 1
    told = valid.copy()
    if v is not None and force is not None and integrator_of(x, v, period) == "semi_implicit_euler":
        x[after + 1] = x[after] + period * (v[after] - period * force[after] / mass)
        several = until - after > 2
        x[until[several] - 1] = x[until[several]] - period * v[until[several]]
        told[after + 1] = told[until - 1] = True
    for a, b in zip(after, until, strict=True):
        gap = np.flatnonzero(~told[a:b]) + a
        near = np.flatnonzero(told[max(0, a - 3) : b + 4]) + max(0, a - 3)
        if len(gap):
            near = near[np.argsort(np.abs(near - (a + b) / 2), kind="stable")[:4]]
            x[gap] = np.polynomial.Polynomial.fit(near, x[near], len(near) - 1)(gap)
