"""Surface position of a press that never leaves the contact, from the force sensor's bias.

Within such a contact, a bias b and a surface that is further away by b / K have the same readings. A run at
rest or in free motion determines the bias. Without one the surface is not observable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxhil.errors import InputError, to_one_line
from tuning.identification.motion import MotionResponse
from tuning.identification.noise import SensorNoise
from tuning.identification.records import LoggedRun

TYPICAL_FORCE_DELAY = 0.005  # s, typical delay of a force sensor, accurate enough to detect a release
SHALLOW_ROW_SHARE = 0.01  # share of the least deep rows, at which a press may leave the contact
MIN_MEAN_ROWS = 20  # rows for a mean
RELEASE_FORCE_SHARE = 0.2  # share of the range of the force above the line through deeper readings: release
MIN_BIAS_STD_RATIO = 0.1  # least standard deviation of the bias from run to run, over the noise


def find_bias_prior(
    runs: Sequence[LoggedRun], motion: MotionResponse, noise: SensorNoise | None, plane: float | None
) -> tuple[float, float] | None:
    """Return the bias of the force sensor and its standard deviation [N] if the runs cannot determine it.

    Args:
        runs: Runs in contact.
        motion: Motion of the mechanism in these runs.
        noise: Noise of the force sensor at rest, if it was measured.
        plane: Position of the surface [m], if it is specified.

    Returns:
        None if a run leaves the contact or the surface is specified; the readings then determine the bias.

    Raises:
        InputError: If neither the runs nor readings at rest determine the bias.
    """
    if plane is not None or any(run.kind != "press" for run in runs) or _has_release(runs, motion):
        return None
    if noise is None:
        names = ", ".join(dict.fromkeys(to_one_line(run.source) for run in runs))
        raise InputError(
            f"{names}: force_measured: found a press that never leaves the contact, which does not tell the "
            "sensor's bias from the surface's place, expected touches, or a run of kind rest or free with "
            "this channel, or --fix rig.contact_plane=..."
        )
    return noise.mean, float(np.hypot(np.hypot(noise.mean_std, noise.drift), MIN_BIAS_STD_RATIO * noise.std))


def find_surface_of_press(
    position: np.ndarray, force: np.ndarray, counts: np.ndarray, bias: tuple[float, float]
) -> float | None:
    """Return the position [m] at which the line through the forces of a press equals the bias.

    Returns None if the line does not rise.
    """
    x, f = position[counts], force[counts] - bias[0]
    slope, at_zero = _fit_line(x, f)
    return -at_zero / slope if slope > 0.0 else None


def _has_release(runs: Sequence[LoggedRun], motion: MotionResponse) -> bool:
    """Return whether the least deep readings lie above the line through deeper ones: a release."""
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
    """Return slope and value at 0 of the least-squares line through points."""
    away = x - np.mean(x)
    power = float(away @ away)
    slope = float(away @ y) / power if power else 0.0
    return slope, float(np.mean(y)) - slope * float(np.mean(x))
