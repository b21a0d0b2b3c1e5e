"""Surface position from the bias of the force sensor, for press runs that never leave the contact.

In such a run (slow motion while pressed against the surface), a bias b has the same effect on the readings as
a surface that is closer by b / K, where K is the stiffness. The surface position is therefore observable only
if a run at rest or in free motion determines the bias.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxhil.errors import InputError, to_one_line
from tuning.identification.motion import MotionResponse
from tuning.identification.noise import NoiseEstimate
from tuning.identification.records import LoggedRun

TYPICAL_FORCE_DELAY = 0.005  # assumed delay of the force sensor [s]; accurate enough to detect a release
SHALLOW_ROW_SHARE = 0.01  # share of the rows, those with the smallest depth, that may be out of contact
MIN_MEAN_ROWS = 20  # minimum number of rows for a mean
# Minimum excess of the force at small depths above the line through deeper readings that shows a release, as
# a share of the range of the force.
RELEASE_FORCE_SHARE = 0.2
MIN_BIAS_STD_RATIO = 0.1  # minimum standard deviation of the bias between runs, as a share of the noise


def find_bias_prior(
    runs: Sequence[LoggedRun], motion: MotionResponse, noise: NoiseEstimate | None, plane: float | None
) -> tuple[float, float] | None:
    """Return a prior of the force sensor's bias if the runs in contact cannot determine the bias.

    Args:
        runs: Runs in contact.
        motion: Motion of the mechanism in these runs.
        noise: Noise of the force sensor at rest, if it was measured.
        plane: Position of the surface [m], if it is specified.

    Returns:
        Mean and standard deviation of the bias [N]; or None if the readings determine the bias, because a run
        leaves the contact or the surface is specified.

    Raises:
        InputError: If neither the runs in contact nor readings at rest determine the bias.
    """
    if plane is not None or any(run.kind != "press" for run in runs) or _has_release(runs, motion):
        return None
    if noise is None:
        names = ", ".join(dict.fromkeys(to_one_line(run.source) for run in runs))
        raise InputError(
            f"{names}: force_measured: found only a press run that stays in contact throughout, which cannot "
            "separate the sensor's bias from the surface position; expected one of: logs with further "
            "contacts; a rest or free run with force_measured; or --fix rig.contact_plane=..."
        )
    return noise.mean, float(np.hypot(np.hypot(noise.mean_std, noise.drift), MIN_BIAS_STD_RATIO * noise.std))


def find_surface_of_press(
    position: np.ndarray, force: np.ndarray, counts: np.ndarray, bias: tuple[float, float]
) -> float | None:
    """Return the position [m] where a line fitted to force against position equals the bias.

    In the press runs of these readings, the simulator presses the mechanism in. Returns None if the force
    does not increase with the position.
    """
    x, f = position[counts], force[counts] - bias[0]
    slope, at_zero = _fit_line(x, f)
    return -at_zero / slope if slope > 0.0 else None


def _has_release(runs: Sequence[LoggedRun], motion: MotionResponse) -> bool:
    """Return whether press runs leave the contact: shallow readings then exceed a line through deep ones."""
    position, _ = motion.at(TYPICAL_FORCE_DELAY)
    x, f = [], []
    for lane, run in enumerate(runs):
        force = np.asarray(run.force_measured, float)
        good = run.valid & np.isfinite(force)
        x.append(position[: len(force), lane][good])
        f.append(force[good])
    x, f = np.concatenate(x), np.concatenate(f)
    if len(x) < 2 * MIN_MEAN_ROWS:
        return False
    deep = x >= np.median(x)
    slope, at_zero = _fit_line(x[deep], f[deep])
    lowest = np.argsort(x)[: max(MIN_MEAN_ROWS, round(SHALLOW_ROW_SHARE * len(x)))]
    above = float(np.mean(f[lowest] - slope * x[lowest] - at_zero))
    return above > RELEASE_FORCE_SHARE * float(np.ptp(f))


def _fit_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return slope and intercept (value at x = 0) of the least-squares line through the points (x, y)."""
    away = x - np.mean(x)
    power = float(away @ away)
    slope = float(away @ y) / power if power else 0.0
    return slope, float(np.mean(y)) - slope * float(np.mean(x))
