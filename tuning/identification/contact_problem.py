"""Linear fit of a contact law at one delay and surface position, with known motion.

The commands determine the position of the mechanism (`motion`). For a given force delay and surface, the law
is linear in its coefficients: stiffness, damping and the sensor's bias.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import special
from scipy.signal import lfilter

from tuning.identification.contact_laws import Law
from tuning.identification.force_readings import ForceReadings
from tuning.identification.motion import MotionResponse
from tuning.identification.sensor_filter import (
    compute_lag_weights,
    compute_onset_shares,
    compute_onset_weights,
)

MAX_FORCE_DELAY = 0.02  # s, longest force delay in a search
COARSE_DELAY_STEP = 0.0005  # s, between the delays of a first search
MAX_NEWTON_STEPS = 6  # Newton steps for the plane
MIN_LIKELIHOOD_GAIN = 2.0  # gain of log likelihood below which no further Newton step is taken
FILTER_MEMORY_TIME_CONSTANTS = 40.0  # time constants after which a filter's response is below rounding


@dataclass(frozen=True)
class CoefficientFit:
    """Linear fit of the coefficients at one delay and surface."""

    coefficients: np.ndarray
    covariance: np.ndarray
    misfit: float  # chi-squared: sum of squares over the variance of the noise
    evidence: float  # log posterior density of delay and plane, up to a constant
    slope: float = 0.0  # derivative of misfit / 2 by the plane [1/m]
    curvature: float = 0.0  # second derivative by the plane, coefficients fitted [1/m^2]
    plane: float = 0.0  # m, plane of the fit
    by_plane: np.ndarray | None = None  # derivative of the coefficients by the plane, if that is fitted


class _NearbyRows(NamedTuple):
    """Rows that may be in contact for any of several planes, with the law's functions there."""

    rows: np.ndarray  # (rows,)
    depth: np.ndarray  # m, (planes, rows); 0 out of contact
    rate: np.ndarray  # m/s, (rows,)
    columns: np.ndarray  # (planes, coefficients, rows), one per coefficient but the bias


class _Onsets(NamedTuple):
    """Onsets of contact within a period, for the integration by a sensor's lag."""

    plane: np.ndarray  # (onsets,), index of the plane
    row: np.ndarray  # (onsets,), index among the rows near contact
    columns: np.ndarray  # (coefficients, onsets), the law's functions just after the onset
    after: np.ndarray  # (onsets,), weight of the force just after the onset
    end: np.ndarray  # (onsets,), weight of the force at the end of the period


class ContactProblem:
    """Linear least-squares problem of a law, with the motion given; `plane` [m] is None if it is fitted.

    Rows out of contact only depend on the bias, so three sums represent all of them, and the law's functions
    are computed only near contact. With a lag of the sensor [s] or coloured noise, every function is filtered
    along the rows like the force, until the filter's response is over.
    """

    def __init__(
        self,
        motion: MotionResponse,
        readings: ForceReadings,
        law: Law,
        plane: float | None,
        time_constant: float = 0.0,
    ):
        self.motion, self.readings, self.law, self.plane = motion, readings, law, plane
        self.time_constant = time_constant
        # The delay is relative to the position sensor's, so it may be negative.
        self.min_delay = -COARSE_DELAY_STEP * float(np.floor(max(motion.delay, 0.0) / COARSE_DELAY_STEP))
        self.plain = len(readings.whitening) == 1 and time_constant == 0.0
        self.kept = np.flatnonzero(readings.counts)
        # Filters also need the rows that are not used.
        self.where = self.kept if self.plain else np.arange(readings.counts.size)
        self.target = self.whiten(readings.force).ravel()[self.kept] / readings.std
        self.damping_indices = [i for i, name in enumerate(self.names) if name.startswith("damping")]
        # A dead zone lowers the readings in contact alone; a bias shifts every reading.
        self.local = bool(readings.threshold)
        # Whitened reading out of contact for a bias of 1 N.
        self.bias_alone = 0.0 if self.local else float(np.sum(readings.whitening)) / readings.std
        self.sums = _sum_and_squares(self.target)
        self.memory = len(readings.whitening) + int(
            np.ceil(FILTER_MEMORY_TIME_CONSTANTS * time_constant / motion.period)
        )
        # Times before the row, in periods, at which the force is computed: a lag integrates it.
        self.before = (0.0,) if time_constant == 0.0 else (0.0, 0.5)
        self._at: tuple[float, list[tuple[np.ndarray, np.ndarray]]] | None = None
        self._guess: np.ndarray | None = None

    @cached_property
    def names(self) -> list[str]:
        law, entries = self.law, self.readings.entries
        own_count = len(law.entry_functions(np.zeros(1), np.zeros(1)))
        numbered = [f"{name}.{i}" for i in entries for name in law.names[:own_count]]
        return [*numbered, *law.names[own_count:], "bias"]

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Return values of shape (..., rows, lanes) with white noise, filtered along the rows."""
        filtered = values.copy() if len(self.readings.whitening) > 1 else values
        for lag, weight in enumerate(self.readings.whitening[1:], 1):
            filtered[..., lag:, :] += weight * values[..., :-lag, :]
        return filtered

    def at(self, delay: float, plane: float) -> CoefficientFit:
        """Fit the coefficients at one delay [s] and plane [m].

        Rows at which the law would pull are treated as out of contact.
        """
        near, flags, fit = self._fit_until_consistent(delay, np.array([plane]))
        (inner,) = self._make_fits(fit)
        if self.plane is not None:
            return replace(inner, plane=plane)
        by_plane = self._by_plane(delay, plane, inner.coefficients, near, flags[0])
        residual, design = fit[3][0], fit[4][0]
        along = _sum_products(design, by_plane)
        change = -inner.covariance @ along
        slope, curvature = (
            _sum_products(residual, by_plane),
            _sum_products(by_plane, by_plane) + along @ change,
        )
        return replace(inner, slope=float(slope), curvature=float(curvature), plane=plane, by_plane=change)

    def fit_surfaces(self, delay: float, planes: np.ndarray) -> list[CoefficientFit]:
        """Fit the coefficients at several planes at once, without derivatives by the plane."""
        return self._make_fits(self._fit_until_consistent(delay, planes)[2])

    def _fit_until_consistent(self, delay: float, planes: np.ndarray):
        """Fit at each plane, with the rows in contact updated until they agree with the fit.

        Returns the rows near contact, the flags of rows in contact, and the linear fit.
        """
        moved = self._motion_at(delay)
        near = [self._near(*motion, self.where, planes) for motion in moved]
        flags = [self._touching(rows, self._guess) for rows in near]
        onsets = self._onsets(near[0], [x for x, _ in moved], planes)
        fit = self._solve(near, flags, onsets)
        for _ in range(2):
            again = [self._touching(rows, fit[0]) for rows in near]
            if all(np.array_equal(new, old) for new, old in zip(again, flags, strict=True)):
                break
            flags = again
            fit = self._solve(near, flags, onsets)
        self._guess = fit[0][len(planes) // 2]
        return near, flags, fit

    def _make_fits(self, fit) -> list[CoefficientFit]:
        """Return the fits of all planes as records, with the log posterior of each."""
        coefficients, covariance, misfit = fit[:3]
        allowed = sum(
            special.log_ndtr(coefficients[:, i] / np.sqrt(covariance[:, i, i])) for i in self.damping_indices
        )
        evidence = -0.5 * misfit + 0.5 * np.linalg.slogdet(covariance)[1] + allowed
        return [
            CoefficientFit(*values) for values in zip(coefficients, covariance, misfit, evidence, strict=True)
        ]

    def _motion_at(self, delay: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return position and rate at the rows of `where`, for each time in `before`."""
        if self._at is None or self._at[0] != delay:
            moved = [self.motion.at(delay + part * self.motion.period) for part in self.before]
            self._at = delay, [(x.ravel()[self.where], v.ravel()[self.where]) for x, v in moved]
        return self._at[1]

    def onsets_between(self, delay: float, low: float, high: float) -> np.ndarray:
        """Return the sorted planes between `low` and `high` at which a row enters the contact."""
        position, rate = self._motion_at(delay)[0]
        return np.unique(position[(rate > 0.0) & (position > low) & (position < high)])

    def _near(self, position, rate, where, planes: np.ndarray) -> _NearbyRows:
        """Return the rows that are in contact for at least one of the planes."""
        rows = np.flatnonzero(position > planes.min())
        depth, rate = np.maximum(position[rows] - planes[:, None], 0.0), rate[rows]
        return _NearbyRows(rows, depth, rate, self._columns(depth, rate, where[rows]))

    def _columns(self, depth: np.ndarray, rate: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the law's functions at rows of the readings, (planes, coefficients, rows)."""
        own_columns, entries = self.law.entry_functions(depth, rate), self.readings.entries
        if len(entries) > 1:
            entry = self.readings.entry.ravel()[rows]
            own_columns = [np.where(entry == i, value, 0.0) for i in entries for value in own_columns]
        all_columns = (*own_columns, *self.law.shared(depth, rate))
        columns = np.empty((len(depth), len(all_columns), depth.shape[1]))
        for i, column in enumerate(all_columns):
            columns[:, i] = column
        return columns

    def _touching(self, near: _NearbyRows, coefficients: np.ndarray | None) -> np.ndarray:
        """Return the rows in contact, without those at which the law with these coefficients would pull."""
        inside = near.depth > 0.0
        if coefficients is None or self.law.pulls or not self.damping_indices:
            return inside
        pushing = inside & (_compute_force(coefficients, near.columns) > 0.0)
        # With the wrong sign of the force the law pulls in most rows; keep them, so that the fit shows it.
        sound = 2 * pushing.sum(axis=1) > inside.sum(axis=1)
        return np.where(sound[:, None], pushing, inside)

    def _onsets(self, near: _NearbyRows, positions: list[np.ndarray], planes: np.ndarray) -> _Onsets | None:
        """Return the onsets, from the positions at all rows and half a period earlier; None without a lag."""
        if self.time_constant == 0.0:
            return None
        now, half = positions
        before = near.rows - self.readings.force.shape[1]
        last = np.where(before >= 0, now[np.maximum(before, 0)], now[near.rows])
        left = compute_onset_shares(last, half[near.rows], now[near.rows], planes[:, None])
        plane, row = np.nonzero(left)
        columns = self._columns(np.zeros((1, len(row))), near.rate[row], self.where[near.rows[row]])[0]
        rate = self.motion.period / self.time_constant
        return _Onsets(plane, row, columns, *compute_onset_weights(rate, left[plane, row]))

    def _window(self, near: list[_NearbyRows]) -> slice:
        """Return the range of rows at which the filters respond to the rows near contact."""
        length, lanes = self.readings.force.shape
        flat = np.concatenate([part.rows for part in near])
        if not len(flat):
            return slice(0, 0)
        return slice(int(flat.min()) // lanes, min(int(flat.max()) // lanes + 1 + self.memory, length))

    def _filtered(
        self, near: list[_NearbyRows], tables: list[np.ndarray], onsets, first, window: slice
    ) -> np.ndarray:
        """Return columns as the sensor with its lag reads them, at the rows of a window.

        `tables` holds the columns for each time in `before`; `first` those just after the onsets, (columns,
        onsets).
        """
        lanes, full = self.readings.force.shape[1], []
        shape, before = (window.stop - window.start, lanes), window.start * lanes
        for columns, part in zip(tables, near, strict=True):
            table = np.zeros((*columns.shape[:2], shape[0] * lanes))
            table[:, :, part.rows - before] = columns
            full.append(table.reshape(*columns.shape[:2], *shape))
        if onsets is None:
            return full[0]
        pole, (now, half, last) = compute_lag_weights(self.motion.period / self.time_constant)
        drive = now * full[0] + half * full[1]
        drive[:, :, 1:] += last * full[0][:, :, :-1]
        flat = drive.reshape(*drive.shape[:2], -1)
        then = tables[0][onsets.plane, :, onsets.row].T
        flat[onsets.plane, :, near[0].rows[onsets.row] - before] = (
            onsets.after * first + onsets.end * then
        ).T
        lagged: Any = lfilter([1.0], [1.0, -pole], drive, axis=-2)
        return lagged

    def _solve(self, near: list[_NearbyRows], flags: list[np.ndarray], onsets: _Onsets | None):
        """Return coefficients, covariance, misfit, residuals and design for each plane.

        Design and residuals are divided by the noise's standard deviation.
        """
        std, tables, first = self.readings.std, [], None
        for rows_near, flag in zip(near, flags, strict=True):
            # The last column is the bias: with a dead zone only in the rows in contact, else in all rows.
            table = np.empty((len(flag), rows_near.columns.shape[1] + 1, len(rows_near.rows)))
            np.multiply(rows_near.columns, flag[:, None] / std, out=table[:, :-1])
            table[:, -1] = flag / std if self.local else 1.0 / std
            tables.append(table)
        if onsets is not None:
            ones = np.ones((1, len(onsets.row)))
            first = np.vstack([onsets.columns, ones]) * flags[0][onsets.plane, onsets.row] / std
        if self.plain:
            design, target = tables[0], self.target[near[0].rows]
        else:
            window = self._window(near)
            design = self._values_at_used_rows(self._filtered(near, tables, onsets, first, window), window)
            target = self.target[self._used_rows_in(window)]
            if not self.local:
                design[:, -1] = self.bias_alone
        normal, right = design @ design.swapaxes(1, 2), _sum_products(design, target)
        # Number and sums of the rows that depend on the bias alone.
        rest_count, total, square = (
            full - part for full, part in zip(self.sums, _sum_and_squares(target), strict=True)
        )
        normal[:, -1, -1] += rest_count * self.bias_alone**2
        right[:, -1] += total * self.bias_alone
        if self.readings.bias is not None:
            bias_prior, error = self.readings.bias
            normal[:, -1, -1] += error**-2
            right[:, -1] += bias_prior * error**-2
        size = np.sqrt(np.maximum(np.einsum("pii->pi", normal), 1e-60))
        scale = size[:, :, None] * size[:, None]
        covariance = np.linalg.inv(normal / scale + 1e-13 * np.eye(size.shape[1])) / scale
        coefficients = np.einsum("pij,pj->pi", covariance, right)
        residual = (coefficients[:, None] @ design)[:, 0] - target
        misfit = np.einsum("pm,pm->p", residual, residual)
        bias = coefficients[:, -1] * self.bias_alone
        misfit += square + bias * (rest_count * bias - 2.0 * total)
        if self.readings.bias is not None:
            bias_prior, error = self.readings.bias
            misfit = misfit + ((coefficients[:, -1] - bias_prior) / error) ** 2
        return coefficients, covariance, misfit, residual, design

    def _used_rows_in(self, window: slice) -> slice:
        """Return the range of a window's rows among the rows that are used."""
        lanes = self.readings.force.shape[1]
        return slice(*np.searchsorted(self.kept, (window.start * lanes, window.stop * lanes)))

    def _values_at_used_rows(self, values: np.ndarray, window: slice) -> np.ndarray:
        """Return whitened values (planes, columns, rows, lanes) of a window at the rows that are used."""
        rows = self.kept[self._used_rows_in(window)] - window.start * self.readings.force.shape[1]
        return self.whiten(values).reshape(*values.shape[:2], -1)[:, :, rows]

    def _by_plane(
        self, delay: float, plane: float, coefficients, near: list[_NearbyRows], flag: np.ndarray
    ) -> np.ndarray:
        """Return the predicted readings' derivative by the plane, over the noise, at the design's rows."""
        step, window = 1e-7, self._window(near)
        if self.time_constant:
            planes = plane + step * np.array([1.0, -1.0])
            shifted = self._all_rows_near_contact(self._motion_at(delay), planes, coefficients)
            wide = self._window([*near, *shifted[0]])
            high, low = self._predicted(*shifted, coefficients, wide)
            change = (high - low)[window.start - wide.start : window.stop - wide.start]
            return self._values_at_used_rows(change[None, None] / (2.0 * step * self.readings.std), window)[
                0, 0
            ]
        now = near[0]
        rows = self.where[now.rows]
        up, down = (
            _compute_force(coefficients, self._columns(np.maximum(now.depth + d, 0.0), now.rate, rows))
            for d in (step, -step)
        )
        table = ((down - up) * flag / (2.0 * step * self.readings.std))[:, None]
        if not self.plain:
            table = self._values_at_used_rows(self._filtered(near, [table], None, None, window), window)
        return table[0, 0]

    def force(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Return the predicted readings [N], bias included, (rows, lanes)."""
        moved = [self.motion.at(delay + part * self.motion.period) for part in self.before]
        moved = [(position.ravel(), rate.ravel()) for position, rate in moved]
        near, flags, onsets = self._all_rows_near_contact(moved, np.array([plane]), coefficients)
        force = self._predicted(near, flags, onsets, coefficients, slice(0, len(self.readings.force)))[0]
        return force if self.local else force + coefficients[-1]

    def _predicted(self, near, flags, onsets, coefficients: np.ndarray, window: slice) -> np.ndarray:
        """Return the readings in a window [N], without a bias that all rows share, (planes, rows, lanes)."""
        offset, first = self.local * coefficients[-1], None
        tables = [
            ((_compute_force(coefficients, part.columns) + offset) * flag)[:, None]
            for part, flag in zip(near, flags, strict=True)
        ]
        if onsets is not None:
            first = (coefficients[:-1] @ onsets.columns + offset) * flags[0][onsets.plane, onsets.row]
        return self._filtered(near, tables, onsets, first, window)[:, 0]

    def touching(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Return whether each row is in contact according to the model, (rows, lanes)."""
        position, rate = self.motion.at(delay)
        moved = [(position.ravel(), rate.ravel())]
        (near,), (flag,), _ = self._all_rows_near_contact(moved, np.array([plane]), coefficients)
        flags = np.zeros(self.readings.force.shape, bool)
        flags.ravel()[near.rows] = flag[0]
        return flags

    def _all_rows_near_contact(self, moved, planes: np.ndarray, coefficients: np.ndarray):
        """Return rows near contact, flags of rows in contact, and onsets, for used and unused rows.

        `moved` holds position and rate at all rows, for each time in `before`.
        """
        all_rows = np.arange(moved[0][0].size)
        near = [self._near(position, rate, all_rows, planes) for position, rate in moved]
        repeated = np.repeat(coefficients[None], len(planes), axis=0)
        flags = [self._touching(part, repeated) for part in near]
        onsets = self._onsets(near[0], [x for x, _ in moved], planes) if len(moved) > 1 else None
        return near, flags, onsets

    def find_best_surface(self, delay: float, plane: float) -> tuple[float, CoefficientFit, float]:
        """Return the plane of least misfit at a delay, a fit nearby, and the gain of log likelihood.

        The gain is from the fit to the returned plane: that of the last Newton step, along a parabola.
        """
        inner = self.at(delay, plane)
        for _ in range(MAX_NEWTON_STEPS):
            if self.plane is not None or inner.curvature <= 0.0:
                return plane, inner, 0.0
            shift = inner.slope / inner.curvature
            gain = 0.5 * inner.slope * shift
            plane = plane - shift
            if gain < MIN_LIKELIHOOD_GAIN:
                return plane, inner, gain
            inner = self.at(delay, plane)
        return plane, inner, 0.0


def _compute_force(coefficients: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the force of the law without the bias, (planes, rows)."""
    return (coefficients[..., None, :-1] @ columns)[:, 0]


def _sum_products(table: np.ndarray, values: np.ndarray) -> Any:
    """Return the sums of products along the rows.

    BLAS would split the sum by its number of threads, which changes the last bits.
    """
    return np.einsum("...m,m->...", table, values)


def _sum_and_squares(values: np.ndarray) -> tuple[int, float, float]:
    """Return the number of values, their sum and that of their squares."""
    return len(values), float(values.sum()), float(_sum_products(values, values))
