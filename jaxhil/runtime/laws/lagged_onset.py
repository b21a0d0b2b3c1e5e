"""Where a surface was met if the force sensor lags.

Since the surface was met, s ago, contact pushes with B + K s; through a sensor that lags by l that is read as
B g + K (s - l g), g = 1 - exp(-s/l), and looks as if it were met later. Of each lag, PLACES places from
l + BEFORE ticks before where it was met by the readings alone until AFTER ticks behind that are tried, with
B ~ N(0, 1) and K as the onset has it: the likelihood of the readings has a closed form in five sums over
them. Depths in s, forces in 1/s.
"""

from math import inf, nan, sqrt

from .history import History
from .onset import SQUARINGS, STIFFNESS, STIFFNESS_VARIANCE, exponential
from .reintegration import Scales

WINDOW = 40  # newest readings that count
PLACES = 8
BEFORE, AFTER = 3.0, 1.0  # ticks
DAMPING_VARIANCE = 1.0  # of B [1/s^2]
# Of a map that has its surface elsewhere than where it was met, the preload is as uncertain as this share of
# the most that the stiffness may be makes it, and the knots are moved by up to FARTHEST [s], from the depth
# WHOLE [s] on wholly, before it less: all maps bend at the same places.
USUAL = 0.5
FARTHEST, WHOLE = 0.004, 0.015


def lagged_onset(
    lag: float, depths: list[float], forces: list[float], variance: float, tick: float
) -> tuple[float, float]:
    """The mean [s] and the variance [s^2] of the place, from readings at depths beyond where the surface was
    met by them alone; the forces' variance [1/s^2], a tick [s]. NaN where that takes too large numbers."""
    first = lag + BEFORE * tick
    width = first + AFTER * tick
    places = [width * (float(j) / float(PLACES - 1)) - first for j in range(PLACES)]
    found = [_evidence(lag, place, depths, forces, variance) for place in places]
    most = -inf
    for explained, _ in found:
        most = explained if explained > most else most
    total = once = twice = 0.0
    for place, (explained, determinant) in zip(places, found, strict=True):
        likely = exponential(most - explained, SQUARINGS) / sqrt(determinant) if determinant > 0.0 else nan
        total += likely
        once += likely * place
        twice += likely * (place * place)
    mean = once / total
    step = width / float(PLACES - 1)
    return mean, twice / total - mean * mean + step * step / 12.0


def newest(history: History, scales: Scales, place: float) -> tuple[list[float], list[float]]:
    """The newest readings: depths [s] beyond the place [m] where a surface was met, and forces [1/s]."""
    depths = []
    forces = []
    for tick in range(max(0, history.newest - WINDOW + 1), history.newest + 1):
        force, shown = history.reading(tick)
        if shown:
            depths.append((scales.beyond(history.recall(tick).position) - place) / scales.length)
            forces.append(scales.force(force))
    return depths, forces


def _evidence(
    lag: float, place: float, depths: list[float], forces: list[float], variance: float
) -> tuple[float, float]:
    """ln of how likely the readings are, met at this place [s], but for sqrt of a determinant; that."""
    gg = b = qq = y = qy = 0.0
    for depth, force in zip(depths, forces, strict=True):
        s = depth - place
        if not s > 0.0:
            continue
        g = 1.0 - exponential(s / lag, SQUARINGS)
        q = s - lag * g
        weighted = g / variance
        weight = q / variance
        gg += weighted * g
        b += weighted * q
        qq += weight * q
        y += weighted * force
        qy += weight * force
    a = 1.0 / DAMPING_VARIANCE + gg
    c = 1.0 / STIFFNESS_VARIANCE + qq
    z = STIFFNESS / STIFFNESS_VARIANCE + qy
    determinant = a * c - b * b
    if not determinant > 0.0:
        return nan, determinant
    return 0.5 * ((c * y * y - 2.0 * (b * y * z) + a * z * z) / determinant), determinant
