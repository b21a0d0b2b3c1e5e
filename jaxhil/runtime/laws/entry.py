"""How well the surface of each hypothesis goes with the readings about the tick in which it was met.

Near the entry a map expects f(x) = f_0 + K x at depth x, by its own surface, and has that surface where its
preload P is undone, at x = -P/K; of P, what is known of a true preload beforehand counts as one. Where a
surface was told, the place is the mean of both by how certain either is. Readings y_i at depths x_1 < x_2 <
.. about the tick: if the surface lies between x_(j-1) and x_j, those from j on are f(x_i), those before 0.
With L_j their likelihood, a hypothesis is as likely as sum_j L_j P(x_(j-1) < place < x_j). Where none of them
has its surface where the readings begin, as behind a lag, all are less likely, by the root of what the best
has of the greatest L_j: a root, as the likelihood of all other readings. In NumPy, all hypotheses at a time.
"""

from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from .contact_plane import Meeting
from .force_depth_map import DAMPING, FRICTION, PRELOAD
from .lagged_onset import USUAL
from .onset import SQUARINGS, exponential

TICKS_BESIDE = 4  # on either side of where the surface was met, whose readings count
MOST_BESIDE = 10  # of these, the first
APART, TICKS_APART = 3.0, 1.5  # standard deviations, and ticks, that it is from there at most
GENTLEST = 1.0  # 1/s^2: what has less of a slope tells of no place
NOT_THERE = 9.0  # times the variance of where the surface is expected: it is not there
UNLIKELY = 0.1  # that it is not, at least
LEAST_AGREED = 1e-12  # of the likelihood of the best: what is ruled out can come back
DENSITY_SQUARINGS = 8


class Readings(NamedTuple):
    """The newest readings as a contact is found, oldest first."""

    depths: list[float]  # beyond where the surface was met [s]
    forces: list[float]  # [1/s]
    variance: float  # of these [1/s^2]


class Entry(NamedTuple):
    """Where a contact was entered; of hypotheses one in each element, depths by its own surface."""

    depths: np.ndarray  # of the readings beside it, beyond where it was met [s]
    forces: np.ndarray  # [1/s]
    variance: float  # of these [1/s^2]
    farthest: float  # by how much it may lie elsewhere [s]
    deeper: np.ndarray  # depth at which it was met [s]
    told: np.ndarray  # depth at which it was told [s]
    known: float  # variance of that [s^2]
    preload: float  # spread of the preload by which a map finds its place [1/s]
    placed: float  # share of the preload's variance that this makes
    true: float  # variance of a true preload [1/s^2]
    between: float  # variance of the delays that a hypothesis stands for [s^2]
    level: float  # by how much the wider preload made the readings less likely

    @classmethod
    def of(
        cls,
        meeting: Meeting,
        readings: Readings,
        deeper: np.ndarray,
        places: np.ndarray,
        known: float,
        true: float,
        step: float,
    ) -> "Entry":
        """By hypotheses with their surfaces at these places, met so much deeper [m]; it is `known` so well
        where it was told [m^2], what a true preload may be [1/s^2], the step from delay to delay [s]."""
        length = meeting.speed / meeting.pace
        tick = meeting.tick
        spread = sqrt(meeting.variance) / length
        ticks = spread / tick * (spread / tick) - 1.0 / 12.0
        farthest = (APART * sqrt(ticks if ticks > 0.0 else 0.0) + TICKS_APART) * tick
        near = min(farthest, TICKS_BESIDE * tick)
        chosen = [i for i, depth in enumerate(readings.depths) if -near < depth < near][:MOST_BESIDE]
        preload = meeting.stiffness * farthest
        square = preload * preload
        return cls(
            np.array([readings.depths[i] for i in chosen]), np.array([readings.forces[i] for i in chosen]),
            readings.variance, farthest, deeper / length, -places / length, known / (length * length),
            preload, square / (square + true) if square > 0.0 else 1.0, true, step * step / 12.0,
            farthest / (USUAL * spread) if spread > 0.0 else 1.0,
        )  # fmt: skip


class Entered(NamedTuple):
    """By each hypothesis."""

    place: np.ndarray  # depth of the surface [s]
    likely: np.ndarray  # how likely it is


def agree(entry: Entry, estimate: np.ndarray, covariance: np.ndarray) -> Entered:
    """By maps of this mean (parameters, hypotheses) and covariance (parameters, parameters, hypotheses)."""
    slope = estimate[0]
    steep = slope > GENTLEST
    k = np.where(steep, slope, 1.0)
    own = -(estimate[PRELOAD] / k)
    square = (
        own * own * covariance[0, 0] + 2.0 * (own * covariance[0, PRELOAD]) + covariance[PRELOAD, PRELOAD]
    )
    variance = (entry.placed * entry.placed * square + entry.placed * entry.true) / (k * k)
    variance = np.where(variance > 0.0, variance, 0.0)
    own = entry.placed * own
    away = own - entry.told
    both = entry.known + variance
    gone = away * away / both
    elsewhere = gone > NOT_THERE
    there = exponential(0.5 * gone, DENSITY_SQUARINGS) * np.sqrt(entry.known / both)
    share = np.where(elsewhere, 0.0, variance / both)
    place = np.where(steep, own - share * away, 0.0)
    spread = np.sqrt(np.where(elsewhere, variance, variance * (entry.known / both)) + entry.between)
    began = _began(entry, estimate, covariance, place, np.where(spread > 0.0, spread, 1.0))
    there = np.where(steep, np.where(there > UNLIKELY, there, UNLIKELY), UNLIKELY)
    farthest = entry.farthest
    place = np.where(place > farthest, farthest, np.where(place < -farthest, -farthest, place))
    return Entered(place, entry.level * (began * there))


def _began(entry: Entry, estimate: np.ndarray, covariance: np.ndarray, place, spread) -> np.ndarray:
    """sum_j L_j P(x_(j-1) < place < x_j), in terms of the greatest, times the root of that over the greatest
    L_j."""
    number = len(entry.depths)
    if number == 0:
        return np.ones_like(place)
    depths = entry.depths[:, None] + entry.deeper
    k = estimate[0]
    jumps = estimate[PRELOAD] + estimate[DAMPING] + estimate[FRICTION]
    of_slope = covariance[0, 0]
    of_jumps = (
        covariance[PRELOAD, PRELOAD] + covariance[DAMPING, DAMPING] + 2.0 * covariance[DAMPING, PRELOAD]
    )
    of_both = covariance[0, PRELOAD] + covariance[0, DAMPING]
    uncertain = of_jumps + depths * (2.0 * of_both + depths * of_slope)
    precision = 1.0 / (entry.variance + np.where(uncertain > 0.0, uncertain, 0.0))
    forces = entry.forces[:, None]
    missed = forces - (jumps + k * depths)
    better = 0.5 * (forces * forces / entry.variance - missed * missed * precision)
    known = entry.variance * precision
    below = cumulative((depths - place) / spread)
    gained = np.zeros_like(depths[:1])
    one = np.ones_like(depths[:1])
    since = np.concatenate((np.add.accumulate(better[::-1], axis=0)[::-1], gained))
    sharpness = np.sqrt(np.concatenate((np.multiply.accumulate(known[::-1], axis=0)[::-1], one)))
    # None where the hardware went back.
    within = np.fmax(np.concatenate((below, one)) - np.concatenate((gained, below)), 0.0)
    each = exponential(np.maximum.reduce(since, axis=None) - since, SQUARINGS) * sharpness
    likely = np.add.accumulate(each * within, axis=0)[-1]
    best = np.maximum.reduce(likely)
    agreed = np.fmax(best / np.maximum.reduce(each, axis=None), LEAST_AGREED)
    return np.fmax(likely / best, LEAST_AGREED) * np.sqrt(agreed)


def cumulative(ratio: np.ndarray) -> np.ndarray:
    """Phi, the normal distribution, with Mills' ratio as in `force_depth_map.positive_mean`."""
    density = exponential(0.5 * (ratio * ratio), DENSITY_SQUARINGS)
    size = np.abs(ratio)
    mills = pi / ((pi - 1.0) * size + np.sqrt(size * size + 2.0 * pi))
    beyond = density * mills * (1.0 / sqrt(2.0 * pi))
    return np.where(ratio > 0.0, 1.0 - beyond, beyond)
