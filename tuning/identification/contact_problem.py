"""The linear fit of a contact law at one delay and plane, over known motion.

Where the mechanism was is known from the commands (`motion`), so with the force delay and the plane given
the law is linear in its coefficients: stiffness, damping, the sensor's bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import special
from scipy.signal import lfilter

from tuning.identification.contact_laws import Law
from tuning.identification.motion import Motion
from tuning.identification.records import Run

STEPS = 6  # of Newton's for the plane
CLOSE = 2.0  # gain of log likelihood below which a step more is not taken


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
    slope: float  # of misfit / 2 by the plane
    curvature: float  # of misfit / 2 by the plane, all else fitted


class Problem:
    """Forces, the motion under them and a law; `plane` is told or None.

    Rows out of contact say something of the bias alone: white noise given, three sums stand for all of them,
    and the law's functions are computed where the mechanism is in contact. With a lag of the sensor [s] or
    coloured noise every function is filtered along the rows as the force is."""

    def __init__(
        self, motion: Motion, readings: Readings, law: Law, plane: float | None, time_constant: float = 0.0
    ):
        self.motion, self.readings, self.law, self.plane = motion, readings, law, plane
        self.time_constant = time_constant
        self.plain = len(readings.whitening) == 1 and time_constant == 0.0
        self.kept = np.flatnonzero(readings.counts)
        # Filters need the rows between those that count.
        self.where = self.kept if self.plain else np.arange(readings.counts.size)
        self.entry = readings.entry.ravel()[self.where]
        self.target = self.whiten(readings.force).ravel()[self.kept] / readings.std
        self.rate_like = [i for i, name in enumerate(self.names) if name.startswith("damping")]
        # A dead zone takes its share of every reading beyond it; a bias is in every reading.
        self.local = bool(readings.threshold)
        self.sums = (
            len(self.kept) / readings.std**2,
            self.target.sum() / readings.std,
            self.target @ self.target,
        )
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
        if len(self.readings.whitening) == 1:
            return values
        filtered: Any = lfilter(self.readings.whitening, [1.0], values, axis=-2)
        return filtered

    def at(self, delay: float, plane: float) -> Inner:
        """Fit the coefficients; rows where the law would pull count as out of contact."""
        moved = self._moved(delay)
        touching = [self._touching(one, plane, self._guess) for one in moved]
        fit = self._solve(moved, plane, touching)
        for _ in range(2):
            again = [self._touching(one, plane, fit[0]) for one in moved]
            if all(np.array_equal(one, other) for one, other in zip(again, touching, strict=True)):
                break
            touching = again
            fit = self._solve(moved, plane, touching)
        coefficients, covariance, misfit, by_row = fit
        self._guess = coefficients
        slope = curvature = 0.0
        if self.plane is None:
            slope, curvature = self._by_plane(coefficients, covariance, moved, plane, touching, by_row)
        allowed = 0.0
        for i in self.rate_like:
            allowed += float(special.log_ndtr(coefficients[i] / np.sqrt(covariance[i, i])))
        evidence = -0.5 * misfit + 0.5 * float(np.linalg.slogdet(covariance)[1]) + allowed
        return Inner(coefficients, covariance, misfit, evidence, slope, curvature)

    def _moved(self, delay: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Position and rate at the rows of `where`, for each part of a period before them."""
        if self._at is None or self._at[0] != delay:
            moved = [self.motion.at(delay + part * self.motion.period) for part in self.before]
            self._at = delay, [(x.ravel()[self.where], v.ravel()[self.where]) for x, v in moved]
        return self._at[1]

    def _columns(self, depth: np.ndarray, rate: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """The law's functions at rows in contact, one per coefficient but the bias."""
        own, entries = self.law.own(depth, rate), self.readings.entries
        if len(entries) > 1:
            entry = self.entry[rows]
            own = [np.where(entry == i, value, 0.0) for i in entries for value in own]
        return np.array([*own, *self.law.shared(depth, rate)])

    def _touching(self, moved, plane: float, coefficients: np.ndarray | None) -> np.ndarray:
        """Rows in contact, without those where the law with these coefficients would pull."""
        position, rate = moved
        rows = np.flatnonzero(position > plane)
        if coefficients is None or self.law.pulls or not self.rate_like:
            return rows
        pushing = rows[coefficients[:-1] @ self._columns(position[rows] - plane, rate[rows], rows) > 0.0]
        # Where the force has the wrong sign the law pulls throughout, and is to be found so.
        return pushing if 2 * len(pushing) > len(rows) else rows

    def _filtered(self, parts: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Columns at their rows, for each part of a period, as the sensor gives them at every row."""
        shape, full = self.readings.force.shape, []
        for columns, rows in parts:
            table = np.zeros((len(columns), len(self.where)))
            table[:, rows] = columns
            full.append(table.reshape(len(columns), *shape))
        if self.time_constant == 0.0:
            return full[0]
        pole, (now, half, last) = lag_weights(self.motion.period / self.time_constant)
        drive = now * full[0] + half * full[1]
        drive[:, 1:] += last * full[0][:, :-1]
        lagged: Any = lfilter([1.0], [1.0, -pole], drive, axis=-2)
        return lagged

    def _design(self, parts: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Columns over the noise: at their rows, or at all that count where they are filtered."""
        if self.plain:
            return parts[0][0] / self.readings.std
        full = self.whiten(self._filtered(parts))
        return full.reshape(len(full), -1)[:, self.kept] / self.readings.std

    def _solve(self, moved, plane: float, touching):
        """Coefficients, their covariance, the misfit, and residuals with the design at its rows."""
        parts = []
        for (position, rate), rows in zip(moved, touching, strict=True):
            columns = self._columns(position[rows] - plane, rate[rows], rows)
            parts.append(
                (np.concatenate([columns, np.ones((1, len(rows)))]) if self.local else columns, rows)
            )
        design = self._design(parts)
        target = self.target[touching[0]] if self.plain else self.target
        if not self.local:
            shift = float(np.sum(self.readings.whitening)) / self.readings.std
            design = np.concatenate([design, np.full((1, design.shape[1]), shift)])
        normal, right = design @ design.T, design @ target
        summed = self.plain and not self.local
        if summed:
            normal[-1, -1], right[-1] = self.sums[:2]
        size = np.sqrt(np.maximum(np.diag(normal), 1e-60))
        scaled = normal / np.outer(size, size) + 1e-13 * np.eye(len(size))
        covariance = np.linalg.inv(scaled) / np.outer(size, size)
        coefficients = covariance @ right
        residual = coefficients @ design - target
        misfit = residual @ residual
        if self.plain:
            # Rows out of contact have the bias as their residual.
            bias = coefficients[-1] if summed else 0.0
            misfit += self.sums[2] - target @ target
            misfit += bias**2 * (self.sums[0] - len(target) / self.readings.std**2)
            misfit -= 2.0 * bias * (self.sums[1] - target.sum() / self.readings.std)
        return coefficients, covariance, float(misfit), (residual, design)

    def _by_plane(self, coefficients, covariance, moved, plane, touching, by_row) -> tuple[float, float]:
        """Slope and curvature of half the misfit by the plane, all else fitted."""
        step, parts = 1e-7, []
        for (position, rate), rows in zip(moved, touching, strict=True):
            depth = position[rows] - plane
            up, down = (self._columns(np.maximum(depth + d, 0.0), rate[rows], rows) for d in (step, -step))
            parts.append(((coefficients[:-1] @ (down - up))[None] / (2.0 * step), rows))
        slope = self._design(parts)[0]
        residual, design = by_row
        across = design @ slope
        return float(residual @ slope), float(slope @ slope - across @ covariance @ across)

    def force(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """The readings the law predicts [N], the bias included, (rows, lanes)."""
        full = Problem.__new__(Problem)
        full.__dict__ |= self.__dict__ | {"where": np.arange(self.readings.force.size), "_at": None}
        full.entry = self.readings.entry.ravel()
        parts = []
        for moved in full._moved(delay):
            rows = full._touching(moved, plane, coefficients)
            columns = full._columns(moved[0][rows] - plane, moved[1][rows], rows)
            parts.append(((coefficients[:-1] @ columns + self.local * coefficients[-1])[None], rows))
        return full._filtered(parts)[0] + (0.0 if self.local else coefficients[-1])

    def touching(self, delay: float, plane: float, coefficients: np.ndarray) -> np.ndarray:
        """Whether each row is in contact by the model, (rows, lanes)."""
        position, rate = self.motion.at(delay)
        entry, self.entry = self.entry, self.readings.entry.ravel()
        flags = np.zeros(position.size, bool)
        flags[self._touching((position.ravel(), rate.ravel()), plane, coefficients)] = True
        self.entry = entry
        return flags.reshape(position.shape)

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


def lag_weights(rate: float) -> tuple[float, tuple[float, float, float]]:
    """A first-order lag over one period: what it keeps of itself, and the weights of the force at the end,
    the middle and the beginning of the period; exact where the force is a parabola. `rate`: period over the
    time constant."""
    pole = float(np.exp(-rate))
    # Moments of rate exp(-(1 - s) rate) over s = 0..1.
    first = 1.0 - pole
    second = 1.0 - first / rate
    third = 1.0 - 2.0 * second / rate
    last, half, now = np.linalg.solve(
        [[1.0, 1.0, 1.0], [0.0, 0.5, 1.0], [0.0, 0.25, 1.0]], [first, second, third]
    )
    return pole, (float(now), float(half), float(last))
