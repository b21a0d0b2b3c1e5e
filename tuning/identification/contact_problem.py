"""Linear least-squares fit of a contact law at a given force delay and surface position.

The logged commands determine the motion of the mechanism (`motion`). For a given force delay and surface
position ("plane"), the predicted force is a linear combination of the regressors of the contact law
(functions of depth and rate). The coefficients are stiffness, damping and the bias of the sensor.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import special

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
from tuning.identification.drifting_noise import whiten
from tuning.identification.force_readings import ForceReadings
from tuning.identification.motion import MotionResponse
from tuning.identification.nearby_rows import NearbyRows, Onsets
from tuning.identification.packed_rows import pack_rows
from tuning.identification.sensor_filter import apply_filter, compute_onset_shares

MAX_FORCE_DELAY = 0.02  # longest force delay in the search range of a fit [s]
COARSE_DELAY_STEP = 0.0005  # step between the delays of a first search [s]
STEP = 1e-7  # step of finite differences with respect to the surface position [m]
FILTER_MEMORY_TIME_CONSTANTS = 25.0  # time constants after which the response of a filter is below 1e-10
Motion = list[tuple[np.ndarray, np.ndarray]]  # position [m] and velocity [m/s] at several times


class ContactProblem:
    """Least-squares problem: fit of a contact law to force readings, for a known motion of the mechanism.

    The surface position `plane` [m] is None if the fit estimates it. Readings out of contact depend only on
    the bias. The fit therefore needs only their number, sum and sum of squares, and computes the law's
    regressors only near contact. If the sensor has a lag or another filter (`time_constant` [s], the inverse
    of its angular cutoff frequency), the regressors pass through the same filter. If its noise is coloured,
    regressors and readings are whitened.
    """

    def __init__(
        self,
        motion: MotionResponse,
        readings: ForceReadings,
        law: Law,
        plane: float | None,
        time_constant: float | None = None,
    ):
        """Prepare the fits; if `time_constant` is None, use the prior's time constant of the force filter."""
        self.motion, self.readings, self.law, self.plane = motion, readings, law, plane
        time_constant = readings.time_constant if time_constant is None else time_constant
        self.time_constant = time_constant
        # The force delay is relative to the delay of the position sensor, so it may be negative.
        self.min_delay = -COARSE_DELAY_STEP * float(np.floor(max(motion.delay, 0.0) / COARSE_DELAY_STEP))
        self.is_unfiltered = len(readings.whitening) == 1 and time_constant == 0.0
        self.used_rows = np.flatnonzero(readings.counts)
        # The additional last entry serves the row index -1.
        self.is_used = np.append(readings.counts.ravel(), False)
        self.whitened = self.whiten(readings.force).ravel() / readings.std
        self.target = self.whitened[self.used_rows]
        self.damping_indices = [i for i, name in enumerate(self.names) if name.startswith("damping")]
        # A dead zone changes only the readings in contact; a bias changes all readings.
        self.has_dead_zone = bool(readings.threshold)
        # Value of a reading out of contact for a bias of 1 N, whitened and divided by the noise's standard
        # deviation.
        self.bias_column = float(np.sum(readings.whitening)) / readings.std
        self.bias_alone = 0.0 if self.has_dead_zone else self.bias_column
        self.sums = sum_and_squares(self.target)
        self.memory = readings.filter_length + int(
            np.ceil(FILTER_MEMORY_TIME_CONSTANTS * time_constant / motion.period / readings.modes.slowest)
        )
        # Times at which the force is computed, in periods before a row. A lag integrates the force between
        # two rows, so it also needs the force in the middle.
        self.periods_before = (0.0,) if time_constant == 0.0 else (0.0, 0.5)
        self._guess: np.ndarray | None = None

    @property
    def filter_rate(self) -> float:
        """Return the control period multiplied by the angular cutoff frequency of the sensor's filter."""
        return self.motion.period / self.time_constant

    @cached_property
    def names(self) -> list[str]:
        law, entries = self.law, self.readings.entries
        own_count = len(law.entry_functions(np.zeros(1), np.zeros(1)))
        numbered = [f"{name}.{i}" for i in entries for name in law.names[:own_count]]
        return [*numbered, *law.names[own_count:], "bias"]

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Apply the whitening filter along the rows of an array (..., rows, lanes)."""
        lost = self.readings.lost.T
        return whiten(values.swapaxes(-1, -2), self.readings.whitening, lost).swapaxes(-1, -2)

    def changed(self, law: Law, time_constant: float, delay: float | None = None) -> ContactProblem:
        """Return a copy of the problem with this contact law and this time constant of the sensor [s].

        `delay` [s] is the approximate force delay for later fits of the copy, or None if it is unknown.
        """
        return ContactProblem(self.motion, self.readings, law, self.plane, time_constant)

    def at(self, delay: float, plane: float, pseudo: PseudoRows | None = None) -> CoefficientFit:
        """Fit the coefficients at one force delay [s] and surface position [m].

        `pseudo` holds rows that are used in place of the readings of runs in deep contact. Rows in which
        the force of the law would be negative are treated as out of contact.
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
        moved = self.motion_at(delay)
        near = self._find_nearby_rows(moved, planes, self.is_unfiltered)
        flags = [self._flag_rows_in_contact(rows, self._guess) for rows in near]
        onsets = self._find_onsets(near[0], moved, planes)
        fit = self._solve(near, flags, onsets, pseudo)
        for _ in range(2):
            again = [self._flag_rows_in_contact(rows, fit.coefficients) for rows in near]
            pairs = zip(again, flags, strict=True)
            changed = np.any([(new != old).any(axis=1) for new, old in pairs], axis=0)
            flags = again
            if not changed.any():
                break
            if changed.all() or onsets is not None:
                fit = self._solve(near, flags, onsets, pseudo)
                continue
            # The rows in contact, and therefore the fits, of the other surface positions have not changed.
            part = near[0]._replace(depth=near[0].depth[changed], columns=near[0].columns[changed])
            rows = pseudo and pseudo._replace(design=pseudo.design[changed])
            for values, change in zip(fit, self._solve([part], [flags[0][changed]], None, rows), strict=True):
                values[changed] = change
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

    def motion_at(self, delay: float) -> Motion:
        """Return position [m] and velocity [m/s] in all rows, once per time in `self.periods_before`."""
        moved = [self.motion.at(delay + part * self.motion.period) for part in self.periods_before]
        return [(position.ravel(), rate.ravel()) for position, rate in moved]

    def onsets_between(self, delay: float, low: float, high: float) -> np.ndarray:
        """Return the surface positions [m] from `low` to `high` at which a row enters or leaves contact."""
        position, rate = self.motion_at(delay)[0]
        inside = (rate > 0.0) & (position > low) & (position < high)
        # A filter also needs the rows that fits do not use.
        return np.unique(position[inside & self.is_used[:-1] if self.is_unfiltered else inside])

    def _find_nearby_rows(self, moved: Motion, planes: np.ndarray, only_used: bool) -> list[NearbyRows]:
        """Return the rows near contact, as one record for each time in `self.periods_before` [periods].

        The result includes all rows that are in contact for at least one of the surface positions `planes`
        [m]. If the readings are filtered, the result also includes the later rows that the filters affect.

        Args:
            moved: Position [m] and velocity [m/s] in all rows, one pair of arrays for each of these times.
            planes: Surface positions [m].
            only_used: Whether to omit rows that fits do not use; possible only without filters.
        """
        # Finite differences also need the rows that would be in contact with a slightly nearer surface.
        lowest = planes.min() - (STEP if self.time_constant else 0.0)
        inside = np.any([position > lowest for position, _ in moved], axis=0)
        if self.is_unfiltered:
            rows = np.flatnonzero(inside & self.is_used[:-1] if only_used else inside)
        else:
            rows = pack_rows(inside.reshape(self.readings.force.shape), self.memory)
        gathered = [(position[rows], rate[rows]) for position, rate in moved]
        if not self.is_unfiltered:
            for position, _ in gathered:
                position[rows < 0] = -np.inf
        return [self._move_surface(rows, *motion, planes) for motion in gathered]

    def _move_surface(self, rows, position, rate, planes: np.ndarray) -> NearbyRows:
        """Compute depth and regressors of `rows` for each of the surface positions `planes` [m]."""
        depth = np.maximum(position - planes[:, None], 0.0)
        return NearbyRows(rows, position, depth, rate, self._tabulate(depth, rate, rows))

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
        """Flag the rows below the surface, except those in which the law's force would not be positive."""
        inside = near.depth > 0.0
        if coefficients is None or self.law.pulls or not self.damping_indices:
            return inside
        pushing = inside & (compute_force(coefficients, near.columns) > 0.0)
        # If the measured force has the wrong sign, the fitted law pulls in most rows. These rows remain in
        # contact, so that the fit reveals the wrong sign.
        sound = 2 * pushing.sum(axis=1) > inside.sum(axis=1)
        return np.where(sound[:, None], pushing, inside)

    def _find_onsets(self, near: NearbyRows, moved: Motion, planes: np.ndarray) -> Onsets | None:
        """Find the onsets of contact, which lie between two rows; return None if the sensor has no lag."""
        if self.time_constant == 0.0:
            return None
        (now, _), (half, _) = moved
        before = near.rows - self.readings.force.shape[1]
        last = np.where(before >= 0, now[before], near.position)
        plane, row = np.nonzero((last <= planes[:, None]) & (near.position > planes[:, None]))
        left = compute_onset_shares(last[row], half[near.rows[row]], near.position[row], planes[plane])
        columns = self._tabulate(np.zeros((1, len(row))), near.rate[row], near.rows[row])[0]
        return Onsets(plane, row, columns, left)

    def _filter(self, rows, tables: list[np.ndarray], onsets: Onsets | None, first, whitening) -> np.ndarray:
        """Apply the sensor's filter and the whitening filter to the regressors in the rows near contact.

        Args:
            rows: The rows near contact, shape (rows,); -1 after the end of a lane.
            tables: Regressors in the rows near contact (0 out of contact): one array (surface positions,
                regressors, rows) per time in `self.periods_before` [periods before a row].
            onsets: Onsets of contact, or None if the sensor has no lag.
            first: Regressors just after the onsets, shape (regressors, onsets), or None.
            whitening: Coefficients of the whitening filter.
        """
        lost = (rows >= 0) & self.readings.lost.ravel()[rows]
        if onsets is None or not tables[0].size:
            return whiten(tables[0], whitening, lost)
        return apply_filter(self.readings.modes, self.filter_rate, tables, whitening, onsets, first, lost)

    def inside(self, delay: float, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the design matrix and the readings of a problem whose lanes are always in contact.

        The design has the shape (surface positions, coefficients, used rows), the readings (used rows,). The
        used rows are sorted by lane.
        """
        length, lanes = self.readings.force.shape
        rows = np.arange(length * lanes).reshape(length, lanes).T.ravel()
        tables = [
            self._tabulate(position[rows] - planes[:, None], rate[rows], rows)
            for position, rate in self.motion_at(delay)
        ]
        tables = [table.reshape(*table.shape[:2], lanes, length) for table in tables]
        whitening, lost = self.readings.whitening, self.readings.lost.T
        if self.time_constant:
            drive = apply_filter(self.readings.modes, self.filter_rate, tables, whitening, lost=lost)
            drive /= self.readings.std
        else:
            drive = whiten(tables[0] / self.readings.std, whitening, lost)
        used = self.is_used[rows]
        design = np.empty((len(planes), drive.shape[1] + 1, len(self.used_rows)))
        np.compress(used, drive.reshape(*drive.shape[:2], -1), axis=2, out=design[:, :-1])
        design[:, -1] = self.bias_column
        return design, self.whitened[rows[used]]

    def _build_design(
        self, near: list[NearbyRows], flags: list[np.ndarray], onsets: Onsets | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return design matrix (surface positions, coefficients, rows) and readings of rows near contact.

        Design matrix and readings are divided by the standard deviation of the noise.
        """
        std, rows, first = self.readings.std, near[0].rows, None
        # The last column belongs to the bias: 1 in all rows or, with a dead zone, only in rows in contact.
        if self.is_unfiltered:
            design = np.empty((len(flags[0]), near[0].columns.shape[1] + 1, len(rows)))
            np.multiply(near[0].columns, flags[0][:, None] / std, out=design[:, :-1])
            design[:, -1] = flags[0] / std if self.has_dead_zone else 1.0 / std
            return design, self.whitened[rows]
        tables = [part.columns * (flag[:, None] / std) for part, flag in zip(near, flags, strict=True)]
        if onsets is not None:
            first = onsets.columns * flags[0][onsets.plane, onsets.row] / std
        used = self.is_used[rows]
        design = np.compress(used, self._filter(rows, tables, onsets, first, self.readings.whitening), axis=2)
        # Bias and dead zone act on the filtered force. Fits use only readings beyond a dead zone.
        bias = np.full((len(design), 1, design.shape[2]), self.bias_column)
        return np.concatenate([design, bias], axis=1), self.whitened[rows[used]]

    def _solve(self, near, flags, onsets, pseudo: PseudoRows | None) -> LeastSquaresFit:
        """Fit the coefficients at each surface position; `flags` marks the rows of `near` in contact."""
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
        planes, now = plane + STEP * np.array([1.0, -1.0]), near[0]
        if self.time_constant:
            shifted = [self._move_surface(now.rows, part.position, part.rate, planes) for part in near]
            repeated = np.repeat(coefficients[None], 2, axis=0)
            flags = [self._flag_rows_in_contact(part, repeated) for part in shifted]
            onsets = self._find_onsets(shifted[0], self.motion_at(delay), planes)
            high, low = self._predict(shifted, flags, onsets, coefficients, self.readings.whitening)
            return (high - low)[self.is_used[now.rows]] / scale
        up, down = (
            compute_force(coefficients, self._tabulate(np.maximum(now.depth + d, 0.0), now.rate, now.rows))
            for d in (STEP, -STEP)
        )
        table = ((down - up) * flag / scale)[:, None]
        if self.is_unfiltered:
            return table[0, 0]
        table = self._filter(now.rows, [table], None, None, self.readings.whitening)
        return table[0, 0, self.is_used[now.rows]]

    def force(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Return the predicted force readings [N], including the bias, shape (rows, lanes)."""
        moved, planes = self.motion_at(delay), np.array([plane])
        near = self._find_nearby_rows(moved, planes, False)
        flags = [self._flag_rows_in_contact(part, coefficients[None]) for part in near]
        onsets = self._find_onsets(near[0], moved, planes)
        force, rows = np.zeros(self.readings.force.size), near[0].rows
        values = self._predict(near, flags, onsets, coefficients, (1.0,))[0]
        force[rows[rows >= 0]] = values[rows >= 0]
        force = force.reshape(self.readings.force.shape)
        return force if self.has_dead_zone else force + coefficients[-1]

    def compute_edge_residuals(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Return the residuals of the readings just before and after onsets, without sensor lag.

        They are divided by the standard deviation of the noise. They are large if a row that is in contact
        counts as out of contact, or the reverse.
        """
        ((position, rate),) = self.motion_at(delay)
        lanes = self.readings.force.shape[1]
        after = lanes + np.flatnonzero((position[lanes:] > plane) & (position[:-lanes] <= plane))
        columns = self._tabulate(position[after][None] - plane, rate[after], after)
        residuals = self.whitened - self.bias_alone * coefficients[-1]
        after_residuals = residuals[after] - compute_force(coefficients[None], columns)[0] / self.readings.std
        used = self.is_used[after] & self.is_used[after - lanes]
        return np.concatenate([residuals[after - lanes][used], after_residuals[used]])

    def _predict(self, near, flags, onsets, coefficients, whitening) -> np.ndarray:
        """Predict whitened readings [N], (surface positions, rows), without a bias that all rows share."""
        first = None
        tables = [
            (compute_force(coefficients, part.columns) * flag)[:, None]
            for part, flag in zip(near, flags, strict=True)
        ]
        if onsets is not None:
            first = coefficients[:-1] @ onsets.columns * flags[0][onsets.plane, onsets.row]
        force = self._filter(near[0].rows, tables, onsets, first, whitening)[:, 0]
        if not self.has_dead_zone:
            return force
        offset = coefficients[-1]
        # After the release, the filtered force decays until the dead zone hides it.
        is_visible = force > max(-offset, 0.0) if self.time_constant else flags[0]
        return force + offset * is_visible

    def touching(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Return flags of the rows that are in contact according to the model, shape (rows, lanes)."""
        position, rate = self.motion.at(delay)
        moved = [(position.ravel(), rate.ravel())]
        (near,) = self._find_nearby_rows(moved, np.array([plane]), False)
        (flag,) = self._flag_rows_in_contact(near, coefficients[None])
        flags = np.zeros(self.readings.force.size, bool)
        flags[near.rows[near.rows >= 0]] = flag[near.rows >= 0]
        return flags.reshape(self.readings.force.shape)
