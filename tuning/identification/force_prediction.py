"""Prediction of force readings by a contact law, at a given force delay and surface position.

The logged commands determine the motion of the mechanism (`motion`). For a given force delay and surface
position ("plane"), the predicted force is a linear combination of the regressors of the contact law
(functions of depth and rate). The coefficients are stiffness, damping and the bias of the sensor.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from tuning.identification.contact_laws import Law
from tuning.identification.contact_regression import compute_force
from tuning.identification.drifting_noise import whiten
from tuning.identification.force_readings import ForceReadings
from tuning.identification.motion import MotionResponse
from tuning.identification.nearby_rows import NearbyRows, Onsets
from tuning.identification.packed_rows import pack_rows
from tuning.identification.sensor_filter import apply_filter, compute_onset_shares

STEP = 1e-7  # step of finite differences with respect to the surface position [m]
FILTER_MEMORY_TIME_CONSTANTS = 25.0  # time constants after which the response of a filter is below 1e-10
Motion = list[tuple[np.ndarray, np.ndarray]]  # position [m] and velocity [m/s] at several times


class ForcePrediction:
    """Prediction of the force readings for a known motion of the mechanism and a contact law.

    If the sensor has a lag or another filter (`time_constant` [s], the inverse of its angular cutoff
    frequency), the regressors of the law pass through the same filter.
    """

    def __init__(self, motion: MotionResponse, readings: ForceReadings, law: Law, time_constant: float):
        self.motion, self.readings, self.law, self.time_constant = motion, readings, law, time_constant
        self.is_unfiltered = len(readings.whitening) == 1 and time_constant == 0.0
        # The additional last entry serves the row index -1.
        self.is_used = np.append(readings.counts.ravel(), False)
        self.damping_indices = [i for i, name in enumerate(self.names) if name.startswith("damping")]
        # A dead zone changes only the readings in contact; a bias changes all readings.
        self.has_dead_zone = bool(readings.threshold)
        self.memory = readings.filter_length + int(
            np.ceil(FILTER_MEMORY_TIME_CONSTANTS * time_constant / motion.period / readings.modes.slowest)
        )
        # Times at which the force is computed, in periods before a row. A lag integrates the force between
        # two rows, so it also needs the force in the middle.
        self.periods_before = (0.0,) if time_constant == 0.0 else (0.0, 0.5)

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

    def touching(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Return flags of the rows that are in contact according to the model, shape (rows, lanes)."""
        position, rate = self.motion.at(delay)
        moved = [(position.ravel(), rate.ravel())]
        (near,) = self._find_nearby_rows(moved, np.array([plane]), False)
        (flag,) = self._flag_rows_in_contact(near, coefficients[None])
        flags = np.zeros(self.readings.force.size, bool)
        flags[near.rows[near.rows >= 0]] = flag[near.rows >= 0]
        return flags.reshape(self.readings.force.shape)

    def motion_at(self, delay: float) -> Motion:
        """Return position [m] and velocity [m/s] in all rows, once per time in `self.periods_before`."""
        moved = [self.motion.at(delay + part * self.motion.period) for part in self.periods_before]
        return [(position.ravel(), rate.ravel()) for position, rate in moved]

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Apply the whitening filter along the rows of an array (..., rows, lanes)."""
        lost = self.readings.lost.T
        return whiten(values.swapaxes(-1, -2), self.readings.whitening, lost).swapaxes(-1, -2)

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
