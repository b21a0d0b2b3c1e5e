"""Preparation of runs in contact for a fit: segments of long runs, and rows after gaps in the log."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tuning.identification.contact_problem import MAX_FORCE_DELAY
from tuning.identification.rational import MotionModel
from tuning.identification.records import LoggedRun

SETTLING_TIME = 0.5  # settling time that is assumed for a motion simulator [s]
SEGMENT_LENGTH = 1.0  # length of the segments of a long run [s]
SPEED_ROWS = 5  # a speed is the difference of two positions that are this many rows apart
MAX_SPEED_CHANGE = 0.01  # maximum relative change of the speed in a motion that counts as uniform


def split_long_run(run: LoggedRun, period: float) -> list[LoggedRun]:
    """Divide a long run into segments of about one second, so that all runs have a similar length.

    Each segment begins with additional rows, in which the motion simulator settles. Fits omit these rows.
    """
    settling, length = round(SETTLING_TIME / period), round(SEGMENT_LENGTH / period)
    if len(run.tick) <= settling + 2 * length:
        return [run]
    segments = []
    for begin in range(settling, len(run.tick), length):
        part = slice(begin - settling, min(begin + length, len(run.tick)))
        names = ("tick", "position_desired", "position_measured", "force_measured", "velocity_desired",
                 "force_command", "contact_index", "force_late")  # fmt: skip
        arrays = {name: None if getattr(run, name) is None else getattr(run, name)[part] for name in names}
        valid = run.valid[part].copy()
        valid[:settling] = False
        segments.append(replace(run, valid=valid, **arrays))
    return segments


def exclude_rows_after_gaps(runs: Sequence[LoggedRun], model: MotionModel, period: float) -> list[LoggedRun]:
    """Mark rows after a gap in the log as invalid while the lost commands can still affect the motion.

    The lost commands affect the motion for as long as the motion simulator's memory plus all delays. If a run
    begins in uniform motion, the motion is assumed to have been uniform during the gap, and all rows remain
    valid.
    """
    settling = int(np.ceil((model.memory + max(model.delay, 0.0) + MAX_FORCE_DELAY) / period))
    result, ends = [], {}
    for run in runs:
        lost = ends.get(run.source, run.tick[0]) + 1 < run.tick[0]
        ends[run.source] = int(run.tick[-1])
        if lost and not _is_uniform_motion(run.position_desired):
            run = replace(run, valid=run.valid & (np.arange(len(run.tick)) >= settling))
        result.append(run)
    return result


def _is_uniform_motion(position: np.ndarray) -> bool:
    """Return whether the speed is constant in the first rows of a run."""
    first, second = np.diff(position[: 2 * SPEED_ROWS + 1 : SPEED_ROWS])
    return bool(abs(second - first) <= MAX_SPEED_CHANGE * abs(first))
