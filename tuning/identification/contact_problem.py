"""Linear least-squares fit of a contact law at a given force delay and surface position."""

from __future__ import annotations

from dataclasses import replace

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
from tuning.identification.force_prediction import STEP, ForcePrediction
from tuning.identification.force_readings import ForceReadings
from tuning.identification.motion import MotionResponse
from tuning.identification.nearby_rows import NearbyRows, Onsets
from tuning.identification.sensor_filter import apply_filter

MAX_FORCE_DELAY = 0.02  # longest force delay in the search range of a fit [s]
COARSE_DELAY_STEP = 0.0005  # step between the delays of a first search [s]


class ContactProblem(ForcePrediction):
    """Least-squares problem: fit of a contact law to force readings, for a known motion of the mechanism.

    The surface position `plane` [m] is None if the fit estimates it. Readings out of contact depend only on
    the bias. The fit therefore needs only their number, sum and sum of squares, and computes the law's
    regressors only near contact. If the noise is coloured, regressors and readings are whitened.
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
        time_constant = readings.time_constant if time_constant is None else time_constant
        super().__init__(motion, readings, law, time_constant)
        self.plane = plane
        # The force delay is relative to the delay of the position sensor, so it may be negative.
        self.min_delay = -COARSE_DELAY_STEP * float(np.floor(max(motion.delay, 0.0) / COARSE_DELAY_STEP))
        self.used_rows = np.flatnonzero(readings.counts)
        self.whitened = self.whiten(readings.force).ravel() / readings.std
        self.target = self.whitened[self.used_rows]
        # Value of a reading out of contact for a bias of 1 N, whitened and divided by the noise's standard
        # deviation.
        self.bias_column = float(np.sum(readings.whitening)) / readings.std
        self.bias_alone = 0.0 if self.has_dead_zone else self.bias_column
        self.sums = sum_and_squares(self.target)
        self._guess: np.ndarray | None = None

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

    def onsets_between(self, delay: float, low: float, high: float) -> np.ndarray:
        """Return the surface positions [m] from `low` to `high` at which a row enters or leaves contact."""
        position, rate = self.motion_at(delay)[0]
        inside = (rate > 0.0) & (position > low) & (position < high)
        # A filter also needs the rows that fits do not use.
        return np.unique(position[inside & self.is_used[:-1] if self.is_unfiltered else inside])

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
