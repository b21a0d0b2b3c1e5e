"""Force readings of all runs in contact, in arrays with one lane (column) per run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.signal import lfilter

from jaxhil.mechanism.sensor_filter import FilterModes, find_modes
from jaxhil.mechanism.structs import SensorFilter
from tuning.identification.drifting_noise import LONG_FILTER
from tuning.identification.records import LoggedRun


@dataclass(frozen=True)
class ForceReadings:
    """Force readings of all runs in contact and their noise.

    Arrays have the shape (rows, lanes), with one run per lane; shorter runs are padded.
    """

    force: np.ndarray  # force reading [N]; 0 if it is missing
    counts: np.ndarray  # bool, whether fits use the reading
    entry: np.ndarray  # int, index into the lists in `[contact]`
    entries: tuple[int, ...]  # indices that occur in `entry`
    std: float  # standard deviation of the noise after whitening [N]
    whitening: tuple[float, ...] = (1.0,)  # coefficients of the filter that whitens the noise
    threshold: float = 0.0  # smallest predicted force of a used reading [N]; a dead zone affects smaller ones
    bias: tuple[float, float] | None = None  # prior mean and standard deviation of the sensor's bias [N]
    subtracted: float = 0.0  # specified size of a continuous dead zone that hides the noise [N]
    zone: float = 0.0  # largest possible size of a cut dead zone [N]; 0 if the dead zone is not cut
    is_valid: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))  # whether a reading exists
    bias_step: float = 0.0  # standard deviation of the change of the bias between two rows [N]
    low_pass: SensorFilter | None = None  # filter of the sensor in the prior, or None

    @classmethod
    def of(
        cls, runs: Sequence[LoggedRun], std: float, whitening=(1.0,), threshold: float = 0.0
    ) -> ForceReadings:
        """Collect the readings of runs in arrays.

        Args:
            runs: Runs with a measured force.
            std: Standard deviation of the noise after whitening [N].
            whitening: Coefficients of the whitening filter.
            threshold: Smallest predicted force [N] at which a reading is used.
        """
        rows = max(len(run.tick) for run in runs)

        def padded(values, fill, kind):
            table = np.full((rows, len(runs)), fill, kind)
            for lane, value in enumerate(values):
                table[: len(value), lane] = value
            return table

        forces = [np.asarray(run.force_measured, float) for run in runs]
        valid = [run.valid & np.isfinite(force) for run, force in zip(runs, forces, strict=True)]
        counts = is_valid = padded(valid, False, bool)
        force = padded([np.nan_to_num(force_column) for force_column in forces], 0.0, float)
        entry = padded([_assign_contact_entries(run) for run in runs], 0, int)
        if len(whitening) > LONG_FILTER:
            # The filter skips lost readings.
            counts = counts & (np.cumsum(counts, axis=0) >= len(whitening))
        elif len(whitening) > 1:
            # A reading is used only if all readings that the filter combines with it are valid.
            gap: Any = lfilter(np.ones(len(whitening)), [1.0], ~counts, axis=0)
            counts = counts & (gap < 0.5)
            counts[: len(whitening) - 1] = False
        entries = tuple(int(number) for number in np.unique(entry[counts])) or (0,)
        return cls(force, counts, entry, entries, std, tuple(whitening), threshold, is_valid=is_valid)

    @cached_property
    def lost(self) -> np.ndarray:
        """Return flags of the missing readings that others follow, shape (rows, lanes)."""
        followed = np.maximum.accumulate(self.is_valid[::-1], axis=0)[::-1]
        return followed & ~self.is_valid

    @property
    def filter_length(self) -> int:
        """Return the largest number of rows that the whitening filter combines, with lost ones it skips."""
        length = len(self.whitening)
        if length <= LONG_FILTER:
            return length
        valid_rows = [np.flatnonzero(valid) for valid in self.is_valid.T]
        return max(int(np.max(rows[length:] - rows[:-length], initial=length)) for rows in valid_rows)

    @property
    def modes(self) -> FilterModes:
        """Return the modes of the prior's sensor filter or, without one, those of a first-order lag."""
        kind, order = (
            ("butterworth", 1) if self.low_pass is None else (self.low_pass.kind, self.low_pass.order)
        )
        return find_modes(kind, order)

    @property
    def time_constant(self) -> float:
        """Return the inverse of the prior's angular cutoff frequency [s]; 0 if the prior has no filter."""
        return 0.0 if self.low_pass is None else 0.5 / (np.pi * self.low_pass.cutoff)

    def select_lanes(self, lanes: np.ndarray, begin: int = 0) -> ForceReadings:
        """Return the readings of `lanes` (indices, which may repeat), without the rows before `begin`."""
        names = ("force", "counts", "entry", "is_valid")
        return replace(self, **{name: getattr(self, name)[begin:, lanes] for name in names})


def _assign_contact_entries(run: LoggedRun) -> np.ndarray:
    """Return, for each row, its index into the parameter lists of the mechanism file's `[contact]`.

    Rows out of contact get the index of the previous contact. Rows before the first contact get the index of
    the first contact.
    """
    index = np.full(len(run.tick), -1) if run.contact_index is None else run.contact_index
    if not np.any(index >= 0):
        return np.zeros(len(run.tick), int)
    last = np.maximum.accumulate(np.where(index >= 0, np.arange(len(index)), -1))
    return np.where(last >= 0, index[last], index[np.argmax(index >= 0)])
