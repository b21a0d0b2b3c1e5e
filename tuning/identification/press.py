"""Surface position of a press that never leaves the contact, from the force sensor's bias.

Within such a contact, a bias b and a surface that is further away by b / K have the same readings. A run at
rest or in free motion determines the bias. Without one the surface is not observable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxhil.errors import InputError, one_line
from tuning.identification.motion import Motion
from tuning.identification.noise import Noise
from tuning.identification.records import Run

USUAL_DELAY = 0.005  # s, typical delay of a force sensor, accurate enough to detect a release
LOWEST = 0.01  # share of the least deep rows, at which a press may leave the contact
FEWEST = 20  # rows for a mean
LEFT = 0.2  # share of the range of the force above the line through deeper readings: release
LASTING = 0.1  # least standard deviation of the bias from run to run, over the noise


def known_bias(
    runs: Sequence[Run], motion: Motion, noise: Noise | None, plane: float | None
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
    if plane is not None or any(run.kind != "press" for run in runs) or _leaves(runs, motion):
        return None
    if noise is None:
        names = ", ".join(dict.fromkeys(one_line(run.source) for run in runs))
        raise InputError(
            f"{names}: force_measured: found a press that never leaves the contact, which does not tell the "
            "sensor's bias from the surface's place, expected touches, or a run of kind rest or free with "
            "this channel, or --fix rig.contact_plane=..."
        )
    return noise.mean, float(np.hypot(np.hypot(noise.mean_std, noise.drift), LASTING * noise.std))


def first_plane(
    position: np.ndarray, force: np.ndarray, counts: np.ndarray, bias: tuple[float, float]
) -> float | None:
    """Return the position [m] at which the line through the forces of a press equals the bias.

    Returns None if the line does not rise.
    """
    x, f = position[counts], force[counts] - bias[0]
    slope, at_zero = _line(x, f)
    return -at_zero / slope if slope > 0.0 else None


def _leaves(runs: Sequence[Run], motion: Motion) -> bool:
    """Return whether the least deep readings lie above the line through deeper ones: a release."""
    position, _ = motion.at(USUAL_DELAY)
    x, f = [], []
    for lane, run in enumerate(runs):
        force = np.asarray(run.force_measured, float)
        good = run.valid & np.isfinite(force)
        x.append(position[: len(force), lane][good])
        f.append(force[good])
    x, f = np.concatenate(x), np.concatenate(f)
    if len(x) < 2 * FEWEST:
        return False
    deep = x >= np.median(x)
    slope, at_zero = _line(x[deep], f[deep])
    lowest = np.argsort(x)[: max(FEWEST, round(LOWEST * len(x)))]
    above = float(np.mean(f[lowest] - slope * x[lowest] - at_zero))
    return above > LEFT * float(np.ptp(f))


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return slope and value at 0 of the least-squares line through points."""
    away = x - np.mean(x)
    power = float(away @ away)
    slope = float(away @ y) / power if power else 0.0
    return slope, float(np.mean(y)) - slope * float(np.mean(x))
