"""Linear least-squares fit of a contact law at a given force delay and surface position.

The logged commands determine the motion of the mechanism (`motion`). For a given force delay and surface
position ("plane"), the predicted force is a linear combination of the regressors of the contact law
(functions of depth and rate). The coefficients are stiffness, damping and the bias of the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import special
from scipy.signal import lfilter

from tuning.identification.contact_laws import Law
from tuning.identification.contact_regression import (
    CoefficientFit,
    LeastSquaresFit,
    PseudoRows,
    compute_force,
    fit_coefficients,
    sum_and_squares,
    sum_products,
)
from tuning.identification.force_readings import ForceReadings
from tuning.identification.motion import MotionResponse
from tuning.identification.nearby_rows import NearbyRows, Onsets
from tuning.identification.packed_rows import PackedRows, pack_rows
from tuning.identification.sensor_filter import (
    compute_lag_weights,
    compute_onset_shares,
    compute_onset_weights,
)

MAX_FORCE_DELAY = 0.02  # s, longest force delay in the search range of a fit
COARSE_DELAY_STEP = 0.0005  # s, step between the delays of a first search
STEP = 1e-7  # m, step of finite differences with respect to the surface position
FILTER_MEMORY_TIME_CONSTANTS = 40.0  # time constants after which a filter's response is below rounding errors


class ContactProblem:
    """Least-squares problem: fit of a contact law to force readings, for a known motion of the mechanism.

    The surface position `plane` [m] is None if the fit estimates it. Readings out of contact depend only on
    the bias. Their number, sum and sum of squares therefore represent them, and the regressors of the law are
    computed only near contact. If the sensor has a lag (`time_constant` [s]), the regressors pass through the
    same lag. If its noise is coloured, regressors and readings are whitened.
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
        # The force delay is relative to the delay of the position sensor, so it may be negative.
        self.min_delay = -COARSE_DELAY_STEP * float(np.floor(max(motion.delay, 0.0) / COARSE_DELAY_STEP))
        self.is_unfiltered = len(readings.whitening) == 1 and time_constant == 0.0
        self.used_rows = np.flatnonzero(readings.counts)
        # Index of each row among the used rows, or -1 for an unused row. The additional last entry serves the
        # row index -1.
        self.used_indices = np.full(readings.counts.size + 1, -1)
        self.used_indices[self.used_rows] = np.arange(len(self.used_rows))
        # A filter also needs the rows that fits do not use.
        self.needed_rows = self.used_rows if self.is_unfiltered else np.arange(readings.counts.size)
        self.target = self.whiten(readings.force).ravel()[self.used_rows] / readings.std
        self.damping_indices = [i for i, name in enumerate(self.names) if name.startswith("damping")]
        # A dead zone changes only the readings in contact; a bias changes all readings.
        self.has_dead_zone = bool(readings.threshold)
        # Value of a reading out of contact for a bias of 1 N, whitened and divided by the noise's standard
        # deviation.
        self.bias_alone = 0.0 if self.has_dead_zone else float(np.sum(readings.whitening)) / readings.std
        self.sums = sum_and_squares(self.target)
        self.memory = len(readings.whitening) + int(
            np.ceil(FILTER_MEMORY_TIME_CONSTANTS * time_constant / motion.period)
        )
        # Times at which the force is computed, in periods before a row. A lag integrates the force between
        # two rows, so it also needs the force in the middle.
        self.periods_before = (0.0,) if time_constant == 0.0 else (0.0, 0.5)
        self._cached_motion: tuple[float, list[tuple[np.ndarray, np.ndarray]]] | None = None
        self._guess: np.ndarray | None = None

    @cached_property
    def names(self) -> list[str]:
        law, entries = self.law, self.readings.entries
        own_count = len(law.entry_functions(np.zeros(1), np.zeros(1)))
        numbered = [f"{name}.{i}" for i in entries for name in law.names[:own_count]]
        return [*numbered, *law.names[own_count:], "bias"]

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Apply the whitening filter along the rows of an array (..., rows, lanes)."""
        return _whiten(values.swapaxes(-1, -2), self.readings.whitening).swapaxes(-1, -2)

    def changed(self, law: Law, time_constant: float) -> ContactProblem:
        """Return the same problem with this contact law and this time constant of the sensor [s]."""
        return ContactProblem(self.motion, self.readings, law, self.plane, time_constant)

    def at(self, delay: float, plane: float, pseudo: PseudoRows | None = None) -> CoefficientFit:
        """Fit the coefficients at one force delay [s] and surface position [m].

        `pseudo` adds rows that replace the readings of other runs. Rows in which the force of the law would
        be negative are treated as out of contact.
        """
        near, flags, fit = self._fit_until_consistent(delay, np.array([plane]), pseudo)
        (inner,) = self._make_fits(fit)
        if self.plane is not None:
            return replace(inner, plane=plane)
        by_plane = self._differentiate_by_plane(delay, plane, inner.coefficients, near, flags[0])
        if pseudo is not None:
            by_plane = np.concatenate([by_plane, inner.coefficients @ pseudo.by_plane[0]])
        residual, design = fit.residual[0], fit.design[0]
        along = sum_products(design, by_plane)
        change = -inner.covariance @ along
        slope, curvature = sum_products(residual, by_plane), sum_products(by_plane, by_plane) + along @ change
        return replace(inner, slope=float(slope), curvature=float(curvature), plane=plane, by_plane=change)

    def fit_surfaces(
        self, delay: float, planes: np.ndarray, pseudo: PseudoRows | None = None
    ) -> list[CoefficientFit]:
        """Fit the coefficients for each surface position `planes` [m]; compute no derivatives of the fits."""
        return self._make_fits(self._fit_until_consistent(delay, planes, pseudo)[2])

    def _fit_until_consistent(self, delay: float, planes: np.ndarray, pseudo: PseudoRows | None):
        """Fit the coefficients at each surface position; repeat until the rows in contact no longer change.

        Returns:
            The rows near contact, flags of the rows in contact, and the fit for each surface position.
        """
        moved = self._get_motion(delay)
        near = [self._find_nearby_rows(*motion, self.needed_rows, planes) for motion in moved]
        flags = [self._flag_rows_in_contact(rows, self._guess) for rows in near]
        onsets = self._find_onsets(near[0], [x for x, _ in moved], planes)
        fit = self._solve(near, flags, onsets, pseudo)
        for _ in range(2):
            again = [self._flag_rows_in_contact(rows, fit.coefficients) for rows in near]
            if all(np.array_equal(new, old) for new, old in zip(again, flags, strict=True)):
                break
            flags = again
            fit = self._solve(near, flags, onsets, pseudo)
        self._guess = fit.coefficients[len(planes) // 2]
        return near, flags, fit

    def _make_fits(self, fit: LeastSquaresFit) -> list[CoefficientFit]:
        coefficients, covariance, misfit = fit.coefficients, fit.covariance, fit.misfit
        allowed = sum(
            special.log_ndtr(coefficients[:, i] / np.sqrt(covariance[:, i, i])) for i in self.damping_indices
        )
        evidence = -0.5 * misfit + 0.5 * np.linalg.slogdet(covariance)[1] + allowed
        return [
            CoefficientFit(*values) for values in zip(coefficients, covariance, misfit, evidence, strict=True)
        ]

    def _get_motion(self, delay: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return position [m] and velocity [m/s] in `needed_rows`, at each of the times `periods_before`."""
        if self._cached_motion is None or self._cached_motion[0] != delay:
            moved, rows = self.motion_at(delay), self.needed_rows
            self._cached_motion = delay, [(x.ravel()[rows], v.ravel()[rows]) for x, v in moved]
        return self._cached_motion[1]

    def motion_at(self, delay: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return position [m] and velocity [m/s] in all rows, at each of the times `periods_before`."""
        return [self.motion.at(delay + part * self.motion.period) for part in self.periods_before]

    def onsets_between(self, delay: float, low: float, high: float) -> np.ndarray:
        """Return the surface positions [m] from `low` to `high` at which a row enters or leaves contact."""
        position, rate = self._get_motion(delay)[0]
        return np.unique(position[(rate > 0.0) & (position > low) & (position < high)])

    def _find_nearby_rows(self, position, rate, where, planes: np.ndarray) -> NearbyRows:
        """Return the rows that are in contact for at least one of the surface positions `planes` [m]."""
        # Finite differences also need the rows that would be in contact with a slightly nearer surface.
        rows = np.flatnonzero(position > planes.min() - (STEP if self.time_constant else 0.0))
        depth, rate = np.maximum(position[rows] - planes[:, None], 0.0), rate[rows]
        return NearbyRows(rows, depth, rate, self._tabulate(depth, rate, where[rows]))

    def _tabulate(self, depth: np.ndarray, rate: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the law's regressors in the given rows, shape (surface positions, coefficients, rows)."""
        own_columns, entries = self.law.entry_functions(depth, rate), self.readings.entries
        if len(entries) > 1:
            entry = self.readings.entry.ravel()[rows]
            own_columns = [np.where(entry == i, value, 0.0) for i in entries for value in own_columns]
        all_columns = (*own_columns, *self.law.shared(depth, rate))
        columns = np.empty((len(depth), len(all_columns), depth.shape[1]))
        for i, column in enumerate(all_columns):
            columns[:, i] = column
        return columns

    def _flag_rows_in_contact(self, near: NearbyRows, coefficients: np.ndarray | None) -> np.ndarray:
        """Return flags that mark the rows in contact in which the force of the law is not negative."""
        inside = near.depth > 0.0
        if coefficients is None or self.law.pulls or not self.damping_indices:
            return inside
        pushing = inside & (compute_force(coefficients, near.columns) > 0.0)
        # If the force has the wrong sign, the law pulls in most rows. These rows remain in contact, so that
        # the fit shows the wrong sign.
        sound = 2 * pushing.sum(axis=1) > inside.sum(axis=1)
        return np.where(sound[:, None], pushing, inside)

    def _find_onsets(
        self, near: NearbyRows, positions: list[np.ndarray], planes: np.ndarray
    ) -> Onsets | None:
        """Find the onsets of contact between two rows; return None if the sensor has no lag.

        `positions` contains the positions [m] at all rows and half a period before all rows.
        """
        if self.time_constant == 0.0:
            return None
        now, half = positions
        before = near.rows - self.readings.force.shape[1]
        last = np.where(before >= 0, now[np.maximum(before, 0)], now[near.rows])
        left = compute_onset_shares(last, half[near.rows], now[near.rows], planes[:, None])
        plane, row = np.nonzero(left)
        columns = self._tabulate(np.zeros((1, len(row))), near.rate[row], self.needed_rows[near.rows[row]])[0]
        rate = self.motion.period / self.time_constant
        return Onsets(plane, row, columns, *compute_onset_weights(rate, left[plane, row]))

    def _pack_nearby_rows(self, near: list[NearbyRows]) -> PackedRows:
        """Return the rows near contact and the later rows that depend on them through the filters."""
        return pack_rows([part.rows for part in near], self.readings.force.shape, self.memory)

    def _filter(self, near, tables: list[np.ndarray], onsets, first, where: PackedRows, whitening):
        """Apply the lag of the sensor and the whitening filter to the regressors of the law.

        Args:
            near: Rows near contact, at each of the times `periods_before`.
            tables: Values of the regressors in these rows, at each of the times `periods_before`.
            onsets: Onsets of contact, or None if the sensor has no lag.
            first: Values of the regressors just after the onsets, shape (regressors, onsets), or None.
            where: Rows of the result.
            whitening: Coefficients of the whitening filter.
        """
        full, places = [], [where.places(part.rows) for part in near]
        for columns, columns_in_table in zip(tables, places, strict=True):
            table = np.zeros((*columns.shape[:2], len(where.rows)))
            table[:, :, columns_in_table] = columns
            full.append(table)
        if onsets is None or not len(where.rows):
            return _whiten(full[0], whitening)
        pole, (now, half, last) = compute_lag_weights(self.motion.period / self.time_constant)
        drive = now * full[0] + half * full[1]
        drive[:, :, 1:] += last * full[0][:, :, :-1]
        then = tables[0][onsets.plane, :, onsets.row].T
        drive[onsets.plane, :, places[0][onsets.row]] = (onsets.after * first + onsets.end * then).T
        lagged: Any = lfilter(whitening, [1.0, -pole], drive)
        return lagged

    def inside(self, delay: float, planes: np.ndarray) -> np.ndarray:
        """Return the design matrix of lanes that are always in contact.

        Its shape is (surface positions, coefficients, used rows).
        """
        tables, shape = [], self.readings.force.shape
        rows = np.arange(self.readings.force.size).reshape(shape).T.ravel()
        for position, rate in self.motion_at(delay):
            depth = position.T.ravel() - planes[:, None]
            columns = self._tabulate(depth, rate.T.ravel(), rows) / self.readings.std
            tables.append(columns.reshape(*columns.shape[:2], shape[1], shape[0]))
        drive = tables[0]
        if self.time_constant:
            pole, (now, half, last) = compute_lag_weights(self.motion.period / self.time_constant)
            drive = now * tables[0] + half * tables[1]
            drive[..., 1:] += last * tables[0][..., :-1]
            drive = np.asarray(lfilter(self.readings.whitening, [1.0, -pole], drive))
        else:
            drive = _whiten(drive, self.readings.whitening)
        used = drive.swapaxes(2, 3).reshape(*drive.shape[:2], -1)[:, :, self.used_rows]
        bias = np.full(
            (len(planes), 1, used.shape[2]), float(np.sum(self.readings.whitening)) / self.readings.std
        )
        return np.concatenate([used, bias], axis=1)

    def _build_design(
        self, near: list[NearbyRows], flags: list[np.ndarray], onsets: Onsets | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return design (surface positions, coefficients, rows) and readings near contact.

        Both are divided by the standard deviation of the noise.
        """
        std, tables, first = self.readings.std, [], None
        for rows_near, flag in zip(near, flags, strict=True):
            # The last column belongs to the bias. It is 1 in all rows or, if there is a dead zone, only in
            # rows in contact.
            table = np.empty((len(flag), rows_near.columns.shape[1] + 1, len(rows_near.rows)))
            np.multiply(rows_near.columns, flag[:, None] / std, out=table[:, :-1])
            table[:, -1] = flag / std if self.has_dead_zone else 1.0 / std
            tables.append(table)
        if onsets is not None:
            ones = np.ones((1, len(onsets.row)))
            first = np.vstack([onsets.columns, ones]) * flags[0][onsets.plane, onsets.row] / std
        if self.is_unfiltered:
            return tables[0], self.target[near[0].rows]
        where = self._pack_nearby_rows(near)
        used = self.used_indices[where.rows]
        design = self._filter(near, tables, onsets, first, where, self.readings.whitening)[:, :, used >= 0]
        if not self.has_dead_zone:
            design[:, -1] = self.bias_alone
        return design, self.target[used[used >= 0]]

    def _solve(self, near, flags, onsets, pseudo: PseudoRows | None) -> LeastSquaresFit:
        """Fit the coefficients at each surface position, for the rows in contact that `flags` marks."""
        design, target = self._build_design(near, flags, onsets)
        # Number, sum and sum of squares of the readings that depend on the bias alone.
        count, total, square = (
            full - part for full, part in zip(self.sums, sum_and_squares(target), strict=True)
        )
        if pseudo is not None:
            design = np.concatenate([design, pseudo.design], axis=2)
            target = np.concatenate([target, pseudo.target])
        return fit_coefficients(design, target, (count, total, square), self.bias_alone, self.readings.bias)

    def _differentiate_by_plane(
        self, delay: float, plane: float, coefficients, near: list[NearbyRows], flag: np.ndarray
    ) -> np.ndarray:
        """Differentiate the predicted readings with respect to the surface position.

        The result is divided by the standard deviation of the noise.
        """
        scale = 2.0 * STEP * self.readings.std
        if self.time_constant:
            shifted = self._all_rows_near_contact(
                self._get_motion(delay), plane + STEP * np.array([1.0, -1.0]), coefficients
            )
            where = self._pack_nearby_rows(near)
            high, low = self._predict(*shifted, coefficients, where, self.readings.whitening)
            return (high - low)[self.used_indices[where.rows] >= 0] / scale
        now = near[0]
        rows = self.needed_rows[now.rows]
        up, down = (
            compute_force(coefficients, self._tabulate(np.maximum(now.depth + d, 0.0), now.rate, rows))
            for d in (STEP, -STEP)
        )
        table = ((down - up) * flag / scale)[:, None]
        if self.is_unfiltered:
            return table[0, 0]
        where = self._pack_nearby_rows(near)
        table = self._filter(near, [table], None, None, where, self.readings.whitening)
        return table[0, 0, self.used_indices[where.rows] >= 0]

    def force(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Return the predicted force readings [N], including the bias, shape (rows, lanes)."""
        moved = [(position.ravel(), rate.ravel()) for position, rate in self.motion_at(delay)]
        near, flags, onsets = self._all_rows_near_contact(moved, np.array([plane]), coefficients)
        where = self._pack_nearby_rows(near)
        force, real = np.zeros(self.readings.force.shape), where.rows >= 0
        values = self._predict(near, flags, onsets, coefficients, where, (1.0,))[0]
        force.ravel()[where.rows[real]] = values[real]
        return force if self.has_dead_zone else force + coefficients[-1]

    def _predict(self, near, flags, onsets, coefficients, where: PackedRows, whitening) -> np.ndarray:
        """Return the whitened predicted readings [N] without a constant bias, (surface positions, rows)."""
        offset, first = self.has_dead_zone * coefficients[-1], None
        tables = [
            ((compute_force(coefficients, part.columns) + offset) * flag)[:, None]
            for part, flag in zip(near, flags, strict=True)
        ]
        if onsets is not None:
            first = (coefficients[:-1] @ onsets.columns + offset) * flags[0][onsets.plane, onsets.row]
        return self._filter(near, tables, onsets, first, where, whitening)[:, 0]

    def touching(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Return flags of the rows that are in contact according to the model, shape (rows, lanes)."""
        position, rate = self.motion.at(delay)
        moved = [(position.ravel(), rate.ravel())]
        (near,), (flag,), _ = self._all_rows_near_contact(moved, np.array([plane]), coefficients)
        flags = np.zeros(self.readings.force.shape, bool)
        flags.ravel()[near.rows] = flag[0]
        return flags

    def _all_rows_near_contact(self, moved, planes: np.ndarray, coefficients: np.ndarray):
        """Search all rows; return the rows near contact, flags of those in contact, and the onsets.

        Args:
            moved: Position [m] and velocity [m/s] in all rows, at each of the times `periods_before`.
            planes: Surface positions [m].
            coefficients: Coefficients of the law.
        """
        all_rows = np.arange(moved[0][0].size)
        near = [self._find_nearby_rows(position, rate, all_rows, planes) for position, rate in moved]
        repeated = np.repeat(coefficients[None], len(planes), axis=0)
        flags = [self._flag_rows_in_contact(part, repeated) for part in near]
        onsets = self._find_onsets(near[0], [x for x, _ in moved], planes) if len(moved) > 1 else None
        return near, flags, onsets


def _whiten(values: np.ndarray, whitening: Sequence[float]) -> np.ndarray:
    filtered = values.copy() if len(whitening) > 1 else values
    for lag, weight in enumerate(whitening[1:], 1):
        filtered[..., lag:] += weight * values[..., :-lag]
    return filtered
