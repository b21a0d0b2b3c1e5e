"""Force readings of all runs in contact, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from tuning.identification.records import LoggedRun


@dataclass(frozen=True)
class ForceReadings:
    """Forces of all runs in contact, padded to arrays of shape (rows, lanes)."""

    force: np.ndarray  # N, 0 where a reading is missing
    counts: np.ndarray  # bool, rows that are used
    entry: np.ndarray  # int, entry of the contact lists
    entries: tuple[int, ...]  # entries of the contact lists that occur
    std: float  # N, standard deviation of the white noise
    whitening: tuple[float, ...] = (1.0,)  # coefficients of the filter that whitens the noise
    threshold: float = 0.0  # N, predicted forces below it are not used (a dead zone hides them)
    # N, bias of the sensor and its standard deviation, if runs at rest determine them
    bias: tuple[float, float] | None = None

    @classmethod
    def of(
        cls, runs: Sequence[LoggedRun], std: float, whitening=(1.0,), threshold: float = 0.0
    ) -> ForceReadings:
        """Return the readings of runs, padded to the longest one."""
        rows = max(len(run.tick) for run in runs)

        def padded(values, fill, kind):
            table = np.full((rows, len(runs)), fill, kind)
            for lane, value in enumerate(values):
                table[: len(value), lane] = value
            return table

        forces = [np.asarray(run.force_measured, float) for run in runs]
        valid = [run.valid & np.isfinite(force) for run, force in zip(runs, forces, strict=True)]
        counts = padded(valid, False, bool)
        force = padded([np.nan_to_num(force_column) for force_column in forces], 0.0, float)
        entry = padded([_assign_contact_entries(run) for run in runs], 0, int)
        if len(whitening) > 1:
            # A row is used if all rows that the filter needs are there.
            gap: Any = lfilter(np.ones(len(whitening)), [1.0], ~counts, axis=0)
            counts = counts & (gap < 0.5)
            counts[: len(whitening) - 1] = False
        entries = tuple(int(number) for number in np.unique(entry[counts])) or (0,)
        return cls(force, counts, entry, entries, std, tuple(whitening), threshold)

    def select_lanes(self, lanes: np.ndarray, begin: int = 0) -> ForceReadings:
        """Return the readings of the given lanes, each as often as it occurs, from row `begin` on."""
        force, counts, entry = (array[begin:, lanes] for array in (self.force, self.counts, self.entry))
        return replace(self, force=force, counts=counts, entry=entry)


def _assign_contact_entries(run: LoggedRun) -> np.ndarray:
    """Return the contact's entry for each row; rows out of contact have that of a neighbouring contact."""
    index = np.full(len(run.tick), -1) if run.contact_index is None else run.contact_index
    if not np.any(index >= 0):
        return np.zeros(len(run.tick), int)
    last = np.maximum.accumulate(np.where(index >= 0, np.arange(len(index)), -1))
    return np.where(last >= 0, index[last], index[np.argmax(index >= 0)])
