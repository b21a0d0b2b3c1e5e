"""The linear fit of a contact law at one delay and plane, over known motion.

Where the mechanism was is known from the commands (`motion`), so with the force delay and the plane given
the law is linear in its coefficients: stiffness, damping, the sensor's bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import special
from scipy.signal import lfilter

from tuning.identification.contact_laws import Law
from tuning.identification.motion import Motion
from tuning.identification.records import Run
from tuning.identification.sensor_filter import lag_weights, onset_weights, onsets

LONGEST = 0.02  # s, of the delays that are looked at
COARSE = 0.0005  # s, between the first delays that are looked at
STEPS = 6  # of Newton's for the plane
CLOSE = 2.0  # gain of log likelihood below which a step more is not taken
MEMORY = 40.0  # time constants after which a filter's output has died out, to rounding


@dataclass(frozen=True)
class Readings:
    """Forces of all runs in contact, padded: arrays of (rows, lanes)."""

    force: np.ndarray  # N, 0 where it does not count
    counts: np.ndarray  # bool
    entry: np.ndarray  # int, entry of the contact's lists
    entries: tuple[int, ...]  # those that are met
    std: float  # N, of the noise
    whitening: tuple[float, ...] = (1.0,)  # filter that makes the noise white
    threshold: float = 0.0  # N: predicted forces below it do not count (a dead zone hides them)
    # N, of the sensor, and its standard deviation, where runs at rest tell them
    bias: tuple[float, float] | None = None

    @classmethod
    def of(cls, runs: Sequence[Run], std: float, whitening=(1.0,), threshold: float = 0.0) -> Readings:
        rows = max(len(run.tick) for run in runs)

        def padded(values, fill, kind):
            table = np.full((rows, len(runs)), fill, kind)
            for lane, value in enumerate(values):
                table[: len(value), lane] = value
            return table

        forces = [np.asarray(run.force_measured, float) for run in runs]
        valid = [run.valid & np.isfinite(one) for run, one in zip(runs, forces, strict=True)]
        counts = padded(valid, False, bool)
        force = padded([np.nan_to_num(one) for one in forces], 0.0, float)
        entry = padded([_entries(run) for run in runs], 0, int)
        if len(whitening) > 1:
            # A row counts where the filter has all its rows.
            gap: Any = lfilter(np.ones(len(whitening)), [1.0], ~counts, axis=0)
            counts = counts & (gap < 0.5)
            counts[: len(whitening) - 1] = False
        entries = tuple(int(one) for one in np.unique(entry[counts])) or (0,)
        return cls(force, counts, entry, entries, std, tuple(whitening), threshold)

    def of_lanes(self, lanes: np.ndarray) -> Readings:
        """Of some of the runs, each as often as it is named."""
        force, counts, entry = (one[:, lanes] for one in (self.force, self.counts, self.entry))
        return replace(self, force=force, counts=counts, entry=entry)


def _entries(run: Run) -> np.ndarray:
    """Of each row; out of contact that of the contact next to it."""
    known = np.full(len(run.tick), -1) if run.contact_index is None else run.contact_index
    if not np.any(known >= 0):
        return np.zeros(len(run.tick), int)
    last = np.maximum.accumulate(np.where(known >= 0, np.arange(len(known)), -1))
    return np.where(last >= 0, known[last], known[np.argmax(known >= 0)])


@dataclass(frozen=True)
class Inner:
    """The linear fit at one delay and plane."""

    coefficients: np.ndarray
    covariance: np.ndarray
    misfit: float  # sum of squares over the variance of the noise
    evidence: float  # log of the posterior density of delay and plane, up to a constant
    slope: float = 0.0  # of misfit / 2 by the plane
    curvature: float = 0.0  # of misfit / 2 by the plane, all else fitted
    plane: float = 0.0  # m, where it was fitted
    by_plane: np.ndarray | None = None  # slope of the coefficients by the plane, where that is not told


class _Near(NamedTuple):
    """Rows that may be in contact, over several planes: what the law makes of them."""

    rows: np.ndarray  # (rows,)
    depth: np.ndarray  # m, (planes, rows); 0 out of contact
    rate: np.ndarray  # m/s, (rows,)
    columns: np.ndarray  # (planes, coefficients, rows), one per coefficient but the bias


class _Onsets(NamedTuple):
    """Where contact begins within a period that a sensor's lag integrates."""

    plane: np.ndarray  # (onsets,), place among the planes
    row: np.ndarray  # (onsets,), place among the rows near contact
    columns: np.ndarray  # (coefficients, onsets), the law's functions just after
    after: np.ndarray  # (onsets,), weight of the force there
    end: np.ndarray  # (onsets,), and of that at the end of the period


class Problem:
    """Forces, the motion under them and a law; `plane` is told or None.

    Rows out of contact say something of the bias alone: three sums stand for all of them, and the law's
    functions are computed where the mechanism is in contact. With a lag of the sensor [s] or coloured noise
    every function is filtered along the rows as the force is, until the filter's output has died out."""

    def __init__(
        self, motion: Motion, readings: Readings, law: Law, plane: float | None, time_constant: float = 0.0
    ):
        self.motion, self.readings, self.law, self.plane = motion, readings, law, plane
        self.time_constant = time_constant
        # A delay is one behind the position sensor's, which may be the longer one.
        self.shortest = -COARSE * float(np.floor(max(motion.delay, 0.0) / COARSE))
        self.plain = len(readings.whitening) == 1 and time_constant == 0.0
        self.kept = np.flatnonzero(readings.counts)
        # Filters need the rows between those that count.
        self.where = self.kept if self.plain else np.arange(readings.counts.size)
        self.target = self.whiten(readings.force).ravel()[self.kept] / readings.std
        self.rate_like = [i for i, name in enumerate(self.names) if name.startswith("damping")]
        # A dead zone takes its share of every reading beyond it; a bias is in every reading.
        self.local = bool(readings.threshold)
        # What a bias of 1 N is in a reading out of contact, over the noise.
        self.bias_alone = 0.0 if self.local else float(np.sum(readings.whitening)) / readings.std
        self.sums = _sums(self.target)
        self.memory = len(readings.whitening) + int(np.ceil(MEMORY * time_constant / motion.period))
        # Parts of a period before the row at which the force is computed: a lag integrates it.
        self.before = (0.0,) if time_constant == 0.0 else (0.0, 0.5)
        self._at: tuple[float, list[tuple[np.ndarray, np.ndarray]]] | None = None
        self._guess: np.ndarray | None = None

    @cached_property
    def names(self) -> list[str]:
        law, entries = self.law, self.readings.entries
        own = len(law.own(np.zeros(1), np.zeros(1)))
        numbered = [f"{name}.{i}" for i in entries for name in law.names[:own]]
        return [*numbered, *law.names[own:], "bias"]

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Values of (..., rows, lanes), filtered along the rows."""
        filtered = values.copy() if len(self.readings.whitening) > 1 else values
        for lag, weight in enumerate(self.readings.whitening[1:], 1):
            filtered[..., lag:, :] += weight * values[..., :-lag, :]
        return filtered

    def at(self, delay: float, plane: float) -> Inner:
        """Fit the coefficients; rows where the law would pull count as out of contact."""
        near, flags, fit = self._settle(delay, np.array([plane]))
        (inner,) = self._inner(fit)
        if self.plane is not None:
            return replace(inner, plane=plane)
        by_plane = self._by_plane(delay, plane, inner.coefficients, near, flags[0])
        residual, design = fit[3][0], fit[4][0]
        along = _dot(design, by_plane)
        change = -inner.covariance @ along
        slope, curvature = _dot(residual, by_plane), _dot(by_plane, by_plane) + along @ change
        return replace(inner, slope=float(slope), curvature=float(curvature), plane=plane, by_plane=change)

    def across(self, delay: float, planes: np.ndarray) -> list[Inner]:
        """The same at several planes at once, without slopes by the plane."""
        return self._inner(self._settle(delay, planes)[2])

    def _settle(self, delay: float, planes: np.ndarray):
        """Rows near contact, those of them in contact, and the linear fit to them, until they agree."""
        moved = self._moved(delay)
        near = [self._near(*one, self.where, planes) for one in moved]
        flags = [self._touching(one, self._guess) for one in near]
        onsets = self._onsets(near[0], [x for x, _ in moved], planes)
        fit = self._solve(near, flags, onsets)
        for _ in range(2):
            again = [self._touching(one, fit[0]) for one in near]
            if all(np.array_equal(one, other) for one, other in zip(again, flags, strict=True)):
                break
            flags = again
            fit = self._solve(near, flags, onsets)
        self._guess = fit[0][len(planes) // 2]
        return near, flags, fit

    def _inner(self, fit) -> list[Inner]:
        coefficients, covariance, misfit = fit[:3]
        allowed = sum(
            special.log_ndtr(coefficients[:, i] / np.sqrt(covariance[:, i, i])) for i in self.rate_like
        )
        evidence = -0.5 * misfit + 0.5 * np.linalg.slogdet(covariance)[1] + allowed
        return [Inner(*one) for one in zip(coefficients, covariance, misfit, evidence, strict=True)]

    def _moved(self, delay: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Position and rate at the rows of `where`, for each part of a period before them."""
        if self._at is None or self._at[0] != delay:
            moved = [self.motion.at(delay + part * self.motion.period) for part in self.before]
            self._at = delay, [(x.ravel()[self.where], v.ravel()[self.where]) for x, v in moved]
        return self._at[1]

    def onsets_between(self, delay: float, low: float, high: float) -> np.ndarray:
        """The planes between these at which rows come into contact, in order."""
        position, rate = self._moved(delay)[0]
        return np.unique(position[(rate > 0.0) & (position > low) & (position < high)])

    def _near(self, position, rate, where, planes: np.ndarray) -> _Near:
        rows = np.flatnonzero(position > planes.min())
        depth, rate = np.maximum(position[rows] - planes[:, None], 0.0), rate[rows]
        return _Near(rows, depth, rate, self._columns(depth, rate, where[rows]))

    def _columns(self, depth: np.ndarray, rate: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """The law's functions at rows of the readings, (planes, coefficients, rows)."""
        own, entries = self.law.own(depth, rate), self.readings.entries
        if len(entries) > 1:
            entry = self.readings.entry.ravel()[rows]
            own = [np.where(entry == i, value, 0.0) for i in entries for value in own]
        every = (*own, *self.law.shared(depth, rate))
        columns = np.empty((len(depth), len(every), depth.shape[1]))
        for i, one in enumerate(every):
            columns[:, i] = one
        return columns

    def _touching(self, near: _Near, coefficients: np.ndarray | None) -> np.ndarray:
        """Rows in contact, without those where the law with these coefficients would pull."""
        inside = near.depth > 0.0
        if coefficients is None or self.law.pulls or not self.rate_like:
            return inside
        pushing = inside & (_force(coefficients, near.columns) > 0.0)
        # Where the force has the wrong sign the law pulls throughout, and is to be found so.
        sound = 2 * pushing.sum(axis=1) > inside.sum(axis=1)
        return np.where(sound[:, None], pushing, inside)

    def _onsets(self, near: _Near, positions: list[np.ndarray], planes: np.ndarray) -> _Onsets | None:
        """Of positions at all rows, and half a period before them; None without a lag."""
        if self.time_constant == 0.0:
            return None
        now, half = positions
        before = near.rows - self.readings.force.shape[1]
        last = np.where(before >= 0, now[np.maximum(before, 0)], now[near.rows])
        left = onsets(last, half[near.rows], now[near.rows], planes[:, None])
        plane, row = np.nonzero(left)
        columns = self._columns(np.zeros((1, len(row))), near.rate[row], self.where[near.rows[row]])[0]
        rate = self.motion.period / self.time_constant
        return _Onsets(plane, row, columns, *onset_weights(rate, left[plane, row]))

    def _window(self, near: list[_Near]) -> slice:
        """Return the rows at which filters show what happens at the rows near contact."""
        length, lanes = self.readings.force.shape
        flat = np.concatenate([one.rows for one in near])
        if not len(flat):
            return slice(0, 0)
        return slice(int(flat.min()) // lanes, min(int(flat.max()) // lanes + 1 + self.memory, length))

    def _filtered(
        self, near: list[_Near], tables: list[np.ndarray], onsets, first, window: slice
    ) -> np.ndarray:
        """Columns at their rows, for each part of a period, as the sensor gives them at the rows of a window;
        `first`: the columns just after the onsets, (columns, onsets)."""
        lanes, full = self.readings.force.shape[1], []
        shape, before = (window.stop - window.start, lanes), window.start * lanes
        for columns, one in zip(tables, near, strict=True):
            table = np.zeros((*columns.shape[:2], shape[0] * lanes))
            table[:, :, one.rows - before] = columns
            full.append(table.reshape(*columns.shape[:2], *shape))
        if onsets is None:
            return full[0]
        pole, (now, half, last) = lag_weights(self.motion.period / self.time_constant)
        drive = now * full[0] + half * full[1]
        drive[:, :, 1:] += last * full[0][:, :, :-1]
        flat = drive.reshape(*drive.shape[:2], -1)
        then = tables[0][onsets.plane, :, onsets.row].T
        flat[onsets.plane, :, near[0].rows[onsets.row] - before] = (
            onsets.after * first + onsets.end * then
        ).T
        lagged: Any = lfilter([1.0], [1.0, -pole], drive, axis=-2)
        return lagged

    def _solve(self, near: list[_Near], flags: list[np.ndarray], onsets: _Onsets | None):
        """Coefficients, their covariance, the misfit, residuals and the design, for each plane.

        Design and residuals are over the noise's standard deviation."""
        std, tables, first = self.readings.std, [], None
        for one, flag in zip(near, flags, strict=True):
            # The last column is the bias: in the rows in contact alone under a dead zone, else in all.
            table = np.empty((len(flag), one.columns.shape[1] + 1, len(one.rows)))
            np.multiply(one.columns, flag[:, None] / std, out=table[:, :-1])
            table[:, -1] = flag / std if self.local else 1.0 / std
            tables.append(table)
        if onsets is not None:
            ones = np.ones((1, len(onsets.row)))
            first = np.vstack([onsets.columns, ones]) * flags[0][onsets.plane, onsets.row] / std
        if self.plain:
            design, target = tables[0], self.target[near[0].rows]
        else:
            window = self._window(near)
            design = self._at_kept(self._filtered(near, tables, onsets, first, window), window)
            target = self.target[self._kept_in(window)]
            if not self.local:
                design[:, -1] = self.bias_alone
        normal, right = design @ design.swapaxes(1, 2), _dot(design, target)
        # Of the rows that the bias alone is in.
        others, total, square = (whole - part for whole, part in zip(self.sums, _sums(target), strict=True))
        normal[:, -1, -1] += others * self.bias_alone**2
        right[:, -1] += total * self.bias_alone
        if self.readings.bias is not None:
            known, error = self.readings.bias
            normal[:, -1, -1] += error**-2
            right[:, -1] += known * error**-2
        size = np.sqrt(np.maximum(np.einsum("pii->pi", normal), 1e-60))
        scale = size[:, :, None] * size[:, None]
        covariance = np.linalg.inv(normal / scale + 1e-13 * np.eye(size.shape[1])) / scale
        coefficients = np.einsum("pij,pj->pi", covariance, right)
        residual = (coefficients[:, None] @ design)[:, 0] - target
        misfit = np.einsum("pm,pm->p", residual, residual)
        bias = coefficients[:, -1] * self.bias_alone
        misfit += square + bias * (others * bias - 2.0 * total)
        if self.readings.bias is not None:
            known, error = self.readings.bias
            misfit = misfit + ((coefficients[:, -1] - known) / error) ** 2
        return coefficients, covariance, misfit, residual, design

    def _kept_in(self, window: slice) -> slice:
        """Return the place of a window's rows among those that count."""
        lanes = self.readings.force.shape[1]
        return slice(*np.searchsorted(self.kept, (window.start * lanes, window.stop * lanes)))

    def _at_kept(self, values: np.ndarray, window: slice) -> np.ndarray:
        """Values of (planes, columns, rows, lanes) of a window, with white noise and at rows that count."""
        rows = self.kept[self._kept_in(window)] - window.start * self.readings.force.shape[1]
        return self.whiten(values).reshape(*values.shape[:2], -1)[:, :, rows]

    def _by_plane(
        self, delay: float, plane: float, coefficients, near: list[_Near], flag: np.ndarray
    ) -> np.ndarray:
        """Slope of the readings predicted by the one plane, at the rows of the design, over the noise."""
        step, window = 1e-7, self._window(near)
        if self.time_constant:
            planes = plane + step * np.array([1.0, -1.0])
            shifted = self._everywhere(self._moved(delay), planes, coefficients)
            wide = self._window([*near, *shifted[0]])
            high, low = self._predicted(*shifted, coefficients, wide)
            change = (high - low)[window.start - wide.start : window.stop - wide.start]
            return self._at_kept(change[None, None] / (2.0 * step * self.readings.std), window)[0, 0]
        now = near[0]
        rows = self.where[now.rows]
        up, down = (
            _force(coefficients, self._columns(np.maximum(now.depth + d, 0.0), now.rate, rows))
            for d in (step, -step)
        )
        table = ((down - up) * flag / (2.0 * step * self.readings.std))[:, None]
        if not self.plain:
            table = self._at_kept(self._filtered(near, [table], None, None, window), window)
        return table[0, 0]

    def force(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """The readings the law predicts [N], the bias included, (rows, lanes)."""
        moved = [self.motion.at(delay + part * self.motion.period) for part in self.before]
        moved = [(position.ravel(), rate.ravel()) for position, rate in moved]
        near, flags, onsets = self._everywhere(moved, np.array([plane]), coefficients)
        force = self._predicted(near, flags, onsets, coefficients, slice(0, len(self.readings.force)))[0]
        return force if self.local else force + coefficients[-1]

    def _predicted(self, near, flags, onsets, coefficients: np.ndarray, window: slice) -> np.ndarray:
        """Return the readings at a window's rows [N] without a bias of all rows, (planes, rows, lanes)."""
        offset, first = self.local * coefficients[-1], None
        tables = [
            ((_force(coefficients, one.columns) + offset) * flag)[:, None]
            for one, flag in zip(near, flags, strict=True)
        ]
        if onsets is not None:
            first = (coefficients[:-1] @ onsets.columns + offset) * flags[0][onsets.plane, onsets.row]
        return self._filtered(near, tables, onsets, first, window)[:, 0]

    def touching(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Whether each row is in contact by the model, (rows, lanes)."""
        position, rate = self.motion.at(delay)
        moved = [(position.ravel(), rate.ravel())]
        (near,), (flag,), _ = self._everywhere(moved, np.array([plane]), coefficients)
        flags = np.zeros(self.readings.force.shape, bool)
        flags.ravel()[near.rows] = flag[0]
        return flags

    def _everywhere(self, moved, planes: np.ndarray, coefficients: np.ndarray):
        """The rows near contact, whether they count or not, and whether they are in it, for each part of a
        period, of which `moved` has position and rate at all rows; and the onsets."""
        every = np.arange(moved[0][0].size)
        near = [self._near(position, rate, every, planes) for position, rate in moved]
        repeated = np.repeat(coefficients[None], len(planes), axis=0)
        flags = [self._touching(one, repeated) for one in near]
        onsets = self._onsets(near[0], [x for x, _ in moved], planes) if len(moved) > 1 else None
        return near, flags, onsets

    def settled(self, delay: float, plane: float) -> tuple[float, Inner, float]:
        """The plane of least misfit at a delay, a fit next to it, and by how much the log likelihood there is
        above that fit's: what one more of Newton's steps gains is a parabola's."""
        inner = self.at(delay, plane)
        for _ in range(STEPS):
            if self.plane is not None or inner.curvature <= 0.0:
                return plane, inner, 0.0
            shift = inner.slope / inner.curvature
            gain = 0.5 * inner.slope * shift
            plane = plane - shift
            if gain < CLOSE:
                return plane, inner, gain
            inner = self.at(delay, plane)
        return plane, inner, 0.0


def _force(coefficients: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The law without the bias, (planes, rows)."""
    return (coefficients[..., None, :-1] @ columns)[:, 0]


def _dot(table: np.ndarray, values: np.ndarray) -> Any:
    """Sums of products along the rows. BLAS would add up as many parts as it has threads: other last bits."""
    return np.einsum("...m,m->...", table, values)


def _sums(values: np.ndarray) -> tuple[int, float, float]:
    """Return the number of values, their sum and that of their squares."""
    return len(values), float(values.sum()), float(_dot(values, values))
